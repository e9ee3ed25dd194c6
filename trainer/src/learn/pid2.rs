//! PID^2: policy, inverse dynamics, discriminator (Algorithm 2 of the paper, lines 8 to 13).
//!
//! ```text
//! warm up, if asked to: coordinates of a proposal, from what was reached by the fresh networks' own noise
//! collect with constraints                                        (line 8; `rollout`)
//! inverse model on reached transitions, Eq. 4, above a threshold  (lines 10 to 12)
//! discriminator, bottleneck, and policy against them, Eq. 2       (line 9)
//! policy gradient on the combined policy, Eq. 1, and the value    (line 13)
//! ```
//!
//! [`INVERSE`] comes first, over the whole batch, whose log probabilities are then those of the model that learned: PPO's ratio begins
//! at 1. The other losses run on each minibatch in the order of [`ACTOR`], [`VALUE`], [`GENERATOR`], [`DISCRIMINATOR`]. The gradient of
//! `log I(a | s_c, C(pi(s)))` reaches the policy through the inverse model's input and the projection: one inside the bounds, zero
//! where the projection clamped. An inverse model that learns by itself makes other actions of the same proposals: beside [`INVERSE`]
//! the policy learns to propose what leads to the actions of before ([`KEEP`]). The adversarial loss pulls at the proposal as a whole,
//! or only at what the action leaves free of it (`null_space`).

mod adversary;
mod demonstrated;
mod fakes;
mod null_space;

use super::combined::{Combined, CombinedScratch, Gradient, Kind};
use super::discriminator::{Discriminator, DiscriminatorScratch, LATENT};
use super::epochs::{Pace, Update};
use super::imitation::Base;
use super::inverse::ThresholdPer;
use super::nets::NetSettings;
use super::optimise::{Group, Params, Phases, Rows, SUMS, Schedule, Tile, add_sums, optimise};
use super::ppo::PpoSettings;
use super::value::ValueScratch;
use super::{Adam, Batch, Dims, Learner, Metrics};
use adversary::{discriminate, fool_discriminator};
use fakes::Fakes;
use nearl_runtime::net::kernel::{V, ZERO};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::{Networks, multiversion};
use null_space::NullSpace;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// `[train.pid2]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Pid2Settings {
    /// Steps of the fresh networks' own noise in which a regression finds what actions change and what the robot does by itself, before
    /// anything else. The policy then proposes in coordinates whose first entries are actions. Refused where it does not learn through a
    /// learned inverse model. With demonstrations: [`DemoSettings::warmup`](crate::demos::DemoSettings::warmup).
    pub warmup: u64,
    /// Learning rate of policy and inverse model in the policy gradient; 0: `ppo.lr`. Two networks in a row move further at the same rate.
    pub lr: f32,
    /// The inverse model learns from reached transitions while its mean squared error is at least this (\[sigma_I\]).
    pub idm_threshold: f64,
    /// The policy gradient moves the inverse model too. Otherwise only what was reached does, so that proposals stay nearer to it; the policy
    /// learns through the inverse model either way. No effect with analytic inverse dynamics.
    pub idm_policy_gradient: bool,
    /// Where the inverse model learns from reached transitions, the policy learns to put out the same mean actions through it. No effect
    /// where proposals are random or inverse dynamics analytic.
    pub keep_actions: bool,
    /// What of a row of actions is compared with the threshold.
    pub idm_threshold_per: ThresholdPer,
    /// Learning rate of the inverse model's supervised loss.
    pub idm_lr: f32,
    /// Learning rate of the discriminator.
    pub discriminator_lr: f32,
    /// Weight of the adversarial loss in the policy's gradient; 0 leaves the adversary out.
    pub generator_weight: f32,
    /// Learning rate of the adversarial loss of the policy with an optimiser of its own, which no clipped ratio hands the whole step;
    /// 0: it shares that of the policy gradient.
    pub generator_lr: f32,
    /// Weight of the squared slope of the discriminator by the reached change.
    pub gradient_penalty: f32,
    /// Proposals are shown to the discriminator with noise like that of what was reached, so that the right one cannot be told from it.
    pub match_noise: bool,
    /// Show the discriminator the proposals of the current policy, made anew before each pass over the batch.
    pub fresh_fakes: bool,
    /// The adversary moves a proposal only where the mean action stays as it is. No effect where the policy does not learn
    /// through the inverse model (`exploration = "proposal"`).
    pub null_space: bool,
    /// Information the bottleneck may pass, in \[nat\] (I_c).
    pub i_c: f32,
    /// Multiplier of the bottleneck at the start.
    pub beta: f32,
    /// Step of the multiplier: `beta <- max(0, beta + alpha (KL - I_c))`.
    pub alpha: f32,
    /// How the policy gradient passes the projection.
    pub gradient: Gradient,
    /// Weight of the squared distance between a proposal and its projection in the policy's loss (of the proposed change in its
    /// standard deviations): what was clamped has no other way back. No effect with `exploration = "proposal"`.
    pub bound_weight: f32,
}

