//! The `[constraints]` section of a task file.

use super::{
    AccelerationSettings, ActionSettings, CollisionSettings, EnergySettings, FrameSettings,
    FrameSpeedSettings, JerkSettings, PositionSettings, TorqueRateSettings, TorqueSettings,
    TorqueSpeedSettings, UserRowSettings, VelocityProfileSettings, VelocitySettings,
};
use crate::{Braking, Consistency, Guard, LimitError, Model, Solver};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// `[constraints]`: how proposals are made consistent and which limits hold. A limit that is not named does not hold.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConstraintSettings {
    /// `"kinematic"` (default) or `"free"`.
    pub consistency: Consistency,
    /// `"ladder"` (default) or `"clarabel"`.
    pub solver: Solver,
    /// `"auto"` (default), `"certified"` or `"stored"`.
    pub braking: Braking,
    /// `true`: actions of a policy and of a learned inverse model lead to a projected state too.
    #[serde(skip_serializing_if = "Guard::is_off")]
    pub guard: Guard,
    /// `position = { margin = 0.01 }`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position: Option<PositionSettings>,
    /// `velocity = { scale = 0.8 }` or `velocity = { limit = 2.0 }`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub velocity: Option<VelocitySettings>,
    /// `acceleration = { limit = 10.0 }` or `acceleration = { limit = { elbow = 10.0 } }`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acceleration: Option<AccelerationSettings>,
    /// `torque = { scale = 0.9 }`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub torque: Option<TorqueSettings>,
    /// `jerk = { limit = 500.0 }`, soft, or `jerk = { limit = 500.0, hard = true }`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jerk: Option<JerkSettings>,
    /// `torque_speed = { stall = 80.0, no_load = 3.0 }`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub torque_speed: Option<TorqueSpeedSettings>,
    /// `torque_rate = { limit = 1000.0 }`; soft.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub torque_rate: Option<TorqueRateSettings>,
    /// `velocity_profile = "fr3"` or curves by joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub velocity_profile: Option<VelocityProfileSettings>,
    /// `locked = ["joint"]`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub locked: Vec<String>,
    /// `frame = [{ frame, point, half_space, box, braking, margin, soft }]`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub frame: Vec<FrameSettings>,
    /// `frame_speed = [{ frame, point, limit }]`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub frame_speed: Vec<FrameSpeedSettings>,
    /// `energy = { limit = 2.0 }`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub energy: Option<EnergySettings>,
    /// `collision = { shapes, urdf, ignore, adjacent, braking, margin, influence, rows, soft }`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub collision: Option<CollisionSettings>,
    /// `action = { power = 20.0 }`; of policies whose actions come out of a network, see [`ActionLimit`](crate::ActionLimit).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub action: Option<ActionSettings>,
    /// `rows = [{ name, terms, lower, upper, equals, braking, soft }]`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rows: Vec<UserRowSettings>,
}

/// One number for every joint, numbers by joint name, or one number for each dof in the order of a velocity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "expected a number, a table of numbers by joint, or a list of one number for each joint"
)]
pub enum PerJoint {
    /// The same for all joints.
    All(f64),
    /// By joint; joints that are not named get nothing from it.
    Joints(BTreeMap<String, f64>),
    /// Dof by dof (nv).
    Each(Vec<f64>),
}

impl PerJoint {
    /// The value of a joint by its name; `None` where nothing is said, and for a list by dof.
    pub fn of(&self, joint: &str) -> Option<f64> {
        match self {
            PerJoint::All(value) => Some(*value),
            PerJoint::Joints(map) => map.get(joint).copied(),
            PerJoint::Each(_) => None,
        }
    }

    /// One value per dof (nv), `None` where nothing is said.
    ///
    /// # Errors
    /// A joint the model does not have, or a value outside the domain (`allowed`, described by `domain`).
    pub(crate) fn values(
        &self,
        model: &Model,
        limit: &'static str,
        allowed: fn(f64) -> bool,
        domain: &'static str,
    ) -> Result<Vec<Option<f64>>, LimitError> {
        let checked = |what: String, value: f64| match value.is_finite() && allowed(value) {
            true => Ok(value),
            false => Err(LimitError::BadValue { what, value, domain }),
        };
        let mut values = vec![None; model.nv()];
        match self {
            PerJoint::All(value) => values.fill(Some(checked(limit.to_string(), *value)?)),
            PerJoint::Each(list) if list.len() != model.nv() => {
                let (given, nv) = (list.len(), model.nv());
                return Err(LimitError::Unusable {
                    what: format!("{limit} is a list of {given} numbers for a robot of {nv} dofs"),
                    next: "give one number for each dof, one for all, or a table by joint",
                });
            }
            PerJoint::Each(list) => {
                for (i, value) in list.iter().enumerate() {
                    let of = || format!("{limit} of joint '{}'", model.dof_name(i));
                    values[i] = Some(checked(of(), *value)?);
                }
            }
            PerJoint::Joints(map) => {
                for (name, value) in map {
                    let unknown = |near| LimitError::UnknownJoint { limit, name: name.clone(), near };
                    let joint = model.find(name).map_err(unknown)?;
                    let value = checked(format!("{limit} of joint '{name}'"), *value)?;
                    values[joint.idx_v..joint.idx_v + joint.nv].fill(Some(value));
                }
            }
        }
        Ok(values)
    }
}
