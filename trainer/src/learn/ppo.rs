//! PPO (Schulman et al. 2017): the paper's RL-Pure. An ordinary Gaussian policy on actions; an inverse model learns on
//! the side, so that its loss can be plotted beside the others. `demonstrated` is what demonstrations add to it.

mod demonstrated;

use super::batch::Batch;
use super::epochs::{Pace, Update};
use super::gaussian::{Gaussian, gather, likelihood_ratio};
use super::inverse::InverseModel;
use super::losses::{mean_std, set_lanes, widths};
use super::net::{Net, Tape};
use super::nets::NetSettings;
use super::optimise::{Group, Params, Phases, Rows, TILE, Tile, add_sums};
use super::value::{Value, ValueScratch};
use super::{Adam, Dims, Learner, Metrics, init};
use demonstrated::{Term, demonstrated};
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
    /// Learning rate of the policy.
    pub lr: f32,
    /// Learning rate of the value; 0: as that of the policy.
    pub value_lr: f32,
    /// Passes over a batch.
    pub n_epochs: usize,
    /// Rows of a minibatch; a multiple of 32 that divides the batch.
    pub batch_size: usize,
    /// Clip range of the probability ratio.
    pub clip_range: f32,
    /// Factor on the clip range at the end of the run, reached linearly.
    pub clip_to: f32,
    /// The value's step is clipped to this distance from what it was, in scaled returns; 0: not at all.
    pub clip_value: f32,
    /// No further pass over a batch once the divergence from the policy that collected is 1.5 times this; 0: all passes.
    pub target_kl: f32,
    /// The rate is lowered after an update whose last pass diverged by more than twice this, and raised below half of it;
    /// 0: it is not.
    pub desired_kl: f32,
    /// Estimate advantages and returns anew before each pass over the batch.
    pub recompute_advantages: bool,
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
            lr: 3e-4,
            value_lr: 0.0,
            n_epochs: 10,
            batch_size: 64,
            clip_range: 0.2,
            clip_to: 1.0,
            clip_value: 0.0,
            target_kl: 0.0,
            desired_kl: 0.0,
            recompute_advantages: false,
            vf_coef: 0.5,
            ent_coef: 0.0,
            max_grad_norm: 0.5,
            log_std: 0.0,
        }
    }
}

impl PpoSettings {
    /// Learning rate of the value.
    pub(super) fn rate_of_value(&self) -> f32 {
        if self.value_lr > 0.0 { self.value_lr } else { self.lr }
    }
}

/// Policy, value and inverse model, each in a parameter group of its own.
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
    value: Value,
    inverse: InverseModel,
    len: usize,
    /// Demonstrations in the policy gradient, where there are some.
    term: Option<Term>,
}

impl Nets {
    /// `None` where no inverse model learns beside the policy.
    fn idm_error(&self, params: &Params, batch: &Batch, threads: usize) -> Option<f64> {
        let learns = !self.dims.seen_obs.is_empty();
        learns.then(|| self.inverse.error(&params.groups[INVERSE].p, batch, &self.dims, threads))
    }
}

/// Buffers of one thread.
pub struct Scratch {
    policy: Tape,
    value: ValueScratch,
    inverse: super::inverse::InverseScratch,
    obs: Vec<V>,
    action: Vec<V>,
    d_action: Vec<V>,
    rows: [Vec<V>; 3],
}

/// Phases, each with a parameter group of its own.
const ACTOR: usize = 0;
const VALUE: usize = 1;
const INVERSE: usize = 2;

