//! Reward and end of control periods that somebody else's code gives.

use crate::env::Step;
use std::sync::Arc;

type Function = dyn Fn(&[f64], &[f64], &[f64], Step) -> Step + Send + Sync;

/// What gives reward and end of a control period in place of the task.
///
/// Environments ask from several threads at once and in any order: the same arguments must give the same answer.
#[derive(Clone)]
pub struct Scorer {
    function: Arc<Function>,
    /// Whether it gives the reward, so that the task's own counts for nothing.
    pub rewards: bool,
}

impl Scorer {
    /// `function(obs, action, next_obs, step)` (n_obs, n_act, n_obs) gives what the period is worth that the task gives as `step`.
    pub fn new(
        rewards: bool,
        function: impl Fn(&[f64], &[f64], &[f64], Step) -> Step + Send + Sync + 'static,
    ) -> Self {
        Self { function: Arc::new(function), rewards }
    }

    pub(super) fn score(&self, obs: &[f64], action: &[f64], next_obs: &[f64], step: Step) -> Step {
        (self.function)(obs, action, next_obs, step)
    }
}

impl std::fmt::Debug for Scorer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Scorer").field("rewards", &self.rewards).finish_non_exhaustive()
    }
}
