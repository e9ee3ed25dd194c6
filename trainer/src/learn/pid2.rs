//! PID^2: policy, inverse dynamics, discriminator (Algorithm 2 of the paper, lines 8 to 13).
//!
//! ```text
//! collect with constraints                                        (line 8; `rollout`)
//! discriminator, bottleneck, and policy against them, Eq. 2       (line 9)
//! inverse model on reached transitions, Eq. 4, above a threshold  (lines 10 to 12)
//! policy gradient on the combined policy, Eq. 1                   (line 13)
//! ```
//!
//! The three losses run on each minibatch in the order of [`ACTOR`], [`DISCRIMINATOR`], [`INVERSE`]. The gradient of
//! `log I(a | s_c, C(pi(s)))` reaches the policy through the inverse model's input and the projection: one inside the
//! bounds, zero where the projection clamped.

use super::batch::Batch;
use super::discriminator::{Discriminator, DiscriminatorWork, LATENT, logit_slope, softplus_sum};
use super::gaussian::{Likelihood, copy, gather, likelihood_ratio};
use super::inverse::{InverseModel, InverseWork};
use super::net::{Net, Tape};
use super::optimise::{Group, Params, Phases, SUMS, Schedule, TILE, Tile, add_sums, optimise};
use super::ppo::{PpoSettings, mean_std, set_lanes, value_loss, values, widths};
use super::{Adam, Dims, Learner, Metrics, init};
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars, scalars_mut};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::{Networks, multiversion};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// How the policy gradient passes the projection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Gradient {
    /// The projection's derivative: zero where it clamped.
    #[default]
    Projection,
    /// As if the projection were not there.
    StraightThrough,
}

/// `[train.pid2]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Pid2Settings {
    /// The inverse model learns from reached transitions while its mean squared error is at least this ([sigma_I]).
    pub idm_threshold: f64,
    /// Learning rate of the inverse model's supervised loss.
    pub idm_lr: f32,
    /// Learning rate of the discriminator.
    pub discriminator_lr: f32,
    /// Weight of the adversarial loss in the policy's gradient; 0 leaves the adversary out.
    pub generator_weight: f32,
    /// Information the bottleneck may pass, in [nat] (I_c).
    pub i_c: f32,
    /// Multiplier of the bottleneck at the start.
    pub beta: f32,
    /// Step of the multiplier: `beta <- max(0, beta + alpha (KL - I_c))`.
    pub alpha: f32,
    /// How the policy gradient passes the projection.
    pub gradient: Gradient,
}

impl Default for Pid2Settings {
    fn default() -> Self {
        Self {
            idm_threshold: 0.5,
            idm_lr: 3e-4,
            discriminator_lr: 3e-4,
            generator_weight: 0.1,
            i_c: 0.5,
            beta: 0.1,
            alpha: 1e-5,
            gradient: Gradient::default(),
        }
    }
}

/// Phase of the policy gradient, the value and the adversarial loss of the policy.
pub const ACTOR: usize = 0;
/// Phase of the discriminator.
pub const DISCRIMINATOR: usize = 1;
/// Phase of the supervised inverse model.
pub const INVERSE: usize = 2;

/// The learner.
pub struct Pid2 {
    nets: Nets,
    params: Params,
    threads: usize,
}

struct Nets {
    dims: Dims,
    ppo: PpoSettings,
    settings: Pid2Settings,
    policy: Net,
    /// Present when exploration is in the proposal.
    policy_log_std: Option<Range<usize>>,
    /// The inverse model and its spread; absent with analytic inverse dynamics.
    inverse: Option<(InverseModel, Range<usize>)>,
    value: Net,
    discriminator: Discriminator,
    len: usize,
    /// Latent noise (n x LATENT) of real, proposed and generator passes.
    noise: [Vec<f32>; 3],
}

/// Buffers of one thread.
pub struct Work {
    policy: Tape,
    value: Tape,
    inverse: Option<InverseWork>,
    discriminator: DiscriminatorWork,
    obs: Vec<V>,
    change: Vec<V>,
    d_change: Vec<V>,
    d_value: Vec<V>,
    rows: [Vec<V>; 3],
}

