//! Whether the joints go where their velocities say.

use crate::link::{MAX_JOINTS, StateMessage};

/// How long the ways are summed up before they are compared \[s\], and in how many periods at least: a velocity that comes late by a filter, and a noisy
/// one, are no other way over it.
const WINDOW: (f64, f64) = (0.25, 16.0);
/// The two ways of a joint may differ by this share of what its fastest speed would have led it.
const OFF: f64 = 0.25;
/// Its fastest speed is taken for no less than this share of its limit.
const SLOW: f64 = 0.1;
/// A state that came so much earlier or later than its period begins the sums anew.
const PERIODS: std::ops::RangeInclusive<f64> = 0.5..=2.0;
/// Sums of a joint: its way by positions, its way by velocities, its fastest speed.
const SUMS: usize = 3;
/// Numbers that a [`Way`] may hold: the time, the periods, and the sums of the joints.
const MAX_NUMBERS: usize = 2 + SUMS * MAX_JOINTS;

/// A joint that goes elsewhere than its velocity says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Apart {
    /// Degree of freedom.
    pub dof: usize,
    /// Its mean speed by its positions [rad/s or m/s].
    pub moved: f64,
    /// Its mean velocity, as told [rad/s or m/s].
    pub told: f64,
}

/// The ways of the joints since the sums began.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Way {
    length: usize,
    numbers: [f64; MAX_NUMBERS],
}

impl Way {
    pub(crate) const fn new() -> Way {
        Way { length: 2, numbers: [0.0; MAX_NUMBERS] }
    }

    /// What a log keeps of it.
    pub(crate) fn numbers(&self) -> &[f64] {
        &self.numbers[..self.length]
    }

    /// The one that a log has kept; `None` if these are more numbers than one has. Of no number at all: the sums begin.
    pub(crate) fn of(numbers: &[f64]) -> Option<Way> {
        let mut way = Way::new();
        way.numbers.get_mut(..numbers.len())?.copy_from_slice(numbers);
        way.length = numbers.len().max(2);
        Some(way)
    }

    /// Begins the sums.
    pub(crate) fn clear(&mut self) {
        self.numbers[..self.length].fill(0.0);
        self.length = 2;
    }

    /// Adds the way from `old` to `new`, which should be `nominal` \[s\], of the `joints` (degree of freedom, configuration index, limit of the speed),
    /// and compares where there is enough of it.
    pub(crate) fn take(
        &mut self,
        old: &StateMessage,
        new: &StateMessage,
        nominal: f64,
        joints: &[(usize, usize, f64)],
    ) -> Option<Apart> {
        let dt = if new.time == 0.0 { nominal } else { new.time - old.time };
        if !PERIODS.contains(&(dt / nominal)) {
            self.clear();
            return None;
        }
        self.numbers[0] += dt;
        self.numbers[1] += 1.0;
        for &(dof, idx_q, _) in joints {
            let at = 2 + SUMS * dof;
            let Some([moved, told, fastest]) = self.numbers.get_mut(at..at + SUMS) else { continue };
            let (way, v) = (new.q[idx_q] - old.q[idx_q], [old.v[dof], new.v[dof]]);
            *moved += way;
            *told += 0.5 * (v[0] + v[1]) * dt;
            *fastest = fastest.max(v[0].abs()).max(v[1].abs()).max(way.abs() / dt);
            self.length = self.length.max(at + SUMS);
        }
        let [passed, periods] = [self.numbers[0], self.numbers[1]];
        if passed < WINDOW.0 || periods < WINDOW.1 {
            return None;
        }
        let apart = joints.iter().find_map(|&(dof, _, limit)| {
            let at = 2 + SUMS * dof;
            let [moved, told, fastest] = *self.numbers.get(at..at + SUMS)? else { return None };
            let most = OFF * passed * fastest.max(SLOW * limit);
            ((moved - told).abs() > most).then(|| Apart { dof, moved: moved / passed, told: told / passed })
        });
        self.clear();
        apart
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::link::Message;

    const JOINTS: [(usize, usize, f64); 1] = [(0, 0, 2.0)];

    /// Where the first window ends in which a joint is found that swings by 1 rad/s at `rate` \[Hz\] and whose driver tells `told(velocity at)` \[s\].
    fn found(dt: f64, rate: f64, told: impl Fn(&dyn Fn(f64) -> f64, f64) -> f64) -> Option<f64> {
        let (q, v) =
            (|t: f64| (1.0 - (TAU * rate * t).cos()) / (TAU * rate), |t: f64| (TAU * rate * t).sin());
        let (mut way, mut old) = (Way::new(), StateMessage::zeroed());
        for k in 0..(8.0 / dt) as u64 {
            let mut new = StateMessage::zeroed();
            let t = k as f64 * dt;
            (new.nq, new.nv, new.time, new.q[0], new.v[0]) = (1, 1, 5.0 + t, q(t), told(&v, t));
            if k > 0 && way.take(&old, &new, dt, &JOINTS).is_some() {
                return Some(t);
            }
            old = new;
        }
        None
    }

    #[test]
    fn velocities_of_another_motion_are_found() {
        for dt in [0.001, 0.004, 0.02] {
            for rate in [0.1, 0.5, 1.0] {
                for share in [0.0, 0.5, -1.0, 2.0] {
                    let at = found(dt, rate, |v, t| share * v(t));
                    assert!(at.is_some(), "{share} of the velocity at {rate} Hz, each {dt} s");
                }
            }
        }
    }

    #[test]
    fn what_drivers_do_to_velocities_is_no_other_motion() {
        let noise = |t: f64| (t * 7919.0).sin() * 0.1;
        for dt in [0.001, 0.004, 0.02] {
            for rate in [0.1, 0.5, 1.0, 3.0] {
                assert_eq!(found(dt, rate, |v, t| v(t)), None, "{rate} Hz, {dt} s");
                assert_eq!(
                    found(dt, rate, |v, t| v((t - 0.02).max(0.0))),
                    None,
                    "20 ms late, {rate} Hz, {dt} s"
                );
                assert_eq!(found(dt, rate, |v, t| v(t) + noise(t)), None, "noisy, {rate} Hz, {dt} s");
                assert_eq!(found(dt, rate, |v, t| 0.9 * v(t)), None, "a tenth off, {rate} Hz, {dt} s");
            }
        }
    }

    #[test]
    fn what_a_log_keeps_is_all_of_it() {
        let (mut way, mut new) = (Way::new(), StateMessage::zeroed());
        (new.q[0], new.v[0]) = (0.01, 2.0);
        way.take(&StateMessage::zeroed(), &new, 0.01, &JOINTS);
        assert_eq!(way.numbers(), [0.01, 1.0, 0.01, 0.01, 2.0]);
        assert_eq!(Way::of(way.numbers()), Some(way));
        assert_eq!(Way::of(&[]), Some(Way::new()));
        assert_eq!(Way::of(&[0.0; MAX_NUMBERS + 1]), None);
    }
}
