//! The learner: networks with hand-written gradients, PPO, the paper's original NEARL and its PID^2.
//!
//! Read [`nearl`] and [`pid2`] for the method; [`optimise`] runs its phases over minibatches on all cores, with the same
//! bits for any number of threads.

mod adam;
mod algorithm;
mod batch;
pub mod bc;
pub mod bco;
mod combined;
mod cost;
pub mod dapg;
mod discriminator;
mod epochs;
mod gae;
pub mod gaifo;
mod gaussian;
mod imitation;
mod init;
mod inverse;
mod likeness;
mod losses;
pub mod nearl;
mod net;
mod nets;
#[cfg(test)]
mod one_step;
pub mod optimise;
pub mod pid2;
pub mod pid2_il;
pub mod ppo;
#[cfg(test)]
mod reference;
mod rescale;
pub mod soil;
mod value;

pub use adam::Adam;
pub use algorithm::{ALGORITHMS, Algorithm, UnknownAlgorithm};
pub use batch::{Batch, CostRows, Stretch};
pub use bc::Bc;
pub use bco::Bco;
pub use combined::{Gradient, Kind};
pub use cost::{CostLimited, CostSettings};
pub use dapg::Dapg;
pub use epochs::Pace;
pub use gae::{Advantages, advantages};
pub use gaifo::Gaifo;
pub use gaussian::MOST_OUTPUTS;
pub use imitation::{Base, Imitating, Imitator, Method, Seen};
pub use inverse::ThresholdPer;
pub use nearl::{Nearl, NearlSettings};
pub use net::{Net, Tape};
pub use nets::NetSettings;
pub use optimise::{Params, Schedule};
pub use pid2::{Pid2, Pid2Settings};
pub use pid2_il::Pid2Il;
pub use ppo::{Ppo, PpoSettings};
pub use soil::Soil;

use nearl_runtime::Networks;
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;
use std::ops::Range;

/// Sizes of a task in network space.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Dims {
    /// Observation entries.
    pub n_obs: usize,
    /// Entries that the value alone sees beside them.
    pub n_privileged: usize,
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
    /// Where the log standard deviations of what explores lie in the first group, in vectors.
    fn spreads(&self) -> Vec<Range<usize>>;
    /// Value of each row of `x` (n x n_obs).
    fn values(&mut self, x: &[f32]) -> Vec<f32>;
    /// Learns from a batch at the pace of the run's schedule; `rng` orders the minibatches and draws noise. Log probabilities, advantages
    /// and returns of the batch may be estimated again on the way.
    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics;
    /// Learns from the fresh networks' own noise what needs no reward: how the robot answers to actions. Nothing, unless said otherwise.
    fn warm_up(&mut self, _batch: &Batch, _rng: &mut ChaCha8Rng) -> Metrics {
        Metrics::new()
    }
    /// Itself, if it learns from demonstrations.
    fn imitator(&mut self) -> Option<&mut dyn Imitator> {
        None
    }
}

/// The inverse model's mean squared error before and after an update, the part of the actions' variance that it explains, and whether
/// it learned; `actions` are its rows of `n_act`.
fn idm_metrics(
    before: Option<f64>,
    after: Option<f64>,
    learned: bool,
    actions: &[f32],
    n_act: usize,
) -> Metrics {
    let (Some(before), Some(after)) = (before, after) else { return Metrics::new() };
    let variance = variance(actions, n_act);
    let explained = |error: f64| if variance > 0.0 { 1.0 - error / variance } else { f64::NAN };
    vec![
        ("idm/mse_before", before),
        ("idm/mse_after", after),
        ("idm/r2_before", explained(before)),
        ("idm/r2_after", explained(after)),
        ("idm/updated", f64::from(u8::from(learned))),
    ]
}

/// Variance of each column of `x` (rows of `width` numbers), averaged over the columns.
fn variance(x: &[f32], width: usize) -> f64 {
    let (mut mean, mut square) = (vec![0.0; width], vec![0.0; width]);
    for (n, row) in x.chunks_exact(width.max(1)).enumerate() {
        for ((mean, square), &x) in mean.iter_mut().zip(&mut square).zip(row) {
            let d = f64::from(x) - *mean;
            *mean += d / (n + 1) as f64;
            *square += d * (f64::from(x) - *mean);
        }
    }
    square.iter().sum::<f64>() / x.len().max(1) as f64
}

/// Mean and standard deviation, for tests.
#[cfg(test)]
pub(crate) fn stats_of(x: &[f32]) -> (f64, f64) {
    let n = x.len() as f64;
    let mean = x.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
    let variance = x.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
    (mean, variance.sqrt())
}

#[cfg(test)]
mod tests {
    use super::{idm_metrics, variance};

    /// Columns 1 3 (variance 1) and 10 30 (variance 100); a model with the error 10.1 explains four fifths.
    #[test]
    fn what_the_inverse_model_explains_is_by_hand() {
        let actions = [1.0, 10.0, 3.0, 30.0];
        let variance = variance(&actions, 2);
        assert!((variance - 50.5).abs() < 1e-12, "{variance}");
        let metrics = idm_metrics(Some(50.5), Some(10.1), true, &actions, 2);
        let of = |name: &str| metrics.iter().find(|(n, _)| *n == name).map_or(f64::NAN, |m| m.1);
        assert!(of("idm/r2_before").abs() < 1e-12 && (of("idm/r2_after") - 0.8).abs() < 1e-12);
    }
}
