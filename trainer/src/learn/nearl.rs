//! Original NEARL (Algorithm 1 of the paper).
//!
//! ```text
//! collect with the combined policy                       (`rollout`)
//! inverse model on (s, s', a), supervised, above a threshold
//! meta policy on reached transitions (s, s'), supervised
//! policy gradient on the combined policy, Eq. 1
//! ```
//!
//! [`INVERSE`] comes first, over the whole batch, whose log probabilities are then those of the model that learned: PPO's ratio begins
//! at 1. The other losses run on each minibatch in the order of [`IMITATE`], [`ACTOR`], [`VALUE`], each with its own optimiser. What was
//! reached is possible but not optimal, so the first loss pulls against the last; PID^2 replaces it by an adversary.

use super::combined::{Combined, CombinedScratch, Gradient, Kind};
use super::epochs::{Pace, Update};
use super::gaussian::gather;
use super::inverse::ThresholdPer;
use super::nets::NetSettings;
use super::optimise::{Group, Params, Phases, Rows, Tile, add_sums, optimise};
use super::pid2::Pid2Settings;
use super::ppo::PpoSettings;
use super::value::ValueScratch;
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
    /// The inverse model learns from reached transitions while its mean squared error is at least this (\[sigma_I\]).
    pub idm_threshold: f64,
    /// What of a row of actions is compared with the threshold.
    pub idm_threshold_per: ThresholdPer,
    /// Learning rate of the inverse model's supervised loss.
    pub idm_lr: f32,
    /// How the policy gradient passes the projection.
    pub gradient: Gradient,
}

impl Default for NearlSettings {
    fn default() -> Self {
        let Pid2Settings { idm_threshold, idm_threshold_per, idm_lr, gradient, .. } = Pid2Settings::default();
        Self { policy_lr: 3e-4, idm_threshold, idm_threshold_per, idm_lr, gradient }
    }
}

impl NearlSettings {
    /// Without the two supervised losses: PPO on the combined policy.
    pub fn without_supervision(&self) -> Self {
        Self { policy_lr: 0.0, idm_threshold: f64::INFINITY, ..self.clone() }
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
        let (lr, value_lr) = (ppo.lr, ppo.rate_of_value());
        let (combined, [actor, critic]) = Combined::new(dims, nets, ppo, settings.gradient, kind, false, rng);
        let adam = vec![
            Adam::new(combined.policy_range.len(), settings.policy_lr),
            Adam::new(combined.inverse_range().len(), settings.idm_lr),
            Adam::new(combined.len, lr),
            Adam::new(combined.value.len, value_lr),
        ];
        let params = Params { groups: vec![actor, critic], adam, beta: 0.0, adapted: 1.0, ranks: None };
        Self { nets: Nets { settings, combined }, params, threads }
    }

    fn actor(&self) -> &[V] {
        &self.params.groups[COMBINED].p
    }
}

impl Learner for Nearl {
    /// One round of Algorithm 1 on the collected batch.
    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        let (ppo, threads) = (self.nets.combined.ppo.clone(), self.threads);
        let before = self.nets.combined.idm_error(self.actor(), batch, threads);
        let (s, n_act) = (&self.nets.settings, self.nets.combined.dims.n_act);
        let learns = |e| s.idm_threshold_per.exceeds(e, n_act, s.idm_threshold);
        let inverse_learns = before.is_some_and(learns);
        let mut phases = Vec::new();
        if self.nets.settings.policy_lr > 0.0 {
            phases.push(IMITATE);
        }
        phases.extend([ACTOR, VALUE]);
        let update = Update { ppo: &ppo, pace, threads, phases: &phases, actor: ACTOR };
        if inverse_learns {
            optimise(&self.nets, &mut self.params, batch, &[INVERSE], update.schedule(), rng);
            batch.log_prob = self.nets.combined.log_probs(&self.params.groups[COMBINED], batch, threads);
        }
        let again = ppo.recompute_advantages;
        let passes =
            update.run(&mut self.nets, &mut self.params, batch, rng, again, |pass, n, params, batch, _| {
                if again && pass > 0 {
                    batch.estimate(|x| n.combined.value.of(&params.groups[CRITIC], x, threads));
                }
            });
        let report = passes.reports;
        let of = |phase| phases.iter().position(|p| *p == phase).map(|i| &report[i]);
        let mut metrics = Metrics::new();
        if let (Some(actor), Some(value)) = (of(ACTOR), of(VALUE)) {
            metrics = self.nets.combined.metrics(self.actor(), actor, value);
            metrics.push(("train/epochs", passes.epochs as f64));
            metrics.push(("train/learning_rate", f64::from(ppo.lr * pace.rate * passes.adapted)));
        }
        if let Some(imitate) = of(IMITATE) {
            metrics.push(("train/policy_mse", imitate.mean[0] / self.nets.combined.dims.n_state as f64));
        }
        let after = self.nets.combined.idm_error(self.actor(), batch, self.threads);
        metrics.extend(super::idm_metrics(before, after, inverse_learns, &batch.action, n_act));
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

    fn spreads(&self) -> Vec<Range<usize>> {
        self.nets.combined.spreads()
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        self.nets.combined.value.of(&self.params.groups[CRITIC], x, self.threads)
    }
}

/// `L_pi = sum |(s' - s) / scale - pi(s)|^2 / 2` on reached transitions (for the mean, where the policy is stochastic).
#[inline(always)]
fn imitate_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut CombinedScratch, grad: &mut [V]) {
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
fn actor_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut CombinedScratch, grad: &mut [V]) {
    let sums = n.combined.policy_gradient(&params.groups[COMBINED], &t, w, grad);
    n.combined.learn(&params.groups[COMBINED], w, grad);
    add_sums(grad, &sums);
}

multiversion!(fn imitate(n: &Nets, params: &Params, t: Tile<'_>, w: &mut CombinedScratch, grad: &mut [V]) = imitate_body);
multiversion!(fn actor(n: &Nets, params: &Params, t: Tile<'_>, w: &mut CombinedScratch, grad: &mut [V]) = actor_body);

impl Phases for Nets {
    type Scratch = (CombinedScratch, ValueScratch);

    fn scratch(&self) -> Self::Scratch {
        (self.combined.scratch(), self.combined.value.scratch())
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
    fn tile(&self, phase: usize, params: &Params, t: Tile<'_>, w: &mut Self::Scratch, grad: &mut [V]) {
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
    fn is_paced(&self, phase: usize) -> bool {
        phase != INVERSE
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
