//! A distance that must not become negative.
//!
//! The geometry is looked at where the robot will be if no joint accelerates, `q^ = q (+) T v`: distance `d^`, closing speed `w^ = r v`
//! with the row `r = n' J` found there, and `c`, the closing acceleration of the same points while no joint accelerates. For a
//! velocity change `y` and both kinds of plant
//!
//! ```text
//!     d' = d^ - kappa T r y + O((T y)²)      w' = w^ + r y + O(T y v)
//! ```
//!
//! which is the motion of a joint with closing acceleration `a = c + r y / T`, speed `w = w^ - (T + tau / 2) c` and distance
//! `d = d^ + T w + kappa T² c` (the half sub-step is there because a semi-implicit plant applies `r y` to a position as `kappa T`,
//! but the curvature of its path as `T / 2`). So the row is `r y / T <= approach(d, w) - c`. The speed `v` enters exactly,
//! however long the period. Every tick measures anew, so the errors in `y` add up in one case alone: where something slides along the
//! boundary. It then creeps beyond the boundary, and is brought back slowly.

use crate::viability::approach;
use crate::{Dynamics, Kinematics, Model, Period};

/// Outside the set that can stop, a row asks for at most this many times `braking`.
const RECOVERY: f64 = 2.0;

/// A state this far outside the set is inside [m].
const ROUNDING: f64 = 1e-10;

/// Rows keep this far inside the boundary [m]: what the linearisation creeps beyond theirs is within it, and taken back in [`RETURN`]
/// periods.
const CREEP: f64 = 1e-4;

/// A state this far beyond the boundary rests at it [m].
pub(super) const AT: f64 = 1e-9;

/// See [`CREEP`].
const RETURN: f64 = 20.0;

/// Frames at `q (+) T v`.
pub(super) struct Ahead {
    dynamics: Dynamics,
    pub(super) kinematics: Kinematics,
    q: Vec<f64>,
    step: Vec<f64>,
    zero: Vec<f64>,
}

impl Ahead {
    pub(super) fn new(model: &Model) -> Ahead {
        let zero = vec![0.0; model.nv()];
        Ahead {
            dynamics: Dynamics::new(model),
            kinematics: Kinematics::new(model),
            q: model.neutral(),
            step: zero.clone(),
            zero,
        }
    }

    /// Moves the frames and Jacobians to `q (+) dt v` with velocity `v`.
    pub(super) fn look(&mut self, q: &[f64], v: &[f64], dt: f64) -> &mut Kinematics {
        self.step.iter_mut().zip(v).for_each(|(s, v)| *s = dt * v);
        self.dynamics.integrate(q, &self.step, &mut self.q);
        self.kinematics.update(&self.q, v, &self.zero);
        &mut self.kinematics
    }

    /// The same without Jacobians.
    pub(super) fn look_at_frames(&mut self, q: &[f64], v: &[f64], dt: f64) -> &mut Kinematics {
        self.step.iter_mut().zip(v).for_each(|(s, v)| *s = dt * v);
        self.dynamics.integrate(q, &self.step, &mut self.q);
        self.turn(v)
    }

    /// Gives the frames another velocity, at the configuration of the last look.
    pub(super) fn turn(&mut self, v: &[f64]) -> &mut Kinematics {
        self.kinematics.update_frames(&self.q, v, &self.zero);
        &mut self.kinematics
    }
}

/// A distance and how it closes, looked at ahead.
#[derive(Debug, Clone, Copy)]
pub(super) struct Clearance {
    /// Distance [m].
    d: f64,
    /// Closing speed [m/s].
    w: f64,
    /// `w^` [m/s].
    ahead: f64,
    /// Closing acceleration while no joint accelerates [m/s²].
    c: f64,
}

impl Clearance {
    /// From distance [m], closing speed [m/s] and closing acceleration [m/s²] at `q (+) T v`.
    pub(super) fn ahead(distance: f64, speed: f64, c: f64, period: &Period) -> Clearance {
        let t = period.dt;
        let w = speed - (t + 0.5 * period.tau) * c;
        Clearance { d: distance - CREEP + t * w + period.kappa * t * t * c, w, ahead: speed, c }
    }

    /// Beyond the boundary itself.
    pub(super) fn is_outside(&self) -> bool {
        self.d < -CREEP - AT
    }

