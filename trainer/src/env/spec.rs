//! What is constant about a task.

use crate::mj::{Actuator, Joint, Model};

/// Names, sizes, times and ranges of a task.
#[derive(Debug, Clone, PartialEq)]
pub struct Spec {
    /// Name of the task.
    pub name: String,
    /// Names of the observation's entries: `q.<joint>` and `v.<joint>` are a joint's position and velocity.
    pub obs: Vec<String>,
    /// Joints in MuJoCo's order.
    pub joints: Vec<Joint>,
    /// What each entry of the action moves.
    pub actuators: Vec<Actuator>,
    /// Entries of a configuration.
    pub nq: usize,
    /// Degrees of freedom.
    pub nv: usize,
    /// Control period \[s\], `sub_steps * sim_dt`.
    pub dt: f64,
    /// Physics step \[s\].
    pub sim_dt: f64,
    /// Physics steps in a control period.
    pub sub_steps: usize,
    /// Whether a physics step is MuJoCo's Euler (velocity first, then position) or fourth-order Runge-Kutta.
    pub semi_implicit_euler: bool,
    /// Control periods after which the caller truncates an episode.
    pub max_episode_steps: usize,
    /// Geoms that may touch something.
    pub touching: usize,
    /// Whether [`Step::cost`](super::Step::cost) means anything.
    pub has_cost: bool,
    /// What the value alone may see ([`Env::privileged`](super::Env::privileged)).
    pub privileged: Vec<String>,
    /// What [`Env::notes`](super::Env::notes) are, as columns of `metrics.csv`.
    pub notes: Vec<String>,
}

impl Spec {
    /// Entries of the observation.
    pub fn n_obs(&self) -> usize {
        self.obs.len()
    }

    /// Entries of the action.
    pub fn n_act(&self) -> usize {
        self.actuators.len()
    }

    /// Smallest action (n_act).
    pub fn action_low(&self) -> impl Iterator<Item = f64> {
        self.actuators.iter().map(|a| a.low)
    }

    /// Largest action (n_act).
    pub fn action_high(&self) -> impl Iterator<Item = f64> {
        self.actuators.iter().map(|a| a.high)
    }

    pub(super) fn new(model: &Model, task: Constants, obs: Vec<String>, actuators: Vec<Actuator>) -> Spec {
        Spec {
            name: task.name,
            obs,
            joints: model.joints(),
            actuators,
            nq: model.nq(),
            nv: model.nv(),
            dt: model.sim_dt() * task.sub_steps as f64,
            sim_dt: model.sim_dt(),
            sub_steps: task.sub_steps,
            semi_implicit_euler: model.is_euler(),
            touching: model.touching(),
            max_episode_steps: task.max_episode_steps,
            has_cost: false,
            privileged: Vec::new(),
            notes: Vec::new(),
        }
    }
}

/// Control periods in an episode of Gymnasium's tasks, and of every other unless its file says otherwise.
pub(super) const EPISODE: usize = 1000;

/// The part of a [`Spec`] that is not in the robot file.
#[derive(Debug, Clone)]
pub(super) struct Constants {
    pub(super) name: String,
    pub(super) sub_steps: usize,
    pub(super) max_episode_steps: usize,
}
