//! What the three planar runners share: `rootx, rootz, rooty` first, `x` left out of the observation.

use crate::mj::{Model, ModelFormat, Options, Sim};

use super::rules::{Robot, Rules, joint_names};
use super::simulated::Simulated;
use super::spec::{Constants, Spec};
use super::{Env, EnvError};

/// Observation names: positions without the first joint's, then all velocities.
pub(super) fn build<R: Rules>(
    task: Constants,
    text: &'static str,
    rules: R,
) -> Result<Box<dyn Env>, EnvError> {
    let physics = |source| EnvError::Physics { task: task.name.clone(), source };
    let robot = Robot { text: text.into(), format: ModelFormat::Mjcf };
    let model = Model::from_text(text, robot.format, Options::default()).map_err(physics)?;
    let sim = Sim::new(&model).map_err(physics)?;
    let spec = Spec::new(&model, task, joint_names(&model, 1), model.actuators());
    Ok(Simulated::boxed(spec, robot, rules, sim))
}

/// `[q_1 .., v_0 ..]` with the velocities clipped to `[-clip, clip]`.
pub(super) fn observe(sim: &Sim, clip: f64, obs: &mut [f64]) {
    let (position, velocity) = obs.split_at_mut(sim.qpos().len() - 1);
    position.copy_from_slice(&sim.qpos()[1..]);
    for (o, v) in velocity.iter_mut().zip(sim.qvel()) {
        *o = v.clamp(-clip, clip);
    }
}

/// Forward velocity over the period \[m/s\].
pub(super) fn speed(spec: &Spec, before: f64, after: f64) -> f64 {
    (after - before) / spec.dt
}
