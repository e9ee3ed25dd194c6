//! PPO (Schulman et al. 2017): the paper's RL-Pure. An ordinary Gaussian policy on actions; an inverse model learns on
//! the side, so that its loss can be plotted beside the others.

use super::batch::Batch;
use super::gaussian::{Likelihood, gather, gather_one, heads, likelihood_ratio, set_heads};
use super::inverse::InverseModel;
use super::net::{Net, Tape};
use super::optimise::{Group, Params, Phases, Schedule, TILE, Tile, add_sums, optimise};
use super::{Adam, Dims, Learner, Metrics, init};
use nearl_runtime::net::Dense;
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::{Networks, multiversion};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// `[train.ppo]`: settings of the clipped surrogate, shared by every algorithm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PpoSettings {
    /// Hidden widths of every network.
    pub hidden: Vec<usize>,
    /// Learning rate.
    pub lr: f32,
    /// Passes over a batch.
    pub n_epochs: usize,
    /// Rows of a minibatch; a multiple of 32 that divides the batch.
    pub batch_size: usize,
    /// Clip range of the probability ratio.
    pub clip_range: f32,
    /// Weight of the value loss.
    pub vf_coef: f32,
    /// Weight of the entropy bonus.
    pub ent_coef: f32,
    /// Largest gradient norm.
    pub max_grad_norm: f32,
    /// Log standard deviation at the start.
    pub log_std: f32,
}

impl Default for PpoSettings {
    fn default() -> Self {
        Self {
            hidden: vec![32, 32],
            lr: 3e-4,
            n_epochs: 10,
            batch_size: 64,
            clip_range: 0.2,
            vf_coef: 0.5,
            ent_coef: 0.0,
            max_grad_norm: 0.5,
            log_std: 0.0,
        }
    }
}

/// `widths` of a network from its ends and the hidden widths.
pub(super) fn widths(n_in: usize, hidden: &[usize], n_out: usize) -> Vec<usize> {
    [&[n_in], hidden, &[n_out]].concat()
}

/// Policy, value and inverse model.
pub struct Ppo {
    nets: Nets,
    params: Params,
    threads: usize,
}

struct Nets {
    dims: Dims,
    settings: PpoSettings,
    policy: Net,
    log_std: Range<usize>,
    value: Net,
    inverse: InverseModel,
    len: usize,
}

/// Buffers of one thread.
pub struct Work {
    policy: Tape,
    value: Tape,
    inverse: super::inverse::InverseWork,
    obs: Vec<V>,
    action: Vec<V>,
    d_action: Vec<V>,
    d_value: Vec<V>,
    rows: [Vec<V>; 3],
}

const ACTOR: usize = 0;
const INVERSE: usize = 1;

impl Ppo {
    /// Fresh networks.
    pub fn new(dims: Dims, settings: PpoSettings, threads: usize, rng: &mut ChaCha8Rng) -> Self {
        let (mut at, mut transposed) = (0, 0);
        let (o, a) = (dims.n_obs, dims.n_act);
        let hidden = settings.hidden.clone();
        let policy = Net::new(&widths(o, &hidden, a), false, &mut at, &mut transposed);
        let log_std = at..at + a.div_ceil(LANES);
        at = log_std.end;
        let value = Net::new(&widths(o, &hidden, 1), false, &mut at, &mut transposed);
        let mut actor = Group { p: vec![ZERO; at], transposed: vec![ZERO; transposed] };
        policy.mlp.write_dense(&init::orthogonal(&widths(o, &hidden, a), 0.01, rng), &mut actor.p);
        value.mlp.write_dense(&init::orthogonal(&widths(o, &hidden, 1), 1.0, rng), &mut actor.p);
        set_lanes(&mut actor.p[log_std.clone()], a, settings.log_std);
        let (inverse, inverse_group) = InverseModel::alone(&dims, &hidden, rng);
        let adam = vec![Adam::new(at, settings.lr), Adam::new(inverse_group.p.len(), settings.lr)];
        let nets = Nets { dims, settings, policy, log_std, value, inverse, len: at };
        let mut params = Params { groups: vec![actor, inverse_group], adam, beta: 0.0 };
        nets.refresh(ACTOR, &mut params);
        nets.refresh(INVERSE, &mut params);
        Self { nets, params, threads }
    }
}

