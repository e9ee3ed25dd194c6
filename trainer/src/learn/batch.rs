//! One batch of experience in network space, row by row.

/// `n` samples; names as in `docs/ARCHITECTURE.md`, "Network space". `ppo` proposes nothing: what is of the proposal and its
/// projection may be empty there.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// Samples.
    pub n: usize,
    /// Normalised observation (n x n_obs).
    pub obs: Vec<f32>,
    /// Sampled proposal u (n x n_state).
    pub proposal: Vec<f32>,
    /// Projected change w (n x n_state).
    pub target: Vec<f32>,
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
}

impl Batch {
    /// Forgets every row; keeps the memory.
    pub fn clear(&mut self) {
        self.n = 0;
        let states = [&mut self.obs, &mut self.proposal, &mut self.target, &mut self.lower, &mut self.upper];
        let actions = [&mut self.reached, &mut self.sampled, &mut self.action];
        let numbers = [&mut self.log_prob, &mut self.advantage, &mut self.returns];
        states.into_iter().chain(actions).chain(numbers).for_each(Vec::clear);
    }
}
