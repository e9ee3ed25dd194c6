//! The least deceleration by which a joint stops in time, in whole periods.

use super::{MANY, ROUNDING};
use crate::jerk::Brake;
use crate::viability::{Dof, Period};

/// The least deceleration that stops a dof before its position limit and below its speed profile; infinite where none does.
pub(super) fn least_deceleration(dof: &Dof, q: f64, v: f64, period: &Period) -> f64 {
    let (room, profile, at) = match v > 0.0 {
        true => (dof.upper - q, dof.profile[1], 1.0),
        false => (q - dof.lower, dof.profile[0], -1.0),
    };
    let (ticks, smooth) = (stopping(room, v.abs(), period), smooth(room, v.abs(), period));
    // Where the smooth brake asks for more than there is, the ticks may still do.
    let mut least = if smooth > dof.braking(period) * (1.0 + 1e-9) { ticks } else { ticks.max(smooth) };
    if let Some(p) = profile {
        // Braking with the deceleration of the parabola that leads from here to the end of the profile stays below the profile.
        let needed = (v.abs() + p.offset).powi(2) / (2.0 * (at * (p.at - q)).max(f64::MIN_POSITIVE));
        least = least.max(needed.min(p.deceleration).min(dof.braking(period)));
    }
    least
}

/// Steps of the search of [`soonest`].
const STEPS: usize = 10;

/// The least deceleration found, from `wanted` on, with which a dof of hard jerk stops before its position limits after a tick at
/// acceleration `a`; `None` where the largest does not.
pub(super) fn soonest(
    dof: &Dof,
    q: Option<f64>,
    (v, a): (f64, f64),
    wanted: f64,
    period: &Period,
) -> Option<f64> {
    let Some(q) = q else { return Some(wanted) };
    let stops = |b: f64| {
        let brake = Brake::new(dof, b, period);
        let (high, low) = (brake.stop(v, a).highest(), brake.stop(-v, -a).highest());
        high <= (dof.upper - q).max(0.0) + ROUNDING && low <= (q - dof.lower).max(0.0) + ROUNDING
    };
    if stops(wanted) {
        return Some(wanted);
    }
    let (mut fails, mut least) = (wanted, Brake::most(dof));
    if !stops(least) {
        return None;
    }
    for _ in 0..STEPS {
        let middle = 0.5 * (fails + least);
        *(if stops(middle) { &mut least } else { &mut fails }) = middle;
    }
    Some(least)
}

/// The least deceleration that stops within `room` from `speed` in whole ticks and a shorter one: with `k` whole ticks
///
/// ```text
///     speed T (k + 1 - kappa) - b T^2 k (k + 1) / 2 = room,   k = floor(speed / (b T))
/// ```
fn stopping(room: f64, speed: f64, period: &Period) -> f64 {
    let t = period.dt;
    if room == f64::INFINITY {
        return 0.0;
    }
    if room < speed * t * (1.0 - period.kappa) - ROUNDING {
        return f64::INFINITY;
    }
    let with = |k: f64| (speed * t * (k + 1.0 - period.kappa) - room) / (0.5 * t * t * k * (k + 1.0));
    // Of a brake without ticks, which needs a little less; then the whole ticks that are the largest deceleration.
    let rough = speed * speed / (2.0 * room.max(0.0) + speed * period.tau).max(f64::MIN_POSITIVE);
    let whole = speed / (rough * t);
    if whole > MANY {
        return rough * (1.0 + 1.0 / MANY); // the ticks make less of a difference than this
    }
    let mut k = whole.floor().max(1.0);
    let mut least = with(k);
    for step in [-1.0, 1.0] {
        while k + step >= 1.0 && with(k + step) > least {
            k += step;
            least = with(k);
        }
    }
    // Not more than what stops within one tick.
    least.clamp(0.0, speed / t)
}

/// The least deceleration `b` that keeps the joint in the set of [`interval`](crate::viability::interval): the smaller root of
/// `(speed - b tau / 2)^2 = 2 b room`. That set is left a little later than the ticks need between some of them.
fn smooth(room: f64, speed: f64, period: &Period) -> f64 {
    if room == f64::INFINITY {
        return 0.0;
    }
    let half = speed * period.tau + 2.0 * room.max(0.0);
    let root = (half * half - (period.tau * speed).powi(2)).max(0.0).sqrt();
    2.0 * speed * speed / (half + root).max(f64::MIN_POSITIVE)
}
