//! The inverse dynamics model I(a | s_c, s'_c) as a network over tiles.

use super::Dims;
use super::batch::Batch;
use super::gaussian::gather;
use super::init;
use super::losses::{in_parts, widths};
use super::net::{Net, Tape};
use super::nets::NetSettings;
use super::optimise::{Group, Rows, TILE, Tile, add_sums};
use nearl_runtime::multiversion;
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars_mut};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Network inputs beyond this many standard deviations are clipped, as in the controller.
pub(super) const CLIP: f32 = nearl_runtime::normaliser::CLIP as f32;

/// What of a row of actions the inverse model's squared error is compared with the threshold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ThresholdPer {
    /// The mean over its entries.
    #[default]
    Entry,
    /// Their sum.
    Row,
}

impl ThresholdPer {
    /// Whether a mean squared error of `error` an entry, of `n` entries, is at least `threshold`.
    pub fn exceeds(self, error: f64, n: usize, threshold: f64) -> bool {
        let factor = if self == Self::Row { n as f64 } else { 1.0 };
        error * factor >= threshold
    }
}

/// Mean of I: `[x_c, w_c] -> a`, and where it lies in its parameter group.
pub(super) struct InverseModel {
    /// The network.
    pub(super) net: Net,
    start: usize,
    end: usize,
}

/// Buffers of one thread.
pub(super) struct InverseScratch {
    /// Activations.
    pub(super) tape: Tape,
    /// Input rows.
    pub(super) input: Vec<V>,
    /// Action rows.
    pub(super) action: Vec<V>,
    /// Gradient of the output.
    pub(super) slope: Vec<V>,
}

impl InverseModel {
    /// Places the network at `at`; `log_std` vectors behind it are the caller's.
    pub(super) fn new(dims: &Dims, nets: &NetSettings, at: &mut usize, transposed: &mut usize) -> Self {
        let start = *at;
        let widths = widths(2 * dims.seen_obs.len(), &nets.idm, dims.n_act);
        let make = if nets.idm_residual && !nets.idm.is_empty() { Net::with_skip } else { Net::new };
        let net = make(&widths, nets.activation, 2 * dims.seen_obs.len(), at, transposed);
        Self { net, start, end: *at }
    }

    /// A model in a group of its own.
    pub(super) fn alone(dims: &Dims, nets: &NetSettings, rng: &mut ChaCha8Rng) -> (Self, Group) {
        let (mut at, mut transposed) = (0, 0);
        let model = Self::new(dims, nets, &mut at, &mut transposed);
        let mut group = Group { p: vec![ZERO; at], transposed: vec![ZERO; transposed] };
        model.init(&mut group.p, rng);
        (model, group)
    }

    /// Orthogonal weights; the first mean action is near zero.
    pub(super) fn init(&self, p: &mut [V], rng: &mut ChaCha8Rng) {
        let make = if self.net.mlp.skip.is_some() { init::linear_beside } else { init::orthogonal };
        let dense = make(&self.net.mlp.widths(), 0.01, rng);
        self.net.mlp.write_dense(&dense, p);
    }

    /// Begins anew as a linear map of its input, where it has one: alone, or beside layers, whose output then begins at zero. False where it
    /// has none.
    pub(super) fn begin_affine(&self, p: &mut [V], weight: Vec<f32>, bias: Vec<f32>) -> bool {
        let mut dense = self.net.mlp.to_dense(p);
        let is_affine = dense.layers.len() == 1;
        let Some(last) = dense.layers.last_mut().filter(|_| is_affine || dense.skip.is_some()) else {
            return false;
        };
        last.bias = bias;
        if is_affine {
            last.weight = weight;
        } else {
            last.weight.fill(0.0);
            dense.skip = Some(weight);
        }
        self.net.mlp.write_dense(&dense, p);
        true
    }

    /// Where its parameters lie.
    pub(super) fn range(&self) -> Range<usize> {
        self.start..self.end
    }

    /// Buffers for a tile.
    pub(super) fn scratch(&self) -> InverseScratch {
        let (n_in, n_out) = (self.net.mlp.n_in().div_ceil(LANES), self.net.mlp.n_out().div_ceil(LANES));
        InverseScratch {
            tape: self.net.tape(TILE),
            input: vec![ZERO; TILE * n_in],
            action: vec![ZERO; TILE * n_out],
            slope: vec![ZERO; TILE * n_out],
        }
    }

