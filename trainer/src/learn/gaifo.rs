//! GAIfO (Torabi et al. 2018): PPO whose reward is how much an own transition of states looks demonstrated. The task's reward is not read.
//!
//! ```text
//! for each batch:  D on demonstrated (s, s') against own ones     min -log D(demonstrated) - log(1 - D(own))
//!                  r <- -log(1 - D(s, s'))
//!                  PPO with r for the reward
//! ```
//!
//! The discriminator is that of `pid2-gan`; it passes over each batch once. Rewards are multiplied by `1 - gamma`, so that a return is a
//! mean of them and the value's loss weighs what it does elsewhere.

use super::discriminator::{Discriminator, DiscriminatorScratch, logit_slope, softplus_sum};
use super::epochs::Pace;
use super::gaussian::gather;
use super::imitation::{Base, Imitator};
use super::nets::NetSettings;
use super::optimise::{Group, Phases, Rows, Schedule, TILE, Tile, add_sums, optimise};
use super::{Adam, Batch, Dims, Learner, Metrics, Params, Ppo};
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::{Networks, multiversion};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::ops::Range;

/// The learner.
pub struct Gaifo {
    ppo: Ppo,
    judge: Judge,
}

/// Tells demonstrated transitions from own ones. Its parameters are the last group of PPO's, its optimiser the last.
struct Judge {
    discriminator: Discriminator,
    n_obs: usize,
    n_state: usize,
    group: usize,
    demos: Batch,
    /// The row of the demonstrations that goes with each row of the batch.
    with: Vec<u32>,
}

impl Gaifo {
    /// With a fresh PPO and a fresh discriminator, which learns at the rate `lr`.
    pub fn new(mut ppo: Ppo, dims: &Dims, nets: &NetSettings, lr: f32, rng: &mut ChaCha8Rng) -> Self {
        let discriminator = Discriminator::new(dims.n_state, dims.n_obs, nets, false);
        let mut group =
            Group { p: vec![ZERO; discriminator.len], transposed: vec![ZERO; discriminator.transposed] };
        discriminator.init(&mut group.p, rng);
        discriminator.refresh(&group.p, &mut group.transposed);
        ppo.params.groups.push(group);
        ppo.params.adam.push(Adam::new(discriminator.len, lr));
        let judge = Judge {
            discriminator,
            n_obs: dims.n_obs,
            n_state: dims.n_state,
            group: ppo.params.groups.len() - 1,
            demos: Batch::default(),
            with: Vec::new(),
        };
        Self { ppo, judge }
    }
}

impl Learner for Gaifo {
    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        let (judge, minibatch, threads) = (&mut self.judge, self.ppo.minibatch(), self.ppo.threads);
        judge.with = (0..batch.n).map(|_| rng.random_range(0..judge.demos.n as u32)).collect();
        let schedule = Schedule { epochs: 1, minibatch, threads, rate: 1.0, clip: 1.0 };
        let report = optimise(&*judge, &mut self.ppo.params, batch, &[judge.group], schedule, rng);
        let rewards = judge.rewards(&self.ppo.params, batch);
        let mut rewards = rewards.into_iter().map(|r| r * (1.0 - batch.discount.0));
        for s in &mut batch.stretches {
            s.reward.iter_mut().zip(&mut rewards).for_each(|(to, r)| *to = r);
        }
        batch.estimate(|x| self.ppo.values(x));
        let mut metrics = self.ppo.update_policy(batch, pace, rng);
        let [loss, right, ..] = report[0].mean;
        metrics.extend([("discriminator/loss", loss), ("discriminator/accuracy", right)]);
        metrics
    }

    fn networks(&self, normaliser: &Normaliser) -> Networks {
        self.ppo.networks(normaliser)
    }

    fn params(&self) -> &Params {
        self.ppo.params()
    }

    fn restore(&mut self, f: &mut dyn FnMut(&mut Params) -> Result<(), String>) -> Result<(), String> {
        self.ppo.restore(f)?;
        self.judge.refresh(self.judge.group, &mut self.ppo.params);
        Ok(())
    }

    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        self.ppo.values(x)
    }

    fn imitator(&mut self) -> Option<&mut dyn Imitator> {
        Some(self)
    }
}

impl Imitator for Gaifo {
    fn see(&mut self, demos: Batch, _: f64) {
        self.judge.demos = demos;
    }

