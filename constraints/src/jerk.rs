//! The box of accelerations of a joint whose jerk is hard: position, velocity, acceleration and jerk hold at once, for ever.
//!
//! The state of such a joint is `(q, v, a)` with the acceleration `a` of the tick before. In a period the acceleration may change by
//! `D = J T`. Left alone, the joint brakes: with `B` its [`Dof::braking`] and
//!
//! ```text
//!     G(x) = T (x + (x - D)_+ + (x - 2 D)_+ + ...)         speed that a deceleration takes while it falls from x to 0
//!     c(v) = -sgn(v) min(B, G^-1(|v|))                     deceleration that falls to 0 just as the joint stands
//!     a'   = c(v) clamped to [a - D, a + D]
//! ```
//!
//! it comes to rest in whole periods, at zero acceleration, and does not overshoot standstill where the start does not force it to. The set of states
//! from which this very motion stays inside the limits is invariant: braking is always allowed. And the next accelerations that lead into the set are
//! an interval, because the brake keeps order: of two joints with `v1 <= v2` and `a1 <= a2` the first never gets ahead. (`c` falls and `v + T c(v)`
//! rises, so where the first has the larger acceleration it is at or below the curve `c` and the second at or above, and both stay there.) So the
//! highest position and velocity on the way rise with the next acceleration, and each end of the interval is one number, found by a search; its
//! result is checked before it is used.
//!
//! The set is that of braking trajectories in Kiemel and Kröger, "Learning robot trajectories subject to kinematic joint constraints" (ICRA 2021), in
//! whole control periods and for any number of physics steps in one. It ends at rest: it leaves out states from which a joint stops in front of its
//! limit but is then thrown back, because its acceleration cannot fall to zero in time.

use crate::viability::{Dof, Interval, Kind, Period};

/// Positions [rad or m] and velocities [rad/s or m/s] this far outside are inside.
const ROUNDING: f64 = 1e-10;

/// Steps of the search for an end of the interval.
const STEPS: usize = 60;

/// Share of a step of acceleration by which the brake meets its curve.
const MEETS: f64 = 1e-9;

/// How one joint brakes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Brake {
    period: Period,
    /// Largest change of acceleration in a period that it counts on D [rad/s² or m/s²].
    step: f64,
    /// Largest deceleration B [rad/s² or m/s²].
    most: f64,
}

impl Brake {
    /// Braking of `dof` with at most the deceleration `most`.
    pub(crate) fn new(dof: &Dof, most: f64, period: &Period) -> Brake {
        Brake { period: *period, step: dof.jerk.min(dof.braking_jerk) * period.dt, most }
    }

    /// Braking of `dof` with all it may count on.
    pub(crate) fn of(dof: &Dof, period: &Period) -> Brake {
        Brake::new(dof, Brake::most(dof), period)
    }

    /// The largest deceleration that `dof` may count on.
    pub(crate) fn most(dof: &Dof) -> f64 {
        dof.deceleration.min(dof.acceleration)
    }

    /// `x = G^-1(speed)` and the number `m` of whole steps in it: with `m D <= x < (m + 1) D`,
    /// `G(x) / T = (m + 1) x - D m (m + 1) / 2`.
    fn ramp(&self, speed: f64) -> (f64, f64) {
        let w = speed / self.period.dt;
        let m = (0.5 * ((1.0 + 8.0 * w / self.step).sqrt() - 1.0)).floor();
        ((w + 0.5 * self.step * m * (m + 1.0)) / (m + 1.0), m)
    }

    /// `c(v)`.
    pub(crate) fn curve(&self, v: f64) -> f64 {
        -v.signum() * self.ramp(v.abs()).0.min(self.most)
    }

    /// The acceleration of the next period of braking, after one at `before`.
    pub(crate) fn next(&self, v: f64, before: f64) -> f64 {
        self.curve(v).clamp(before - self.step, before + self.step)
    }

    /// The whole motion to rest after a period at acceleration `a` that ended with velocity `v`.
    pub(crate) fn stop(&self, v: f64, a: f64) -> Stop {
        let (c, slack) = (self.curve(v), MEETS * self.step);
        let slope = match c - a {
            above if above > self.step + slack => self.step,
            below if below < -self.step - slack => -self.step,
            _ => 0.0,
        };
        let ramp = Ramp { v, a, slope, period: self.period };
        let mut ticks = 0.0;
        if slope != 0.0 {
            let meets = |k: f64| {
                let (to, from) = (self.curve(ramp.velocity(k)), ramp.acceleration(k));
                slope.signum() * (to - from) <= self.step + slack
            };
            let longest = ((self.most + a.abs()) / self.step).ceil() + 1.0;
            ticks = first(longest, meets);
        }
        let (way, landed) = (ramp.way(ticks), ramp.velocity(ticks));
        let (t, speed) = (self.period.dt, landed.abs());
        let full = self.most * t; // speed of a period of the largest deceleration
        let m = (self.most / self.step).floor();
        let bend = t * ((m + 1.0) * self.most - 0.5 * self.step * m * (m + 1.0)); // G(B)
        let hold = ((speed - bend) / full).ceil().max(0.0);
        let (x, last) = self.ramp((speed - hold * full).max(0.0));
        Stop { ramp, ticks, way, landed, hold, most: self.most, x, last, step: self.step }
    }

