//! A limit on the cost of an episode, for any learner: the Lagrangian of PPO (Ray, Achiam & Amodei 2019).
//!
//! ```text
//! for each batch:  e = clip((J_C - d) / d, -1, 1)             J_C: cost of an episode, d: its limit
//!                  integral <- max(0, integral + lr e)
//!                  lambda = max(0, integral + gain e)
//!                  A <- (A - lambda A_C) / (1 + lambda)       A_C: by a value of the cost, as A by that of the reward
//!                  the learner's own update;  then the value of the cost on its returns
//! ```
//!
//! Without the term of `gain` the multiplier swings (Stooke, Achiam & Abbeel 2020). `J_C` is the cost of a step of the batch times the mean
//! length of the last episodes: what the last hundred episodes cost comes too late.
//! Costs are divided by the running standard deviation of their discounted sum, as rewards are, so that the multiplier has no unit.
//! A limit of 0 is exceeded by all there is wherever there is a cost, as one that goes to 0 is.

use super::epochs::Pace;
use super::nets::NetSettings;
use super::optimise::{Group, Params, Phases, Rows, Schedule, Tile, optimise};
use super::ppo::PpoSettings;
use super::value::{Value, ValueScratch};
use super::{Adam, Batch, Dims, Learner, Metrics};
use nearl_runtime::Networks;
use nearl_runtime::net::kernel::V;
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// `[train.cost]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CostSettings {
    /// Mean cost of an episode that the learner keeps to; infinite: the cost is only counted.
    pub limit: f64,
    /// Largest step of the multiplier's integral in an update.
    pub lr: f32,
    /// What the multiplier has at most beside its integral.
    pub gain: f32,
    /// The integral at the start.
    pub multiplier: f32,
}

impl Default for CostSettings {
    fn default() -> Self {
        Self { limit: f64::INFINITY, lr: 0.01, gain: 1.0, multiplier: 0.0 }
    }
}

impl CostSettings {
    /// Whether the learner is to keep to a limit.
    pub fn is_limited(&self) -> bool {
        self.limit.is_finite()
    }

    /// Integral and multiplier after a batch in which an episode cost so much; NaN, before the first episode, leaves the integral.
    fn stepped(&self, integral: f32, cost: f64) -> [f32; 2] {
        let excess = match self.limit > 0.0 {
            true => (cost - self.limit) / self.limit,
            // What a limit that goes to 0 makes of it.
            false if cost > 0.0 => 1.0,
            false => cost,
        };
        if excess.is_nan() {
            return [integral; 2];
        }
        let excess = excess.clamp(-1.0, 1.0) as f32;
        let integral = (integral + self.lr * excess).max(0.0);
        [integral, (integral + self.gain * excess).max(0.0)]
    }
}

/// A learner that keeps to a limit on the cost. The value of the cost and the multiplier are groups of parameters behind the learner's own.
pub struct CostLimited {
    learner: Box<dyn Learner>,
    settings: CostSettings,
    ppo: PpoSettings,
    critic: Critic,
    threads: usize,
}

/// The value of the cost, and its place among the groups and the optimisers; the multiplier's integral is in the group behind it.
struct Critic {
    value: Value,
    group: usize,
    phase: usize,
    max_norm: f32,
}

impl CostLimited {
    /// Around `learner`, whose parameters get those of a fresh value of the cost behind them.
    pub fn new(
        mut learner: Box<dyn Learner>,
        settings: CostSettings,
        dims: &Dims,
        nets: &NetSettings,
        ppo: PpoSettings,
        threads: usize,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let (value, group) = Value::new(dims, nets, &ppo, rng);
        let (at, phase) = (learner.params().groups.len(), learner.params().adam.len());
        let adam = Adam::new(value.len, ppo.rate_of_value());
        let multiplier = Group { p: vec![V::splat(settings.multiplier)], transposed: Vec::new() };
        let (mut groups, mut adam) = (vec![group, multiplier], vec![adam]);
        change(&mut *learner, |params| {
            params.groups.append(&mut groups);
            params.adam.append(&mut adam);
        });
        let critic = Critic { value, group: at, phase, max_norm: ppo.max_grad_norm };
        Self { learner, settings, ppo, critic, threads }
    }

    fn integral(&self) -> f32 {
        self.learner.params().groups[self.critic.group + 1].p[0].0[0]
    }
}

/// Takes `f` to the learner's parameters, and refreshes what follows from them.
fn change(learner: &mut dyn Learner, mut f: impl FnMut(&mut Params)) {
    let done = learner.restore(&mut |params| {
        f(params);
        Ok(())
    });
    done.unwrap_or_else(|e| unreachable!("nothing was read: {e}"));
}