/// The first `n` lanes of `p`.
pub(super) fn set_lanes(p: &mut [V], n: usize, value: f32) {
    nearl_runtime::net::kernel::scalars_mut(p)[..n].fill(value);
}

impl Learner for Ppo {
    fn networks(&self, normaliser: &Normaliser) -> Networks {
        let p = &self.params.groups[ACTOR].p;
        Networks {
            normaliser: normaliser.clone(),
            policy: self.nets.policy.mlp.to_dense(p),
            policy_log_std: scalars(&p[self.nets.log_std.clone()])[..self.nets.dims.n_act].to_vec(),
            idm: None,
        }
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        values(&self.nets.value, &self.params.groups[ACTOR].p, x, self.nets.dims.n_obs)
    }

    fn update(&mut self, batch: &Batch, rate: f32, rng: &mut ChaCha8Rng) -> Metrics {
        let s = &self.nets.settings;
        let before = self.nets.inverse.error(&self.params.groups[INVERSE].p, batch, &self.nets.dims);
        let schedule = Schedule { epochs: s.n_epochs, minibatch: s.batch_size, threads: self.threads, rate };
        let report = optimise(&self.nets, &mut self.params, batch, &[ACTOR, INVERSE], schedule, rng);
        let after = self.nets.inverse.error(&self.params.groups[INVERSE].p, batch, &self.nets.dims);
        let p = &self.params.groups[ACTOR].p;
        let log_std = &scalars(&p[self.nets.log_std.clone()])[..self.nets.dims.n_act];
        vec![
            ("train/policy_gradient_loss", report[0].mean[0]),
            ("train/approx_kl", report[0].mean[1]),
            ("train/clip_fraction", report[0].mean[2]),
            ("train/value_loss", report[0].mean[3]),
            ("train/grad_norm", report[0].norm),
            ("train/std", mean_std(log_std)),
            ("idm/mse_before", before),
            ("idm/mse_after", after),
            ("idm/updated", 1.0),
        ]
    }
}

/// Mean standard deviation.
pub(super) fn mean_std(log_std: &[f32]) -> f64 {
    log_std.iter().map(|l| f64::from(l.exp())).sum::<f64>() / log_std.len().max(1) as f64
}

/// Value of each row of `x`.
pub(super) fn values(net: &Net, p: &[V], x: &[f32], n_obs: usize) -> Vec<f32> {
    let (n, vectors) = (x.len() / n_obs, n_obs.div_ceil(LANES));
    let (mut tape, mut rows) = (net.tape(TILE), vec![ZERO; TILE * vectors]);
    let mut out = Vec::with_capacity(n);
    for start in (0..n).step_by(TILE) {
        let count = TILE.min(n - start);
        let idx: Vec<u32> = (start..start + count).map(|i| i as u32).collect();
        gather(&mut rows, vectors, 0, x, n_obs, &idx);
        let y = net.forward(p, &rows, &mut tape);
        out.extend(y[..count].iter().map(|v| v.0[0]));
    }
    out
}

/// The value loss of a tile: `d = dL / dV` a row; returns the sum of squared errors.
#[inline(always)]
pub(super) fn value_loss(
    d: &mut [V],
    rows: &mut [Vec<V>; 3],
    output: &[V],
    t: &Tile<'_>,
    weight: f32,
) -> f32 {
    let [value, target, slope] = rows;
    heads(value, output);
    gather_one(target, &t.batch.returns, t.idx);
    let mut sum = ZERO;
    for i in 0..value.len() {
        let e = value[i] - target[i];
        sum = sum.fma(e, e);
        slope[i] = e * V::splat(2.0 * weight * t.scale);
    }
    set_heads(d, slope);
    sum.sum()
}