    /// The highest position of a period at acceleration `a` and of braking after it, less the position at its start.
    pub(crate) fn reach(&self, v: f64, a: f64) -> f64 {
        let p = &self.period;
        let (end, v_next) = (p.dt * v + p.kappa * p.dt * p.dt * a, v + p.dt * a);
        peak(v, a, p).max(end + self.stop(v_next, a).highest())
    }

    /// By how much less a dof would have had to accelerate in the period before, where it had the acceleration `a` and ended with velocity `v` at distance
    /// `d` below the upper limit, to stop in front of it [rad/s² or m/s²]; 0 where it does.
    pub(crate) fn too_fast(&self, d: f64, v: f64, a: f64) -> f64 {
        let p = &self.period;
        let beyond = |less: f64| {
            let (d, v, a) = (d + p.kappa * p.dt * p.dt * less, v - p.dt * less, a - less);
            self.stop(v, a).highest() - d
        };
        if beyond(0.0) <= 0.0 {
            return 0.0;
        }
        // With it the dof ends at rest or on its way back, and above no deceleration that it brakes with.
        let most = (v / p.dt).max(0.0) + self.most + self.step + a.abs();
        -last_inside((-most, beyond(most)), (0.0, beyond(0.0)), |less| beyond(-less))
    }

    /// The smaller of the largest deceleration and what it changes by in a period.
    pub(crate) fn gentlest(&self) -> f64 {
        self.most.min(self.step)
    }

    /// The largest acceleration of the next period with which neither the velocity `limit` nor `room` is exceeded for ever after, at most
    /// `most`; never below `brake`, the next one of the brake. What is exceeded even then comes with it.
    fn upper_bound(
        &self,
        (limit, room): (f64, f64),
        v: f64,
        most: (f64, Kind),
        brake: f64,
    ) -> (f64, Kind, Option<Kind>) {
        let (mut bound, mut outside) = (most, None);
        if limit.is_finite() {
            let left = limit - v;
            let speed = if left >= 0.0 { self.ramp(left).0 } else { left / self.period.dt };
            if speed < brake {
                let fastest = if brake > 0.0 { self.rest(v, brake) } else { v + self.period.dt * brake };
                outside = (fastest > limit + ROUNDING).then_some(Kind::Velocity);
            }
            if speed < bound.0 {
                bound = (speed.max(brake), Kind::Velocity);
            }
        }
        if room == f64::INFINITY {
            return (bound.0, bound.1, outside);
        }
        let beyond = self.reach(v, bound.0) - room;
        if beyond > 0.0 {
            let at_least = self.reach(v, brake) - room;
            outside = outside.or((at_least > ROUNDING).then_some(Kind::Viability));
            let end = match at_least < 0.0 {
                true => last_inside((brake, at_least), (bound.0, beyond), |a| self.reach(v, a) - room),
                false => brake,
            };
            bound = (end, Kind::Viability);
        }
        (bound.0, bound.1, outside)
    }

    /// The highest velocity of braking whose first period has acceleration `a`, and the lowest, with its sign turned.
    pub(crate) fn fastest(&self, v: f64, a: f64) -> [f64; 2] {
        [(v, a), (-v, -a)].map(|(v, a)| if a > 0.0 { self.rest(v, a) } else { v + self.period.dt * a })
    }

    /// Velocity after a period at acceleration `a > 0` and the way back to none: `v + G(a)`.
    fn rest(&self, v: f64, a: f64) -> f64 {
        let m = (a / self.step).floor();
        v + self.period.dt * ((m + 1.0) * a - 0.5 * self.step * m * (m + 1.0))
    }
}

