//! How much an own transition of states looks demonstrated, as a reward (Torabi et al. 2018).
//!
//! ```text
//! for each batch:  D on demonstrated (s, s') against own ones     min -log D(demonstrated) - log(1 - D(own))
//!                  r <- -log(1 - D(s, s'))
//! ```
//!
//! The discriminator is that of `pid2-gan`; it passes over each batch once. Rewards are multiplied by `1 - gamma`, so that a return is a
//! mean of them and the value's loss weighs what it does elsewhere. Actions, and the task's own reward, are not read.

use super::discriminator::{Discriminator, DiscriminatorScratch, logit_slope, softplus_sum};
use super::gaussian::gather;
use super::nets::NetSettings;
use super::optimise::{Group, Phases, Rows, Schedule, TILE, Tile, add_sums, optimise};
use super::{Adam, Batch, Dims, Metrics, Params};
use nearl_runtime::multiversion;
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::ops::Range;

/// Tells demonstrated transitions from own ones. Its parameters are a group of the learner's, beside an optimiser of its own.
pub(super) struct Likeness {
    discriminator: Discriminator,
    n_obs: usize,
    n_state: usize,
    /// Its place among the groups, and among the optimisers: there its phase is found.
    group: usize,
    phase: usize,
    minibatch: usize,
    threads: usize,
}

/// It, and what it learns from in one pass over a batch.
struct Comparison<'a> {
    likeness: &'a Likeness,
    demos: &'a Batch,
    /// The row of the demonstrations that goes with each row of the batch.
    with: Vec<u32>,
}

impl Likeness {
    /// A fresh one beside what `params` has, which learns at the rate `lr` from minibatches of so many rows.
    pub(super) fn new(
        params: &mut Params,
        dims: &Dims,
        nets: &NetSettings,
        lr: f32,
        minibatch: usize,
        threads: usize,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let discriminator = Discriminator::new(dims.n_state, dims.n_obs, nets, false);
        let mut group =
            Group { p: vec![ZERO; discriminator.len], transposed: vec![ZERO; discriminator.transposed] };
        discriminator.init(&mut group.p, rng);
        discriminator.refresh(&group.p, &mut group.transposed);
        let (at, phase) = (params.groups.len(), params.adam.len());
        params.groups.push(group);
        params.adam.push(Adam::new(discriminator.len, lr));
        Self { discriminator, n_obs: dims.n_obs, n_state: dims.n_state, group: at, phase, minibatch, threads }
    }

    /// Learns from one pass over `batch`, then writes its rewards; advantages and returns are still to be estimated from them.
    pub(super) fn reward(
        &self,
        params: &mut Params,
        batch: &mut Batch,
        demos: &Batch,
        rng: &mut ChaCha8Rng,
    ) -> Metrics {
        let with = (0..batch.n).map(|_| rng.random_range(0..demos.n as u32)).collect();
        let comparison = Comparison { likeness: self, demos, with };
        let schedule =
            Schedule { epochs: 1, minibatch: self.minibatch, threads: self.threads, rate: 1.0, clip: 1.0 };
        let report = optimise(&comparison, params, batch, &[self.phase], schedule, rng);
        let rewards = self.rewards(params, batch);
        let mean = rewards.iter().sum::<f32>() / batch.n as f32;
        let mut rewards = rewards.into_iter().map(|r| r * (1.0 - batch.discount.0));
        for s in &mut batch.stretches {
            s.reward.iter_mut().zip(&mut rewards).for_each(|(to, r)| *to = r);
        }
        let [loss, right, ..] = report[0].mean;
        vec![("likeness/loss", loss), ("likeness/accuracy", right), ("likeness/reward", f64::from(mean))]
    }

    /// What follows from parameters that were restored.
    pub(super) fn refresh(&self, params: &mut Params) {
        let Group { p, transposed } = &mut params.groups[self.group];
        self.discriminator.refresh(p, transposed);
    }

    /// Puts `[s' - s, s]` of rows into `w`.
    fn show(&self, batch: &Batch, idx: &[u32], w: &mut DiscriminatorScratch) {
        let (o, s) = (self.n_obs, self.n_state);
        let vectors = (o + s).div_ceil(LANES);
        gather(&mut w.input, vectors, 0, &batch.reached, s, idx);
        gather(&mut w.input, vectors, s, &batch.obs, o, idx);
    }