impl Learner for CostLimited {
    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        let [integral, multiplier] = self.settings.stepped(self.integral(), batch.episode_cost);
        let (group, threads) = (self.critic.group, self.threads);
        change(&mut *self.learner, |params| params.groups[group + 1].p[0] = V::splat(integral));
        let params = self.learner.params();
        batch.estimate_cost(multiplier, |x| self.critic.value.of(&params.groups[group], x, threads));
        let mut metrics = self.learner.update(batch, pace, rng);

        // the network that values the cost learns as that of the reward does, from the same rows
        std::mem::swap(&mut batch.returns, &mut batch.cost.returns);
        std::mem::swap(&mut batch.value, &mut batch.cost.value);
        let (epochs, minibatch) = (self.ppo.n_epochs, self.ppo.batch_size);
        let schedule = Schedule { epochs, minibatch, threads, rate: pace.rate, clip: pace.clip };
        let mut loss = f64::NAN;
        let Self { learner, critic, .. } = self;
        change(&mut **learner, |params| {
            loss = optimise(critic, params, batch, &[critic.phase], schedule, rng)[0].mean[0];
        });
        std::mem::swap(&mut batch.returns, &mut batch.cost.returns);
        std::mem::swap(&mut batch.value, &mut batch.cost.value);
        metrics.extend([("cost/multiplier", f64::from(multiplier)), ("cost/value_loss", loss)]);
        metrics
    }

    fn warm_up(&mut self, batch: &Batch, rng: &mut ChaCha8Rng) -> Metrics {
        self.learner.warm_up(batch, rng)
    }

    fn networks(&self, normaliser: &Normaliser) -> Networks {
        self.learner.networks(normaliser)
    }

    fn params(&self) -> &Params {
        self.learner.params()
    }

    fn restore(&mut self, f: &mut dyn FnMut(&mut Params) -> Result<(), String>) -> Result<(), String> {
        let Self { learner, critic, .. } = self;
        learner.restore(&mut |params| {
            f(params)?;
            critic.refresh(critic.phase, params);
            Ok(())
        })
    }

    fn spreads(&self) -> Vec<Range<usize>> {
        self.learner.spreads()
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        self.learner.values(x)
    }
}

impl Phases for Critic {
    type Scratch = ValueScratch;