impl Ppo {
    /// Fresh networks.
    pub fn new(
        dims: Dims,
        nets: &NetSettings,
        settings: PpoSettings,
        threads: usize,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let (mut at, mut transposed) = (0, 0);
        let (o, a, f) = (dims.n_obs, dims.n_act, nets.activation);
        let policy = Net::new(&widths(o, &nets.policy, a), f, 0, &mut at, &mut transposed);
        let log_std = at..at + a.div_ceil(LANES);
        at = log_std.end;
        let mut actor = Group { p: vec![ZERO; at], transposed: vec![ZERO; transposed] };
        policy.mlp.write_dense(&init::orthogonal(&policy.mlp.widths(), 0.01, rng), &mut actor.p);
        let (value, value_group) = Value::new(&dims, nets, &settings, rng);
        set_lanes(&mut actor.p[log_std.clone()], a, settings.log_std);
        let mut aside = rng.clone(); // so that the policy learns the same with any inverse model beside it
        aside.set_stream(rng.get_stream() ^ (1 << 63)); // far from those of environments
        let (inverse, inverse_group) = InverseModel::alone(&dims, nets, &mut aside);
        let groups = vec![actor, value_group, inverse_group];
        let rates = [settings.lr, settings.rate_of_value(), settings.lr];
        let adam = groups.iter().zip(rates).map(|(g, lr)| Adam::new(g.p.len(), lr)).collect();
        let nets = Nets { dims, settings, policy, log_std, value, inverse, len: at, term: None };
        let mut params = Params { groups, adam, beta: 0.0, adapted: 1.0, ranks: None };
        [ACTOR, VALUE, INVERSE].iter().for_each(|&phase| nets.refresh(phase, &mut params));
        Self { nets, params, threads }
    }
}

impl Learner for Ppo {
    fn networks(&self, normaliser: &Normaliser) -> Networks {
        let p = &self.params.groups[ACTOR].p;
        Networks {
            normaliser: normaliser.clone(),
            policy: self.nets.policy.mlp.to_dense(p),
            policy_log_std: scalars(&p[self.nets.log_std.clone()])[..self.nets.dims.n_act].to_vec(),
            idm: None,
            margins: Vec::new(),
        }
    }

    fn params(&self) -> &Params {
        &self.params
    }

    fn restore(&mut self, f: &mut dyn FnMut(&mut Params) -> Result<(), String>) -> Result<(), String> {
        f(&mut self.params)?;
        [ACTOR, VALUE, INVERSE].iter().for_each(|&phase| self.nets.refresh(phase, &mut self.params));
        Ok(())
    }

    fn spreads(&self) -> Vec<Range<usize>> {
        vec![self.nets.log_std.clone()]
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        self.nets.value.of(&self.params.groups[VALUE], x, self.threads)
    }

    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        let before = self.nets.idm_error(&self.params, batch, self.threads);
        let phases: &[usize] = if before.is_some() { &[ACTOR, VALUE, INVERSE] } else { &[ACTOR, VALUE] };
        let mut metrics = self.passes(batch, pace, rng, phases);
        let after = self.nets.idm_error(&self.params, batch, self.threads);
        metrics.extend(super::idm_metrics(before, after, true, &batch.action, self.nets.dims.n_act));
        metrics
    }
}

impl Ppo {
    /// An update of policy and value alone.
    pub(super) fn update_policy(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        self.passes(batch, pace, rng, &[ACTOR, VALUE])
    }

    /// Passes of `phases`, of which the policy's and the value's are the first.
    fn passes(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng, phases: &[usize]) -> Metrics {
        let (ppo, threads) = (self.nets.settings.clone(), self.threads);
        let update = Update { ppo: &ppo, pace, threads, phases, actor: ACTOR };
        let again = ppo.recompute_advantages;
        let passes =
            update.run(&mut self.nets, &mut self.params, batch, rng, again, |pass, n, params, batch, _| {
                if again && pass > 0 {
                    batch.estimate(|x| n.value.of(&params.groups[VALUE], x, threads));
                }
            });
        let report = passes.reports;
        let p = &self.params.groups[ACTOR].p;
        let log_std = &scalars(&p[self.nets.log_std.clone()])[..self.nets.dims.n_act];
        let mut metrics = vec![
            ("train/policy_gradient_loss", report[0].mean[0]),
            ("train/approx_kl", report[0].mean[1]),
            ("train/clip_fraction", report[0].mean[2]),
            ("train/value_loss", report[1].mean[0]),
            ("train/grad_norm", report[0].norm),
            ("train/std", mean_std(log_std)),
            ("train/epochs", passes.epochs as f64),
            ("train/learning_rate", f64::from(ppo.lr * pace.rate * passes.adapted)),
        ];
        if self.nets.term.is_some() {
            metrics.push(("demos/loss", report[0].mean[3]));
        }
        metrics
    }
}