    /// The rows that [`InverseModel::tile`] reads.
    pub(super) fn rows<'b>(&self, dims: &Dims, batch: &'b Batch) -> Vec<Rows<'b>> {
        vec![
            Rows::new(&batch.obs, dims.n_obs),
            Rows::new(&batch.reached, dims.n_state),
            Rows::new(&batch.action, dims.n_act),
        ]
    }

    /// `L_I = sum |a - I(s_c, s'_c)|^2 / 2` on reached transitions (Eq. 4 of the paper for the mean of the Gaussian; its
    /// spread is left to the policy gradient, which needs it to explore).
    pub(super) fn tile(
        &self,
        group: &Group,
        t: &Tile<'_>,
        dims: &Dims,
        w: &mut InverseScratch,
        grad: &mut [V],
    ) {
        supervised(self, group, t, dims, w, grad);
    }

    /// Mean squared error of the mean action over a batch, per action entry.
    pub(super) fn error(&self, p: &[V], batch: &Batch, dims: &Dims, threads: usize) -> f64 {
        let mut sums = vec![0.0f32; batch.n.div_ceil(TILE)];
        in_parts(&mut sums, 1, threads, |first, sums| {
            let (mut w, mut idx) = (self.scratch(), [0u32; TILE]);
            for (tile, sum) in (first..).zip(sums) {
                let start = tile * TILE;
                for (k, i) in idx.iter_mut().enumerate() {
                    *i = (start + k).min(batch.n - 1) as u32;
                }
                squared_error(self, p, batch, &idx, dims, &mut w, TILE.min(batch.n - start), sum);
            }
        });
        sums.into_iter().map(f64::from).sum::<f64>() / (batch.n * dims.n_act) as f64
    }
}

/// Input rows `[x_c, change_c]`.
#[inline(always)]
pub(super) fn gather_input(to: &mut [V], batch: &Batch, change: &[f32], idx: &[u32], dims: &Dims) {
    let (n, vectors) = (dims.seen_obs.len(), (2 * dims.seen_obs.len()).div_ceil(LANES));
    let lanes = scalars_mut(to);
    for (r, &i) in idx.iter().enumerate() {
        let row = &mut lanes[r * vectors * LANES..][..2 * n];
        let obs = &batch.obs[i as usize * dims.n_obs..][..dims.n_obs];
        let change = &change[i as usize * dims.n_state..][..dims.n_state];
        for j in 0..n {
            row[j] = obs[dims.seen_obs[j]];
            row[n + j] = change[dims.seen_state[j]].clamp(-CLIP, CLIP);
        }
    }
}

#[inline(always)]
fn supervised_body(
    m: &InverseModel,
    group: &Group,
    t: &Tile<'_>,
    dims: &Dims,
    w: &mut InverseScratch,
    grad: &mut [V],
) {
    let vectors = dims.n_act.div_ceil(LANES);
    gather_input(&mut w.input, t.batch, &t.batch.reached, t.idx, dims);
    gather(&mut w.action, vectors, 0, &t.batch.action, dims.n_act, t.idx);
    let mean = m.net.forward(&group.p, &w.input, &mut w.tape);
    let mut sum = ZERO;
    for ((d, &y), &a) in w.slope.iter_mut().zip(mean).zip(&w.action) {
        let e = y - a;
        sum = sum.fma(e, e);
        *d = e * V::splat(t.scale);
    }
    m.net.backward(&group.transposed, &w.input, &w.slope, &mut w.tape, Some(grad), false);
    add_sums(grad, &[sum.sum()]);
}
multiversion!(fn supervised(m: &InverseModel, group: &Group, t: &Tile<'_>, dims: &Dims, w: &mut InverseScratch, grad: &mut [V]) = supervised_body);

#[inline(always)]
fn error_body(
    m: &InverseModel,
    p: &[V],
    b: &Batch,
    idx: &[u32],
    dims: &Dims,
    w: &mut InverseScratch,
    n: usize,
    out: &mut f32,
) {
    let vectors = dims.n_act.div_ceil(LANES);
    gather_input(&mut w.input, b, &b.reached, idx, dims);
    gather(&mut w.action, vectors, 0, &b.action, dims.n_act, idx);
    let mean = m.net.forward(p, &w.input, &mut w.tape);
    let mut sum = ZERO;
    for (&y, &a) in mean[..n * vectors].iter().zip(&w.action) {
        sum = sum.fma(y - a, y - a);
    }
    *out = sum.sum();
}
multiversion!(fn squared_error(m: &InverseModel, p: &[V], b: &Batch, idx: &[u32], dims: &Dims, w: &mut InverseScratch, n: usize, out: &mut f32) = error_body);

#[cfg(test)]
mod tests {
    use super::ThresholdPer;

    /// 0.3 an entry is 2.4 a row of eight: below the paper's 0.5 as one reading, above it as the other.
    #[test]
    fn the_threshold_has_two_readings() {
        assert!(!ThresholdPer::Entry.exceeds(0.3, 8, 0.5) && ThresholdPer::Row.exceeds(0.3, 8, 0.5));
        assert!(ThresholdPer::Entry.exceeds(0.5, 8, 0.5) && !ThresholdPer::Row.exceeds(0.06, 8, 0.5));
    }
}
