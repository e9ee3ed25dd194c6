//! The learner: networks with hand-written gradients, PPO, the paper's original NEARL and its PID^2.
//!
//! Read [`nearl`] and [`pid2`] for the method; [`optimise`] runs its phases over minibatches on all cores, with the same
//! bits for any number of threads.

mod adam;
mod batch;
mod combined;
mod discriminator;
mod gae;
mod gaussian;
mod init;
mod inverse;
mod losses;
pub mod nearl;
mod net;
mod nets;
#[cfg(test)]
mod one_step;
pub mod optimise;
pub mod pid2;
pub mod ppo;
#[cfg(test)]
mod reference;
mod value;

pub use adam::Adam;
pub use batch::Batch;
pub use combined::{Gradient, Kind};
pub use gae::{Advantages, advantages};
pub use gaussian::MOST_OUTPUTS;
pub use nearl::{Nearl, NearlSettings};
pub use net::{Net, Tape};
pub use nets::NetSettings;
pub use optimise::{Params, Schedule};
pub use pid2::{Pid2, Pid2Settings};
pub use ppo::{Ppo, PpoSettings};

use nearl_runtime::Networks;
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;

/// Sizes of a task in network space.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Dims {
    /// Observation entries.
    pub n_obs: usize,
    /// Proposed entries.
    pub n_state: usize,
    /// Action entries.
    pub n_act: usize,
    /// Observation index of each entry the inverse model sees.
    pub seen_obs: Vec<usize>,
    /// Index into the proposed state of each entry the inverse model sees.
    pub seen_state: Vec<usize>,
}

/// Named numbers of one update, with SB3's tags where they exist.
pub type Metrics = Vec<(&'static str, f64)>;

/// An algorithm as the training loop sees it.
pub trait Learner: Send {
    /// The current networks for a controller.
    fn networks(&self, normaliser: &Normaliser) -> Networks;
    /// Everything an update changes.
    fn params(&self) -> &Params;
    /// Takes `f` to everything an update changes, then refreshes what follows from it.
    fn restore(&mut self, f: &mut dyn FnMut(&mut Params) -> Result<(), String>) -> Result<(), String>;
    /// Value of each row of `x` (n x n_obs).
    fn values(&mut self, x: &[f32]) -> Vec<f32>;
    /// Learns from a batch; `rate` scales every learning rate, `rng` orders the minibatches and draws latent noise.
    fn update(&mut self, batch: &Batch, rate: f32, rng: &mut ChaCha8Rng) -> Metrics;
}

/// The inverse model's mean squared error before and after an update, and whether it learned.
fn idm_metrics(before: Option<f64>, after: Option<f64>, learned: bool) -> Metrics {
    let (Some(before), Some(after)) = (before, after) else { return Metrics::new() };
    vec![("idm/mse_before", before), ("idm/mse_after", after), ("idm/updated", f64::from(u8::from(learned)))]
}

/// Mean and standard deviation, for tests.
#[cfg(test)]
pub(crate) fn stats_of(x: &[f32]) -> (f64, f64) {
    let n = x.len() as f64;
    let mean = x.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
    let variance = x.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
    (mean, variance.sqrt())
}