    /// No inverse model has a part in it.
    fn warm_up(&mut self, _: &Batch, _: &mut ChaCha8Rng) -> Metrics {
        Metrics::new()
    }

    /// Nothing is cloned.
    fn pretrain(&mut self, _: &mut ChaCha8Rng) -> Metrics {
        Metrics::new()
    }

    /// The discriminator learns anew in each update.
    fn rescale(&mut self, from: &Normaliser, to: &Normaliser) {
        self.ppo.rescale(from, to);
    }
}

impl Judge {
    /// Puts `[s' - s, s]` of rows into `w`.
    fn show(&self, batch: &Batch, idx: &[u32], w: &mut DiscriminatorScratch) {
        let (o, s) = (self.n_obs, self.n_state);
        let vectors = (o + s).div_ceil(LANES);
        gather(&mut w.input, vectors, 0, &batch.reached, s, idx);
        gather(&mut w.input, vectors, s, &batch.obs, o, idx);
    }

    /// `-log(1 - D)` of each row.
    fn rewards(&self, params: &Params, batch: &Batch) -> Vec<f32> {
        let (mut w, mut rewards) = (self.scratch(), Vec::with_capacity(batch.n));
        for start in (0..batch.n).step_by(TILE) {
            let idx: [u32; TILE] = std::array::from_fn(|k| (start + k).min(batch.n - 1) as u32);
            self.show(batch, &idx, &mut w);
            self.discriminator.forward(&params.groups[self.group].p, &mut w);
            let rows = scalars(&w.logit).iter().take(batch.n - start);
            rewards.extend(rows.map(|&logit| logit.max(0.0) + (-logit.abs()).exp().ln_1p()));
        }
        rewards
    }
}

