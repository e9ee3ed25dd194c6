//! Speed limits: the robot file's, scaled, or the task file's own.

use super::margin::less_each;
use super::{About, AlwaysHard, Argument, Form, Limit, LimitSet, PerJoint, Takes, quoted};
use crate::{LimitError, Model};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "VelocityLimit",
    promise: "Speed stays below `scale`, a share in (0, 1] of the robot file's limits, or below `limit` [rad/s, m/s]; the \
        smaller holds where both are given.",
    example: "velocity = { scale = 0.8 }",
    form: Form::Hard,
    margin: "[rad/s, m/s]",
    stricter: Some(["velocity = { limit = 0.9, margin = 0.3 }", "velocity = { limit = 0.6 }"]),
    arguments: &[
        Argument::or("limit", Takes::PerJoint, "None"),
        Argument::named("scale", Takes::Number, "None"),
        Argument::MARGINS,
    ],
};

/// `velocity = { scale }` or `velocity = { limit }`, less `margin`; with both, the smaller holds; with none, `scale = 1`. Joints that
/// `limit` does not name keep the robot file's.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VelocitySettings {
    /// Share of the robot file's limit, in (0, 1].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    /// Own limits [rad/s or m/s], in place of the robot file's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub limit: Option<PerJoint>,
    /// Speed kept below the limit [rad/s or m/s].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub margin: Option<PerJoint>,
    /// Has no soft form.
    #[serde(skip_serializing)]
    pub soft: AlwaysHard,
}

/// `|v'| <= V`.
#[derive(Debug, Clone, Default)]
pub struct VelocityLimit {
    settings: VelocitySettings,
}

impl VelocityLimit {
    /// From the task file's settings.
    pub fn new(settings: VelocitySettings) -> VelocityLimit {
        VelocityLimit { settings }
    }

    /// A share in (0, 1] of the robot file's limits.
    pub fn scaled(scale: f64) -> VelocityLimit {
        VelocityLimit { settings: VelocitySettings { scale: Some(scale), ..VelocitySettings::default() } }
    }

    /// Own limits [rad/s or m/s].
    pub fn values(limit: PerJoint) -> VelocityLimit {
        VelocityLimit { settings: VelocitySettings { limit: Some(limit), ..VelocitySettings::default() } }
    }

    fn restrict_by_file(
        &self,
        scale: f64,
        model: &Model,
        controllable: &[usize],
        own: &mut [Option<f64>],
    ) -> Result<(), LimitError> {
        if !(scale > 0.0 && scale <= 1.0) {
            let domain = "above 0 and at most 1";
            return Err(LimitError::BadValue { what: "velocity scale".to_string(), value: scale, domain });
        }
        let stated = model.velocity_limit();
        let missing: Vec<usize> = controllable.iter().copied().filter(|i| stated[*i].is_infinite()).collect();
        if !missing.is_empty() {
            let next = match missing.iter().all(|&i| own[i].is_some()) {
                true => "scale is a share of the robot file's: leave it out and write a smaller limit",
                false => {
                    "give them in the task file: velocity = { limit = 3.0 } or { limit = { joint = 3.0 } }"
                }
            };
            return Err(LimitError::Missing { limit: "velocity", joints: quoted(model, &missing), next });
        }
        for &i in controllable {
            own[i] = Some(own[i].unwrap_or(f64::INFINITY).min(scale * stated[i]));
        }
        Ok(())
    }
}

impl Limit for VelocityLimit {
    fn name(&self) -> &'static str {
        "velocity"
    }

    fn notes(&self, model: &Model, controllable: &[usize]) -> Vec<String> {
        let Some(limit) = self.settings.limit.as_ref().filter(|_| self.settings.scale.is_none()) else {
            return Vec::new();
        };
        let mut without = limit.left_out(model, controllable);
        without.retain(|i| model.velocity_limit()[*i].is_infinite());
        if without.is_empty() {
            return Vec::new();
        }
        vec![format!(
            "the velocity limit does not name {}, for which the robot file gives none either; name every controllable joint, or give one number for all",
            quoted(model, &without)
        )]
    }

    fn named_joints(&self) -> Vec<&str> {
        self.settings.limit.as_ref().map_or(Vec::new(), |limit| limit.names())
    }

    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        let mut own = match &self.settings.limit {
            Some(limit) => limit.values(model, "velocity limit", |x| x > 0.0, "above 0 rad/s or m/s")?,
            None => vec![None; model.nv()],
        };
        if self.settings.scale.is_some() || self.settings.limit.is_none() {
            let scale = self.settings.scale.unwrap_or(1.0);
            self.restrict_by_file(scale, model, controllable, &mut own)?;
        }
        for &i in controllable {
            own[i] = own[i].or(Some(model.velocity_limit()[i]).filter(|v| v.is_finite()));
        }
        less_each(model, "velocity margin", &mut own, self.settings.margin.as_ref(), controllable)?;
        for &i in controllable {
            set.velocity[i] = set.velocity[i].min(own[i].unwrap_or(f64::INFINITY));
        }
        Ok(())
    }
}
