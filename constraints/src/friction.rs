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
    /// What a motor adds (N·m or N) on average over a period by Coulomb's law. The joint begins at velocity `v` and accelerates with `a`.
    pub(crate) fn coulomb(f: f64, period: &Period, v: f64, a: f64) -> f64 {
        let force = |v: f64| f * (v / STANDS);
        if period.sub_steps == 0 {
            return mean_of_clamp(force(v), force(v + period.dt * a), f);
        }
        let steps = (1..=period.sub_steps).map(|k| force(v + f64::from(k) * period.tau * a).clamp(-f, f));
        steps.sum::<f64>() / f64::from(period.sub_steps)
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
}

impl Onset {
    /// What MuJoCo makes of a joint on which nothing is said about it, whose acceleration for a unit of force is `mobility` [1/(kg·m²) or
    /// 1/kg] where every joint is at its reference: `solimp` begins at 0.9 and ends at 0.95, `solref` is 0.02 s.
    pub(crate) fn usual(mobility: f64) -> Onset {
        Onset { inertia: 0.9 / (1.0 - 0.9) / mobility, time: 0.5 * 0.95 * 0.02 }
    }

    /// What a motor adds (N·m or N) on average over a period against friction `f`. The joint begins at velocity `v` and accelerates with `a`;
    /// `solved` is the acceleration before an implicit damper takes its share.
    pub(crate) fn mean(&self, f: f64, period: &Period, v: f64, a: f64, solved: f64) -> f64 {
        // No time constant of MuJoCo's is below two physics steps.
        let time = self.time.max(0.95 * period.tau);
        let force = |v: f64| self.inertia * (solved + v / time);
        if period.sub_steps == 0 {
            return mean_of_clamp(force(v), force(v + period.dt * a), f);
        }
        let steps = (0..period.sub_steps).map(|k| force(v + f64::from(k) * period.tau * a).clamp(-f, f));
        steps.sum::<f64>() / f64::from(period.sub_steps)
    }
}

/// Mean of `clamp(x, -f, f)` for `x` that goes evenly from `x0` to `x1`.
fn mean_of_clamp(x0: f64, x1: f64, f: f64) -> f64 {
    // The integral of the clamp: a parabola that goes on as a line.
    let integral = |x: f64| if x.abs() <= f { 0.5 * x * x } else { f * (x.abs() - 0.5 * f) };
    match (x1 - x0).abs() > 1e-9 * f {
        true => (integral(x1) - integral(x0)) / (x1 - x0),
        false => (0.5 * (x0 + x1)).clamp(-f, f),
    }
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
            crate::period_dynamics::solve(nv, &mut matrix, &mut column);
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
            assert_eq!(FrictionLaw::coulomb(2.0, &p, 1.0, 3.0), 2.0);
            assert_eq!(FrictionLaw::coulomb(2.0, &p, -1.0, 3.0), -2.0);
            assert_eq!(FrictionLaw::coulomb(2.0, &p, 0.0, 0.0), 0.0);
            assert!(FrictionLaw::coulomb(2.0, &p, 1e-15, -1e-15).abs() < 1e-8);
        }
        // From 0.04 to -0.06: two of five periods forward; of five steps the first, the second stands, three are backward.
        assert!((FrictionLaw::coulomb(2.0, &Period::new(0.01, 0), 0.04, -10.0) + 0.4).abs() < 1e-4);
        assert!((FrictionLaw::coulomb(2.0, &Period::new(0.01, 5), 0.04, -10.0) + 0.8).abs() < 1e-9);
        assert_eq!(FrictionLaw::coulomb(2.0, &Period::new(0.01, 1), 0.04, -10.0), -2.0);
    }
}
