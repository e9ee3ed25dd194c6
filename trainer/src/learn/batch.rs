//! One batch of experience in network space, row by row.

use super::gae::advantages;

/// `n` samples; names as in `docs/ARCHITECTURE.md`, "Network space". `ppo` proposes nothing: what is of the proposal and its
/// projection may be empty there.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// Samples.
    pub n: usize,
    /// Normalised observation (n x n_obs).
    pub obs: Vec<f32>,
    /// The same with the privileged entries behind it (n x (n_obs + n_privileged)), which the value sees; empty where there are none.
    pub seen_by_value: Vec<f32>,
    /// Sampled proposal u, a normalised change (n x n_state).
    pub change: Vec<f32>,
    /// Projected change w (n x n_state).
    pub target_change: Vec<f32>,
    /// Lowest change the projection lets through (n x n_state).
    pub lower: Vec<f32>,
    /// Highest change the projection lets through (n x n_state).
    pub upper: Vec<f32>,
    /// Reached change (n x n_state).
    pub reached: Vec<f32>,
    /// Sampled action (n x n_act).
    pub sampled: Vec<f32>,
    /// Executed action (n x n_act).
    pub action: Vec<f32>,
    /// Log probability of what was sampled (n).
    pub log_prob: Vec<f32>,
    /// Advantage (n).
    pub advantage: Vec<f32>,
    /// Target of the value network (n).
    pub returns: Vec<f32>,
    /// What advantages are estimated from; together n rows.
    pub stretches: Vec<Stretch>,
    /// Discount and lambda of the estimate.
    pub discount: (f32, f32),
}

/// Rows of one environment, one after another.
#[derive(Clone, Debug, Default)]
pub struct Stretch {
    /// Rewards as the learner sees them.
    pub reward: Vec<f32>,
    /// The episode ended in a terminal state.
    pub terminated: Vec<bool>,
    /// The episode was cut.
    pub truncated: Vec<bool>,
    /// What the value sees of the final state of each cut row (cuts x (n_obs + n_privileged)).
    pub final_obs: Vec<f32>,
}

impl Batch {
    /// Forgets every row; keeps the memory.
    pub fn clear(&mut self) {
        self.n = 0;
        let states =
            [&mut self.obs, &mut self.change, &mut self.target_change, &mut self.lower, &mut self.upper];
        let actions = [&mut self.reached, &mut self.sampled, &mut self.action];
        let numbers = [&mut self.log_prob, &mut self.advantage, &mut self.returns];
        states.into_iter().chain(actions).chain(numbers).for_each(Vec::clear);
        self.seen_by_value.clear();
        self.stretches.clear();
    }

    /// What the value sees.
    pub fn of_value(&self) -> &[f32] {
        if self.seen_by_value.is_empty() { &self.obs } else { &self.seen_by_value }
    }

    /// Advantages and returns under the values that `value` gives for rows of observations. Without stretches they stay.
    pub fn estimate(&mut self, mut value: impl FnMut(&[f32]) -> Vec<f32>) {
        if self.stretches.is_empty() {
            return;
        }
        self.advantage.clear();
        self.returns.clear();
        let (values, (gamma, lambda)) = (value(self.of_value()), self.discount);
        let mut first = 0;
        for s in &self.stretches {
            let own = &values[first..][..s.reward.len()];
            first += s.reward.len();
            let finals = value(&s.final_obs);
            let a = advantages(&s.reward, own, &s.terminated, &s.truncated, &finals, gamma, lambda);
            self.advantage.extend(a.advantage);
            self.returns.extend(a.returns);
        }
    }
}
