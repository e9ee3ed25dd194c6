//! Walker2d-v5: walk forward on two legs without falling.
//!
//! `reward = (x' - x) / dt + 1 [healthy] - 0.001 |a|^2`; healthy while `0.8 < z < 2` and `|angle| < 1`.
//! Source: gymnasium 1.4.0, `envs/mujoco/walker2d_v5.py`.

use rand_chacha::ChaCha8Rng;

use super::rules::{Rules, add_uniform, squared};
use super::spec::{Constants, EPISODE, Spec};
use super::{Env, EnvError, planar};
use crate::mj::{MjError, Sim};

pub(super) const NAME: &str = "Walker2d-v5";
pub(super) const ABOUT: &str = "planar biped, walk forward";
const ROBOT: &str = include_str!("../../../examples/robots/gymnasium/walker2d_v5.xml");
const RESET_NOISE: f64 = 5e-3;
const CONTROL_COST: f64 = 1e-3;
const OBSERVED_SPEED: f64 = 10.0;

#[derive(Clone)]
struct Walker2d;

pub(super) fn build() -> Result<Box<dyn Env>, EnvError> {
    planar::build(Constants { name: NAME.into(), sub_steps: 4, max_episode_steps: EPISODE }, ROBOT, Walker2d)
}

fn healthy(sim: &Sim) -> bool {
    let (z, angle) = (sim.qpos()[1], sim.qpos()[2]);
    0.8 < z && z < 2.0 && -1.0 < angle && angle < 1.0
}

impl Rules for Walker2d {
    fn start(
        &mut self,
        rng: &mut ChaCha8Rng,
        _: &mut Sim,
        qpos: &mut [f64],
        qvel: &mut [f64],
    ) -> Result<(), MjError> {
        add_uniform(rng, RESET_NOISE, qpos);
        add_uniform(rng, RESET_NOISE, qvel);
        Ok(())
    }

    fn progress(&self, sim: &Sim) -> f64 {
        sim.qpos()[0]
    }

    fn score(&mut self, spec: &Spec, sim: &Sim, before: f64, action: &[f64]) -> (f64, bool) {
        let healthy = healthy(sim);
        let speed = planar::speed(spec, before, sim.qpos()[0]);
        (speed + f64::from(u8::from(healthy)) - CONTROL_COST * squared(action), !healthy)
    }

    fn observe(&self, sim: &Sim, obs: &mut [f64]) {
        planar::observe(sim, OBSERVED_SPEED, obs);
    }
}
