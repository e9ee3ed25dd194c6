//! From what the controllable joints are commanded to what the plant's motors are sent, and back.
//!
//! ```text
//!     torque = gear (gain u + bias)        so        u = (torque / gear - bias) / gain
//! ```
//!
//! The plant's order is that of its motors; the joints' is that of their dofs. A joint that is commanded something else than a force is
//! sent its command as it is.

use nearl_constraints::description::Motor;
use nearl_constraints::{Drive, Model};

/// The motors of the controllable joints, one each.
#[derive(Clone, Debug, PartialEq)]
pub struct Motors {
    /// By controllable joint.
    by_joint: Vec<OneMotor>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct OneMotor {
    /// Place in the action.
    at: usize,
    law: Option<Law>,
}

/// A motor that is more than its torque.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Law {
    gear: f64,
    gain: f64,
    bias: f64,
}

impl Motors {
    /// The motors of the joints of `dofs` (ascending), whose commands `drives` (nv) names.
    ///
    /// # Errors
    /// A sentence: a joint without a motor or with several, a motor whose torque is not linear in its control.
    pub fn new(model: &Model, dofs: &[usize], drives: &[Drive]) -> Result<Motors, String> {
        let motors = dofs.iter().map(|&dof| one(model, dof)).collect::<Result<Vec<_>, _>>()?;
        let place = |motor: &Motor| motors.iter().filter(|other| other.order < motor.order).count();
        let one_motor = |(&dof, motor): (&usize, &&Motor)| {
            let law = if drives[dof] == Drive::Effort { law(motor)? } else { None };
            Ok(OneMotor { at: place(motor), law })
        };
        Ok(Motors { by_joint: dofs.iter().zip(&motors).map(one_motor).collect::<Result<_, String>>()? })
    }

    /// Where in the action the `k`-th controllable joint's entry is.
    pub fn place(&self, k: usize) -> usize {
        self.by_joint[k].at
    }

    /// The action entry for a command to the `k`-th controllable joint; of motors the torque [N·m or N].
    pub fn action(&self, k: usize, command: f64) -> f64 {
        match self.by_joint[k].law {
            None => command,
            Some(law) => (command / law.gear - law.bias) / law.gain,
        }
    }

    /// The command that an action entry is: the inverse of [`Motors::action`].
    pub fn command(&self, k: usize, action: f64) -> f64 {
        match self.by_joint[k].law {
            None => action,
            Some(law) => law.gear * (law.gain * action + law.bias),
        }
    }
}

/// The motor of a joint.
fn one(model: &Model, dof: usize) -> Result<&Motor, String> {
    let joint = model.dof_name(dof);
    let mut motors = model.motors().iter().filter(|motor| motor.joint == joint);
    match (motors.next(), motors.next()) {
        (Some(motor), None) => Ok(motor),
        (None, _) => Err(format!(
            "joint '{joint}' is controllable and has no motor; give it one, or do not control it"
        )),
        (Some(a), Some(b)) => Err(format!(
            "joint '{joint}' is driven by the actuators '{}' and '{}', and nothing says how they share its torque; keep one",
            a.name, b.name
        )),
    }
}

/// `None` where the control is the torque.
fn law(motor: &Motor) -> Result<Option<Law>, String> {
    let Motor { name, joint, gear, gain, bias: [bias, by_q, by_v], .. } = motor;
    let beyond = match &motor.not_modelled {
        Some(reason) if *gear == 0.0 || *gain == 0.0 => {
            Some((format!("has {reason}"), "write another number into the robot file"))
        }
        Some(reason) => Some((format!("has {reason}"), "take a <motor> in its place")),
        None if (*by_q, *by_v) != (0.0, 0.0) => Some((
            "depends on position or velocity".to_string(),
            "say what it is sent under [command], take a <motor> in its place",
        )),
        None => None,
    };
    match beyond {
        Some((reason, next)) => Err(format!(
            "the torque of actuator '{name}' on joint '{joint}' is asked for, but it {reason}; {next}, or use idm.kind = \"learned\""
        )),
        None if (*gear, *gain, *bias) == (1.0, 1.0, 0.0) => Ok(None),
        None => Ok(Some(Law { gear: *gear, gain: *gain, bias: *bias })),
    }
}
