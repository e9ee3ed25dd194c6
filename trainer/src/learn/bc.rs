//! Behaviour cloning of states: no reward is read.
//!
//! ```text
//! warm up: the inverse model on the fresh networks' own noise
//! meta policy on demonstrated (s, s')            L_BC = sum |s' - pi(s)|^2
//! for each batch: inverse model on own (s, s', a)
//! ```

use super::imitation::{Base, Imitating, Method};
use super::{Batch, Metrics, Pace, Pid2};
use rand_chacha::ChaCha8Rng;

/// The method, on the networks of PID^2.
pub struct Bc;

impl Method for Bc {
    type Base = Pid2;

    fn update(l: &mut Imitating<Self>, batch: &mut Batch, _: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        l.base.learn_inverse(batch, rng)
    }
}
