//! Types that the settings of several kinds of limits share.

use crate::{LimitError, Model};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Settings of one kind: of one limit or none, or of a list.
pub(super) trait Section {
    /// A list.
    const MANY: bool;

    /// Nothing is asked for.
    fn is_absent(&self) -> bool;
}

impl<S> Section for Option<S> {
    const MANY: bool = false;

    fn is_absent(&self) -> bool {
        self.is_none()
    }
}

impl<S> Section for Vec<S> {
    const MANY: bool = true;

    fn is_absent(&self) -> bool {
        self.is_empty()
    }
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
    /// The value of a dof; `None` where nothing is said.
    pub fn at(&self, model: &Model, dof: usize) -> Option<f64> {
        self.of(&model.joint_of_dof(dof).name, dof)
    }

    /// The same of the joint that has it, by name.
    pub fn of(&self, joint: &str, dof: usize) -> Option<f64> {
        match self {
            PerJoint::All(value) => Some(*value),
            PerJoint::Joints(map) => map.get(joint).copied(),
            PerJoint::Each(list) => list.get(dof).copied(),
        }
    }

    /// Refuses a table without a joint, of a limit that holds for the joints it names alone.
    ///
    /// # Errors
    /// [`LimitError::Unusable`] with the name of the limit.
    pub(crate) fn names_some(&self, limit: &str) -> Result<(), LimitError> {
        match self {
            PerJoint::Joints(map) if map.is_empty() => Err(LimitError::Unusable {
                what: format!("{limit} is an empty table, which holds for no joint"),
                next: "give one number for all, name joints, or leave the limit out",
            }),
            _ => Ok(()),
        }
    }

    /// The joints of a table by joint.
    pub(crate) fn names(&self) -> Vec<&str> {
        let PerJoint::Joints(map) = self else { return Vec::new() };
        map.keys().map(String::as_str).collect()
    }

    /// The dofs among `controllable` of which a table by joint says nothing.
    pub(crate) fn left_out(&self, model: &Model, controllable: &[usize]) -> Vec<usize> {
        let PerJoint::Joints(map) = self else { return Vec::new() };
        controllable.iter().copied().filter(|i| !map.contains_key(&model.joint_of_dof(*i).name)).collect()
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
