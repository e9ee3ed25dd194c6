//! DAPG (Rajeswaran et al. 2018): a policy gradient with demonstrations that have actions, on PPO's clipped surrogate where it was
//! published with the natural gradient.
//!
//! ```text
//! behaviour cloning of the demonstrated actions
//! for each batch:  g = sum_own A grad log pi(a | s) + sum_demo lambda0 lambda1^k grad log pi(a | s)
//! ```

use super::imitation::{Imitating, Method};
use super::{Batch, Learner, Metrics, Pace, Ppo};
use rand_chacha::ChaCha8Rng;

/// The method, on PPO.
pub struct Dapg;

impl Method for Dapg {
    type Base = Ppo;

    fn update(l: &mut Imitating<Self>, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        l.base.augment(l.seen.demos.clone(), l.seen.weight, batch.n, rng);
        l.base.update(batch, pace, rng)
    }
}
