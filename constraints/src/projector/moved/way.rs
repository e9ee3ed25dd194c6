//! The way of one joint to limits that were moved.

use super::ROUNDING;
use crate::viability::{Dof, Interval, Kind, Period, brake, interval};

/// What one dof may do in a tick.
pub(super) struct Way {
    /// What the fastest way allows.
    pub(super) aim: Interval,
    /// Next velocity by the brake in force [rad/s or m/s].
    pub(super) stop: f64,
    /// The state is inside the new limits, and the brake in force stays there.
    pub(super) arrived: bool,
}

/// The way of one dof at `q`, `v` with the limits of the build and those wanted; `stored` is its velocity after a tick of the stored brake.
pub(super) fn way(
    (dof, wanted): (&Dof, &Dof),
    (q, v): (f64, f64),
    built: Interval,
    stored: Option<f64>,
    faster: f64,
    p: &Period,
) -> Way {
    let t = p.dt;
    let mut new = interval(wanted, q, v, p);
    let arrived = new.outside.is_none() && v.abs() <= wanted.velocity * (1.0 + ROUNDING);
    if !arrived && built.outside.is_none() {
        // Slowing down as the build can; the new speed is cut off below.
        new = interval(&Dof { velocity: dof.velocity, ..*wanted }, q, v, p);
        // Where it could not stop in time it brakes, and does not turn round to be in time either.
        let stop = brake(dof, v, p);
        if new.lower == new.upper || !(new.lower..=new.upper).contains(&stop) {
            (new.lower, new.upper) = (stop, stop);
        }
    }
    let mut aim = Interval { lower: new.lower.max(built.lower), upper: new.upper.min(built.upper), ..new };
    if built.outside.is_some() {
        aim = built;
    }
    aim.upper = aim.upper.max(aim.lower).min(built.upper.max(built.lower));
    aim.lower = aim.lower.min(aim.upper);
    let slower = brake(dof, v, p).clamp(aim.lower, aim.upper);
    let stop = stored.map_or(v + t * slower, |s| s.clamp(v + t * built.lower, v + t * built.upper));
    // Never empty: the brake is in it.
    let up = [((wanted.velocity - v) / t, Kind::Velocity), (gaining(faster, v, t), Kind::Acceleration)];
    let down = [((wanted.velocity + v) / t, Kind::Velocity), (gaining(faster, -v, t), Kind::Acceleration)];
    for (bound, kind) in up {
        if bound < aim.upper {
            (aim.upper, aim.upper_kind) = (bound.max(slower), kind);
        }
    }
    for (bound, kind) in down {
        if -bound > aim.lower {
            (aim.lower, aim.lower_kind) = ((-bound).min(slower), kind);
        }
    }
    let stays = stored.is_none_or(|s| s.abs() <= wanted.velocity * (1.0 + ROUNDING));
    Way { aim, stop, arrived: arrived && stays }
}

/// The largest acceleration with which a dof at speed `v` gains at most `a` [rad/s² or m/s²] of speed, from standstill where it turns round.
fn gaining(a: f64, v: f64, t: f64) -> f64 {
    if v < 0.0 { a - v / t } else { a }
}

/// How much speed is gained from `v` to `next`, from standstill where it turns round.
pub(super) fn gain(v: f64, next: f64) -> f64 {
    if v * next > 0.0 { next.abs() - v.abs() } else { next.abs() }
}

/// The way that a brake by `b` in whole periods and a shorter last one goes from speed `v`, with its sign; never less than without periods.
pub(super) fn rest(v: f64, b: f64, p: &Period) -> f64 {
    let (t, speed) = (p.dt, v.abs());
    let step = b * t;
    if !(step > 0.0 && step.is_finite()) {
        return if speed == 0.0 || b > 0.0 { 0.0 } else { v.signum() * f64::INFINITY };
    }
    let full = (speed / step + 1e-9).floor();
    let left = (speed - full * step).max(0.0);
    let way = full * t * speed - b * t * t * (0.5 * full * (full - 1.0) + p.kappa * full)
        + t * left * (1.0 - p.kappa);
    let smooth = (speed - 0.5 * b * p.tau).max(0.0).powi(2) / (2.0 * b);
    v.signum() * way.max(smooth)
}
