//! SOIL (Radosavovic et al. 2020): DAPG on demonstrations without actions, which an inverse model fills in.
//!
//! ```text
//! warm up: the inverse model on the fresh policy's own experience
//! for each batch:  inverse model on own transitions (s, s', a)
//!                  a <- I(s_c, s'_c) in every demonstrated transition
//!                  g = sum_own A grad log pi(a | s) + sum_demo lambda0 lambda1^k grad log pi(a | s)
//! ```

use super::epochs::Pace;
use super::imitation::Imitator;
use super::{Batch, Learner, Metrics, Params, Ppo};
use nearl_runtime::Networks;
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;

/// The learner.
pub struct Soil {
    ppo: Ppo,
    demos: Batch,
    weight: f64,
}

impl Soil {
    /// With a fresh PPO.
    pub fn new(ppo: Ppo) -> Self {
        Self { ppo, demos: Batch::default(), weight: 0.0 }
    }
}

impl Learner for Soil {
    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        let inverse = self.ppo.learn_inverse(batch, rng);
        let mut demos = self.demos.clone();
        self.ppo.relabel(&mut demos);
        self.ppo.augment(demos, self.weight, batch.n, rng);
        let mut metrics = self.ppo.update_policy(batch, pace, rng);
        metrics.extend(inverse);
        metrics
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

impl Imitator for Soil {
    fn see(&mut self, demos: Batch, weight: f64) {
        (self.demos, self.weight) = (demos, weight);
    }

    fn warm_up(&mut self, batch: &Batch, rng: &mut ChaCha8Rng) -> Metrics {
        self.ppo.learn_inverse(batch, rng)
    }

    /// Without actions there is nothing to clone yet.
    fn pretrain(&mut self, _: &mut ChaCha8Rng) -> Metrics {
        Metrics::new()
    }

    fn rescale(&mut self, from: &Normaliser, to: &Normaliser) {
        self.ppo.rescale(from, to);
    }
}
