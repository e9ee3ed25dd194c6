//! One policy step at a time with everything it produced: what the rollout server sends.

use super::Worker;
use crate::env::EnvError;
use crate::rollout::Tally;
use nearl_rollout_protocol::Layout;
use rand_chacha::ChaCha8Rng;

impl Worker {
    /// Starts anew with another random stream, as a new worker would.
    ///
    /// # Errors
    /// [`EnvError`] of the environment's reset.
    pub fn reseed(&mut self, rng: ChaCha8Rng) -> Result<(), EnvError> {
        self.rng = rng;
        self.rows.clear();
        self.controller.forget_margins();
        self.restart()
    }

    /// Sizes of the rows of [`Worker::transition`].
    pub fn layout(&self) -> Layout {
        let layout = self.controller.layout();
        Layout { n_obs: layout.n_obs(), n_state: layout.n_state(), n_act: self.out.action.len() }
    }

    /// One policy step; appends its row to `row` as [`Layout::columns`] has it. The tally holds this step alone.
    ///
    /// # Errors
    /// [`EnvError`] of a reset.
    pub fn transition(&mut self, explore: bool, row: &mut Vec<f64>) -> Result<(), EnvError> {
        row.extend_from_slice(&self.state.obs);
        self.draw(explore);
        self.rows.collected.tally = Tally::default();
        let cost = self.cost;
        let (reward, terminated) = self.policy_step();
        let truncated = !terminated && self.ticks >= self.env.spec().max_episode_steps;
        let out = &self.out;
        row.extend_from_slice(&self.state.obs);
        row.extend_from_slice(&out.proposal);
        row.extend_from_slice(&out.target);
        row.extend_from_slice(&out.action);
        row.extend([out.log_prob_proposal, out.log_prob_action, reward, self.cost - cost]);
        row.extend([f64::from(u8::from(terminated)), f64::from(u8::from(truncated))]);
        row.extend(self.rows.collected.tally.ledger());
        if terminated || truncated {
            self.restart()?;
        }
        Ok(())
    }
}
