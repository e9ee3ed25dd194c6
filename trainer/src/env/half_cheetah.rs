//! HalfCheetah-v5: run forward with six joints. Never terminates.
//!
//! `reward = (x' - x) / dt - 0.1 |a|^2`. Source: gymnasium 1.4.0, `envs/mujoco/half_cheetah_v5.py`.

use rand_chacha::ChaCha8Rng;

use super::rules::{Rules, add_normal, add_uniform, squared};
use super::spec::{Constants, EPISODE, Spec};
use super::{Env, EnvError, planar};
use crate::mj::{MjError, Sim};

pub(super) const NAME: &str = "HalfCheetah-v5";
pub(super) const ABOUT: &str = "planar cheetah, run forward";
const ROBOT: &str = include_str!("../../../examples/robots/gymnasium/half_cheetah.xml");
const RESET_NOISE: f64 = 0.1;
const CONTROL_COST: f64 = 0.1;

#[derive(Clone)]
struct HalfCheetah;

pub(super) fn build() -> Result<Box<dyn Env>, EnvError> {
    planar::build(
        Constants { name: NAME.into(), sub_steps: 5, max_episode_steps: EPISODE },
        ROBOT,
        HalfCheetah,
    )
}

impl Rules for HalfCheetah {
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

    fn progress(&self, sim: &Sim) -> f64 {
        sim.qpos()[0]
    }

    fn score(&mut self, spec: &Spec, sim: &Sim, before: f64, action: &[f64]) -> (f64, bool) {
        let speed = planar::speed(spec, before, sim.qpos()[0]);
        (speed - CONTROL_COST * squared(action), false)
    }

    fn observe(&self, sim: &Sim, obs: &mut [f64]) {
        planar::observe(sim, f64::INFINITY, obs);
    }
}
