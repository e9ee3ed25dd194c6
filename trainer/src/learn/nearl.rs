//! Original NEARL (Algorithm 1 of the paper).
//!
//! ```text
//! collect with the combined policy                       (`rollout`)
//! meta policy on reached transitions (s, s'), supervised
//! inverse model on (s, s', a), supervised, above a threshold
//! policy gradient on the combined policy, Eq. 1
//! ```
//!
//! The losses run on each minibatch in the order of [`IMITATE`], [`INVERSE`], [`ACTOR`], [`VALUE`], each with its own optimiser: run one
//! after another over the whole batch, the first two would leave PPO's ratio far from 1 before its first step. What was
//! reached is possible but not optimal, so the first loss pulls against the last; PID^2 replaces it by an adversary.

use super::combined::{Combined, CombinedWork, Gradient, Kind};
use super::gaussian::gather;
use super::nets::NetSettings;
use super::optimise::{Group, Params, Phases, Rows, Schedule, Tile, add_sums, optimise};
use super::pid2::Pid2Settings;
use super::ppo::PpoSettings;
use super::value::ValueWork;
use super::{Adam, Batch, Dims, Learner, Metrics};
use nearl_runtime::net::kernel::{LANES, V, ZERO};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::{Networks, multiversion};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// `[train.nearl]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NearlSettings {
    /// Learning rate of the meta policy's supervised loss; 0 leaves it out.
    pub policy_lr: f32,
    /// The inverse model learns from reached transitions while its mean squared error is at least this ([sigma_I]).
    pub idm_threshold: f64,
    /// Learning rate of the inverse model's supervised loss.
    pub idm_lr: f32,
    /// How the policy gradient passes the projection.
    pub gradient: Gradient,
}

impl Default for NearlSettings {
    fn default() -> Self {
        let Pid2Settings { idm_threshold, idm_lr, gradient, .. } = Pid2Settings::default();
        Self { policy_lr: 3e-4, idm_threshold, idm_lr, gradient }
    }
}

/// Phase of the supervised meta policy.
pub const IMITATE: usize = 0;
/// Phase of the supervised inverse model.
pub const INVERSE: usize = 1;
/// Phase of the policy gradient.
pub const ACTOR: usize = 2;
/// Phase of the value.
pub const VALUE: usize = 3;

/// Parameter group of policy and inverse model.
const COMBINED: usize = 0;
/// Parameter group of the value.
const CRITIC: usize = 1;

/// The learner.
pub struct Nearl {
    nets: Nets,
    params: Params,
    threads: usize,
}

struct Nets {
    settings: NearlSettings,
    combined: Combined,
}

impl Nearl {
    /// Fresh networks.
    pub fn new(
        dims: Dims,
        nets: &NetSettings,
        ppo: PpoSettings,
        settings: NearlSettings,
        kind: Kind,
        threads: usize,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let lr = ppo.lr;
        let (combined, [actor, critic]) = Combined::new(dims, nets, ppo, settings.gradient, kind, rng);
        let adam = vec![
            Adam::new(combined.policy_range.len(), settings.policy_lr),
            Adam::new(combined.inverse_range().len(), settings.idm_lr),
            Adam::new(combined.len, lr),
            Adam::new(combined.value.len, lr),
        ];
        let params = Params { groups: vec![actor, critic], adam, beta: 0.0 };
        Self { nets: Nets { settings, combined }, params, threads }
    }

    fn actor(&self) -> &[V] {
        &self.params.groups[COMBINED].p
    }
}

impl Learner for Nearl {
    /// One round of Algorithm 1 on the collected batch.
    fn update(&mut self, batch: &Batch, rate: f32, rng: &mut ChaCha8Rng) -> Metrics {
        let s = &self.nets.combined.ppo;
        let schedule = Schedule { epochs: s.n_epochs, minibatch: s.batch_size, threads: self.threads, rate };
        let before = self.nets.combined.idm_error(self.actor(), batch, self.threads);
        let inverse_learns = before.is_some_and(|e| e >= self.nets.settings.idm_threshold);
        let mut phases = Vec::new();
        if self.nets.settings.policy_lr > 0.0 {
            phases.push(IMITATE);
        }
        if inverse_learns {
            phases.push(INVERSE);
        }
        phases.extend([ACTOR, VALUE]);
        let report = optimise(&self.nets, &mut self.params, batch, &phases, schedule, rng);
        let of = |phase| phases.iter().position(|p| *p == phase).map(|i| &report[i]);
        let mut metrics = Metrics::new();
        if let (Some(actor), Some(value)) = (of(ACTOR), of(VALUE)) {
            metrics = self.nets.combined.metrics(self.actor(), actor, value);
        }
        if let Some(imitate) = of(IMITATE) {
            metrics.push(("train/policy_mse", imitate.mean[0] / self.nets.combined.dims.n_state as f64));
        }
        let after = self.nets.combined.idm_error(self.actor(), batch, self.threads);
        metrics.extend(super::idm_metrics(before, after, inverse_learns));
        metrics
    }