    fn scratch(&self) -> ValueScratch {
        self.value.scratch()
    }
    fn group(&self, _: usize) -> usize {
        self.group
    }
    fn range(&self, _: usize) -> Range<usize> {
        0..self.value.len
    }
    fn tile(&self, _: usize, params: &Params, t: Tile<'_>, w: &mut ValueScratch, grad: &mut [V]) {
        self.value.tile(&params.groups[self.group], &t, w, grad);
    }
    fn refresh(&self, _: usize, params: &mut Params) {
        self.value.refresh(&mut params.groups[self.group]);
    }
    fn is_paced(&self, _: usize) -> bool {
        true
    }
    fn max_norm(&self, _: usize) -> f32 {
        self.max_norm
    }
    fn lane(&self, _: usize) -> usize {
        0
    }
    fn rows<'b>(&'b self, _: usize, batch: &'b Batch) -> Vec<Rows<'b>> {
        self.value.rows(batch)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learn::optimise::TILE;
    use crate::learn::reference::{batch, dims};
    use crate::learn::{Ppo, Stretch};
    use nearl_runtime::net::Forward;
    use nearl_runtime::net::kernel::scalars;

    fn limited(settings: CostSettings) -> (CostLimited, ChaCha8Rng) {
        let ppo = PpoSettings { batch_size: TILE, ..PpoSettings::default() };
        let (nets, mut rng) = (NetSettings::default(), crate::rollout::stream(1, 1));
        let learner = Box::new(Ppo::new(dims(), &nets, ppo.clone(), 1, &mut rng));
        (CostLimited::new(learner, settings, &dims(), &nets, ppo, 1, &mut rng), rng)
    }

    /// Steps that each end their episode: an advantage is the reward, or cost, less its value.
    fn ends(costs: impl Fn(usize) -> f32) -> Batch {
        let mut b = batch(&dims(), 4 * TILE, 3);
        b.discount = (0.9, 0.9);
        b.stretches = (0..b.n)
            .map(|i| Stretch {
                reward: vec![0.0],
                cost: vec![costs(i)],
                terminated: vec![true],
                truncated: vec![false],
                final_obs: Vec::new(),
            })
            .collect();
        b
    }

    #[test]
    fn the_multiplier_moves_with_the_relative_excess_as_by_hand() {
        let s = CostSettings { limit: 25.0, lr: 0.1, gain: 0.5, multiplier: 0.0 };
        for (integral, cost, want) in [
            (0.0, 900.0, [0.1, 0.6]),
            (1.0, 30.0, [1.02, 1.12]),
            (1.0, 20.0, [0.98, 0.88]),
            (0.01, 0.0, [0.0, 0.0]),
            (0.5, f64::NAN, [0.5, 0.5]),
        ] {
            let got = s.stepped(integral, cost);
            assert!(
                got.iter().zip(want).all(|(got, want)| (got - want).abs() < 1e-6),
                "{integral} {cost}: {got:?}"
            );
        }
        let none = CostSettings { limit: 0.0, ..s };
        assert_eq!(none.stepped(0.5, 0.0), [0.5, 0.5]);
        assert!((none.stepped(0.5, 3.0)[0] - 0.6).abs() < 1e-6);
        assert!((none.stepped(0.5, 0.3)[0] - 0.6).abs() < 1e-6, "as of a limit next to 0");
    }

    /// The value of the cost learns what each state costs, and what is unsafe becomes less likely than what is not.
    #[test]
    fn the_value_of_the_cost_learns_it_and_the_policy_turns_from_it() {
        let settings = CostSettings { limit: 1.0, lr: 0.0, gain: 0.0, multiplier: 1e3 };
        let (mut l, mut rng) = limited(settings);
        let cost = |b: &Batch, i: usize| f32::from(u8::from(b.sampled[i * dims().n_act] > 0.0));
        let shape = batch(&dims(), 4 * TILE, 3);
        let mut b = ends(|i| cost(&shape, i));
        b.estimate(|x| vec![0.0; x.len() / dims().n_obs]);
        b.episode_cost = 5.0;
        let normaliser = Normaliser::identity(dims().n_obs, dims().n_state);
        let first = |l: &CostLimited| -> f32 {
            let mut net = Forward::new(&l.networks(&normaliser).policy, NetSettings::default().activation);
            shape.obs.chunks_exact(dims().n_obs).map(|x| net.forward(x)[0]).sum()
        };
        let (before, values) = (first(&l), |l: &CostLimited, b: &Batch| {
            l.critic.value.of(&l.params().groups[l.critic.group], &b.obs, 1)
        });
        let error = |v: &[f32]| v.iter().enumerate().map(|(i, v)| (v - cost(&shape, i)).powi(2)).sum::<f32>();
        let untaught = error(&values(&l, &b));
        let metrics = l.update(&mut b, Pace::default(), &mut rng);
        assert!(error(&values(&l, &b)) < 0.9 * untaught, "the value of the cost learned");
        assert!(first(&l) < before, "what costs is asked for less");
        assert!(metrics.contains(&("cost/multiplier", 1e3)));
        assert!(metrics.iter().any(|(name, loss)| *name == "cost/value_loss" && loss.is_finite()));
    }

    /// Without a multiplier the learner learns what it would without a limit, to the bit.
    #[test]
    fn a_multiplier_of_zero_changes_nothing_for_the_learner() {
        let (mut l, mut rng) = limited(CostSettings { limit: 1.0, lr: 0.0, gain: 0.0, multiplier: 0.0 });
        let settings = PpoSettings { batch_size: TILE, ..PpoSettings::default() };
        let mut alone_rng = crate::rollout::stream(1, 1);
        let mut alone = Ppo::new(dims(), &NetSettings::default(), settings, 1, &mut alone_rng);
        let mut b = ends(|i| i as f32);
        b.estimate(|x| vec![0.0; x.len() / dims().n_obs]);
        let mut same = b.clone();
        rng.set_word_pos(0);
        alone_rng.set_word_pos(0);
        l.update(&mut b, Pace::default(), &mut rng);
        alone.update(&mut same, Pace::default(), &mut alone_rng);
        for (ours, theirs) in l.params().groups.iter().zip(&alone.params().groups) {
            assert!(scalars(&ours.p) == scalars(&theirs.p));
        }
        assert_eq!(l.params().groups.len(), alone.params().groups.len() + 2);
    }

    #[test]
    fn what_is_restored_is_used() {
        let (mut l, mut rng) = limited(CostSettings { limit: 1.0, ..CostSettings::default() });
        let mut b = ends(|_| 1.0);
        b.estimate(|x| vec![0.0; x.len() / dims().n_obs]);
        b.episode_cost = 9.0;
        l.update(&mut b, Pace::default(), &mut rng);
        let saved = l.params().clone();
        let (mut again, _) = limited(CostSettings { limit: 1.0, ..CostSettings::default() });
        again
            .restore(&mut |params| {
                *params = saved.clone();
                Ok(())
            })
            .expect("nothing is read");
        assert!((again.integral() - 0.01).abs() < 1e-6);
        let of = |l: &CostLimited| l.critic.value.of(&l.params().groups[l.critic.group], &b.obs, 1);
        assert_eq!(of(&again), of(&l));
    }
}