    /// `-log(1 - D)` of each row.
    fn rewards(&self, params: &Params, batch: &Batch) -> Vec<f32> {
        let (mut w, mut rewards) = (self.discriminator.scratch(), Vec::with_capacity(batch.n));
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
fn body(c: &Comparison<'_>, params: &Params, t: &Tile<'_>, w: &mut DiscriminatorScratch, grad: &mut [V]) {
    let (j, group) = (c.likeness, &params.groups[c.likeness.group]);
    let mut demos = [0u32; TILE];
    demos.iter_mut().zip(t.idx).for_each(|(to, &i)| *to = c.with[i as usize]);
    let (mut loss, mut right) = (0.0, 0.0);
    for (batch, idx, sign) in [(c.demos, &demos[..], 1.0), (t.batch, t.idx, -1.0)] {
        j.show(batch, idx, w);
        j.discriminator.forward(&group.p, w);
        loss += softplus_sum(&w.logit, sign);
        right += scalars(&w.logit).iter().filter(|&&l| l * sign > 0.0).count() as f32 * 0.5;
        logit_slope(&mut w.logit, sign, t.scale);
        j.discriminator.backward(&group.transposed, w, 0.0, Some(&mut *grad), false);
    }
    add_sums(grad, &[loss, right]);
}
multiversion!(fn discriminate(c: &Comparison<'_>, params: &Params, t: &Tile<'_>, w: &mut DiscriminatorScratch, grad: &mut [V]) = body);

impl Phases for Comparison<'_> {
    type Scratch = DiscriminatorScratch;

    fn scratch(&self) -> DiscriminatorScratch {
        self.likeness.discriminator.scratch()
    }
    fn group(&self, _: usize) -> usize {
        self.likeness.group
    }
    fn range(&self, _: usize) -> Range<usize> {
        0..self.likeness.discriminator.len
    }
    fn tile(&self, _: usize, params: &Params, t: Tile<'_>, w: &mut DiscriminatorScratch, grad: &mut [V]) {
        discriminate(self, params, &t, w, grad);
    }
    fn refresh(&self, _: usize, params: &mut Params) {
        self.likeness.refresh(params);
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
        vec![Rows::new(&batch.obs, self.likeness.n_obs), Rows::new(&batch.reached, self.likeness.n_state)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demos::DemoSettings;
    use crate::learn::imitation::{Base, Imitating};
    use crate::learn::reference::{Net64, batch, dims, flat32, relative_error, row, spread, tile};
    use crate::learn::{Gaifo, Learner, Pace, Ppo, PpoSettings};
    use nearl_runtime::net::Activation;

    /// A learner whose discriminator has weights far from zero, demonstrations for it, and what it sees.
    fn learner() -> (Imitating<Gaifo>, Batch, Batch) {
        let nets = NetSettings { discriminator: vec![6, 5], ..NetSettings::default() };
        let settings = PpoSettings { batch_size: TILE, ..PpoSettings::default() };
        let mut rng = crate::rollout::stream(1, 1);
        let ppo = Ppo::new(dims(), &nets, settings, 1, &mut rng);
        let l = Imitating::<Gaifo>::new(ppo, DemoSettings::default());
        let mut l = l.by_likeness(&dims(), &nets, 3e-4, TILE, 1, &mut rng);
        let (j, params) = (l.likeness.as_ref().expect("a reward"), l.base.params_mut());
        let (encoder, decoder) = j.discriminator.nets();
        spread(&mut params.groups[j.group].p, &[encoder, decoder]);
        j.refresh(params);
        (l, batch(&dims(), 3 * TILE, 8), batch(&dims(), TILE, 3))
    }

    /// `D` on `[s' - s, s]` as the textbook writes it; without a bottleneck the latent is the mean.
    fn logit(encoder: &Net64, decoder: &Net64, b: &Batch, i: usize) -> f64 {
        let x = [row(&b.reached, i, 5), row(&b.obs, i, 7)].concat();
        decoder.forward(&encoder.forward(&x)[..super::super::discriminator::LATENT])[0]
    }

    #[test]
    fn the_discriminators_gradient_equals_central_differences() {
        let (l, demos, b) = learner();
        let j = l.likeness.as_ref().expect("a reward");
        let p = &l.params().groups[j.group].p;
        let with = (0..TILE as u32).map(|i| (5 * i) % (3 * TILE as u32)).collect();
        let c = Comparison { likeness: j, demos: &demos, with };
        let idx: Vec<u32> = (0..b.n as u32).collect();
        let mut grad = vec![ZERO; p.len() + 1];
        c.tile(j.phase, l.params(), tile(&b, &idx), &mut c.scratch(), &mut grad);
        let loss = |e: &Net64, d: &Net64| {
            let one = |i: usize| {
                let real = logit(e, d, &demos, c.with[i] as usize);
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
        let (mut l, demos, mut b) = learner();
        b.discount = (0.9, 0.95);
        b.stretches = vec![super::super::Stretch {
            reward: vec![f32::NAN; b.n],
            terminated: vec![true; b.n],
            truncated: vec![false; b.n],
            final_obs: Vec::new(),
            cost: Vec::new(),
        }];
        b.advantage.fill(f32::NAN);
        let mut rng = crate::rollout::stream(1, 2);
        l.seen.demos = demos;
        l.update(&mut b, Pace::default(), &mut rng);
        let j = l.likeness.as_ref().expect("a reward");
        let (encoder, decoder) = j.discriminator.nets();
        let p = &l.params().groups[j.group].p;
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
