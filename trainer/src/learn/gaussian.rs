//! Diagonal Gaussians over tiles of rows, and the small row operations the losses share.

use super::losses::{entropy_bonus, gather_advantage};
use super::optimise::{TILE, Tile};
use super::ppo::PpoSettings;
use nearl_runtime::net::kernel::{LANES, V, ZERO, exp, scalars, scalars_mut};
use std::ops::Range;

/// Vectors of [`MOST_OUTPUTS`].
pub(super) const MOST_VECTORS: usize = 16;
/// Most outputs of a Gaussian network.
pub const MOST_OUTPUTS: usize = MOST_VECTORS * LANES;

const HALF_LOG_TWO_PI: f64 = 0.918_938_533_204_672_7;

/// Copies rows `idx` of `source` (each `width` wide) into rows of `to`, `vectors` vectors each, from lane `offset`.
#[inline(always)]
pub(super) fn gather(to: &mut [V], vectors: usize, offset: usize, source: &[f32], width: usize, idx: &[u32]) {
    let lanes = scalars_mut(to);
    for (r, &i) in idx.iter().enumerate() {
        copy(&mut lanes[r * vectors * LANES + offset..][..width], &source[i as usize * width..][..width]);
    }
}

/// An inlined copy: 16 lanes at a time, the last chunk overlapping.
#[inline(always)]
pub(super) fn copy(to: &mut [f32], from: &[f32]) {
    let n = from.len();
    if n < LANES {
        to.copy_from_slice(from);
        return;
    }
    let mut k = 0;
    while k + LANES < n {
        to[k..k + LANES].copy_from_slice(&from[k..k + LANES]);
        k += LANES;
    }
    to[n - LANES..n].copy_from_slice(&from[n - LANES..]);
}

/// Gathers one number a row.
#[inline(always)]
pub(super) fn gather_one(to: &mut [V], source: &[f32], idx: &[u32]) {
    for (to, &i) in scalars_mut(to).iter_mut().zip(idx) {
        *to = source[i as usize];
    }
}

/// Lane 0 of each row, densely.
#[inline(always)]
pub(super) fn heads(to: &mut [V], rows: &[V]) {
    for (to, row) in scalars_mut(to).iter_mut().zip(rows) {
        *to = row.0[0];
    }
}

/// The inverse of [`heads`]; the other lanes stay as they are.
#[inline(always)]
pub(super) fn set_heads(rows: &mut [V], from: &[V]) {
    for (row, &v) in rows.iter_mut().zip(scalars(from)) {
        row.0[0] = v;
    }
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub(super) fn sigmoid(x: V) -> V {
    V::splat(1.0) / (V::splat(1.0) + exp(ZERO - x))
}

/// Writes `1 / sigma` (n entries in whole vectors) and returns the constant of the log density.
#[inline(always)]
pub(super) fn inverse_sigma(inverse: &mut [V], log_std: &[V], n: usize) -> f64 {
    for (i, &l) in inverse.iter_mut().zip(log_std) {
        *i = exp(ZERO - l);
    }
    -scalars(log_std)[..n].iter().map(|&l| f64::from(l) + HALF_LOG_TWO_PI).sum::<f64>()
}

/// `d = (x - mean) / sigma`; adds `-|d|^2 / 2` of each row to `log_prob`.
#[inline(always)]
pub(super) fn residuals(d: &mut [V], x: &[V], mean: &[V], inverse: &[V], log_prob: &mut [V]) {
    let n = inverse.len();
    let rows = d.chunks_exact_mut(n).zip(x.chunks_exact(n).zip(mean.chunks_exact(n)));
    for (lp, (d, (x, m))) in scalars_mut(log_prob).iter_mut().zip(rows) {
        let mut q = ZERO;
        for j in 0..n {
            d[j] = (x[j] - m[j]) * inverse[j];
            q = q.fma(d[j], d[j]);
        }
        *lp -= 0.5 * q.sum();
    }
}

/// From residuals and a weight `c = dL / d log_prob` a row: `d <- dL / d mean`; adds `dL / d log_std` to `grad` if given.
#[inline(always)]
pub(super) fn residuals_back(d: &mut [V], inverse: &[V], c: &[V], grad: Option<&mut [V]>, n: usize) {
    let vectors = inverse.len();
    let (mut total, mut spread) = (0.0, [ZERO; MOST_VECTORS]);
    for (d, &c) in d.chunks_exact_mut(vectors).zip(scalars(c)) {
        total += c;
        let c = V::splat(c);
        for j in 0..vectors {
            let t = c * d[j];
            spread[j] = spread[j].fma(t, d[j]);
            d[j] = t * inverse[j];
        }
    }
    if let Some(grad) = grad {
        for j in 0..vectors {
            grad[j] = grad[j] + spread[j];
        }
        for g in &mut scalars_mut(grad)[..n] {
            *g -= total;
        }
    }
}

/// No action is reckoned with as more likely than before by more than `e` to this.
const MOST_LOG_RATIO: f32 = 20.0;

/// Clipped surrogate of PPO: from log ratios, advantages and `scale = 1 / batch` to `c = dL / d log_prob` in place of
/// `log_prob`; returns sums over the tile: loss, approximate KL `(r - 1) - log r`, clipped rows.
#[inline(always)]
pub(super) fn surrogate(log_prob: &mut [V], old: &[V], advantage: &[V], range: f32, scale: f32) -> [f32; 3] {
    let (mut loss, mut kl, mut clipped) = (ZERO, ZERO, ZERO);
    for i in 0..log_prob.len() {
        // Beyond it a gradient would be infinite, of which its norm makes no number.
        let log_ratio = (log_prob[i] - old[i]).map(|x| if x > MOST_LOG_RATIO { MOST_LOG_RATIO } else { x });
        let ratio = exp(log_ratio);
        let free = ratio * advantage[i];
        let bound = ratio.map(|r| r.clamp(1.0 - range, 1.0 + range));
        let held = bound * advantage[i];
        loss = loss - free.zip(held, f32::min);
        kl = kl + ratio - V::splat(1.0) - log_ratio;
        clipped = clipped + ratio.zip(bound, |r, b| if r == b { 0.0 } else { 1.0 });
        log_prob[i] = free.zip(held, |f, h| if f <= h { f } else { 0.0 }) * V::splat(-scale);
    }
    [loss.sum(), kl.sum(), clipped.sum()]
}

/// One Gaussian of the policy: what was sampled from it, and where its spread lies in the parameter vector.
pub(super) struct Gaussian<'a> {
    /// Its log standard deviations in the parameter vector (n entries in whole vectors).
    pub(super) log_std: Range<usize>,
    /// Entries.
    pub(super) n: usize,
    /// What was sampled.
    pub(super) sampled: &'a [V],
    /// Its mean under the current policy.
    pub(super) mean: &'a [V],
    /// Receives `dL / d mean`.
    pub(super) d: &'a mut [V],
}

