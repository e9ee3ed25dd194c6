//! Position limits of the robot file.

use super::{About, AlwaysHard, Argument, Form, Limit, LimitSet, PerJoint, Takes, quoted};
use crate::{LimitError, Model};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "PositionLimit",
    promise: "The joint can always stop in front of the limits of the robot file, at any period and number of physics \
        steps. `margin` is kept inside them.",
    example: "position = { margin = 0.01 }",
    form: Form::Hard,
    margin: "from both ends [rad, m]",
    stricter: None,
    arguments: &[Argument::or("margin", Takes::PerJoint, "0.0")],
};

/// `position = { margin }`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PositionSettings {
    /// Distance kept from both limits [rad or m].
    pub margin: PerJoint,
    /// Has no soft form.
    #[serde(skip_serializing)]
    pub soft: AlwaysHard,
}

impl Default for PositionSettings {
    fn default() -> Self {
        PositionSettings { margin: PerJoint::All(0.0), soft: AlwaysHard }
    }
}

/// `lower + margin <= q <= upper - margin`.
///
/// Continuous joints, joints the file declares unlimited, and joints with several dofs have no position limit; a note names those of an MJCF,
/// where a forgotten range looks like an intended one.
#[derive(Debug, Clone, Default)]
pub struct PositionLimit {
    settings: PositionSettings,
    /// Least margin [rad or m].
    gap: f64,
}

/// How far from the end of its range a joint stops at least \[rad or m\] that stops before it ([`PositionLimit::before_stops`]): where a period is
/// one physics step, whose end is foreseen to rounding, and where it is several or none.
pub const STOP_GAPS: [f64; 2] = [1e-6, 1e-4];

/// What counts as outside of a position limit: the end of the range of a limit that lies one of [`STOP_GAPS`] before it, else the limit.
pub fn end_of_range(limit: f64, end: f64) -> f64 {
    if STOP_GAPS.iter().any(|gap| ((limit - end).abs() - gap).abs() < 1e-9) { end } else { limit }
}

impl PositionLimit {
    /// From the task file's settings.
    pub fn new(settings: PositionSettings) -> PositionLimit {
        PositionLimit { settings, gap: 0.0 }
    }

    /// The same, at least one of [`STOP_GAPS`] away from the ends, with `sub_steps` physics steps in a period: the stop of a simulated joint acts
    /// on a joint that is beyond it by a rounding error, and throws a robot about that would otherwise move as it is asked to.
    pub fn before_stops(settings: PositionSettings, sub_steps: usize) -> PositionLimit {
        PositionLimit { settings, gap: STOP_GAPS[usize::from(sub_steps != 1)] }
    }

    /// The same margin [rad or m] for every joint.
    pub fn with_margin(margin: f64) -> PositionLimit {
        PositionLimit::new(PositionSettings { margin: PerJoint::All(margin), soft: AlwaysHard })
    }
}

impl Limit for PositionLimit {
    fn name(&self) -> &'static str {
        "position"
    }

    fn notes(&self, model: &Model, controllable: &[usize]) -> Vec<String> {
        let free: Vec<usize> = controllable.iter().copied().filter(|i| is_free(model, *i)).collect();
        if free.is_empty() {
            return Vec::new();
        }
        vec![format!(
            "the position limit does not hold for {}, for which the robot file gives no range; write one into it, or bound q. of the joint with rows",
            quoted(model, &free)
        )]
    }

    fn named_joints(&self) -> Vec<&str> {
        self.settings.margin.names()
    }

    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        let margin =
            self.settings.margin.values(model, "position margin", |x| x >= 0.0, "at least 0 rad or m")?;
        let missing: Vec<usize> =
            controllable.iter().copied().filter(|i| model.position_limit_missing(*i)).collect();
        if !missing.is_empty() {
            let next = "write lower and upper into it, wide ones such as -1000 and 1000 for a joint that turns without end";
            return Err(LimitError::Missing { limit: "position", joints: quoted(model, &missing), next });
        }
        if !controllable.is_empty() && controllable.iter().all(|i| is_free(model, *i)) {
            let next = "write a range into it (in MJCF without <flag limit=\"disable\"/>), or leave the position limit out";
            return Err(LimitError::Missing { limit: "position", joints: quoted(model, controllable), next });
        }
        let mut narrow = Vec::new();
        for &i in controllable {
            let joint = model.joint_of_dof(i);
            if joint.nq == 1 && joint.nv == 1 {
                let m = margin[i].unwrap_or(0.0).max(self.gap);
                let (lower, upper) =
                    (model.lower_position_limit()[joint.idx_q], model.upper_position_limit()[joint.idx_q]);
                if m > 0.0 && lower + m >= upper - m {
                    let name = &joint.name;
                    narrow.push(format!("constraints.position.margin {m} of joint '{name}' leaves nothing of its range from {lower} to {upper} rad or m"));
                }
                set.q_lower[i] = set.q_lower[i].max(lower + m);
                set.q_upper[i] = set.q_upper[i].min(upper - m);
            }
        }
        if !narrow.is_empty() {
            let next = "write a smaller one, or a table of margins by joint: position = { margin = { JOINT = 0.001 } }";
            return Err(LimitError::Unusable { what: narrow.join(", "), next });
        }
        Ok(())
    }
}

/// True for a hinge or slide without a range.
fn is_free(model: &Model, dof: usize) -> bool {
    let joint = model.joint_of_dof(dof);
    let (lower, upper) = (model.lower_position_limit(), model.upper_position_limit());
    joint.nq == 1 && joint.nv == 1 && lower[joint.idx_q].is_infinite() && upper[joint.idx_q].is_infinite()
}