/// Accelerations allowed for the next period to a dof of finite [`Dof::jerk`] and [`Dof::acceleration`] at position `q` [rad or m] and
/// velocity `v` [rad/s or m/s], after a period at acceleration `before` [rad/s² or m/s²]; where that is not known, the jerk of the next
/// period is free. Never empty: braking is in it.
pub fn interval(dof: &Dof, q: f64, v: f64, before: Option<f64>, period: &Period) -> Interval {
    let brake = Brake::of(dof, period);
    let within =
        |most: f64, from: f64| if most < from { (most, Kind::Acceleration) } else { (from, Kind::Jerk) };
    let (a, step) = (dof.acceleration, dof.jerk * period.dt);
    // An acceleration beyond the limit counts as the limit: what it really was could leave nothing but to speed up.
    let known = before.map(|before| before.clamp(-a, a));
    let reached = |side: f64| known.map_or(f64::INFINITY, |known| side * known + step);
    let (up, down) = (within(a, reached(1.0)), within(a, reached(-1.0)));
    let next = brake.next(v, known.unwrap_or(brake.curve(v))).clamp(-down.0, up.0);
    if dof.locked {
        let (lower_kind, upper_kind) = (Kind::Locked, Kind::Locked);
        return Interval { lower: next, upper: next, lower_kind, upper_kind, outside: None };
    }
    let (upper, upper_kind, above) = brake.upper_bound((dof.velocity, dof.upper - q), v, up, next);
    let (lower, lower_kind, below) = brake.upper_bound((dof.velocity, q - dof.lower), -v, down, -next);
    let beyond = q > dof.upper + ROUNDING || q < dof.lower - ROUNDING;
    let position = beyond.then_some(Kind::Position);
    let acceleration = before.filter(|before| before.abs() > a + step).map(|_| Kind::Acceleration);
    let outside = position.or(above).or(below).or(acceleration);
    Interval { lower: -lower, upper, lower_kind, upper_kind, outside }
}

/// Ticks of evenly changing acceleration `a + slope, a + 2 slope, ...` after velocity `v`.
#[derive(Debug, Clone, Copy)]
struct Ramp {
    v: f64,
    a: f64,
    slope: f64,
    period: Period,
}

impl Ramp {
    /// Acceleration in tick `k`.
    fn acceleration(&self, k: f64) -> f64 {
        self.a + k * self.slope
    }

    /// Velocity after `k` ticks.
    fn velocity(&self, k: f64) -> f64 {
        self.v + self.period.dt * self.sum(k)
    }

    /// Sum of the accelerations of the first `k` ticks.
    fn sum(&self, k: f64) -> f64 {
        k * self.a + 0.5 * self.slope * k * (k + 1.0)
    }

    /// Way of the first `k` ticks, each `T v + kappa T^2 a`.
    fn way(&self, k: f64) -> f64 {
        let (t, kappa) = (self.period.dt, self.period.kappa);
        let sums = 0.5 * self.a * k * (k - 1.0) + self.slope * (k - 1.0) * k * (k + 1.0) / 6.0;
        t * (k * self.v + t * (sums + kappa * self.sum(k)))
    }
}

/// A motion to rest: the acceleration changes by the same step in each tick until it meets the curve, stays the largest deceleration for a
/// while, and falls to zero as the joint stands.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stop {
    ramp: Ramp,
    /// Ticks of the ramp, and where it ends: way and velocity.
    ticks: f64,
    way: f64,
    landed: f64,
    /// Ticks of the largest deceleration, and that.
    hold: f64,
    most: f64,
    /// First deceleration of the last ramp, the whole steps in it, and a step.
    x: f64,
    last: f64,
    step: f64,
}

impl Stop {
    /// Way and velocity after `k` ticks.
    pub(crate) fn at(&self, k: f64) -> (f64, f64) {
        if k < self.ticks {
            return (self.ramp.way(k), self.ramp.velocity(k));
        }
        let (t, kappa) = (self.ramp.period.dt, self.ramp.period.kappa);
        let (side, speed) = (self.landed.signum(), self.landed.abs());
        let j = (k - self.ticks).min(self.hold);
        let sum = j * self.most;
        let mut way = t * (j * speed - 0.5 * self.most * t * j * (j - 1.0)) - kappa * t * t * sum;
        let mut left = speed - t * sum;
        let j = (k - self.ticks - self.hold).clamp(0.0, self.last + 1.0);
        if j > 0.0 {
            let sum = j * self.x - 0.5 * self.step * j * (j - 1.0);
            let sums = 0.5 * self.x * j * (j - 1.0) - self.step * j * (j - 1.0) * (j - 2.0) / 6.0;
            way += t * (j * left - t * sums) - kappa * t * t * sum;
            left = if j > self.last { 0.0 } else { left - t * sum };
        }
        (self.way + side * way, side * left)
    }

    /// Ticks until the joint stands.
    pub(crate) fn length(&self) -> f64 {
        self.ticks + self.hold + self.last + 1.0
    }