impl Default for Pid2Settings {
    fn default() -> Self {
        Self {
            warmup: 0,
            lr: 0.0,
            idm_threshold: 0.5,
            idm_policy_gradient: true,
            keep_actions: true,
            idm_threshold_per: ThresholdPer::default(),
            idm_lr: 3e-4,
            discriminator_lr: 3e-4,
            generator_weight: 0.1,
            generator_lr: 0.0,
            gradient_penalty: 0.0,
            match_noise: false,
            fresh_fakes: true,
            null_space: false,
            i_c: 0.5,
            beta: 0.1,
            alpha: 1e-5,
            gradient: Gradient::default(),
            bound_weight: 0.0,
        }
    }
}

/// Phase of the policy gradient, and of the adversarial loss of the policy where it shares the optimiser.
pub const ACTOR: usize = 0;
/// Phase of the value.
pub const VALUE: usize = 1;
/// Phase of the discriminator.
pub const DISCRIMINATOR: usize = 2;
/// Phase of the supervised inverse model.
pub const INVERSE: usize = 3;
/// Phase of the adversarial loss of the policy with an optimiser of its own.
pub const GENERATOR: usize = 4;
/// Phase in which the policy puts out the actions of before through an inverse model that learned.
pub const KEEP: usize = 5;

/// The learner.
pub struct Pid2 {
    nets: Nets,
    params: Params,
    threads: usize,
}

struct Nets {
    settings: Pid2Settings,
    combined: Combined,
    discriminator: Discriminator,
    /// Latent noise (n x LATENT), read by three passes: see [`Nets::noise_shift`].
    noise: Vec<f32>,
    /// What the discriminator sees beside the reached changes.
    fakes: Fakes,
    /// Mean actions before the inverse model learned from the batch (n x n_act).
    kept: Vec<f32>,
    /// Own and demonstrated transitions in equal parts, where the adversary sees both: what it takes for real.
    union: Option<Batch>,
}

/// A pass through the bottleneck.
#[derive(Clone, Copy)]
enum Pass {
    Real,
    Proposed,
    Generator,
}

impl Nets {
    /// An action is what the inverse model makes of the mean proposal.
    fn acts_through_inverse(&self) -> bool {
        self.combined.inverse.is_some() && self.combined.policy_log_std.is_none()
    }

    /// The rows by which a pass reads the table of latent noise apart from the others: no sample meets the same noise
    /// twice, and a table of a third of the size stays in the caches.
    fn noise_shift(&self, pass: Pass) -> usize {
        pass as usize * (self.noise.len() / LATENT) / 3
    }

    /// Latent noise of sample `i` in a pass.
    fn noise(&self, pass: Pass, i: usize) -> &[f32] {
        let at = (i + self.noise_shift(pass)) * LATENT;
        let at = if at >= self.noise.len() { at - self.noise.len() } else { at };
        &self.noise[at..at + LATENT]
    }
}

/// Buffers of one thread.
struct Scratch {
    actor: CombinedScratch,
    value: ValueScratch,
    discriminator: DiscriminatorScratch,
    /// Where the adversary is held to it.
    null_space: Option<NullSpace>,
}

/// Parameter group of policy and inverse model.
const COMBINED: usize = 0;
/// Parameter group of the value.
const CRITIC: usize = 1;
/// Parameter group of the discriminator.
const ADVERSARY: usize = 2;

