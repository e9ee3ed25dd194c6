//! The robot and the limits of a task as a snapshot without a policy, for a process that proposes in its place.

use crate::vector::{VectorError, space};
use crate::{env, tasks, train};
use nearl_runtime::constraints::description::Command;
use nearl_runtime::constraints::{Drive, Guard, Model};
use nearl_runtime::controller::Parts;
use nearl_runtime::snapshot::BLANK;
use nearl_runtime::task::{IdmKind, Task};
use nearl_runtime::{Manifest, Snapshot};

/// A snapshot whose own policy keeps the robot where it is (states), or asks for nothing (`actions`, behind the guard).
///
/// A task that is no environment, as that of a robot, needs `[state] observation`, and takes the range of its actions from the robot file.
///
/// # Errors
/// [`VectorError`]: the task, a joint without limits, or inverse dynamics that nothing but a learned model or a simulator knows.
pub fn snapshot(task: &str, actions: bool) -> Result<Snapshot, VectorError> {
    let mut manifest = tasks::load(task, &[])?;
    if manifest.task.idm.kind == IdmKind::Learned {
        return Err(VectorError::Unusable(format!(
            "task '{task}' has a learned inverse model, and a loop without its networks does not know what an action leads to; use a task with \
             idm.kind = \"pinocchio\""
        )));
    }
    let guard = &mut manifest.task.constraints.guard;
    if actions && matches!(guard, Guard::Simulator) {
        return Err(VectorError::Unusable(format!(
            "task '{task}' has guard = \"simulator\", and a loop has no simulator; write guard = true, or \"drive\" for a robot on legs"
        )));
    }
    if actions && guard.is_off() {
        *guard = Guard::Model;
    }
    complete(&mut manifest)?;
    manifest.algo = BLANK.into();
    let snapshot = if actions { space::idle(manifest) } else { space::still(manifest) };
    snapshot.check()?;
    Ok(snapshot)
}

/// Fills in what the environment of the task knows, or what follows from the robot where it is none.
///
/// # Errors
/// As [`snapshot`].
pub fn complete(manifest: &mut Manifest) -> Result<(), VectorError> {
    if !env::is_known(&manifest.task) {
        return range(manifest);
    }
    train::complete(manifest)?;
    Ok(())
}

/// The range of the actions: what the motors give, and where drives may be sent.
fn range(manifest: &mut Manifest) -> Result<(), VectorError> {
    let name = manifest.task.name.clone();
    if manifest.task.state.observation.is_empty() {
        return Err(VectorError::Unusable(format!(
            "task '{name}' is no environment and does not say what its plant observes; write observation = [\"q.JOINT\", \"v.JOINT\", ...] under [state]"
        )));
    }
    let Parts { model, layout, .. } = Parts::new(manifest)?;
    let drives = Parts::drives(manifest, &model, layout.controllable())?;
    let motors = Parts::motors(&model, layout.controllable(), &drives)?;
    let mut places = vec![(0.0, 0.0); layout.controllable().len()];
    for (k, &dof) in layout.controllable().iter().enumerate() {
        let [low, high] = commands(&manifest.task, &model, drives[dof], dof);
        if !(low.is_finite() && high.is_finite()) {
            return Err(VectorError::Unusable(format!(
                "task '{name}': nothing bounds what joint '{}' can be sent; {}",
                model.dof_name(dof),
                bound_by(drives[dof], &model, dof)
            )));
        }
        let ends = [motors.action(k, low), motors.action(k, high)];
        places[motors.place(k)] = (ends[0].min(ends[1]), ends[0].max(ends[1]));
    }
    (manifest.action_lower, manifest.action_upper) = places.into_iter().unzip();
    Ok(())
}

/// What would bound the commands of a joint.
fn bound_by(drive: Drive, model: &Model, dof: usize) -> &'static str {
    match drive {
        Drive::Effort => {
            "write its effort into the robot file: effort in <limit> of a URDF, ctrlrange of an MJCF's motor"
        }
        Drive::Pd { .. } if model.effort_limit()[dof].is_infinite() => {
            "write its effort into the robot file: effort in <limit> of a URDF, forcerange of an MJCF's actuator"
        }
        Drive::Velocity => {
            "write velocity into its <limit> in a URDF, or limit under constraints.velocity of the task: an MJCF has no place for it"
        }
        _ => {
            "write its range into the robot file: lower and upper in <limit> of a URDF, range of an MJCF's joint"
        }
    }
}

/// Lowest and highest command of a joint, infinite where nothing bounds it: all that its motor gives; of a drive the control range that the robot
/// file states for it, else the targets that may ask for the whole effort somewhere, at any speed that file and task know.
pub(crate) fn commands(task: &Task, model: &Model, drive: Drive, dof: usize) -> [f64; 2] {
    let (joint, effort) = (model.dof_name(dof), model.effort_limit()[dof]);
    let iq = model.joint_of_dof(dof).idx_q;
    let range = [model.lower_position_limit()[iq], model.upper_position_limit()[iq]];
    let asked = task.constraints.velocity.as_ref().and_then(|v| v.limit.as_ref()?.at(model, dof));
    let speeds = [Some(model.velocity_limit()[dof]).filter(|x| x.is_finite()), asked];
    let speed = speeds.into_iter().flatten().reduce(f64::max);
    let motor = model.motors().iter().find(|motor| motor.joint == joint);
    let own = motor.filter(|motor| matches!(motor.command, Command::Position | Command::Pd));
    let own = own.and_then(|motor| motor.control_range);
    let servo = |(stiffness, damping)| Drive::Pd { stiffness, damping };
    let pulls = match drive {
        Drive::Position => task.command.gains(&joint).ok().flatten().map(servo),
        Drive::Pd { .. } => Some(drive),
        _ => None,
    };
    match (drive, own, pulls) {
        (Drive::Effort, ..) => [-effort, effort],
        (Drive::Velocity, ..) => speed.map_or([f64::NEG_INFINITY, f64::INFINITY], |speed| [-speed, speed]),
        (_, Some(own), _) => own,
        (_, None, Some(pulls)) => {
            let reach = pulls.reach(&task.period(), effort, speed.unwrap_or(0.0));
            let turns = 2.0 * std::f64::consts::PI;
            [range[0].max(-turns) - reach, range[1].min(turns) + reach]
        }
        (_, None, None) => range,
    }
}
