//! GAIfO (Torabi et al. 2018): PPO whose reward is how much an own transition of states looks demonstrated. The task's reward is not read.
//!
//! ```text
//! for each batch:  D on demonstrated (s, s') against own ones     (`likeness`)
//!                  r <- -log(1 - D(s, s'))
//!                  PPO with r for the reward
//! ```

use super::imitation::{Imitating, Method};
use super::{Batch, Metrics, Pace, Ppo};
use rand_chacha::ChaCha8Rng;

/// The method, on PPO, rewarded by likeness.
pub struct Gaifo;

impl Method for Gaifo {
    type Base = Ppo;

    fn update(l: &mut Imitating<Self>, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        l.base.update_policy(batch, pace, rng)
    }

    /// Nothing is cloned.
    fn pretrain(_: &mut Imitating<Self>, _: &mut ChaCha8Rng) -> Metrics {
        Metrics::new()
    }
}