/// Normalised advantages of the rows.
#[inline(always)]
pub(super) fn gather_advantage(to: &mut [V], t: &Tile<'_>) {
    gather_one(to, &t.batch.advantage, t.idx);
    let (mean, inverse) = t.advantage;
    for a in to {
        *a = (*a - V::splat(mean)) * V::splat(inverse);
    }
}

#[inline(always)]
fn actor_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) {
    let (s, a) = (&n.settings, n.dims.n_act);
    let (ov, av) = (n.dims.n_obs.div_ceil(LANES), a.div_ceil(LANES));
    let group = &params.groups[ACTOR];
    gather(&mut w.obs, ov, 0, &t.batch.obs, n.dims.n_obs, t.idx);
    gather(&mut w.action, av, 0, &t.batch.sampled, a, t.idx);
    // log pi(a | s) and the clipped surrogate
    let mean = n.policy.forward(&group.p, &w.obs, &mut w.policy);
    let likelihood = Likelihood {
        log_std: &group.p[n.log_std.clone()],
        n: a,
        sampled: &w.action,
        mean,
        clip_range: s.clip_range,
        ent_coef: s.ent_coef,
    };
    let log_std = &mut grad[n.log_std.clone()];
    let [loss, kl, clipped] = likelihood_ratio(&likelihood, &t, &mut w.rows, &mut w.d_action, log_std);
    n.policy.backward(&group.transposed, &w.obs, &w.d_action, &mut w.policy, Some(grad), false);
    // value
    let value = n.value.forward(&group.p, &w.obs, &mut w.value);
    let squares = value_loss(&mut w.d_value, &mut w.rows, value, &t, s.vf_coef);
    n.value.backward(&group.transposed, &w.obs, &w.d_value, &mut w.value, Some(grad), false);
    add_sums(grad, &[loss, kl, clipped, squares]);
}

/// Entropy of a diagonal Gaussian is the sum of its log standard deviations plus a constant.
#[inline(always)]
pub(super) fn entropy_bonus(grad: &mut [V], n: usize, weight: f32) {
    for g in &mut nearl_runtime::net::kernel::scalars_mut(grad)[..n] {
        *g -= weight;
    }
}

multiversion!(fn actor(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) = actor_body);

impl Phases for Nets {
    type Work = Work;

    fn work(&self) -> Work {
        let (ov, av) = (self.dims.n_obs.div_ceil(LANES), self.dims.n_act.div_ceil(LANES));
        Work {
            policy: self.policy.tape(TILE),
            value: self.value.tape(TILE),
            inverse: self.inverse.work(),
            obs: vec![ZERO; TILE * ov],
            action: vec![ZERO; TILE * av],
            d_action: vec![ZERO; TILE * av],
            d_value: vec![ZERO; TILE],
            rows: std::array::from_fn(|_| vec![ZERO; TILE / LANES]),
        }
    }
    fn group(&self, phase: usize) -> usize {
        phase
    }
    fn range(&self, phase: usize) -> Range<usize> {
        if phase == ACTOR { 0..self.len } else { self.inverse.range() }
    }
    fn tile(&self, phase: usize, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) {
        if phase == ACTOR {
            actor(self, params, t, w, grad);
        } else {
            self.inverse.tile(&params.groups[INVERSE], &t, &self.dims, &mut w.inverse, grad);
        }
    }
    fn refresh(&self, phase: usize, params: &mut Params) {
        let group = &mut params.groups[phase];
        if phase == ACTOR {
            self.policy.transpose(&group.p, &mut group.transposed);
            self.value.transpose(&group.p, &mut group.transposed);
        } else {
            self.inverse.net.transpose(&group.p, &mut group.transposed);
        }
    }
    fn max_norm(&self, _: usize) -> f32 {
        self.settings.max_grad_norm
    }
}

/// The policy as a network, for tests and exports.
impl Ppo {
    /// Mean action network.
    pub fn policy(&self) -> Dense {
        self.nets.policy.mlp.to_dense(&self.params.groups[ACTOR].p)
    }
}

#[cfg(test)]
mod tests;