    /// Upper bound of `r y / T` [m/s²].
    pub(super) fn bound(&self, braking: f64, period: &Period) -> f64 {
        self.allowed(braking, period) - self.c
    }

    /// The largest closing acceleration [m/s²] after which `braking` still stops at `d = 0`.
    fn allowed(&self, braking: f64, period: &Period) -> f64 {
        if self.d <= 0.0 {
            return ((self.leave(period) - self.w) / period.dt).clamp(-braking, braking);
        }
        approach(self.d, self.w, braking, period).max(-RECOVERY * braking)
    }

    /// By how much ending at the closing speed `speed` [m/s] exceeds [`Clearance::allowed`], as a share of `braking`; negative
    /// inside. Found from where it leads, not from the bound: each overshoot of a position or a stopping distance is
    /// divided by its slope in the acceleration.
    pub(super) fn excess(&self, speed: f64, braking: f64, period: &Period) -> f64 {
        let (d, w, b) = (self.d, self.w, braking);
        let a = self.c + (speed - self.ahead) / period.dt;
        if d <= 0.0 {
            return (a + b).min(((w + period.dt * a - self.leave(period)) / period.dt).max(a - b)) / b;
        }
        let beyond = positions(d, w, a, period).max(stopping(d, w, a, b, period));
        let half = 0.5 * b * period.tau;
        let can_stop = (w - half).max(0.0).powi(2) <= 2.0 * b * (d + ROUNDING);
        let always = if can_stop { a + b } else { a + RECOVERY * b };
        beyond.min(always) / b
    }

    /// Closing speed to have beyond the boundary; at most 0.
    fn leave(&self, period: &Period) -> f64 {
        self.d.max(-CREEP) / (RETURN * period.dt)
    }
}

/// Overshoot of `d` at the end of a sub-step, or at the turning point of a plant without them.
fn positions(d: f64, w: f64, a: f64, period: &Period) -> f64 {
    let turn = -w / a;
    if period.sub_steps == 0 {
        return match turn > 0.0 && turn < period.dt && a < 0.0 {
            true => (0.5 * w * turn - d) / (0.5 * turn * turn),
            false => (w * period.dt + 0.5 * a * period.dt * period.dt - d) / (0.5 * period.dt * period.dt),
        };
    }
    let (mut gone, mut speed, mut slope, mut worst) = (0.0, w, 0.0, f64::NEG_INFINITY);
    for j in 1..=period.sub_steps {
        speed += period.tau * a;
        gone += period.tau * speed;
        slope += period.tau * period.tau * f64::from(j);
        worst = f64::max(worst, (gone - d) / slope);
    }
    worst
}

/// Overshoot of `d` by the distance gone in the period and the stopping distance after it.
fn stopping(d: f64, w: f64, a: f64, b: f64, period: &Period) -> f64 {
    let t = period.dt;
    let speed = (w + t * a - 0.5 * b * period.tau).max(0.0);
    let gone = t * w + period.kappa * t * t * a;
    (gone + speed * speed / (2.0 * b) - d) / (speed * t / b + period.kappa * t * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The checker accepts the bound itself and refuses a little more, whatever the state; it shares no formula with it.
    #[test]
    fn the_checker_draws_the_line_where_the_bound_is() {
        let mut lines = 0;
        for sub_steps in [0, 1, 5] {
            for dt in [0.001, 0.01] {
                let p = Period::new(dt, sub_steps);
                for b in [0.5, 5.0, 40.0] {
                    for k in 0..4000 {
                        let (x, y) = (f64::from(k % 80) / 80.0, f64::from(k / 80) / 50.0);
                        let d = (x - 0.1) * x * x * 0.5;
                        let w = (y - 0.3) * (2.0 * b * d.abs()).sqrt() * 2.0 + (y - 0.5) * 1e-2;
                        let at = Clearance::ahead(d, w, b * (x - y), &p);
                        let a = at.bound(b, &p);
                        assert!(at.excess(w + dt * a, b, &p) < 1e-9, "{at:?} {a} {b} {p:?}");
                        let more = a + 1e-6 * b.max(a.abs());
                        assert!(at.excess(w + dt * more, b, &p) > 1e-9, "{at:?} {more} {b} {p:?}");
                        lines += 1;
                    }
                }
            }
        }
        assert_eq!(lines, 72_000);
    }
}
