//! SOIL (Radosavovic et al. 2020): DAPG on demonstrations without actions, which an inverse model fills in.
//!
//! ```text
//! warm up: the inverse model on the fresh policy's own experience
//! for each batch:  inverse model on own transitions (s, s', a)
//!                  a <- I(s_c, s'_c) in every demonstrated transition
//!                  g = sum_own A grad log pi(a | s) + sum_demo lambda0 lambda1^k grad log pi(a | s)
//! ```

use super::imitation::{Base, Imitating, Method};
use super::{Batch, Metrics, Pace, Ppo};
use rand_chacha::ChaCha8Rng;

/// The method, on PPO.
pub struct Soil;

impl Method for Soil {
    type Base = Ppo;

    fn update(l: &mut Imitating<Self>, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        let inverse = l.base.learn_inverse(batch, rng);
        let mut demos = l.seen.demos.clone();
        l.base.relabel(&mut demos);
        l.base.augment(demos, l.seen.weight, batch.n, rng);
        let mut metrics = l.base.update_policy(batch, pace, rng);
        metrics.extend(inverse);
        metrics
    }

    /// Without actions there is nothing to clone yet.
    fn pretrain(_: &mut Imitating<Self>, _: &mut ChaCha8Rng) -> Metrics {
        Metrics::new()
    }
}