impl Pid2 {
    /// Fresh networks. `stochastic`: exploration is in the proposal and inverse dynamics is analytic. `bottleneck` off
    /// is `pid2-gan`.
    pub fn new(
        dims: Dims,
        ppo: PpoSettings,
        settings: Pid2Settings,
        stochastic: bool,
        bottleneck: bool,
        threads: usize,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let (mut at, mut transposed) = (0, 0);
        let (o, s, hidden) = (dims.n_obs, dims.n_state, ppo.hidden.clone());
        let vectors = |at: &mut usize, n: usize| {
            let range = *at..*at + n.div_ceil(LANES);
            *at = range.end;
            range
        };
        let policy = Net::new(&widths(o, &hidden, s), false, &mut at, &mut transposed);
        let policy_log_std = stochastic.then(|| vectors(&mut at, s));
        let inverse = (!stochastic).then(|| {
            let model = InverseModel::new(&dims, &hidden, &mut at, &mut transposed);
            let log_std = vectors(&mut at, dims.n_act);
            (model, log_std)
        });
        let value = Net::new(&widths(o, &hidden, 1), false, &mut at, &mut transposed);
        let discriminator = Discriminator::new(o + s, &hidden, bottleneck);
        let mut actor = Group { p: vec![ZERO; at], transposed: vec![ZERO; transposed] };
        policy.mlp.write_dense(&init::orthogonal(&widths(o, &hidden, s), 0.01, rng), &mut actor.p);
        value.mlp.write_dense(&init::orthogonal(&widths(o, &hidden, 1), 1.0, rng), &mut actor.p);
        if let Some(range) = &policy_log_std {
            set_lanes(&mut actor.p[range.clone()], s, ppo.log_std);
        }
        if let Some((model, range)) = &inverse {
            model.init(&dims, &hidden, &mut actor.p, rng);
            set_lanes(&mut actor.p[range.clone()], dims.n_act, ppo.log_std);
        }
        let d = &discriminator;
        let mut judge = Group { p: vec![ZERO; d.len], transposed: vec![ZERO; d.transposed] };
        d.init(&mut judge.p, rng);
        let inverse_len = inverse.as_ref().map_or(0, |(m, _)| m.range().len());
        let adam = vec![
            Adam::new(at, ppo.lr),
            Adam::new(d.len, settings.discriminator_lr),
            Adam::new(inverse_len, settings.idm_lr),
        ];
        let mut params = Params { groups: vec![actor, judge], adam, beta: settings.beta };
        let noise = [Vec::new(), Vec::new(), Vec::new()];
        let nets = Nets {
            dims,
            ppo,
            settings,
            policy,
            policy_log_std,
            inverse,
            value,
            discriminator,
            len: at,
            noise,
        };
        nets.refresh(ACTOR, &mut params);
        nets.refresh(DISCRIMINATOR, &mut params);
        Self { nets, params, threads }
    }

    fn idm_error(&self, batch: &Batch) -> Option<f64> {
        let (model, _) = self.nets.inverse.as_ref()?;
        Some(model.error(&self.params.groups[0].p, batch, &self.nets.dims))
    }
}

impl Learner for Pid2 {
    fn networks(&self, normaliser: &Normaliser) -> Networks {
        let (n, p) = (&self.nets, &self.params.groups[0].p);
        let lanes = |r: &Range<usize>, n: usize| scalars(&p[r.clone()])[..n].to_vec();
        Networks {
            normaliser: normaliser.clone(),
            policy: n.policy.mlp.to_dense(p),
            policy_log_std: n.policy_log_std.as_ref().map_or(Vec::new(), |r| lanes(r, n.dims.n_state)),
            idm: n.inverse.as_ref().map(|(m, r)| (m.net.mlp.to_dense(p), lanes(r, n.dims.n_act))),
        }
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        values(&self.nets.value, &self.params.groups[0].p, x, self.nets.dims.n_obs)
    }

