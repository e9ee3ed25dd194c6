//! Acceleration limits, which are also what braking counts on.

use super::margin::less_each;
use super::{About, AlwaysHard, Argument, Form, Limit, LimitSet, PerJoint, Takes, quoted};
use crate::{LimitError, Model, Period};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "AccelerationLimit",
    promise: "Acceleration stays below `limit` [rad/s², m/s²]. `braking` is the deceleration that position limits count on, \
        at most `limit`, which is also its default.",
    example: "acceleration = { limit = 10.0 }",
    form: Form::Hard,
    margin: "[rad/s², m/s²]; `braking` is as it is written",
    stricter: Some([
        "acceleration = { limit = 10.0, braking = 4.0, margin = { panda_joint1 = 3.0 } }",
        "acceleration = { limit = { panda_joint1 = 7.0, panda_joint2 = 10.0, panda_joint3 = 10.0, panda_joint4 = 10.0, \
        panda_joint5 = 10.0, panda_joint6 = 10.0, panda_joint7 = 10.0 }, braking = 4.0 }",
    ]),
    arguments: &[
        Argument::needed("limit", Takes::PerJoint),
        Argument::or("braking", Takes::PerJoint, "None"),
        Argument::MARGINS,
    ],
};

/// `acceleration = { limit }` or `acceleration = { limit, braking }`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AccelerationSettings {
    /// Largest acceleration A [rad/s² or m/s²].
    pub limit: PerJoint,
    /// Deceleration that braking in front of position limits counts on, at most A, which is also its default
    /// [rad/s² or m/s²].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub braking: Option<PerJoint>,
    /// Acceleration kept below the limit [rad/s² or m/s²].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub margin: Option<PerJoint>,
    /// Has no soft form.
    #[serde(default, skip_serializing)]
    pub soft: AlwaysHard,
}

impl AccelerationSettings {
    /// `limit`, and the deceleration that `braking` counts on.
    pub fn of(limit: PerJoint, braking: Option<PerJoint>) -> AccelerationSettings {
        AccelerationSettings { limit, braking, margin: None, soft: AlwaysHard }
    }
}

/// `|a| <= A`, and every position limit is approached so that `braking` still stops in front of it.
///
/// With torque limits, `braking` must be a deceleration the motors can always give:
/// [`certify_braking`](crate::certify_braking) says whether it is. A itself may be larger, the torque rows hold it back.
#[derive(Debug, Clone)]
pub struct AccelerationLimit {
    settings: AccelerationSettings,
    /// Share of A that braking counts on at most.
    share: f64,
}

impl AccelerationLimit {
    /// From the task file's settings.
    pub fn new(settings: AccelerationSettings) -> AccelerationLimit {
        AccelerationLimit { settings, share: 1.0 }
    }

    /// The same for a plant that moves through a period in such a way ([`Period::counted`]).
    pub fn over_steps(settings: AccelerationSettings, period: &Period) -> AccelerationLimit {
        AccelerationLimit { settings, share: period.counted() }
    }

    /// The same limit [rad/s² or m/s²] for every joint.
    pub fn uniform(a_max: f64) -> AccelerationLimit {
        AccelerationLimit::new(AccelerationSettings::of(PerJoint::All(a_max), None))
    }
}

impl Limit for AccelerationLimit {
    fn name(&self) -> &'static str {
        "acceleration"
    }

    fn notes(&self, model: &Model, controllable: &[usize]) -> Vec<String> {
        let without = self.settings.limit.left_out(model, controllable);
        if without.is_empty() {
            return Vec::new();
        }
        vec![format!(
            "the acceleration limit does not name {}, which may speed up and brake without limit; name every controllable joint, or give one number for \
             all",
            quoted(model, &without)
        )]
    }

    fn named_joints(&self) -> Vec<&str> {
        self.settings.limit.names()
    }

    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        let domain = "above 0 rad/s² or m/s²";
        self.settings.limit.names_some("acceleration limit")?;
        let mut values = self.settings.limit.values(model, "acceleration limit", |x| x > 0.0, domain)?;
        less_each(model, "acceleration margin", &mut values, self.settings.margin.as_ref(), controllable)?;
        for &i in controllable {
            set.acceleration[i] = set.acceleration[i].min(values[i].unwrap_or(f64::INFINITY));
            set.braking[i] = set.braking[i].min(self.share * set.acceleration[i]);
        }
        let Some(braking) = &self.settings.braking else { return Ok(()) };
        let values = braking.values(model, "acceleration braking", |x| x > 0.0, domain)?;
        for &i in controllable {
            let (stated, most) = (values[i].unwrap_or(set.acceleration[i]), set.acceleration[i]);
            if stated > most {
                return Err(LimitError::Unusable {
                    what: format!(
                        "acceleration braking of joint '{}' is {stated} rad/s² or m/s², above its acceleration limit of {most}",
                        model.dof_name(i)
                    ),
                    next: "brake with at most the limit less its margin",
                });
            }
            set.braking[i] = set.braking[i].min(stated);
        }
        Ok(())
    }
}
