//! Dry friction of joints: what a motor makes up for, and how far off that may be.

use crate::{Dynamics, LimitSet, Model, Period};
use serde::{Deserialize, Serialize};

/// How dry friction `f` sets in. It opposes motion and what would become motion, as a constraint of MuJoCo's does (`frictionloss`):
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