    /// One round of Algorithm 2 on the collected batch.
    fn update(&mut self, batch: &Batch, rate: f32, rng: &mut ChaCha8Rng) -> Metrics {
        for noise in &mut self.nets.noise {
            noise.resize(batch.n * LATENT, 0.0);
            noise.fill_with(|| StandardNormal.sample(&mut *rng));
        }
        let s = &self.nets.ppo;
        let schedule = Schedule { epochs: s.n_epochs, minibatch: s.batch_size, threads: self.threads, rate };
        let before = self.idm_error(batch);
        let inverse_learns = before.is_some_and(|e| e >= self.nets.settings.idm_threshold);
        let mut phases = vec![ACTOR];
        if self.nets.settings.generator_weight > 0.0 {
            phases.push(DISCRIMINATOR);
        }
        if inverse_learns {
            phases.push(INVERSE);
        }
        let report = optimise(&self.nets, &mut self.params, batch, &phases, schedule, rng);
        let actor = &report[0].mean;
        let mut metrics = vec![
            ("train/policy_gradient_loss", actor[0]),
            ("train/approx_kl", actor[1]),
            ("train/clip_fraction", actor[2]),
            ("train/value_loss", actor[3]),
            ("train/generator_loss", actor[4]),
            ("train/clamped_fraction", actor[5] / self.nets.dims.seen_state.len().max(1) as f64),
            ("train/grad_norm", report[0].norm),
            ("train/std", mean_std(&self.log_std())),
        ];
        if phases.contains(&DISCRIMINATOR) {
            let judge = &report[1].mean;
            metrics.extend([
                ("discriminator/loss", judge[0]),
                ("discriminator/kl", judge[1]),
                ("discriminator/accuracy", judge[2]),
                ("discriminator/beta", f64::from(self.params.beta)),
            ]);
        }
        if let (Some(before), Some(after)) = (before, self.idm_error(batch)) {
            metrics.extend([
                ("idm/mse_before", before),
                ("idm/mse_after", after),
                ("idm/updated", f64::from(u8::from(inverse_learns))),
            ]);
        }
        metrics
    }
}

impl Pid2 {
    fn log_std(&self) -> Vec<f32> {
        let (n, p) = (&self.nets, &self.params.groups[0].p);
        match (&n.inverse, &n.policy_log_std) {
            (Some((_, r)), _) => scalars(&p[r.clone()])[..n.dims.n_act].to_vec(),
            (None, Some(r)) => scalars(&p[r.clone()])[..n.dims.n_state].to_vec(),
            (None, None) => Vec::new(),
        }
    }
}

/// Policy gradient on the combined policy (Eq. 1), value, and the adversarial loss of the policy (Eq. 2).
#[inline(always)]
fn actor_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) {
    let group = &params.groups[0];
    gather(&mut w.obs, n.dims.n_obs.div_ceil(LANES), 0, &t.batch.obs, n.dims.n_obs, t.idx);
    n.policy.forward(&group.p, &w.obs, &mut w.policy);
    let mut sums = [0.0; 6];
    match (&n.inverse, &n.policy_log_std) {
        (Some((model, log_std)), _) => through_inverse(n, model, log_std, group, &t, w, grad, &mut sums),
        (None, Some(log_std)) => through_proposal(n, log_std, group, &t, w, grad, &mut sums),
        (None, None) => unreachable!("a policy explores in its action or in its proposal"),
    }
    // value
    let value = n.value.forward(&group.p, &w.obs, &mut w.value);
    sums[3] = value_loss(&mut w.d_value, &mut w.rows, value, &t, n.ppo.vf_coef);
    n.value.backward(&group.transposed, &w.obs, &w.d_value, &mut w.value, Some(grad), false);
    if n.settings.generator_weight > 0.0 {
        sums[4] = fool_discriminator(n, &params.groups[1], &t, w);
    }
    n.policy.backward(&group.transposed, &w.obs, &w.d_change, &mut w.policy, Some(grad), false);
    add_sums(grad, &sums);
}

