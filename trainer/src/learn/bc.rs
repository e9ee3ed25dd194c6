//! Behaviour cloning of states: no reward is read.
//!
//! ```text
//! warm up: the inverse model on the fresh networks' own noise
//! meta policy on demonstrated (s, s')            L_BC = sum |s' - pi(s)|^2
//! for each batch: inverse model on own (s, s', a)
//! ```

use super::epochs::Pace;
use super::imitation::Imitator;
use super::{Batch, Learner, Metrics, Params, Pid2};
use crate::demos::DemoSettings;
use nearl_runtime::Networks;
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;

/// The learner: the networks of PID^2, of whose losses two are used.
pub struct Bc {
    pid2: Pid2,
    settings: DemoSettings,
    demos: Batch,
}

impl Bc {
    /// With fresh networks.
    pub fn new(pid2: Pid2, settings: DemoSettings) -> Self {
        Self { pid2, settings, demos: Batch::default() }
    }
}

impl Learner for Bc {
    fn update(&mut self, batch: &mut Batch, _: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        self.pid2.learn_inverse(batch, rng)
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

impl Imitator for Bc {
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