impl Pid2 {
    /// Fresh networks. `bottleneck` off is `pid2-gan`.
    pub fn new(
        dims: Dims,
        nets: &NetSettings,
        ppo: PpoSettings,
        settings: Pid2Settings,
        kind: Kind,
        bottleneck: bool,
        threads: usize,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let value_lr = ppo.rate_of_value();
        let lr = if settings.lr > 0.0 { settings.lr } else { ppo.lr };
        let ppo = PpoSettings { lr, value_lr, ..ppo };
        let discriminator = Discriminator::new(dims.n_state, dims.n_obs, nets, bottleneck);
        let (mut combined, [actor, critic]) =
            Combined::new(dims, nets, ppo, settings.gradient, kind, settings.warmup > 0, rng);
        combined.bound_weight = settings.bound_weight;
        combined.idm_policy_gradient = settings.idm_policy_gradient;
        let d = &discriminator;
        let mut adversary = Group { p: vec![ZERO; d.len], transposed: vec![ZERO; d.transposed] };
        d.init(&mut adversary.p, rng);
        d.refresh(&adversary.p, &mut adversary.transposed);
        let adam = vec![
            Adam::new(combined.len, lr),
            Adam::new(combined.value.len, value_lr),
            Adam::new(d.len, settings.discriminator_lr),
            Adam::new(combined.inverse_range().len(), settings.idm_lr),
            Adam::new(combined.proposal_range().len(), settings.generator_lr),
            Adam::new(combined.proposal_range().len(), settings.idm_lr),
        ];
        let params = Params {
            groups: vec![actor, critic, adversary],
            adam,
            beta: settings.beta,
            adapted: 1.0,
            ranks: None,
        };
        let nets = Nets {
            settings,
            combined,
            discriminator,
            noise: Vec::new(),
            fakes: Fakes::default(),
            kept: Vec::new(),
            union: None,
        };
        Self { nets, params, threads }
    }

    fn actor(&self) -> &[V] {
        &self.params.groups[COMBINED].p
    }

    /// The inverse model learns by itself ([`INVERSE`]), and the policy keeps its actions beside it ([`KEEP`]). Returns the divergence of the
    /// mean actions from those of before \[nat\]; 0 where no action is put out through the inverse model.
    fn learn_from_what_was_reached(
        &mut self,
        batch: &Batch,
        schedule: Schedule,
        rng: &mut ChaCha8Rng,
    ) -> f64 {
        let Self { nets, params, threads } = self;
        if !nets.acts_through_inverse() {
            optimise(nets, params, batch, &[INVERSE], schedule, rng);
            return 0.0;
        }
        nets.combined.mean_actions(&params.groups[COMBINED], batch, *threads, &mut nets.kept);
        let phases = if nets.settings.keep_actions { &[INVERSE, KEEP][..] } else { &[INVERSE] };
        optimise(nets, params, batch, phases, schedule, rng);
        let (group, mut now) = (&params.groups[COMBINED], Vec::new());
        nets.combined.mean_actions(group, batch, *threads, &mut now);
        nets.combined.divergence(&group.p, &nets.kept, &now)
    }
}

