//! How a joint of hard jerk brakes, written anew and tick by tick: in a period its deceleration changes by at most `D = J T`, is at most `b`, and
//! falls to zero as the joint stands.

use crate::period::Period;

/// A speed or an acceleration below this share of a period's change is rounding.
const ROUNDING: f64 = 1e-9;
/// Longest brake that is looked at [periods].
const LONGEST: u32 = 10_000;

/// The brake of one joint.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Brake {
    p: Period,
    /// D [rad/s² or m/s²].
    pub(crate) step: f64,
    /// Largest deceleration b [rad/s² or m/s²].
    most: f64,
}

impl Brake {
    pub(crate) fn new(jerk: f64, most: f64, p: &Period) -> Brake {
        Brake { p: *p, step: jerk * p.dt, most }
    }

    /// The smaller of the largest deceleration and what it changes by in a period.
    pub(crate) fn gentlest(&self) -> f64 {
        self.most.min(self.step)
    }

    /// Speed that an acceleration `a` adds while it falls to zero, its own period included: `T (a + (a - D) + (a - 2 D) + ...)`, terms above 0.
    pub(crate) fn adds(&self, a: f64) -> f64 {
        let whole = (a / self.step).floor().max(0.0);
        self.p.dt * ((whole + 1.0) * a.max(0.0) - 0.5 * self.step * whole * (whole + 1.0))
    }

    /// The deceleration, with its sign, that falls to zero just as a joint at velocity `v` stands; at most `b`.
    fn wanted(&self, v: f64) -> f64 {
        let periods = v.abs() / self.p.dt;
        // `whole` steps are in it: the sum over them is below the speed, and with one more it is above. The root may be one off.
        let mut whole = (0.5 * ((1.0 + 8.0 * periods / self.step).sqrt() - 1.0)).floor();
        if 0.5 * self.step * whole * (whole + 1.0) > periods {
            whole -= 1.0;
        } else if 0.5 * self.step * (whole + 1.0) * (whole + 2.0) <= periods {
            whole += 1.0;
        }
        let least = (periods + 0.5 * self.step * whole * (whole + 1.0)) / (whole + 1.0);
        -v.signum() * least.min(self.most)
    }

    /// Acceleration of the period after one at acceleration `before` that ended with velocity `v`.
    pub(crate) fn next(&self, v: f64, before: f64) -> f64 {
        if v == 0.0 && before.abs() <= ROUNDING * self.step {
            return 0.0;
        }
        self.wanted(v).clamp(before - self.step, before + self.step)
    }

    /// Velocity after a period at acceleration `a`: none where what is left is rounding.
    pub(crate) fn velocity(&self, v: f64, a: f64) -> f64 {
        let left = v + self.p.dt * a;
        if left.abs() <= ROUNDING * self.step * self.p.dt + 1e-12 && a.abs() <= self.step * (1.0 + ROUNDING) {
            0.0
        } else {
            left
        }
    }

    /// Whether a joint at velocity `v` after a period at acceleration `before` has come to rest.
    pub(crate) fn rests(&self, v: f64, before: f64) -> bool {
        v == 0.0 && before.abs() <= self.step * (1.0 + ROUNDING)
    }

    /// The highest place and velocity on the way to rest after a period at acceleration `a` that ended with velocity `v`, the start at 0.
    pub(crate) fn highest(&self, v: f64, a: f64) -> (f64, f64) {
        let (mut v, mut a, mut at, mut most, mut fastest) = (v, a, 0.0, 0.0f64, v);
        for _ in 0..LONGEST {
            if self.rests(v, a) {
                return (most, fastest);
            }
            a = self.next(v, a);
            most = most.max(at + self.p.farthest(v, a));
            let v1 = self.velocity(v, a);
            at += self.p.way(v, v1);
            (v, fastest) = (v1, fastest.max(v1));
        }
        (f64::INFINITY, fastest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: D = 2 a period of 0.1 s, at most 3. From 1.3 rad/s at rest: decelerations 2, 3, 3, 3, then 2 and 0 make 1.3.
    #[test]
    fn a_brake_rises_holds_and_falls() {
        let brake = Brake::new(20.0, 3.0, &Period::new(0.1, 1));
        let (mut v, mut a, mut all) = (1.3, 0.0, Vec::new());
        while !brake.rests(v, a) {
            a = brake.next(v, a);
            v = brake.velocity(v, a);
            all.push(a);
        }
        let by_hand = [-2.0, -3.0, -3.0, -3.0, -2.0];
        assert_eq!(all.len(), by_hand.len(), "{all:?}");
        assert!(all.iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 1e-9), "{all:?}");
        assert!((brake.adds(3.0) - 0.1 * (3.0 + 1.0)).abs() < 1e-12);
    }
}
