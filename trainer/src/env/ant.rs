//! Ant-v5: walk forward on four legs, with contact forces observed and paid for.
//!
//! `reward = (x' - x) / dt + 1 [healthy] - 0.5 |a|^2 - 0.0005 |clip(cfrc, -1, 1)|^2`, where `x` is the torso's; healthy while
//! `0.2 <= z <= 1` and the state is finite. Source: gymnasium 1.4.0, `envs/mujoco/ant_v5.py`.

use std::borrow::Cow;

use rand_chacha::ChaCha8Rng;

use super::rules::{Robot, Rules, add_normal, add_uniform, squared};
use super::simulated::Simulated;
use super::spec::{Constants, EPISODE, Spec};
use super::{Env, EnvError};
use crate::mj::{MjError, Model, ModelFormat, Options, Sim};

pub(super) const NAME: &str = "Ant-v5";
pub(super) const ABOUT: &str = "quadruped on a free base, walk forward";
const ROBOT: Robot = Robot {
    text: Cow::Borrowed(include_str!("../../../examples/robots/gymnasium/ant.xml")),
    format: ModelFormat::Mjcf,
};
const TORSO: usize = 1;
const RESET_NOISE: f64 = 0.1;
const CONTROL_COST: f64 = 0.5;
const CONTACT_COST: f64 = 5e-4;

#[derive(Clone)]
struct Ant;

pub(super) fn build() -> Result<Box<dyn Env>, EnvError> {
    let physics = |source| EnvError::Physics { task: NAME.into(), source };
    let model = Model::from_text(&ROBOT.text, ROBOT.format, Options::default()).map_err(physics)?;
    let task = Constants { name: NAME.into(), sub_steps: 5, max_episode_steps: EPISODE };
    let spec = Spec::new(&model, task, names(&model), model.actuators());
    Ok(Simulated::boxed(spec, ROBOT, Ant, Sim::new(&model).map_err(physics)?))
}

/// Positions without the root's x and y, velocities, contact torque and force on each body but the world.
fn names(model: &Model) -> Vec<String> {
    let legs: Vec<_> = model.joints()[1..].iter().map(|j| j.name.clone()).collect();
    let mut names: Vec<String> =
        ["z", "qw", "qx", "qy", "qz"].iter().map(|c| format!("q.root.{c}")).collect();
    names.extend(legs.iter().map(|j| format!("q.{j}")));
    names.extend(["x", "y", "z", "wx", "wy", "wz"].iter().map(|c| format!("v.root.{c}")));
    names.extend(legs.iter().map(|j| format!("v.{j}")));
    for body in 1..model.n_bodies() {
        let body = model.body_name(body);
        names.extend(["tx", "ty", "tz", "fx", "fy", "fz"].iter().map(|c| format!("cfrc.{body}.{c}")));
    }
    names
}

fn healthy(sim: &Sim) -> bool {
    let finite = sim.qpos().iter().chain(sim.qvel()).all(|s| s.is_finite());
    finite && (0.2..=1.0).contains(&sim.qpos()[2])
}

impl Rules for Ant {
    fn start(
        &mut self,
        rng: &mut ChaCha8Rng,
        _: &mut Sim,
        qpos: &mut [f64],
        qvel: &mut [f64],
    ) -> Result<(), MjError> {
        add_uniform(rng, RESET_NOISE, qpos);
        add_normal(rng, RESET_NOISE, qvel);
        Ok(())
    }

    /// The torso's frame as last evaluated, which lags the state by a stage of the last physics step, as in Gymnasium.
    fn progress(&self, sim: &Sim) -> f64 {
        sim.position(TORSO)[0]
    }

    fn finish(&self, sim: &mut Sim) -> Result<(), MjError> {
        sim.compute_contact_forces()
    }

    fn score(&mut self, spec: &Spec, sim: &Sim, before: f64, action: &[f64]) -> (f64, bool) {
        let healthy = healthy(sim);
        let speed = (sim.position(TORSO)[0] - before) / spec.dt;
        let contact: f64 = sim.contact_forces().iter().flatten().map(|f| f.clamp(-1.0, 1.0).powi(2)).sum();
        let costs = CONTROL_COST * squared(action) + CONTACT_COST * contact;
        (speed + f64::from(u8::from(healthy)) - costs, !healthy)
    }

    fn observe(&self, sim: &Sim, obs: &mut [f64]) {
        let (nq, nv) = (sim.qpos().len(), sim.qvel().len());
        obs[..nq - 2].copy_from_slice(&sim.qpos()[2..]);
        obs[nq - 2..][..nv].copy_from_slice(sim.qvel());
        let forces = sim.contact_forces()[1..].iter().flatten();
        for (o, f) in obs[nq - 2 + nv..].iter_mut().zip(forces) {
            *o = f.clamp(-1.0, 1.0);
        }
    }
}
