//! PID^2 with demonstrations (Algorithm 2 of the paper, whole).
//!
//! ```text
//! warm up: the inverse model on the fresh networks' own noise
//! pre-train the meta policy on demonstrated (s, s')                 (lines 1 to 5)
//! for each batch: the lines of `pid2`, where the discriminator takes (lines 6 to 14)
//!                 reached and demonstrated transitions for real
//! ```
//!
//! Episodes begin in frames of the demonstrations now and then (`train.demos.resets`).

use super::imitation::{Imitating, Method};
use super::{Batch, Learner, Metrics, Pace, Pid2};
use rand_chacha::ChaCha8Rng;

/// The method, on PID^2.
pub struct Pid2Il;

impl Method for Pid2Il {
    type Base = Pid2;

    fn update(l: &mut Imitating<Self>, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        if l.settings.in_discriminator {
            l.base.unite(batch, &l.seen.demos, rng);
        }
        l.base.update(batch, pace, rng)
    }
}
