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
    /// Value under which the advantage was estimated (n).
    pub value: Vec<f32>,
    /// Target of the value network (n).
    pub returns: Vec<f32>,
    /// The same of the cost, where the learner keeps to a limit on it; empty before they are estimated.
    pub cost: CostRows,
    /// What advantages are estimated from; together n rows.
    pub stretches: Vec<Stretch>,
    /// Discount and lambda of the estimate.
    pub discount: (f32, f32),
    /// Cost of an episode that goes on as this batch did, NaN before the first has ended.
    pub episode_cost: f64,
}

/// Advantage, value and target of the cost, and what the advantage weighs.
#[derive(Clone, Debug, Default)]
pub struct CostRows {
    /// Advantage (n).
    pub advantage: Vec<f32>,
    /// Value under which it was estimated (n).
    pub value: Vec<f32>,
    /// Target of the network that values the cost (n).
    pub returns: Vec<f32>,
    /// What an advantage of the cost weighs beside one of the reward.
    pub multiplier: f32,
}

impl CostRows {
    fn clear(&mut self) {
        [&mut self.advantage, &mut self.value, &mut self.returns].into_iter().for_each(Vec::clear);
    }
}

/// Rows of one environment, one after another.
#[derive(Clone, Debug, Default)]
pub struct Stretch {
    /// Rewards as the learner sees them.
    pub reward: Vec<f32>,
    /// Costs as the learner sees them; empty where it keeps to no limit.
    pub cost: Vec<f32>,
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
        let numbers = [&mut self.log_prob, &mut self.advantage, &mut self.value, &mut self.returns];
        states.into_iter().chain(actions).chain(numbers).for_each(Vec::clear);
        self.seen_by_value.clear();
        self.stretches.clear();
        self.cost.clear();
    }

    /// What the value sees.
    pub fn of_value(&self) -> &[f32] {
        if self.seen_by_value.is_empty() { &self.obs } else { &self.seen_by_value }
    }

    /// Advantages and returns under the values that `value` gives for rows of observations, the advantages less those of the cost where
    /// there are some. Without stretches they stay.
    pub fn estimate(&mut self, value: impl FnMut(&[f32]) -> Vec<f32>) {
        if self.stretches.is_empty() {
            return;
        }
        (self.value, self.advantage, self.returns) = self.estimated(|s| &s.reward, value);
        self.weigh();
    }

    /// The same of the cost, whose advantages are then taken off those of the reward with the weight `multiplier`:
    /// `(A - multiplier A_cost) / (1 + multiplier)`.
    pub fn estimate_cost(&mut self, multiplier: f32, value: impl FnMut(&[f32]) -> Vec<f32>) {
        let (value, advantage, returns) = self.estimated(|s| &s.cost, value);
        self.cost = CostRows { advantage, value, returns, multiplier };
        self.weigh();
    }

    fn weigh(&mut self) {
        let multiplier = self.cost.multiplier;
        for (a, cost) in self.advantage.iter_mut().zip(&self.cost.advantage) {
            *a = (*a - multiplier * cost) / (1.0 + multiplier);
        }
    }

    /// Values, advantages and targets of what `of` finds in each stretch.
    fn estimated(
        &self,
        of: impl Fn(&Stretch) -> &[f32],
        mut value: impl FnMut(&[f32]) -> Vec<f32>,
    ) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
        let (values, (gamma, lambda)) = (value(self.of_value()), self.discount);
        let (mut advantage, mut returns) = (Vec::with_capacity(self.n), Vec::with_capacity(self.n));
        for s in &self.stretches {
            let own = &values[advantage.len()..][..s.terminated.len()];
            let finals = value(&s.final_obs);
            let a = advantages(of(s), own, &s.terminated, &s.truncated, &finals, gamma, lambda);
            advantage.extend(a.advantage);
            returns.extend(a.returns);
        }
        (values, advantage, returns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two steps, the second terminal; gamma = lambda = 1. Rewards 1 2 and values 0: advantages 3 2. Costs 4 6 under values 1 2: advantages
    /// 4 + 6 - 1 = 9 and 6 - 2 = 4, targets 10 and 6. With a multiplier of 3: (3 - 27) / 4 and (2 - 12) / 4.
    #[test]
    fn the_cost_is_weighed_as_by_hand_and_weighed_again_when_the_reward_is_estimated_anew() {
        let stretch = Stretch {
            reward: vec![1.0, 2.0],
            cost: vec![4.0, 6.0],
            terminated: vec![false, true],
            truncated: vec![false; 2],
            final_obs: Vec::new(),
        };
        let mut b = Batch {
            n: 2,
            obs: vec![1.0, 2.0],
            stretches: vec![stretch],
            discount: (1.0, 1.0),
            ..Batch::default()
        };
        b.estimate(|x| vec![0.0; x.len()]);
        assert_eq!((&b.advantage[..], &b.returns[..]), (&[3.0, 2.0][..], &[3.0, 2.0][..]));
        b.estimate_cost(3.0, <[f32]>::to_vec);
        assert_eq!((&b.cost.advantage[..], &b.cost.returns[..]), (&[9.0, 4.0][..], &[10.0, 6.0][..]));
        assert_eq!((&b.advantage[..], &b.returns[..]), (&[-6.0, -2.5][..], &[3.0, 2.0][..]));
        b.estimate(|x| vec![0.0; x.len()]);
        assert_eq!(b.advantage, [-6.0, -2.5], "not weighed twice");
        b.clear();
        assert!(b.cost.advantage.is_empty());
    }
}
