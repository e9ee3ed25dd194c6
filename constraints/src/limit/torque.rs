//! Motor force limits of the robot file.

use super::{Limit, LimitSet, quoted};
use crate::{LimitError, Model};
use serde::{Deserialize, Serialize};

/// `torque = { scale }`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TorqueSettings {
    /// Share of the robot file's effort limit, in (0, 1].
    pub scale: f64,
}

impl Default for TorqueSettings {
    fn default() -> Self {
        TorqueSettings { scale: 1.0 }
    }
}

/// `|(M/T) y + nle - passive| <= scale * effort`, at the state of the tick.
#[derive(Debug, Clone, Default)]
pub struct TorqueLimit {
    settings: TorqueSettings,
}

impl TorqueLimit {
    /// From the task file's settings.
    pub fn new(settings: TorqueSettings) -> TorqueLimit {
        TorqueLimit { settings }
    }

    /// A share in (0, 1] of the robot file's effort limits.
    pub fn scaled(scale: f64) -> TorqueLimit {
        TorqueLimit { settings: TorqueSettings { scale } }
    }
}

impl Limit for TorqueLimit {
    fn name(&self) -> &'static str {
        "torque"
    }

    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        let scale = self.settings.scale;
        if !(scale > 0.0 && scale <= 1.0) {
            let domain = "above 0 and at most 1";
            return Err(LimitError::BadValue { what: "torque scale".to_string(), value: scale, domain });
        }
        let stated = model.effort_limit();
        let without = |i: &usize| stated[*i].is_infinite() || stated[*i] <= 0.0;
        let missing: Vec<usize> = controllable.iter().copied().filter(without).collect();
        if !missing.is_empty() {
            let next =
                "write effort (URDF) or a motor with ctrlrange (MJCF) into it, or do not control the joint";
            return Err(LimitError::Missing { limit: "torque", joints: quoted(model, &missing), next });
        }
        for &i in controllable {
            set.effort[i] = set.effort[i].min(scale * stated[i]);
        }
        Ok(())
    }
}