/// Ratio on `log I(a | s_c, w_c)` with `w = clamp(pi(s), lower, upper)`; leaves `dL / du` in `w.d_change`.
#[inline(always)]
fn through_inverse(
    n: &Nets,
    model: &InverseModel,
    log_std: &Range<usize>,
    group: &Group,
    t: &Tile<'_>,
    w: &mut Work,
    grad: &mut [V],
    sums: &mut [f32; 6],
) {
    let (d, a) = (&n.dims, n.dims.n_act);
    let seen = d.seen_obs.len();
    let (xv, av, sv) = ((2 * seen).div_ceil(LANES), a.div_ceil(LANES), d.n_state.div_ceil(LANES));
    let Some(inv) = &mut w.inverse else { return };
    // project again with the current policy
    let u = scalars(w.policy.output());
    let (x, mut clamped) = (scalars_mut(&mut inv.input), 0.0);
    for (r, &i) in t.idx.iter().enumerate() {
        let i = i as usize;
        for j in 0..seen {
            let k = d.seen_state[j];
            let raw = u[r * sv * LANES + k];
            let held = raw.max(t.batch.lower[i * d.n_state + k]).min(t.batch.upper[i * d.n_state + k]);
            let held = held.clamp(-super::inverse::CLIP, super::inverse::CLIP);
            x[r * xv * LANES + j] = t.batch.obs[i * d.n_obs + d.seen_obs[j]];
            x[r * xv * LANES + seen + j] = held;
            clamped += if held == raw { 0.0 } else { 1.0 };
        }
    }
    gather(&mut inv.action, av, 0, &t.batch.sampled, a, t.idx);
    let mean = model.net.forward(&group.p, &inv.input, &mut inv.tape);
    let likelihood = Likelihood {
        log_std: &group.p[log_std.clone()],
        n: a,
        sampled: &inv.action,
        mean,
        clip_range: n.ppo.clip_range,
        ent_coef: n.ppo.ent_coef,
    };
    let [loss, kl, clipped] =
        likelihood_ratio(&likelihood, t, &mut w.rows, &mut inv.slope, &mut grad[log_std.clone()]);
    let dx = model.net.backward(&group.transposed, &inv.input, &inv.slope, &mut inv.tape, Some(grad), true);
    // through the projection into the proposal
    let (dx, x) = (scalars(dx), scalars(&inv.input));
    let straight = n.settings.gradient == Gradient::StraightThrough;
    w.d_change.fill(ZERO);
    let du = scalars_mut(&mut w.d_change);
    for r in 0..TILE {
        for j in 0..seen {
            let (at, k) = (r * xv * LANES + seen + j, r * sv * LANES + d.seen_state[j]);
            if straight || x[at] == u[k] {
                du[k] = dx[at];
            }
        }
    }
    (sums[0], sums[1], sums[2], sums[5]) = (loss, kl, clipped, clamped);
}

/// Ratio on `log pi(proposal | s)`; leaves `dL / du` in `w.d_change`.
#[inline(always)]
fn through_proposal(
    n: &Nets,
    log_std: &Range<usize>,
    group: &Group,
    t: &Tile<'_>,
    w: &mut Work,
    grad: &mut [V],
    sums: &mut [f32; 6],
) {
    let s = n.dims.n_state;
    let sv = s.div_ceil(LANES);
    gather(&mut w.change, sv, 0, &t.batch.proposal, s, t.idx);
    let likelihood = Likelihood {
        log_std: &group.p[log_std.clone()],
        n: s,
        sampled: &w.change,
        mean: w.policy.output(),
        clip_range: n.ppo.clip_range,
        ent_coef: n.ppo.ent_coef,
    };
    let [loss, kl, clipped] =
        likelihood_ratio(&likelihood, t, &mut w.rows, &mut w.d_change, &mut grad[log_std.clone()]);
    (sums[0], sums[1], sums[2]) = (loss, kl, clipped);
}

/// Non-saturating loss `-log D(E(s, pi(s)))`: adds its gradient to `dL / du`; returns its sum.
#[inline(always)]
fn fool_discriminator(n: &Nets, judge: &Group, t: &Tile<'_>, w: &mut Work) -> f32 {
    let (o, s) = (n.dims.n_obs, n.dims.n_state);
    let (xv, sv) = ((o + s).div_ceil(LANES), s.div_ceil(LANES));
    let d = &mut w.discriminator;
    gather(&mut d.input, xv, 0, &t.batch.obs, o, t.idx);
    gather(&mut d.noise, 1, 0, &n.noise[2], LATENT, t.idx);
    let (x, u) = (scalars_mut(&mut d.input), scalars(w.policy.output()));
    for r in 0..TILE {
        copy(&mut x[r * xv * LANES + o..][..s], &u[r * sv * LANES..][..s]);
    }
    n.discriminator.forward(&judge.p, d);
    let loss = softplus_sum(&d.logit, 1.0);
    logit_slope(&mut d.logit, 1.0, n.settings.generator_weight * t.scale);
    let dx = scalars(n.discriminator.backward(&judge.transposed, d, 0.0, None, true));
    let du = scalars_mut(&mut w.d_change);
    for r in 0..TILE {
        for k in 0..s {
            du[r * sv * LANES + k] += dx[r * xv * LANES + o + k];
        }
    }
    loss
}

