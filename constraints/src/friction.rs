//! Dry friction of joints: how much of it a motor makes up for, and by how much that may be wrong.

use crate::{Dynamics, LimitSet, Model, Period};
use serde::{Deserialize, Serialize};

/// How the note of a projector begins that says what is made up for, so that what makes up for nothing can leave it out.
pub const MADE_UP_FOR: &str = "dry friction is made up for";

/// What dry friction is taken to be.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FrictionLaw {
    /// MuJoCo's: it sets in evenly with what would become motion, see [`Onset`].
    #[default]
    Mujoco,
    /// Coulomb's: all of `f` against any motion, and whatever holds a joint that stands, up to `f`. What counts is the velocity that a period
    /// leads to, not a measured one, whose sign is noise where a joint stands:
    ///
    /// ```text
    ///     force = -mean over the period of f clamp(v / 1e-6, -1, 1)
    /// ```
    ///
    /// of the velocities at the ends of physics steps, or of all of the period where there are none.
    Coulomb,
}

impl FrictionLaw {
    /// What a motor adds on average over a period by Coulomb's law. The joint begins at velocity `v` and accelerates with `a`.
    pub(crate) fn coulomb(f: f64, period: &Period, v: f64, a: f64) -> MadeUpFor {
        let (force, slope) = (|v: f64| f * (v / STANDS), f / STANDS);
        if period.sub_steps == 0 {
            let (force, [_, by_end]) = mean_of_clamp(force(v), force(v + period.dt * a), f);
            return MadeUpFor { force, by_acceleration: by_end * slope * period.dt, by_solved: 0.0 };
        }
        let steps = (1..=period.sub_steps).map(|k| {
            let time = f64::from(k) * period.tau;
            let wanted = force(v + time * a);
            MadeUpFor::step(wanted, f, [slope * time, 0.0])
        });
        MadeUpFor::mean(steps, period.sub_steps)
    }
}

/// What motors add on average over a period to make up for the dry friction of a joint.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct MadeUpFor {
    /// N·m or N.
    pub(crate) force: f64,
    /// Its slope by the acceleration, at least 0 [kg·m² or kg].
    pub(crate) by_acceleration: f64,
    /// Its slope by the acceleration before an implicit damper takes its share, at least 0 [kg·m² or kg].
    pub(crate) by_solved: f64,
}

impl MadeUpFor {
    /// Of the `i`-th dof of `model`, which begins at velocity `v` and accelerates with `a`; `solved` is the acceleration before an implicit
    /// damper takes its share.
    pub(crate) fn of(model: &Model, i: usize, period: &Period, v: f64, a: f64, solved: f64) -> MadeUpFor {
        let f = model.friction()[i];
        match (model.friction_law()[i], model.friction_onset()[i]) {
            (FrictionLaw::Coulomb, _) if f > 0.0 => FrictionLaw::coulomb(f, period, v, a),
            (FrictionLaw::Mujoco, Some(onset)) if f > 0.0 => onset.mean(f, period, v, a, solved),
            _ => MadeUpFor::default(),
        }
    }

    /// Of one physics step that would take `wanted`, with its slopes where it is less than `f`.
    fn step(wanted: f64, f: f64, slopes: [f64; 2]) -> MadeUpFor {
        let [by_acceleration, by_solved] = if wanted.abs() < f { slopes } else { [0.0; 2] };
        MadeUpFor { force: wanted.clamp(-f, f), by_acceleration, by_solved }
    }

    fn mean(steps: impl Iterator<Item = MadeUpFor>, n: u32) -> MadeUpFor {
        let n = f64::from(n);
        let sum = steps.fold(MadeUpFor::default(), |sum, step| MadeUpFor {
            force: sum.force + step.force,
            by_acceleration: sum.by_acceleration + step.by_acceleration,
            by_solved: sum.by_solved + step.by_solved,
        });
        MadeUpFor {
            force: sum.force / n,
            by_acceleration: sum.by_acceleration / n,
            by_solved: sum.by_solved / n,
        }
    }
}

/// Below this speed a joint stands [rad/s or m/s].
const STANDS: f64 = 1e-6;

