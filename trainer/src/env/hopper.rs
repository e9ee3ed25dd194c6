//! Hopper-v5: hop forward on one leg without falling.
//!
//! `reward = (x' - x) / dt + 1 [healthy] - 0.001 |a|^2`; healthy while `z > 0.7`, `|angle| < 0.2` and every other entry of the
//! state lies within 100. Source: gymnasium 1.4.0, `envs/mujoco/hopper_v5.py`.

use rand_chacha::ChaCha8Rng;

use super::rules::{Rules, add_uniform, squared};
use super::spec::{Constants, EPISODE, Spec};
use super::{Env, EnvError, planar};
use crate::mj::{MjError, Sim};

pub(super) const NAME: &str = "Hopper-v5";
pub(super) const ABOUT: &str = "planar one-legged hopper, hop forward";
const ROBOT: &str = include_str!("../../../examples/robots/gymnasium/hopper.xml");
const RESET_NOISE: f64 = 5e-3;
const CONTROL_COST: f64 = 1e-3;
const OBSERVED_SPEED: f64 = 10.0;

#[derive(Clone)]
struct Hopper;

pub(super) fn build() -> Result<Box<dyn Env>, EnvError> {
    planar::build(Constants { name: NAME.into(), sub_steps: 4, max_episode_steps: EPISODE }, ROBOT, Hopper)
}

fn healthy(sim: &Sim) -> bool {
    let (z, angle) = (sim.qpos()[1], sim.qpos()[2]);
    let bounded = sim.qpos()[2..].iter().chain(sim.qvel()).all(|s| -100.0 < *s && *s < 100.0);
    bounded && z > 0.7 && -0.2 < angle && angle < 0.2
}

impl Rules for Hopper {
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