    fn networks(&self, normaliser: &Normaliser) -> Networks {
        self.nets.combined.networks(self.actor(), normaliser)
    }

    fn params(&self) -> &Params {
        &self.params
    }

    fn restore(&mut self, f: &mut dyn FnMut(&mut Params) -> Result<(), String>) -> Result<(), String> {
        f(&mut self.params)?;
        [ACTOR, VALUE].iter().for_each(|&phase| self.nets.refresh(phase, &mut self.params));
        Ok(())
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        self.nets.combined.value.of(&self.params.groups[CRITIC], x, self.threads)
    }
}

/// `L_pi = sum |(s' - s) / scale - pi(s)|^2 / 2` on reached transitions (for the mean, where the policy is stochastic).
#[inline(always)]
fn imitate_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut CombinedWork, grad: &mut [V]) {
    let (c, group) = (&n.combined, &params.groups[COMBINED]);
    let s = c.dims.n_state;
    c.propose(group, &t, w);
    gather(&mut w.change, s.div_ceil(LANES), 0, &t.batch.reached, s, t.idx);
    let mut sum = ZERO;
    for ((d, &u), &reached) in w.d_change.iter_mut().zip(w.policy.output()).zip(&w.change) {
        let e = u - reached;
        sum = sum.fma(e, e);
        *d = e * V::splat(t.scale);
    }
    c.learn(group, w, grad);
    add_sums(grad, &[sum.sum()]);
}

/// Policy gradient on the combined policy (Eq. 1).
#[inline(always)]
fn actor_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut CombinedWork, grad: &mut [V]) {
    let sums = n.combined.policy_gradient(&params.groups[COMBINED], &t, w, grad);
    n.combined.learn(&params.groups[COMBINED], w, grad);
    add_sums(grad, &sums);
}

multiversion!(fn imitate(n: &Nets, params: &Params, t: Tile<'_>, w: &mut CombinedWork, grad: &mut [V]) = imitate_body);
multiversion!(fn actor(n: &Nets, params: &Params, t: Tile<'_>, w: &mut CombinedWork, grad: &mut [V]) = actor_body);

impl Phases for Nets {
    type Work = (CombinedWork, ValueWork);

    fn work(&self) -> Self::Work {
        (self.combined.work(), self.combined.value.work())
    }
    fn group(&self, phase: usize) -> usize {
        if phase == VALUE { CRITIC } else { COMBINED }
    }
    fn range(&self, phase: usize) -> Range<usize> {
        match phase {
            IMITATE => self.combined.policy_range.clone(),
            INVERSE => self.combined.inverse_range(),
            VALUE => 0..self.combined.value.len,
            _ => 0..self.combined.len,
        }
    }
    fn tile(&self, phase: usize, params: &Params, t: Tile<'_>, w: &mut Self::Work, grad: &mut [V]) {
        let (w, value) = w;
        match phase {
            IMITATE => imitate(self, params, t, w, grad),
            INVERSE => self.combined.idm_tile(&params.groups[COMBINED], &t, w, grad),
            VALUE => self.combined.value.tile(&params.groups[CRITIC], &t, value, grad),
            _ => actor(self, params, t, w, grad),
        }
    }
    fn refresh(&self, phase: usize, params: &mut Params) {
        let group: &mut Group = &mut params.groups[self.group(phase)];
        match phase {
            INVERSE => self.combined.refresh_inverse(group),
            VALUE => self.combined.value.refresh(group),
            _ => self.combined.refresh(group),
        }
    }
    fn max_norm(&self, phase: usize) -> f32 {
        if matches!(phase, ACTOR | VALUE) { self.combined.ppo.max_grad_norm } else { f32::INFINITY }
    }
    fn clipped_with(&self, phase: usize) -> Option<usize> {
        [None, None, Some(VALUE), Some(ACTOR)][phase]
    }
    fn lane(&self, phase: usize) -> usize {
        usize::from(phase == VALUE)
    }
    fn rows<'b>(&'b self, phase: usize, batch: &'b Batch) -> Vec<Rows<'b>> {
        let d = &self.combined.dims;
        match phase {
            IMITATE => vec![Rows::new(&batch.obs, d.n_obs), Rows::new(&batch.reached, d.n_state)],
            INVERSE => self.combined.idm_rows(batch),
            VALUE => self.combined.value.rows(batch),
            _ => self.combined.rows(batch),
        }
    }
}

#[cfg(test)]
mod tests;
