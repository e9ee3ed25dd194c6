//! The robot and the limits of a task as a snapshot without a policy, for a process that proposes in its place.

use crate::vector::{VectorError, space};
use crate::{env, tasks, train};
use nearl_runtime::constraints::{Drive, Guard};
use nearl_runtime::controller::Parts;
use nearl_runtime::task::IdmKind;
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
    if actions {
        manifest.task.constraints.guard = Guard::Model;
    }
    complete(&mut manifest)?;
    manifest.algo = "blank".into();
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
        let (iq, effort) = (model.joint_of_dof(dof).idx_q, model.effort_limit()[dof]);
        let (lower, upper) = (model.lower_position_limit()[iq], model.upper_position_limit()[iq]);
        let (low, high) = match drives[dof] {
            Drive::Effort => (motors.action(k, -effort), motors.action(k, effort)),
            Drive::Pd { .. } => {
                let reach = drives[dof].reach(&manifest.task.period(), effort, model.velocity_limit()[dof]);
                (lower - reach, upper + reach)
            }
            Drive::Position => (lower, upper),
            Drive::Velocity => (-model.velocity_limit()[dof], model.velocity_limit()[dof]),
        };
        if !(low.is_finite() && high.is_finite()) {
            return Err(VectorError::Unusable(format!(
                "task '{name}': the robot file does not bound what joint '{}' can be sent; give it position, velocity and effort limits",
                model.dof_name(dof)
            )));
        }
        places[motors.place(k)] = (low.min(high), low.max(high));
    }
    (manifest.action_lower, manifest.action_upper) = places.into_iter().unzip();
    Ok(())
}
