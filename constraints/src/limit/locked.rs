//! Joints that must not move.

use super::{About, Argument, Form, Limit, LimitSet, Takes};
use crate::{LimitError, Model};
use serde::{Deserialize, Serialize};

/// `locked`, as it describes itself.
pub(super) const ABOUT: About = About {
    class: "LockedJoints",
    promise: "The joint brakes to standstill and stays.",
    example: "locked = [\"panda_joint7\"]",
    form: Form::Hard,
    margin: "has no bound",
    stricter: None,
    arguments: &[Argument::needed("joints", Takes::Names).at("")],
};

/// Names of joints.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct LockedSettings {
    /// The joints by name.
    pub joints: Vec<String>,
}

/// `locked = ["joint", ...]`: these joints brake to standstill and stay, whatever is proposed.
#[derive(Debug, Clone)]
pub struct LockedJoints {
    settings: LockedSettings,
}

impl LockedJoints {
    /// From the task file's settings.
    pub fn new(settings: LockedSettings) -> LockedJoints {
        LockedJoints { settings }
    }

    /// The joints by name.
    pub fn of(joints: Vec<String>) -> LockedJoints {
        LockedJoints { settings: LockedSettings { joints } }
    }
}

impl Limit for LockedJoints {
    fn name(&self) -> &'static str {
        "locked"
    }

    fn named_joints(&self) -> Vec<&str> {
        self.settings.joints.iter().map(String::as_str).collect()
    }

    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        for (k, name) in self.settings.joints.iter().enumerate() {
            if self.settings.joints[..k].contains(name) {
                let what = format!("locked names joint '{name}' twice");
                return Err(LimitError::Unusable { what, next: "name each joint once" });
            }
            let unknown = |near| LimitError::UnknownJoint { limit: "locked", name: name.clone(), near };
            let joint = model.find(name).map_err(unknown)?;
            for i in joint.idx_v..joint.idx_v + joint.nv {
                set.locked[i] |= controllable.contains(&i);
            }
        }
        Ok(())
    }
}