/// Real transitions against proposed ones through the bottleneck (Eq. 2).
#[inline(always)]
fn discriminator_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) {
    let (o, s) = (n.dims.n_obs, n.dims.n_state);
    let xv = (o + s).div_ceil(LANES);
    let (judge, d) = (&params.groups[1], &mut w.discriminator);
    let (mut loss, mut kl, mut right) = (0.0, 0.0, 0.0);
    for (real, sign) in [(true, 1.0), (false, -1.0)] {
        let (change, noise) =
            if real { (&t.batch.reached, &n.noise[0]) } else { (&t.batch.proposal, &n.noise[1]) };
        gather(&mut d.input, xv, 0, &t.batch.obs, o, t.idx);
        gather(&mut d.input, xv, o, change, s, t.idx);
        gather(&mut d.noise, 1, 0, noise, LATENT, t.idx);
        kl += 0.5 * n.discriminator.forward(&judge.p, d);
        loss += softplus_sum(&d.logit, sign);
        right += scalars(&d.logit).iter().filter(|&&l| l * sign > 0.0).count() as f32 * 0.5;
        logit_slope(&mut d.logit, sign, t.scale);
        // the mixture of real and proposed transitions bears the bottleneck: half each
        n.discriminator.backward(&judge.transposed, d, 0.5 * params.beta * t.scale, Some(grad), false);
    }
    add_sums(grad, &[loss, kl, right]);
}

multiversion!(fn actor(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) = actor_body);
multiversion!(fn discriminator(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) = discriminator_body);

impl Phases for Nets {
    type Work = Work;

    fn work(&self) -> Work {
        let (ov, sv) = (self.dims.n_obs.div_ceil(LANES), self.dims.n_state.div_ceil(LANES));
        Work {
            policy: self.policy.tape(TILE),
            value: self.value.tape(TILE),
            inverse: self.inverse.as_ref().map(|(m, _)| m.work()),
            discriminator: self.discriminator.work(),
            obs: vec![ZERO; TILE * ov],
            change: vec![ZERO; TILE * sv],
            d_change: vec![ZERO; TILE * sv],
            d_value: vec![ZERO; TILE],
            rows: std::array::from_fn(|_| vec![ZERO; TILE / LANES]),
        }
    }
    fn group(&self, phase: usize) -> usize {
        usize::from(phase == DISCRIMINATOR)
    }
    fn range(&self, phase: usize) -> Range<usize> {
        match (phase, &self.inverse) {
            (ACTOR, _) => 0..self.len,
            (INVERSE, Some((model, _))) => model.range(),
            _ => 0..self.discriminator.len,
        }
    }
    fn tile(&self, phase: usize, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) {
        match (phase, &self.inverse, &mut w.inverse) {
            (ACTOR, ..) => actor(self, params, t, w, grad),
            (INVERSE, Some((model, _)), Some(work)) => {
                model.tile(&params.groups[0], &t, &self.dims, work, grad)
            }
            _ => discriminator(self, params, t, w, grad),
        }
    }
    fn refresh(&self, phase: usize, params: &mut Params) {
        if phase == DISCRIMINATOR {
            let Group { p, transposed } = &mut params.groups[1];
            self.discriminator.refresh(p, transposed);
            return;
        }
        let Group { p, transposed } = &mut params.groups[0];
        if let Some((model, _)) = &self.inverse {
            model.net.transpose(p, transposed);
        }
        if phase == ACTOR {
            self.policy.transpose(p, transposed);
            self.value.transpose(p, transposed);
        }
    }
    fn max_norm(&self, phase: usize) -> f32 {
        if phase == ACTOR { self.ppo.max_grad_norm } else { f32::INFINITY }
    }
    /// `beta <- max(0, beta + alpha (KL - I_c))`.
    fn after(&self, phase: usize, mean: &[f32; SUMS], params: &mut Params) {
        if phase == DISCRIMINATOR {
            params.beta = (params.beta + self.settings.alpha * (mean[1] - self.settings.i_c)).max(0.0);
        }
    }
}

#[cfg(test)]
mod tests;
