//! Whether the simulator's actuators take what `[command]` of a task sends them.

use nearl_runtime::Manifest;
use nearl_runtime::constraints::description::Motor;
use nearl_runtime::constraints::{Drive, Model, StateLayout};

use super::{Env, EnvError};

/// Whether two gains are the same but for the three decimals that a policy's metadata has.
fn same(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-3 * a.abs().max(1.0)
}

/// Whether an actuator that gives `gain u + by_q q + by_v v` takes commands of this kind.
fn takes(drive: Drive, gains: Option<[f64; 3]>) -> bool {
    match (drive, gains) {
        (Drive::Effort, _) => true,
        (Drive::Pd { .. } | Drive::Position, Some([gain, by_q, _])) => gain > 0.0 && gain == -by_q,
        (Drive::Velocity, Some([gain, by_q, by_v])) => gain > 0.0 && by_q == 0.0 && gain == -by_v,
        (_, None) => false,
    }
}

/// What the actuator of a joint is in place of a drive.
fn other(manifest: &Manifest, joint: &str) -> Option<String> {
    let motor = manifest.robot.motors.iter().find(|motor| motor.joint == joint)?;
    let Motor { name, gear, gain, bias: [constant, by_q, _], not_modelled, .. } = motor;
    let what = if let Some(reason) = not_modelled {
        format!("has {reason}")
    } else if *gear != 1.0 {
        format!(
            "has gear {gear}; with gear 1 its gains are {gear}² times as much, and what it is sent a {gear}th"
        )
    } else if *by_q != 0.0 && *by_q != -gain {
        format!(
            "pushes with {gain} times what it is sent and {by_q} times the position, which have to be opposite"
        )
    } else if *constant != 0.0 {
        format!("pushes with {constant} besides")
    } else {
        return None;
    };
    Some(format!("actuator '{name}' {what}"))
}

/// Refuses a simulation in which positions, velocities or targets would act as something else.
///
/// # Errors
/// [`EnvError::Task`].
pub(super) fn check(manifest: &Manifest, env: &dyn Env, origin: &str) -> Result<(), EnvError> {
    let task = &manifest.task;
    if task.command.is_effort() {
        return Ok(());
    }
    // What is wrong with robot, state or section is said where the controller is made.
    let Ok(model) = Model::from_description(manifest.robot.clone()) else { return Ok(()) };
    let (propose, controllable) = (task.state.propose.as_deref(), task.state.controllable.as_deref());
    // What the policy sees where the task does not say.
    let of_task = &task.state.observation;
    let observation = if of_task.is_empty() { &env.spec().obs } else { of_task };
    let Ok(layout) = StateLayout::new(&model, observation, propose, controllable) else {
        return Ok(());
    };
    let Ok(drives) = task.command.drives(&model, layout.controllable()) else { return Ok(()) };
    for &dof in layout.controllable() {
        let (drive, joint) = (drives[dof], model.dof_name(dof));
        let actuator = env.spec().actuators.iter().find(|a| a.joint == joint);
        let gains = actuator.filter(|a| a.gear == 1.0).and_then(|a| env.sim().model().gains(a.control));
        let reason = match (drive, gains) {
            (Drive::Pd { stiffness, damping }, Some([gain, _, by_v]))
                if takes(drive, gains) && !(same(stiffness, gain) && same(damping, -by_v)) =>
            {
                format!(
                    "the drive of joint '{joint}' has stiffness {stiffness} and damping {damping} here, and the simulated robot's has {gain} and {}; \
                     write the gains of the robot file",
                    -by_v
                )
            }
            _ if takes(drive, gains) => continue,
            _ => format!(
                "joint '{joint}' is sent '{}' commands, and the simulated robot has no such drive{}; give {}, or drive the robot by a plant of your \
                 own (docs/CONNECT.md)",
                drive.name(),
                other(manifest, &joint).map(|what| format!(" ({what})")).unwrap_or_default(),
                match drive {
                    Drive::Velocity => "an MJCF with <velocity kv=\"D\"> actuators",
                    Drive::Pd { .. } => "an MJCF with <position kp=\"K\" kv=\"D\"> actuators",
                    _ =>
                        "an MJCF with <position kp=\"K\"> actuators, or a URDF and the servos' stiffness and damping in [command]",
                }
            ),
        };
        return Err(EnvError::Task { origin: origin.into(), key: "command".into(), reason });
    }
    Ok(())
}
