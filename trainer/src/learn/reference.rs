//! For tests: the losses again, row by row in f64, as the textbook writes them. Shares no code with the kernels.

use super::batch::Batch;
use super::net::Net;
use super::optimise::Tile;
use super::{Dims, stats_of};
use nearl_runtime::net::kernel::{V, scalars_mut};
use nearl_runtime::net::{Activation, Dense};

/// Dimensions of most tests: an adversary that sees three of each.
pub(super) fn dims() -> Dims {
    Dims {
        n_obs: 7,
        n_privileged: 0,
        n_state: 5,
        n_act: 3,
        seen_obs: vec![1, 2, 6],
        seen_state: vec![0, 2, 4],
    }
}

/// A network in f64: weight (n_out x n_in) and bias of each layer, and the function between them.
#[derive(Clone)]
pub(super) struct Net64 {
    layers: Vec<(Vec<f64>, Vec<f64>)>,
    /// A linear map from input to output beside the layers; empty where there is none.
    skip: Vec<f64>,
    between: fn(f64) -> f64,
}

impl Net64 {
    pub(super) fn of(dense: &Dense, activation: Activation) -> Self {
        let wide = |x: &[f32]| x.iter().map(|&v| f64::from(v)).collect::<Vec<f64>>();
        let between = match activation {
            Activation::Tanh => f64::tanh,
            Activation::Relu => |x: f64| x.max(0.0),
            Activation::Elu => |x: f64| if x > 0.0 { x } else { x.exp_m1() },
            Activation::Silu => |x: f64| x / (1.0 + (-x).exp()),
        };
        let skip = dense.skip.as_ref().map_or(Vec::new(), |s| wide(s));
        Self {
            layers: dense.layers.iter().map(|l| (wide(&l.weight), wide(&l.bias))).collect(),
            skip,
            between,
        }
    }

    /// The textbook sums.
    pub(super) fn forward(&self, x: &[f64]) -> Vec<f64> {
        let mut h = x.to_vec();
        for (i, (w, b)) in self.layers.iter().enumerate() {
            let n_in = h.len();
            let y =
                b.iter().enumerate().map(|(n, b)| b + (0..n_in).map(|k| w[n * n_in + k] * h[k]).sum::<f64>());
            h = if i + 1 < self.layers.len() { y.map(self.between).collect() } else { y.collect() };
        }
        for (h, row) in h.iter_mut().zip(self.skip.chunks_exact(x.len())) {
            *h += row.iter().zip(x).map(|(w, x)| w * x).sum::<f64>();
        }
        h
    }

    /// Without what the linear map reads of these of its `n_in` inputs.
    pub(super) fn unread(mut self, n_in: usize, inputs: impl Fn(usize) -> bool) -> Self {
        for row in self.skip.chunks_exact_mut(n_in) {
            row.iter_mut().enumerate().filter(|(k, _)| inputs(*k)).for_each(|(_, w)| *w = 0.0);
        }
        self
    }

    /// Parameters one after another: weight, bias of each layer.
    pub(super) fn flat(&mut self) -> Vec<&mut f64> {
        self.layers
            .iter_mut()
            .flat_map(|(w, b)| w.iter_mut().chain(b.iter_mut()))
            .chain(&mut self.skip)
            .collect()
    }
}

/// The parameters in the order of [`Net64::flat`].
pub(super) fn flat32(dense: &Dense) -> Vec<f64> {
    let layers = dense.layers.iter().flat_map(|l| l.weight.iter().chain(&l.bias));
    layers.chain(dense.skip.iter().flatten()).map(|&v| f64::from(v)).collect()
}

pub(super) fn row(x: &[f32], i: usize, n: usize) -> Vec<f64> {
    x[i * n..][..n].iter().map(|&v| f64::from(v)).collect()
}

pub(super) fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// log N(x; mean, exp(log_std)^2).
pub(super) fn log_normal(x: &[f64], mean: &[f64], log_std: &[f64]) -> f64 {
    let term = |((x, m), s): ((&f64, &f64), &f64)| {
        let z = (x - m) / s.exp();
        -0.5 * z * z - s - 0.5 * (2.0 * std::f64::consts::PI).ln()
    };
    x.iter().zip(mean).zip(log_std).map(term).sum()
}