#[inline(always)]
fn body(j: &Judge, params: &Params, t: &Tile<'_>, w: &mut DiscriminatorScratch, grad: &mut [V]) {
    let group = &params.groups[j.group];
    let mut demos = [0u32; TILE];
    demos.iter_mut().zip(t.idx).for_each(|(to, &i)| *to = j.with[i as usize]);
    let (mut loss, mut right) = (0.0, 0.0);
    for (batch, idx, sign) in [(&j.demos, &demos[..], 1.0), (t.batch, t.idx, -1.0)] {
        j.show(batch, idx, w);
        j.discriminator.forward(&group.p, w);
        loss += softplus_sum(&w.logit, sign);
        right += scalars(&w.logit).iter().filter(|&&l| l * sign > 0.0).count() as f32 * 0.5;
        logit_slope(&mut w.logit, sign, t.scale);
        j.discriminator.backward(&group.transposed, w, 0.0, Some(&mut *grad), false);
    }
    add_sums(grad, &[loss, right]);
}
multiversion!(fn discriminate(j: &Judge, params: &Params, t: &Tile<'_>, w: &mut DiscriminatorScratch, grad: &mut [V]) = body);

impl Phases for Judge {
    type Scratch = DiscriminatorScratch;

    fn scratch(&self) -> DiscriminatorScratch {
        self.discriminator.scratch()
    }
    fn group(&self, phase: usize) -> usize {
        phase
    }
    fn range(&self, _: usize) -> Range<usize> {
        0..self.discriminator.len
    }
    fn tile(&self, _: usize, params: &Params, t: Tile<'_>, w: &mut DiscriminatorScratch, grad: &mut [V]) {
        discriminate(self, params, &t, w, grad);
    }
    fn refresh(&self, phase: usize, params: &mut Params) {
        let Group { p, transposed } = &mut params.groups[phase];
        self.discriminator.refresh(p, transposed);
    }
    fn is_paced(&self, _: usize) -> bool {
        false
    }
    fn max_norm(&self, _: usize) -> f32 {
        f32::INFINITY
    }
    fn lane(&self, _: usize) -> usize {
        0
    }
    fn rows<'b>(&'b self, _: usize, batch: &'b Batch) -> Vec<Rows<'b>> {
        vec![Rows::new(&batch.obs, self.n_obs), Rows::new(&batch.reached, self.n_state)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learn::PpoSettings;
    use crate::learn::reference::{Net64, batch, flat32, relative_error, row, spread, tile};
    use nearl_runtime::net::Activation;

    fn dims() -> Dims {
        Dims {
            n_obs: 7,
            n_privileged: 0,
            n_state: 5,
            n_act: 3,
            seen_obs: vec![1, 2, 6],
            seen_state: vec![0, 2, 4],
        }
    }

    /// A learner whose discriminator has weights far from zero, and what it sees.
    fn learner() -> (Gaifo, Batch) {
        let nets = NetSettings { discriminator: vec![6, 5], ..NetSettings::default() };
        let settings = PpoSettings { batch_size: TILE, ..PpoSettings::default() };
        let mut rng = crate::rollout::stream(1, 1);
        let ppo = Ppo::new(dims(), &nets, settings, 1, &mut rng);
        let mut l = Gaifo::new(ppo, &dims(), &nets, 3e-4, &mut rng);
        let (encoder, decoder) = l.judge.discriminator.nets();
        spread(&mut l.ppo.params.groups[l.judge.group].p, &[encoder, decoder]);
        l.judge.refresh(l.judge.group, &mut l.ppo.params);
        l.judge.demos = batch(&dims(), 3 * TILE, 8);
        l.judge.with = (0..TILE as u32).map(|i| (5 * i) % (3 * TILE as u32)).collect();
        (l, batch(&dims(), TILE, 3))
    }

    /// `D` on `[s' - s, s]` as the textbook writes it; without a bottleneck the latent is the mean.
    fn logit(encoder: &Net64, decoder: &Net64, b: &Batch, i: usize) -> f64 {
        let x = [row(&b.reached, i, 5), row(&b.obs, i, 7)].concat();
        decoder.forward(&encoder.forward(&x)[..super::super::discriminator::LATENT])[0]
    }

    #[test]
    fn the_discriminators_gradient_equals_central_differences() {
        let (l, b) = learner();
        let (j, p) = (&l.judge, &l.ppo.params.groups[l.judge.group].p);
        let idx: Vec<u32> = (0..b.n as u32).collect();
        let mut grad = vec![ZERO; p.len() + 1];
        j.tile(j.group, &l.ppo.params, tile(&b, &idx), &mut j.scratch(), &mut grad);
        let loss = |e: &Net64, d: &Net64| {
            let one = |i: usize| {
                let real = logit(e, d, &j.demos, j.with[i] as usize);
                (-real).exp().ln_1p() + logit(e, d, &b, i).exp().ln_1p()
            };
            (0..b.n).map(one).sum::<f64>() / b.n as f64
        };
        let (encoder, decoder) = j.discriminator.nets();
        let of = |net: &super::super::Net| Net64::of(&net.mlp.to_dense(p), Activation::Tanh);
        let flat = |net: &super::super::Net| flat32(&net.mlp.to_dense(&grad));
        let (e, d) = (of(encoder), of(decoder));
        let errors = [
            relative_error(&e, &flat(encoder), |n| loss(n, &d)),
            relative_error(&d, &flat(decoder), |n| loss(&e, n)),
        ];
        assert!(errors.iter().all(|e| *e < 2e-4), "encoder, decoder: {errors:?}");
        let sum = f64::from(grad[p.len()].0[0]) / b.n as f64;
        assert!((sum - loss(&e, &d)).abs() < 1e-4, "what is reported is the loss: {sum}");
    }

    /// The reward by the textbook; the task's own is NaN here, and nothing that is learned is.
    #[test]
    fn the_reward_is_the_discriminators_and_the_tasks_is_not_read() {
        let (mut l, mut b) = learner();
        b.discount = (0.9, 0.95);
        b.stretches = vec![super::super::Stretch {
            reward: vec![f32::NAN; b.n],
            terminated: vec![true; b.n],
            truncated: vec![false; b.n],
            final_obs: Vec::new(),
        }];
        b.advantage.fill(f32::NAN);
        let mut rng = crate::rollout::stream(1, 2);
        l.update(&mut b, Pace::default(), &mut rng);
        let (encoder, decoder) = l.judge.discriminator.nets();
        let p = &l.ppo.params.groups[l.judge.group].p;
        let of = |net: &super::super::Net| Net64::of(&net.mlp.to_dense(p), Activation::Tanh);
        let (e, d) = (of(encoder), of(decoder));
        for i in 0..b.n {
            // a step that ends its episode is worth its reward
            let want = 0.1 * logit(&e, &d, &b, i).exp().ln_1p();
            assert!((f64::from(b.returns[i]) - want).abs() < 1e-4 * (1.0 + want), "{i}: {}", b.returns[i]);
        }
        assert!(l.values(&b.obs).iter().all(|v| v.is_finite()));
    }
}
