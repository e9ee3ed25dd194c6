//! What a task adds to a simulated robot: the extension point of this folder.

use std::borrow::Cow;
use std::ops::Range;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::mj::{MjError, Model, ModelFormat, Sim};

use super::spec::Spec;

/// A robot file and how a task simulates it.
#[derive(Debug, Clone)]
pub(super) struct Robot {
    pub(super) text: Cow<'static, str>,
    pub(super) format: ModelFormat,
}

/// Start, observation, reward and termination of a task.
pub(super) trait Rules: Clone + Send + 'static {
    /// Turns `qpos` and `qvel` (on entry: the robot's initial configuration at rest) into the start of an episode, and
    /// draws a new goal where there is one. `sim` may be moved about; its state is set afterwards.
    fn start(
        &mut self,
        rng: &mut ChaCha8Rng,
        sim: &mut Sim,
        qpos: &mut [f64],
        qvel: &mut [f64],
    ) -> Result<(), MjError>;

    /// Changes the robot as the episode that begins wants it, before its state is set.
    fn prepare(&mut self, _sim: &mut Sim) -> Result<(), MjError> {
        Ok(())
    }

    /// The episode begins in `sim`'s state.
    fn began(&mut self, _sim: &Sim) {}

    /// Remembers what a period begins with, for the rules that compare more than [`Rules::progress`].
    fn begin(&mut self, _sim: &Sim) {}

    /// Hands the action (n_act) to the plant.
    fn actuate(&self, _spec: &Spec, sim: &mut Sim, action: &[f64]) {
        // Not clamped here: MuJoCo does it by `ctrlrange`.
        sim.ctrl_mut().copy_from_slice(action);
    }

    /// What is compared before and after the period, as the distance travelled \[m\].
    fn progress(&self, sim: &Sim) -> f64;

    /// Finishes what a step computes (contact forces where they are observed).
    fn finish(&self, _sim: &mut Sim) -> Result<(), MjError> {
        Ok(())
    }

    /// Follows a period that was simulated and ended in `sim`'s state.
    fn follow(&mut self, _sim: &Sim, _action: &[f64]) {}

    /// What happens between this period and the next, once reward and end of this one are known.
    fn advance(&mut self, _sim: &mut Sim) {}

    /// Reward of the period that ends in `sim`'s state, and whether the episode ends there. `before` is what
    /// [`Rules::progress`] was when it began.
    fn score(&mut self, spec: &Spec, sim: &Sim, before: f64, action: &[f64]) -> (f64, bool);

    /// Writes the observation.
    fn observe(&self, sim: &Sim, obs: &mut [f64]);

    /// The goal, empty where there is none.
    fn goal(&self) -> &[f64] {
        &[]
    }

    /// Where the goal is in the observation; an empty range where there is none.
    fn goal_in_observation(&self) -> Range<usize> {
        0..0
    }

    /// Where to write a new goal.
    fn goal_mut(&mut self) -> &mut [f64] {
        &mut []
    }

    /// See [`Env::circumstances`](super::Env::circumstances).
    fn circumstances(&self) -> Vec<f64> {
        Vec::new()
    }

    /// See [`Env::set_circumstances`](super::Env::set_circumstances).
    fn set_circumstances(&mut self, _circumstances: &[f64]) {}

    /// See [`Env::start_curriculum`](super::Env::start_curriculum).
    fn start_curriculum(&mut self) {}

    /// See [`Env::privileged`](super::Env::privileged).
    fn privileged(&self, _sim: &Sim, _to: &mut [f64]) {}

    /// Configuration and velocity as they are measured, MuJoCo's convention; none where they are known as they are.
    fn measured(&self) -> Option<(&[f64], &[f64])> {
        None
    }

    /// Whether the robot differs from episode to episode, so that each simulation needs one of its own.
    fn changes_robot(&self) -> bool {
        false
    }

    /// Whether velocities change by something that is no force.
    fn pushes(&self) -> bool {
        false
    }

    /// See [`Env::notes`](super::Env::notes).
    fn notes(&self) -> &[f64] {
        &[]
    }
}

/// `sum(action^2)`, on the action as it was asked for, not as it was clamped.
///
/// Gymnasium sums in the action's own type; its float32 actions give a cost that differs in the eighth digit from this one.
pub(super) fn squared(action: &[f64]) -> f64 {
    action.iter().map(|a| a * a).sum()
}

/// Adds noise uniform in `[-scale, scale)` to each entry.
pub(super) fn add_uniform(rng: &mut ChaCha8Rng, scale: f64, entries: &mut [f64]) {
    for x in entries {
        *x += rng.random_range(-scale..scale);
    }
}

/// Adds Gaussian noise of standard deviation `scale` to each entry.
pub(super) fn add_normal(rng: &mut ChaCha8Rng, scale: f64, entries: &mut [f64]) {
    for x in entries {
        let noise: f64 = StandardNormal.sample(rng);
        *x += scale * noise;
    }
}

/// `q.<joint>` for every one-dof joint from the `skip`-th on, then `v.<joint>` for all.
pub(super) fn joint_names(model: &Model, skip: usize) -> Vec<String> {
    let joints = model.joints();
    let positions = joints[skip..].iter().map(|j| format!("q.{}", j.name));
    positions.chain(joints.iter().map(|j| format!("v.{}", j.name))).collect()
}
