//! The proposals that the discriminator sees beside the reached changes, with noise like that of the reached ones.
//!
//! A reached change is the proposal that would have been right, plus what exploration and the plant add to it. Without such noise the
//! discriminator could tell even an exactly right proposal from a reached change. So a proposal is shown with the residual of another row,
//!
//! ```text
//! r = reached - (m + b u),    b = cov(reached, u) / var(u) within [0, 1]
//! ```
//!
//! with a coefficient for each entry: residuals of proposals that are right are the noise around them, those of proposals that
//! say nothing are what was reached itself, and no noise is larger than that. All entries of a residual come from the same row,
//! because the noise of one action moves several of them together.

use super::super::Batch;
use super::super::combined::Combined;
use super::super::inverse::CLIP;
use super::super::optimise::Group;
use super::Pid2Settings;
use nearl_runtime::net::kernel::scalars;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Tables of one update, row by row of the batch.
#[derive(Default)]
pub(super) struct Fakes {
    n_state: usize,
    /// Residuals (n x n_state); empty where proposals are shown as they are.
    residual: Vec<f32>,
    /// Standard normal noise of a stochastic proposal (n x n_state); empty where it is deterministic.
    normal: Vec<f32>,
    /// What the discriminator sees (n x n_state); empty: the batch's own proposals.
    shown: Vec<f32>,
    /// Rows between a proposal and the residual it is shown with: in the pass of the discriminator, in that of the policy.
    shift: [usize; 2],
}

impl Fakes {
    /// Tables of the batch, whose proposals are those of the current policy.
    pub(super) fn new(s: &Pid2Settings, combined: &Combined, batch: &Batch, rng: &mut ChaCha8Rng) -> Self {
        let n_state = combined.dims.n_state;
        let mut fakes = Self { n_state, ..Self::default() };
        if combined.policy_log_std.is_some() {
            fakes.normal = (0..batch.n * n_state).map(|_| StandardNormal.sample(&mut *rng)).collect();
        }
        if s.match_noise {
            fakes.residual = residuals(batch, n_state);
            fakes.shown.clone_from(&batch.change);
            fakes.disturb(batch.n, rng);
        }
        fakes
    }

    /// The same with the proposals of the current policy, sampled anew where it is stochastic.
    pub(super) fn renew(
        &mut self,
        combined: &Combined,
        group: &Group,
        batch: &Batch,
        threads: usize,
        rng: &mut ChaCha8Rng,
    ) {
        combined.proposals(group, batch, threads, &mut self.shown);
        if let Some(spread) = &combined.policy_log_std {
            let spread: Vec<f32> =
                scalars(&group.p[spread.clone()])[..self.n_state].iter().map(|l| l.exp()).collect();
            for row in self.shown.chunks_exact_mut(self.n_state) {
                for (u, spread) in row.iter_mut().zip(&spread) {
                    let z: f32 = StandardNormal.sample(&mut *rng);
                    *u += spread * z;
                }
            }
        }
        self.disturb(batch.n, rng);
    }

    /// Adds the residuals of other rows to what is shown.
    fn disturb(&mut self, n: usize, rng: &mut ChaCha8Rng) {
        if self.residual.is_empty() {
            return;
        }
        self.shift = std::array::from_fn(|_| rng.random_range(0..n));
        let (first, second) = self.residual.split_at(self.shift[0] * self.n_state);
        for (u, r) in self.shown.iter_mut().zip(second.iter().chain(first)) {
            *u += r;
        }
    }

    /// What the discriminator sees.
    pub(super) fn shown<'a>(&'a self, batch: &'a Batch) -> &'a [f32] {
        if self.shown.is_empty() { &batch.change } else { &self.shown }
    }

    /// Noise of a stochastic proposal of row `i`, for the policy against the discriminator.
    #[inline(always)]
    pub(super) fn normal(&self, i: usize) -> &[f32] {
        if self.normal.is_empty() { &[] } else { &self.normal[i * self.n_state..][..self.n_state] }
    }

    /// The residual with which row `i` is shown in the pass of the policy.
    #[inline(always)]
    pub(super) fn residual(&self, i: usize) -> &[f32] {
        if self.residual.is_empty() {
            return &[];
        }
        let at = (i + self.shift[1]) * self.n_state % self.residual.len();
        &self.residual[at..at + self.n_state]
    }
}

/// Within the range of what is shown, as reached changes are.
#[inline(always)]
pub(super) fn within(u: f32) -> f32 {
    u.clamp(-CLIP, CLIP)
}

/// `reached - (m + b u)` of each row, entry by entry.
fn residuals(batch: &Batch, n_state: usize) -> Vec<f32> {
    let n = batch.n as f64;
    let mut out = vec![0.0; batch.n * n_state];
    for k in 0..n_state {
        let rows = || (0..batch.n).map(|i| i * n_state + k);
        let mean = |x: &[f32]| rows().map(|at| f64::from(x[at])).sum::<f64>() / n;
        let (u, r) = (mean(&batch.change), mean(&batch.reached));
        let (mut both, mut own) = (0.0, 0.0);
        for at in rows() {
            let d = f64::from(batch.change[at]) - u;
            both += d * (f64::from(batch.reached[at]) - r);
            own += d * d;
        }
        let b = if own > 0.0 { (both / own).clamp(0.0, 1.0) } else { 0.0 };
        for at in rows() {
            out[at] = (f64::from(batch.reached[at]) - r - b * (f64::from(batch.change[at]) - u)) as f32;
        }
    }
    out
}