impl Learner for Pid2 {
    /// One round of Algorithm 2 on the collected batch.
    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        let (ppo, threads) = (self.nets.combined.ppo.clone(), self.threads);
        let (s, n_act) = (self.nets.settings.clone(), self.nets.combined.dims.n_act);
        let before = self.nets.combined.idm_error(self.actor(), batch, threads);
        let inverse_learns = before.is_some_and(|e| s.idm_threshold_per.exceeds(e, n_act, s.idm_threshold));
        let opposed = s.generator_weight > 0.0;
        let mut phases = vec![ACTOR, VALUE];
        if opposed && s.generator_lr > 0.0 {
            phases.push(GENERATOR);
        }
        if opposed {
            phases.push(DISCRIMINATOR);
        }
        let update = Update { ppo: &ppo, pace, threads, phases: &phases, actor: ACTOR };
        let mut divergence = 0.0;
        if inverse_learns {
            divergence = self.learn_from_what_was_reached(batch, update.schedule(), rng);
            batch.log_prob = self.nets.combined.log_probs(&self.params.groups[COMBINED], batch, threads);
        }
        if opposed {
            self.nets.noise.resize(batch.n * LATENT, 0.0);
            self.nets.noise.fill_with(|| StandardNormal.sample(&mut *rng));
            self.nets.fakes = Fakes::new(&s, &self.nets.combined, batch, rng);
            if self.nets.union.is_some() {
                self.nets.renew(&self.params.groups[COMBINED], batch, threads, rng);
            }
        }
        let (again, fresh) = (ppo.recompute_advantages, opposed && s.fresh_fakes);
        let passes = update.run(
            &mut self.nets,
            &mut self.params,
            batch,
            rng,
            again || fresh,
            |pass, n, params, batch, rng| {
                if again && pass > 0 {
                    batch.estimate(|x| n.combined.value.of(&params.groups[CRITIC], x, threads));
                }
                if fresh && pass > 0 {
                    n.renew(&params.groups[COMBINED], batch, threads, rng);
                }
            },
        );
        let report = passes.reports;
        let mut metrics = self.nets.combined.metrics(self.actor(), &report[0], &report[1]);
        metrics.push(("train/epochs", passes.epochs as f64));
        metrics.push(("train/learning_rate", f64::from(ppo.lr * pace.rate * passes.adapted)));
        if opposed {
            let means = &report[phases.len() - 1].mean;
            let generator = if s.generator_lr > 0.0 { report[2].mean[0] } else { report[0].mean[4] };
            metrics.extend([
                ("train/generator_loss", generator),
                ("discriminator/loss", means[0]),
                ("discriminator/kl", means[1]),
                ("discriminator/accuracy", means[2]),
                ("discriminator/beta", f64::from(self.params.beta)),
            ]);
        }
        let after = self.nets.combined.idm_error(self.actor(), batch, self.threads);
        metrics.extend(super::idm_metrics(before, after, inverse_learns, &batch.action, n_act));
        if self.nets.acts_through_inverse() {
            metrics.push(("idm/divergence", divergence));
        }
        metrics
    }

    /// What the robot does by itself and what actions change, by least squares. An inverse model that cannot begin so learns from the batch.
    fn warm_up(&mut self, batch: &Batch, rng: &mut ChaCha8Rng) -> Metrics {
        if !self.nets.combined.identify(&mut self.params.groups[COMBINED], batch) {
            return self.learn_inverse(batch, rng);
        }
        let error = self.nets.combined.idm_error(self.actor(), batch, self.threads);
        super::idm_metrics(error, error, false, &batch.action, self.nets.combined.dims.n_act)
    }

    fn networks(&self, normaliser: &Normaliser) -> Networks {
        self.nets.combined.networks(self.actor(), normaliser)
    }

    fn params(&self) -> &Params {
        &self.params
    }

    fn restore(&mut self, f: &mut dyn FnMut(&mut Params) -> Result<(), String>) -> Result<(), String> {
        f(&mut self.params)?;
        [ACTOR, VALUE, DISCRIMINATOR].iter().for_each(|&phase| self.nets.refresh(phase, &mut self.params));
        Ok(())
    }

    fn spreads(&self) -> Vec<Range<usize>> {
        self.nets.combined.spreads()
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        self.nets.combined.value.of(&self.params.groups[CRITIC], x, self.threads)
    }
}

/// Policy gradient on the combined policy (Eq. 1), and the adversarial loss of the policy (Eq. 2).
#[inline(always)]
fn actor_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) {
    let group = &params.groups[COMBINED];
    let [loss, kl, clipped, clamped] = n.combined.policy_gradient(group, &t, &mut w.actor, grad);
    let mut generator = 0.0;
    let shared = n.settings.generator_weight > 0.0 && n.settings.generator_lr == 0.0;
    if shared && n.union.is_none() {
        generator = fool_discriminator(n, params, &t, w, grad);
    }
    n.combined.learn(group, &mut w.actor, grad);
    if shared && n.union.is_some() {
        generator = generate(n, params, t, w, grad);
    }
    add_sums(grad, &[loss, kl, clipped, clamped, generator]);
}

/// The adversarial loss of the policy (Eq. 2) alone.
#[inline(always)]
fn generator_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) {
    let loss = generate(n, params, t, w, grad);
    add_sums(grad, &[loss]);
}

/// Its gradient, through the proposals for what the discriminator sees; returns its sum.
#[inline(always)]
fn generate(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) -> f32 {
    let t = n.shown(t);
    let group = &params.groups[COMBINED];
    n.combined.propose(group, &t, &mut w.actor);
    if w.null_space.is_some() {
        n.combined.invert(group, &t, &mut w.actor);
    }
    w.actor.d_change.fill(ZERO);
    let loss = fool_discriminator(n, params, &t, w, grad);
    n.combined.learn(group, &mut w.actor, grad);
    loss
}

/// The policy follows the inverse model.
#[inline(always)]
fn keep_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) {
    let loss = n.combined.keep_actions(&n.kept, &params.groups[COMBINED], &t, &mut w.actor, grad);
    add_sums(grad, &[loss]);
}