/// How MuJoCo's dry friction `f` sets in. It opposes motion and what would become motion, as a constraint of MuJoCo's does (`frictionloss`):
///
/// ```text
///     force = -clamp(inertia (a + v / time), -f, f)
/// ```
///
/// A joint that stands and is not driven feels none, one that starts feels `f` as soon as its motor wants more than `inertia` gives, and one
/// that is about to turn round feels it fall and rise again. No sign of a velocity has to be told. Of a light joint it is a damper.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Onset {
    /// Force for a unit of acceleration [kg·m² or kg], above 0.
    pub inertia: f64,
    /// A velocity asks for as much as the acceleration that stops it in this time would \[s\], above 0.
    pub time: f64,
    /// The time is at least this many physics steps, 0 or more.
    #[serde(default = "usual_steps")]
    pub steps: f64,
}

/// No time constant of MuJoCo's is below two physics steps, unless its file says so.
const fn usual_steps() -> f64 {
    0.95
}

impl Onset {
    /// What MuJoCo makes of a joint on which nothing is said about it, whose acceleration for a unit of force is `mobility` [1/(kg·m²) or
    /// 1/kg] where every joint is at its reference: `solimp` begins at 0.9 and ends at 0.95, `solref` is 0.02 s.
    pub(crate) fn usual(mobility: f64) -> Onset {
        Onset { inertia: 0.9 / (1.0 - 0.9) / mobility, time: 0.5 * 0.95 * 0.02, steps: usual_steps() }
    }

    /// What a motor adds on average over a period against friction `f`. The joint begins at velocity `v` and accelerates with `a`;
    /// `solved` is the acceleration before an implicit damper takes its share.
    pub(crate) fn mean(&self, f: f64, period: &Period, v: f64, a: f64, solved: f64) -> MadeUpFor {
        let time = self.time.max(self.steps * period.tau);
        let force = |v: f64| self.inertia * (solved + v / time);
        if period.sub_steps == 0 {
            let (force, [by_start, by_end]) = mean_of_clamp(force(v), force(v + period.dt * a), f);
            return MadeUpFor {
                force,
                by_acceleration: by_end * self.inertia * period.dt / time,
                by_solved: (by_start + by_end) * self.inertia,
            };
        }
        let steps = (0..period.sub_steps).map(|k| {
            let gone = f64::from(k) * period.tau;
            MadeUpFor::step(force(v + gone * a), f, [self.inertia * gone / time, self.inertia])
        });
        MadeUpFor::mean(steps, period.sub_steps)
    }
}

/// Mean of `clamp(x, -f, f)` for `x` that goes evenly from `x0` to `x1`, and its slopes by either.
fn mean_of_clamp(x0: f64, x1: f64, f: f64) -> (f64, [f64; 2]) {
    // The integral of the clamp: a parabola that goes on as a line.
    let integral = |x: f64| if x.abs() <= f { 0.5 * x * x } else { f * (x.abs() - 0.5 * f) };
    if (x1 - x0).abs() > 1e-9 * f {
        let mean = (integral(x1) - integral(x0)) / (x1 - x0);
        let slope = |end: f64, other: f64| ((end.clamp(-f, f) - mean) / (end - other)).max(0.0);
        return (mean, [slope(x0, x1), slope(x1, x0)]);
    }
    let middle = 0.5 * (x0 + x1);
    (middle.clamp(-f, f), if middle.abs() < f { [0.5; 2] } else { [0.0; 2] })
}

/// Configurations looked at.
const SAMPLES: usize = 200;

