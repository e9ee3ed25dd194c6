//! Joints that must not move.

use super::{Limit, LimitSet};
use crate::{LimitError, Model};

/// `locked = ["joint", ...]`: these joints brake to standstill and stay, whatever is proposed.
#[derive(Debug, Clone)]
pub struct LockedJoints {
    joints: Vec<String>,
}

impl LockedJoints {
    /// The joints by name.
    pub fn new(joints: Vec<String>) -> LockedJoints {
        LockedJoints { joints }
    }
}

impl Limit for LockedJoints {
    fn name(&self) -> &'static str {
        "locked"
    }

    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        for name in &self.joints {
            let unknown = |near| LimitError::UnknownJoint { limit: "locked", name: name.clone(), near };
            let joint = model.find(name).map_err(unknown)?;
            for i in joint.idx_v..joint.idx_v + joint.nv {
                set.locked[i] |= controllable.contains(&i);
            }
        }
        Ok(())
    }
}
