//! `[command]` of a task file: what each controllable joint is sent.

use nearl_constraints::{Drive, Model, PerJoint};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// `[command]`: `interface = "pd"`, `stiffness = 100.0`, `damping = 5.0`, each one word or number for all joints or a table by joint.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct CommandSection {
    /// What the joints are commanded; a joint that is not named has `effort`.
    pub interface: Interfaces,
    /// K of `pd` joints, and of the simulated servos of a URDF's `position` joints [N·m/rad or N/m].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stiffness: Option<PerJoint>,
    /// D of the same [N·m s/rad or N s/m]; 0 when absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub damping: Option<PerJoint>,
}

/// One interface for every joint, or interfaces by joint name.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(
    untagged,
    expecting = "expected \"effort\", \"position\", \"velocity\" or \"pd\", or a table of these by joint"
)]
pub enum Interfaces {
    /// The same for all joints.
    All(Interface),
    /// By joint.
    Joints(BTreeMap<String, Interface>),
}

impl Default for Interfaces {
    fn default() -> Self {
        Interfaces::All(Interface::Effort)
    }
}

/// What a joint is commanded; see [`Drive`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Interface {
    /// A motor force [N·m or N].
    #[default]
    Effort,
    /// The position at the end of the period [rad or m].
    Position,
    /// The velocity at the end of the period [rad/s or m/s].
    Velocity,
    /// The target position of a drive with stiffness and damping [rad or m].
    Pd,
}

impl CommandSection {
    /// Every joint is sent a force: what a task file without the section says.
    pub fn is_effort(&self) -> bool {
        *self == CommandSection::default()
    }

    /// What each dof of `model` is commanded (nv); the dofs in `controllable` are the ones that matter.
    ///
    /// # Errors
    /// One sentence: a joint that the model does not have or that is not controllable, a drive without stiffness, a value out of its domain.
    pub fn drives(&self, model: &Model, controllable: &[usize]) -> Result<Vec<Drive>, String> {
        self.check_names(model, controllable)?;
        if self.interface == Interfaces::All(Interface::Effort)
            && let Some(key) = self.first_gain()
        {
            return Err(format!(
                "[command.{key}] is given, but every joint is sent a force (interface = \"effort\"), which has no gains; write interface = \"pd\", or \
                 take {key} out"
            ));
        }
        let mut drives = vec![Drive::Effort; model.nv()];
        for &i in controllable {
            let joint = model.dof_name(i);
            let interface = match &self.interface {
                Interfaces::All(all) => *all,
                Interfaces::Joints(map) => map.get(&joint).copied().unwrap_or_default(),
            };
            drives[i] = match interface {
                Interface::Effort => Drive::Effort,
                Interface::Position => Drive::Position,
                Interface::Velocity => Drive::Velocity,
                Interface::Pd => self.pd(&joint)?,
            };
        }
        Ok(drives)
    }

    /// The key of a gain that is given.
    fn first_gain(&self) -> Option<&'static str> {
        let gains = [("stiffness", &self.stiffness), ("damping", &self.damping)];
        gains.into_iter().find_map(|(key, value)| value.is_some().then_some(key))
    }

    fn pd(&self, joint: &str) -> Result<Drive, String> {
        let (stiffness, damping) = self.gains(joint)?.ok_or_else(|| {
            format!("[command.stiffness]: joint '{joint}' has a pd drive and no stiffness; give it in N m/rad or N/m")
        })?;
        Ok(Drive::Pd { stiffness, damping })
    }

    /// Stiffness [N·m/rad or N/m] and damping [N·m s/rad or N s/m] of a joint, where it has a stiffness.
    ///
    /// # Errors
    /// One sentence: a value out of its domain.
    pub fn gains(&self, joint: &str) -> Result<Option<(f64, f64)>, String> {
        let Some(stiffness) = number(self.stiffness.as_ref(), joint) else { return Ok(None) };
        let damping = number(self.damping.as_ref(), joint).unwrap_or(0.0);
        if !(stiffness.is_finite() && stiffness > 0.0) {
            return Err(format!(
                "[command.stiffness]: {stiffness} of joint '{joint}' is no stiffness; give a number above 0"
            ));
        }
        if !(damping.is_finite() && damping >= 0.0) {
            return Err(format!(
                "[command.damping]: {damping} of joint '{joint}' is no damping; give a number of at least 0"
            ));
        }
        Ok(Some((stiffness, damping)))
    }

    fn check_names(&self, model: &Model, controllable: &[usize]) -> Result<(), String> {
        let known: Vec<String> = controllable.iter().map(|i| model.dof_name(*i)).collect();
        // A simulation holds the other joints by drives, which have gains too.
        let has_motor = |name: &String| model.motors().iter().any(|motor| motor.joint == *name);
        let interface = match &self.interface {
            Interfaces::All(_) => Vec::new(),
            Interfaces::Joints(map) => map.keys().collect(),
        };
        let of = |values: &'_ Option<PerJoint>| match values {
            Some(PerJoint::Joints(map)) => map.keys().cloned().collect(),
            _ => Vec::new(),
        };
        for (key, values) in [("stiffness", &self.stiffness), ("damping", &self.damping)] {
            if let Some(PerJoint::Each(_)) = values {
                return Err(format!(
                    "[command.{key}] is a list; give one number, or a table of numbers by joint"
                ));
            }
        }
        let named = [
            ("interface", interface.into_iter().cloned().collect()),
            ("stiffness", of(&self.stiffness)),
            ("damping", of(&self.damping)),
        ];
        for (key, names) in named {
            let is_known = |name: &String| known.contains(name) || (key != "interface" && has_motor(name));
            if let Some(name) = names.iter().find(|name| !is_known(name)) {
                return Err(format!(
                    "[command.{key}]: '{name}' is no controllable joint; they are {}",
                    known.join(", ")
                ));
            }
        }
        Ok(())
    }
}

fn number(values: Option<&PerJoint>, joint: &str) -> Option<f64> {
    match values? {
        PerJoint::All(value) => Some(*value),
        PerJoint::Joints(map) => map.get(joint).copied(),
        PerJoint::Each(_) => None,
    }
}