/// By how much the acceleration of each dof (nv) [rad/s² or m/s²] may differ from what was asked for where joints rub otherwise than
/// [`Onset`] says, each with anything from `-f` to `f`: the largest of
///
/// ```text
///     sum_j |R^-1|_ij 2 f_j
/// ```
///
/// over seeded configurations within the limits, with `R` of [`Dynamics::motor_rows`] at rest.
pub(crate) fn doubt(model: &Model, limits: &LimitSet, period: &Period) -> Vec<f64> {
    let nv = model.nv();
    let mut dynamics = Dynamics::new(model);
    let (mut q, rest) = (model.neutral(), vec![0.0; nv]);
    let (mut rows, mut bias, mut most) = (vec![0.0; nv * nv], vec![0.0; nv], vec![0.0_f64; nv]);
    for sample in 0..SAMPLES {
        for joint in model.joints().iter().filter(|j| j.nq == 1) {
            let or = |x: f64, otherwise: f64| if x.is_finite() { x } else { otherwise };
            let low = or(limits.q_lower[joint.idx_v], -std::f64::consts::PI);
            let high = or(limits.q_upper[joint.idx_v], std::f64::consts::PI);
            // Additive recurrence (Roberts 2018).
            let share = ((sample + 1) as f64 * (1.0 / (joint.idx_v as f64 + 1.618)).fract()).fract();
            q[joint.idx_q] = low + share * (high - low);
        }
        dynamics.motor_rows(period, &q, &rest, &mut rows, &mut bias);
        let mut off = vec![0.0; nv];
        for j in (0..nv).filter(|j| model.friction()[*j] > 0.0) {
            let (mut matrix, mut column) = (rows.clone(), vec![0.0; nv]);
            column[j] = 2.0 * model.friction()[j];
            crate::period_dynamics::solve(nv, 1, &mut matrix, &mut column);
            off.iter_mut().zip(&column).for_each(|(off, x)| *off += x.abs());
        }
        most.iter_mut().zip(&off).for_each(|(most, off)| *most = most.max(*off));
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: all of it against a motion, none of it at rest whatever the sign of the noise, the mean of both signs where it turns round.
    #[test]
    fn coulomb_s_friction_is_against_motion_and_knows_no_sign_at_rest() {
        for sub_steps in [0, 1, 5] {
            let p = Period::new(0.01, sub_steps);
            let of = |v, a| FrictionLaw::coulomb(2.0, &p, v, a).force;
            assert_eq!(of(1.0, 3.0), 2.0);
            assert_eq!(of(-1.0, 3.0), -2.0);
            assert_eq!(of(0.0, 0.0), 0.0);
            assert!(of(1e-15, -1e-15).abs() < 1e-8);
        }
        // From 0.04 to -0.06: two of five periods forward; of five steps the first, the second stands, three are backward.
        let of = |sub_steps| FrictionLaw::coulomb(2.0, &Period::new(0.01, sub_steps), 0.04, -10.0).force;
        assert!((of(0) + 0.4).abs() < 1e-4);
        assert!((of(5) + 0.8).abs() < 1e-9);
        assert_eq!(of(1), -2.0);
    }

    /// Against central differences, where the law has no corner.
    #[test]
    fn slopes_are_those_of_the_force() {
        let onset = Onset { inertia: 0.3, time: 0.0095, steps: 0.95 };
        for sub_steps in [0, 1, 5] {
            let p = Period::new(0.01, sub_steps);
            for (v, a, solved) in [(0.01, -0.7, -0.9), (0.05, -8.0, -8.5), (-0.02, 3.0, 3.1), (1.0, 3.0, 3.0)]
            {
                let at = |a: f64, solved: f64| onset.mean(2.0, &p, v, a, solved);
                let h = 1e-6;
                let by_a = (at(a + h, solved).force - at(a - h, solved).force) / (2.0 * h);
                let by_solved = (at(a, solved + h).force - at(a, solved - h).force) / (2.0 * h);
                let found = at(a, solved);
                assert!((found.by_acceleration - by_a).abs() < 1e-7, "{sub_steps} {v}: {found:?} {by_a}");
                assert!((found.by_solved - by_solved).abs() < 1e-7, "{sub_steps} {v}: {found:?} {by_solved}");
            }
            let (v, a, h) = (2e-7, -3e-5, 1e-9);
            let at = |a: f64| FrictionLaw::coulomb(2.0, &p, v, a);
            let by_a = (at(a + h).force - at(a - h).force) / (2.0 * h);
            assert!((at(a).by_acceleration / by_a - 1.0).abs() < 1e-5, "{sub_steps}: {by_a} {:?}", at(a));
        }
    }
}