multiversion!(fn keep(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) = keep_body);
multiversion!(fn generator(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) = generator_body);
multiversion!(fn actor(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) = actor_body);

impl Phases for Nets {
    type Scratch = Scratch;

    fn scratch(&self) -> Scratch {
        Scratch {
            actor: self.combined.scratch(),
            value: self.combined.value.scratch(),
            discriminator: self.discriminator.scratch(),
            null_space: (self.settings.null_space && self.combined.policy_log_std.is_none())
                .then(|| NullSpace::new(&self.combined.dims)),
        }
    }
    fn group(&self, phase: usize) -> usize {
        match phase {
            VALUE => CRITIC,
            DISCRIMINATOR => ADVERSARY,
            _ => COMBINED,
        }
    }
    fn range(&self, phase: usize) -> Range<usize> {
        match phase {
            ACTOR => 0..self.combined.len,
            VALUE => 0..self.combined.value.len,
            INVERSE => self.combined.inverse_range(),
            GENERATOR | KEEP => self.combined.proposal_range(),
            _ => 0..self.discriminator.len,
        }
    }
    fn tile(&self, phase: usize, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) {
        match phase {
            ACTOR => actor(self, params, t, w, grad),
            GENERATOR => generator(self, params, t, w, grad),
            KEEP => keep(self, params, t, w, grad),
            VALUE => self.combined.value.tile(&params.groups[CRITIC], &t, &mut w.value, grad),
            INVERSE => self.combined.idm_tile(&params.groups[COMBINED], &t, &mut w.actor, grad),
            _ => discriminate(self, params, self.shown(t), w, grad),
        }
    }
    fn refresh(&self, phase: usize, params: &mut Params) {
        match phase {
            ACTOR | GENERATOR | KEEP => self.combined.refresh(&mut params.groups[COMBINED]),
            VALUE => self.combined.value.refresh(&mut params.groups[CRITIC]),
            INVERSE => self.combined.refresh_inverse(&mut params.groups[COMBINED]),
            _ => {
                let Group { p, transposed } = &mut params.groups[ADVERSARY];
                self.discriminator.refresh(p, transposed);
            }
        }
    }
    fn is_paced(&self, phase: usize) -> bool {
        !matches!(phase, INVERSE | DISCRIMINATOR | KEEP)
    }
    fn max_norm(&self, phase: usize) -> f32 {
        if matches!(phase, ACTOR | VALUE) { self.combined.ppo.max_grad_norm } else { f32::INFINITY }
    }
    fn clipped_with(&self, phase: usize) -> Option<usize> {
        match phase {
            ACTOR => Some(VALUE),
            VALUE => Some(ACTOR),
            _ => None,
        }
    }
    fn lane(&self, phase: usize) -> usize {
        usize::from(matches!(phase, VALUE | DISCRIMINATOR))
    }
    /// The policy's phase asks the discriminator what it thinks of the proposals, unless its loss has no weight.
    fn read_across(&self) -> Option<usize> {
        (self.settings.generator_weight > 0.0).then_some(ADVERSARY)
    }
    fn rows<'b>(&'b self, phase: usize, batch: &'b Batch) -> Vec<Rows<'b>> {
        let d = &self.combined.dims;
        let noise = |pass| Rows::shifted(&self.noise, LATENT, self.noise_shift(pass));
        let shown = self.union.as_ref().unwrap_or(batch);
        match phase {
            ACTOR => {
                let mut rows = self.combined.rows(batch);
                if self.settings.generator_weight > 0.0 {
                    rows.push(noise(Pass::Generator));
                }
                rows
            }
            VALUE => self.combined.value.rows(batch),
            INVERSE => self.combined.idm_rows(batch),
            KEEP => vec![
                Rows::new(&batch.obs, d.n_obs),
                Rows::new(&batch.lower, d.n_state),
                Rows::new(&batch.upper, d.n_state),
                Rows::new(&self.kept, d.n_act),
            ],
            GENERATOR => vec![Rows::new(&shown.obs, d.n_obs), noise(Pass::Generator)],
            _ => vec![
                Rows::new(&shown.obs, d.n_obs),
                Rows::new(&shown.reached, d.n_state),
                Rows::new(self.fakes.shown(shown), d.n_state),
                noise(Pass::Real),
                noise(Pass::Proposed),
            ],
        }
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