#[inline(always)]
fn actor_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) {
    let (s, a) = (&n.settings, n.dims.n_act);
    let (ov, av) = (n.dims.n_obs.div_ceil(LANES), a.div_ceil(LANES));
    let group = &params.groups[ACTOR];
    gather(&mut w.obs, ov, 0, &t.batch.obs, n.dims.n_obs, t.idx);
    gather(&mut w.action, av, 0, &t.batch.sampled, a, t.idx);
    // log pi(a | s) and the clipped surrogate
    let mean = n.policy.forward(&group.p, &w.obs, &mut w.policy);
    let action = Gaussian { log_std: n.log_std.clone(), n: a, sampled: &w.action, mean, d: &mut w.d_action };
    let [loss, kl, clipped] = likelihood_ratio([action], s, &t, &mut w.rows, &group.p, grad);
    n.policy.backward(&group.transposed, &w.obs, &w.d_action, &mut w.policy, Some(grad), false);
    let demos = demonstrated(n, params, &t, w, grad);
    add_sums(grad, &[loss, kl, clipped, demos]);
}

multiversion!(fn actor(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) = actor_body);

impl Phases for Nets {
    type Scratch = Scratch;

    fn scratch(&self) -> Scratch {
        let (ov, av) = (self.dims.n_obs.div_ceil(LANES), self.dims.n_act.div_ceil(LANES));
        Scratch {
            policy: self.policy.tape(TILE),
            value: self.value.scratch(),
            inverse: self.inverse.scratch(),
            obs: vec![ZERO; TILE * ov],
            action: vec![ZERO; TILE * av],
            d_action: vec![ZERO; TILE * av],
            rows: std::array::from_fn(|_| vec![ZERO; TILE / LANES]),
        }
    }
    fn group(&self, phase: usize) -> usize {
        phase
    }
    fn range(&self, phase: usize) -> Range<usize> {
        match phase {
            ACTOR => 0..self.len,
            VALUE => 0..self.value.len,
            _ => self.inverse.range(),
        }
    }
    fn tile(&self, phase: usize, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) {
        match phase {
            ACTOR => actor(self, params, t, w, grad),
            VALUE => self.value.tile(&params.groups[VALUE], &t, &mut w.value, grad),
            _ => self.inverse.tile(&params.groups[INVERSE], &t, &self.dims, &mut w.inverse, grad),
        }
    }
    fn refresh(&self, phase: usize, params: &mut Params) {
        let group = &mut params.groups[phase];
        match phase {
            ACTOR => self.policy.transpose(&group.p, &mut group.transposed),
            VALUE => self.value.refresh(group),
            _ => self.inverse.net.transpose(&group.p, &mut group.transposed),
        }
    }
    fn is_paced(&self, phase: usize) -> bool {
        phase != INVERSE
    }
    fn max_norm(&self, _: usize) -> f32 {
        self.settings.max_grad_norm
    }
    fn clipped_with(&self, phase: usize) -> Option<usize> {
        [Some(VALUE), Some(ACTOR), None][phase]
    }
    fn lane(&self, phase: usize) -> usize {
        usize::from(phase == INVERSE)
    }
    fn rows<'b>(&'b self, phase: usize, batch: &'b Batch) -> Vec<Rows<'b>> {
        let d = &self.dims;
        match phase {
            ACTOR => vec![Rows::new(&batch.obs, d.n_obs), Rows::new(&batch.sampled, d.n_act)],
            VALUE => self.value.rows(batch),
            _ => self.inverse.rows(d, batch),
        }
    }
}

#[cfg(test)]
mod tests;