/// PPO's clipped surrogate of one row with the minibatch's normalised advantage.
pub(super) fn surrogate(b: &Batch, i: usize, log_prob: f64, clip: f64) -> f64 {
    let (mean, std) = stats_of(&b.advantage);
    let a = (f64::from(b.advantage[i]) - mean) / std;
    let r = (log_prob - f64::from(b.log_prob[i])).exp();
    -(r * a).min(r.clamp(1.0 - clip, 1.0 + clip) * a)
}

/// Input of the inverse model for change `w`.
pub(super) fn inverse_input(b: &Batch, i: usize, d: &Dims, w: &[f64]) -> Vec<f64> {
    let obs = row(&b.obs, i, d.n_obs);
    let seen = d.seen_obs.iter().map(|&k| obs[k]);
    seen.chain(d.seen_state.iter().map(|&k| w[k].clamp(-10.0, 10.0))).collect()
}

/// Central differences of `loss` in every parameter of `net` against `analytic`: relative error in the Euclidean norm.
pub(super) fn relative_error(net: &Net64, analytic: &[f64], loss: impl Fn(&Net64) -> f64) -> f64 {
    let mut probe = net.clone();
    let n = probe.flat().len();
    assert_eq!(n, analytic.len());
    let (mut error, mut size) = (0.0, 0.0);
    for k in 0..n {
        const H: f64 = 1e-5;
        let at = |probe: &mut Net64, x: f64| {
            *probe.flat()[k] += x;
            let l = loss(probe);
            *probe.flat()[k] -= x;
            l
        };
        let slope = (at(&mut probe, H) - at(&mut probe, -H)) / (2.0 * H);
        error += (slope - analytic[k]).powi(2);
        size += slope * slope;
    }
    assert!(size > 1e-12, "the gradient vanishes: the test could not fail");
    (error / size).sqrt()
}

/// Moves weights and biases of the networks away from zero: small last layers would hide errors in what lies below them,
/// and a unit whose inputs are all zero would sit on the kink of a ReLU.
pub(super) fn spread(p: &mut [V], nets: &[&Net]) {
    scalars_mut(p).iter_mut().filter(|x| x.abs() < 0.02).for_each(|x| *x *= 50.0);
    for layer in nets.iter().flat_map(|n| &n.mlp.layers) {
        let bias = &mut scalars_mut(&mut p[layer.b..layer.b + layer.n_vectors()])[..layer.n];
        bias.iter_mut().enumerate().for_each(|(k, b)| *b = 0.3 * (1.7 * k as f32 + 0.5).sin());
    }
}

/// The whole batch as one tile.
pub(super) fn tile<'a>(batch: &'a Batch, idx: &'a [u32]) -> Tile<'a> {
    let (mean, std) = stats_of(&batch.advantage);
    Tile { batch, idx, scale: 1.0 / batch.n as f32, advantage: (mean as f32, (1.0 / std) as f32), clip: 0.2 }
}

/// One minibatch of random experience.
pub(super) fn batch(d: &Dims, n: usize, seed: u64) -> Batch {
    use rand::RngExt;
    let mut rng = crate::rollout::stream(seed, 0);
    let mut draw = |k: usize, size: f32| -> Vec<f32> {
        (0..n * k)
            .map(|_| size * (rng.random::<f32>() + rng.random::<f32>() + rng.random::<f32>() - 1.5))
            .collect()
    };
    let mut batch = Batch {
        n,
        obs: draw(d.n_obs, 1.0),
        change: draw(d.n_state, 1.0),
        target_change: Vec::new(),
        lower: draw(d.n_state, 0.3).iter().map(|x| x - 0.3).collect(),
        upper: draw(d.n_state, 0.3).iter().map(|x| x + 0.6).collect(),
        reached: draw(d.n_state, 1.0),
        sampled: draw(d.n_act, 1.0),
        action: draw(d.n_act, 1.0),
        log_prob: draw(1, 1.0).iter().map(|x| x - 4.0).collect(),
        advantage: draw(1, 1.0),
        returns: draw(1, 1.0),
        ..Batch::default()
    };
    batch.target_change = draw(d.n_state, 1.0);
    batch
}
