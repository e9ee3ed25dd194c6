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

use super::epochs::Pace;
use super::imitation::Imitator;
use super::{Batch, Learner, Metrics, Params, Pid2};
use crate::demos::DemoSettings;
use nearl_runtime::Networks;
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;

/// The learner.
pub struct Pid2Il {
    pid2: Pid2,
    settings: DemoSettings,
    demos: Batch,
}

impl Pid2Il {
    /// With a fresh PID^2.
    pub fn new(pid2: Pid2, settings: DemoSettings) -> Self {
        Self { pid2, settings, demos: Batch::default() }
    }
}

impl Learner for Pid2Il {
    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        if self.settings.in_discriminator {
            self.pid2.unite(batch, &self.demos, rng);
        }
        self.pid2.update(batch, pace, rng)
    }

    fn networks(&self, normaliser: &Normaliser) -> Networks {
        self.pid2.networks(normaliser)
    }

    fn params(&self) -> &Params {
        self.pid2.params()
    }

    fn restore(&mut self, f: &mut dyn FnMut(&mut Params) -> Result<(), String>) -> Result<(), String> {
        self.pid2.restore(f)
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        self.pid2.values(x)
    }

    fn imitator(&mut self) -> Option<&mut dyn Imitator> {
        Some(self)
    }
}

impl Imitator for Pid2Il {
    fn see(&mut self, demos: Batch, _: f64) {
        self.demos = demos;
    }

    fn warm_up(&mut self, batch: &Batch, rng: &mut ChaCha8Rng) -> Metrics {
        self.pid2.learn_inverse(batch, rng)
    }

    fn pretrain(&mut self, rng: &mut ChaCha8Rng) -> Metrics {
        self.pid2.clone_states(&self.demos, &self.settings, rng)
    }

    fn rescale(&mut self, from: &Normaliser, to: &Normaliser) {
        self.pid2.rescale(from, to);
    }
}
