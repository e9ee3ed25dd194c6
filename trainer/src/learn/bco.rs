//! BCO (Torabi et al. 2018, with own experience after each change of the policy): actions of demonstrated states are inferred, then
//! cloned. No reward is read.
//!
//! ```text
//! warm up: the inverse model on the fresh policy's own experience
//! for each batch:  inverse model on own transitions (s, s', a)
//!                  a <- I(s_c, s'_c) in every demonstrated transition
//!                  policy on demonstrated (s, a)              L_BC = sum |a - pi(s)|^2
//! ```

use super::imitation::{Base, Imitating, Method};
use super::{Batch, Metrics, Pace, Ppo};
use crate::demos::DemoSettings;
use rand_chacha::ChaCha8Rng;

/// The method, on the networks of PPO, of which the value has no use.
pub struct Bco;

impl Method for Bco {
    type Base = Ppo;

    fn update(l: &mut Imitating<Self>, batch: &mut Batch, _: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        let mut metrics = l.base.learn_inverse(batch, rng);
        metrics.extend(clone_inferred(l, 1, rng));
        metrics
    }

    fn pretrain(l: &mut Imitating<Self>, rng: &mut ChaCha8Rng) -> Metrics {
        clone_inferred(l, l.settings.epochs, rng)
    }
}

/// Passes over the demonstrations with the actions that the inverse model infers now.
fn clone_inferred(l: &mut Imitating<Bco>, epochs: usize, rng: &mut ChaCha8Rng) -> Metrics {
    l.base.relabel(&mut l.seen.demos);
    let settings = DemoSettings { epochs, ..l.settings.clone() };
    l.base.clone_demos(&l.seen.demos, &settings, rng)
}
