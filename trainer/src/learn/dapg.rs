//! DAPG (Rajeswaran et al. 2018): a policy gradient with demonstrations that have actions, on PPO's clipped surrogate where it was
//! published with the natural gradient.
//!
//! ```text
//! behaviour cloning of the demonstrated actions
//! for each batch:  g = sum_own A grad log pi(a | s) + sum_demo lambda0 lambda1^k grad log pi(a | s)
//! ```

use super::epochs::Pace;
use super::imitation::Imitator;
use super::{Batch, Learner, Metrics, Params, Ppo};
use crate::demos::DemoSettings;
use nearl_runtime::Networks;
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;

/// The learner.
pub struct Dapg {
    ppo: Ppo,
    settings: DemoSettings,
    demos: Batch,
    weight: f64,
}

impl Dapg {
    /// With a fresh PPO.
    pub fn new(ppo: Ppo, settings: DemoSettings) -> Self {
        Self { ppo, settings, demos: Batch::default(), weight: 0.0 }
    }
}

impl Learner for Dapg {
    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        self.ppo.augment(self.demos.clone(), self.weight, batch.n, rng);
        self.ppo.update(batch, pace, rng)
    }

    fn networks(&self, normaliser: &Normaliser) -> Networks {
        self.ppo.networks(normaliser)
    }

    fn params(&self) -> &Params {
        self.ppo.params()
    }

    fn restore(&mut self, f: &mut dyn FnMut(&mut Params) -> Result<(), String>) -> Result<(), String> {
        self.ppo.restore(f)
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        self.ppo.values(x)
    }

    fn imitator(&mut self) -> Option<&mut dyn Imitator> {
        Some(self)
    }
}

impl Imitator for Dapg {
    fn see(&mut self, demos: Batch, weight: f64) {
        (self.demos, self.weight) = (demos, weight);
    }

    fn warm_up(&mut self, batch: &Batch, rng: &mut ChaCha8Rng) -> Metrics {
        self.ppo.learn_inverse(batch, rng)
    }

    fn pretrain(&mut self, rng: &mut ChaCha8Rng) -> Metrics {
        self.ppo.clone_actions(&self.demos, &self.settings, rng)
    }

    fn rescale(&mut self, from: &Normaliser, to: &Normaliser) {
        self.ppo.rescale(from, to);
    }
}