/// PPO's loss of a tile for a policy that is a product of N Gaussians (one of them, or proposal and action): leaves
/// `dL / d mean` in each `d`, adds `dL / d log_std` to `grad`; returns the sums of [`surrogate`]. `rows` are scratch.
#[inline(always)]
pub(super) fn likelihood_ratio<const N: usize>(
    mut policy: [Gaussian<'_>; N],
    settings: &PpoSettings,
    t: &Tile<'_>,
    rows: &mut [Vec<V>; 3],
    p: &[V],
    grad: &mut [V],
) -> [f32; 3] {
    let mut inverse = [[ZERO; MOST_VECTORS]; N];
    let mut constant = 0.0;
    for (g, inverse) in policy.iter().zip(&mut inverse) {
        constant += inverse_sigma(&mut inverse[..g.log_std.len()], &p[g.log_std.clone()], g.n);
    }
    let [log_prob, old, advantage] = rows;
    log_prob.fill(V::splat(constant as f32));
    gather_one(old, &t.batch.log_prob, t.idx);
    gather_advantage(advantage, t);
    for (g, inverse) in policy.iter_mut().zip(&inverse) {
        residuals(g.d, g.sampled, g.mean, &inverse[..g.log_std.len()], log_prob);
    }
    let sums = surrogate(log_prob, old, advantage, t.clip, t.scale);
    for (g, inverse) in policy.iter_mut().zip(&inverse) {
        let grad = &mut grad[g.log_std.clone()];
        residuals_back(g.d, &inverse[..g.log_std.len()], log_prob, Some(&mut *grad), g.n);
        entropy_bonus(grad, g.n, settings.ent_coef * t.scale * TILE as f32);
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An action that is e^500 times as likely as it was, by advantages of either sign and none: every number stays finite, and pushes as hard as the bound.
    #[test]
    fn an_action_that_became_far_more_likely_leaves_numbers() {
        let far = |advantage: f32, log_ratio: f32| {
            let mut c = [V::splat(log_ratio)];
            let sums = surrogate(&mut c, &[ZERO], &[V::splat(advantage)], 0.2, 0.5);
            (c[0].0[0], sums)
        };
        for advantage in [-3.0, 0.0, 3.0] {
            let (c, sums) = far(advantage, 500.0);
            assert!(c.is_finite() && sums.iter().all(|x| x.is_finite()), "{advantage}: {c} {sums:?}");
            assert_eq!(far(advantage, 500.0), far(advantage, 20.0));
        }
        let (c, _) = far(-3.0, 500.0);
        assert!((c / (20f32.exp() * 1.5) - 1.0).abs() < 1e-5, "{c}");
        let (c, _) = far(-3.0, 2.0);
        assert!((c / (2f32.exp() * 1.5) - 1.0).abs() < 1e-5, "{c}");
    }
}