    /// Ticks in which the acceleration begins to change in another way: after the ramp, the largest deceleration, the last ramp.
    pub(crate) fn cuts(&self) -> [f64; 3] {
        [self.ticks, self.ticks + self.hold, self.length()]
    }

    /// The highest position on the way, the start at 0.
    pub(crate) fn highest(&self) -> f64 {
        let mut highest = self.at(self.length()).0.max(0.0);
        let r = &self.ramp;
        if r.slope > 0.0 && r.v > 0.0 && r.a < 0.0 {
            // The velocity falls as long as the acceleration is below 0, and may turn round.
            let falling = ((-r.a / r.slope).ceil() - 1.0).clamp(0.0, self.ticks);
            if r.velocity(falling) <= 0.0 {
                let k = first(falling, |k| r.velocity(k) <= 0.0);
                let (way, v) = (r.way(k - 1.0), r.velocity(k - 1.0));
                highest = highest.max(way).max(way + peak(v, r.acceleration(k), &r.period));
            }
        }
        highest
    }
}

/// The highest position of a period that begins with velocity `v`, its start at 0: of the ends of physics steps, or of all of it where there are
/// none.
fn peak(v: f64, a: f64, p: &Period) -> f64 {
    let end = p.dt * v + p.kappa * p.dt * p.dt * a;
    if !(v > 0.0 && a < 0.0) {
        return end;
    }
    if p.sub_steps == 0 {
        return if -v / a < p.dt { -0.5 * v * v / a } else { end };
    }
    // The j-th physics step moves by tau (v + j tau a).
    let j = (-v / (p.tau * a)).floor().min(f64::from(p.sub_steps));
    if j >= 1.0 { p.tau * (j * v + 0.5 * p.tau * j * (j + 1.0) * a) } else { end }
}

/// The smallest whole number from 0 to `longest` for which `holds`, which holds from there on, and for `longest`.
fn first(longest: f64, holds: impl Fn(f64) -> bool) -> f64 {
    let (mut below, mut at) = (-1.0, longest);
    while at - below > 1.0 {
        let middle = (0.5 * (below + at)).floor();
        if middle <= below || middle >= at {
            break; // there are no numbers between them
        }
        *(if holds(middle) { &mut at } else { &mut below }) = middle;
    }
    at
}

/// The largest number found at which a rising function is not above 0, between one where it is not and one where it is; each is a place
/// and a value. False position with halving (Illinois).
fn last_inside(mut inside: (f64, f64), mut outside: (f64, f64), value: impl Fn(f64) -> f64) -> f64 {
    let (width, mut weights) = (1e-13 * outside.0.abs().max(inside.0.abs()), (1.0, 1.0));
    for _ in 0..STEPS {
        if outside.0 - inside.0 <= width || inside.1 > -1e-16 {
            break;
        }
        let (low, high) = (inside.1 * weights.0, outside.1 * weights.1);
        let at = inside.0 + (outside.0 - inside.0) * (low / (low - high)).clamp(1e-3, 1.0 - 1e-3);
        let found = value(at);
        if found <= 0.0 {
            (inside, weights) = ((at, found), (1.0, 0.5 * weights.1));
        } else {
            (outside, weights) = ((at, found), (0.5 * weights.0, 1.0));
        }
    }
    inside.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A command that throws a light joint leads to any acceleration at the end of its period.
    #[test]
    fn what_is_too_fast_is_found_from_any_state() {
        for sub_steps in [0, 1, 5] {
            let period = Period::new(0.02, sub_steps);
            let dof =
                Dof { acceleration: 10.0, deceleration: 9.0, jerk: 100.0, braking_jerk: 90.0, ..Dof::FREE };
            let brake = Brake::of(&dof, &period);
            for size in [0.0, 1.0, 1e9, 1e18, 1e300, f64::INFINITY, f64::NAN] {
                for (v, a) in [(0.1, size), (size, 0.1), (size, -size), (-size, size)] {
                    let less = brake.too_fast(0.5, v, a);
                    assert!(less >= 0.0 || size.is_nan() || size.is_infinite(), "{v} {a}: {less}");
                }
            }
            let less = brake.too_fast(0.01, 0.5, 4.0);
            let kept = brake.stop(0.5 - 0.02 * less, 4.0 - less).highest();
            let room = 0.01 + period.kappa * 0.02 * 0.02 * less;
            assert!(less > 0.0 && (kept - room).abs() < 1e-9, "{less}: {kept} of {room}");
            assert_eq!(brake.too_fast(1.0, 0.5, 4.0), 0.0);
        }
    }
}
