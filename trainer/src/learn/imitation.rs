//! What the imitating algorithms share: when they see demonstrations, and behaviour cloning.
//!
//! ```text
//! fill the statistics with demonstrations and a first batch
//! warm up: the inverse model on the fresh networks' own noise
//! pre-train: behaviour cloning                                   (Algorithm 2, lines 1 to 5)
//! for each batch: demonstrations normalised by the statistics of the moment; where likeness is the reward, it is learned and given first
//! ```

use super::batch::Batch;
use super::gaussian::gather;
use super::likeness::Likeness;
use super::net::{Net, Tape};
use super::nets::NetSettings;
use super::optimise::{Group, Params, Phases, Rows, Schedule, TILE, Tile, add_sums, optimise};
use super::{Adam, Dims, Learner, Metrics, Pace};
use crate::demos::DemoSettings;
use nearl_runtime::Networks;
use nearl_runtime::multiversion;
use nearl_runtime::net::kernel::{LANES, V, ZERO};
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;
use std::ops::Range;

/// A learner that demonstrations are of use to.
pub trait Imitator {
    /// Demonstrations in the units of the next batch, and what a row of them weighs in the policy gradient beside one of the batch.
    fn see(&mut self, demos: Batch, weight: f64);
    /// Learns from the demonstrations alone, once.
    fn pretrain(&mut self, rng: &mut ChaCha8Rng) -> Metrics;
    /// Changes the first and last layers so that what goes out stays the same in the robot's units.
    fn rescale(&mut self, from: &Normaliser, to: &Normaliser);
}

/// A learner as the imitating algorithms take it for their networks.
pub trait Base: Learner {
    /// Learns the inverse model alone.
    fn learn_inverse(&mut self, batch: &Batch, rng: &mut ChaCha8Rng) -> Metrics;
    /// Behaviour cloning: the policy takes on what the demonstrations have where it puts out states, or actions.
    fn clone_demos(&mut self, demos: &Batch, settings: &DemoSettings, rng: &mut ChaCha8Rng) -> Metrics;
    /// See [`Imitator::rescale`].
    fn rescale(&mut self, from: &Normaliser, to: &Normaliser);
    /// Everything an update changes.
    fn params_mut(&mut self) -> &mut Params;
}

/// Demonstrations as an update finds them.
#[derive(Default)]
pub struct Seen {
    /// Rows in the units of the batch.
    pub demos: Batch,
    /// What a row of them weighs in the policy gradient beside one of the batch.
    pub weight: f64,
}

/// How an imitating algorithm uses a batch and the demonstrations: what it has of its own.
pub trait Method: Send + Sized {
    /// What holds its networks.
    type Base: Base;
    /// Learns from a batch; see [`Learner::update`].
    fn update(
        imitating: &mut Imitating<Self>,
        batch: &mut Batch,
        pace: Pace,
        rng: &mut ChaCha8Rng,
    ) -> Metrics;
    /// Learns from the demonstrations alone, once.
    fn pretrain(imitating: &mut Imitating<Self>, rng: &mut ChaCha8Rng) -> Metrics {
        let Imitating { base, settings, seen, .. } = imitating;
        base.clone_demos(&seen.demos, settings, rng)
    }
}

/// The learner of a [`Method`].
pub struct Imitating<M: Method> {
    pub(super) base: M::Base,
    pub(super) settings: DemoSettings,
    pub(super) seen: Seen,
    /// What gives the reward, where it is not the task's.
    pub(super) likeness: Option<Likeness>,
}

impl<M: Method> Imitating<M> {
    /// With the networks of `base`.
    pub fn new(base: M::Base, settings: DemoSettings) -> Self {
        Self { base, settings, seen: Seen::default(), likeness: None }
    }

    /// With a fresh discriminator for its reward, which learns at the rate `lr` from minibatches of so many rows.
    pub fn by_likeness(
        mut self,
        dims: &Dims,
        nets: &NetSettings,
        lr: f32,
        minibatch: usize,
        threads: usize,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        self.likeness = Some(Likeness::new(self.base.params_mut(), dims, nets, lr, minibatch, threads, rng));
        self
    }

    /// Rewards by likeness in place of those of the task, where it is asked for.
    fn rewarded(&mut self, batch: &mut Batch, rng: &mut ChaCha8Rng) -> Metrics {
        let Some(likeness) = &self.likeness else { return Metrics::new() };
        let metrics = likeness.reward(self.base.params_mut(), batch, &self.seen.demos, rng);
        batch.estimate(|x| self.base.values(x));
        metrics
    }
}

impl<M: Method> Learner for Imitating<M> {
    fn update(&mut self, batch: &mut Batch, pace: Pace, rng: &mut ChaCha8Rng) -> Metrics {
        let told = self.rewarded(batch, rng);
        let mut metrics = M::update(self, batch, pace, rng);
        metrics.extend(told);
        metrics
    }
    /// The inverse model alone: the policy clones demonstrations.
    fn warm_up(&mut self, batch: &Batch, rng: &mut ChaCha8Rng) -> Metrics {
        self.base.learn_inverse(batch, rng)
    }
    fn networks(&self, normaliser: &Normaliser) -> Networks {
        self.base.networks(normaliser)
    }
    fn params(&self) -> &Params {
        self.base.params()
    }
    fn restore(&mut self, f: &mut dyn FnMut(&mut Params) -> Result<(), String>) -> Result<(), String> {
        self.base.restore(f)?;
        if let Some(likeness) = &self.likeness {
            likeness.refresh(self.base.params_mut());
        }
        Ok(())
    }
    fn spreads(&self) -> Vec<Range<usize>> {
        self.base.spreads()
    }
    fn values(&mut self, x: &[f32]) -> Vec<f32> {
        self.base.values(x)
    }
    fn imitator(&mut self) -> Option<&mut dyn Imitator> {
        Some(self)
    }
}

impl<M: Method> Imitator for Imitating<M> {
    fn see(&mut self, demos: Batch, weight: f64) {
        self.seen = Seen { demos, weight };
    }
    fn pretrain(&mut self, rng: &mut ChaCha8Rng) -> Metrics {
        M::pretrain(self, rng)
    }
    fn rescale(&mut self, from: &Normaliser, to: &Normaliser) {
        self.base.rescale(from, to);
    }
}

/// Column of the squared error of behaviour cloning, an entry.
pub(super) const CLONED: &str = "demos/cloning_mse";

/// A network whose output is drawn to what demonstrations have.
pub(super) struct Cloning<'a> {
    /// The network.
    pub(super) net: &'a Net,
    /// Where it lies in its group.
    pub(super) range: Range<usize>,
    /// What it should put out.
    pub(super) wanted: Wanted,
}

/// What of a row a cloned network puts out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wanted {
    /// The change of state: the paper's `|s' - pi(s)|^2`.
    Change,
    /// The action.
    Action,
}

impl Cloning<'_> {
    /// Passes over the demonstrations with an optimiser of their own; returns the squared error of the last one, an entry.
    pub(super) fn run(
        &self,
        group: &mut Group,
        demos: &Batch,
        s: &DemoSettings,
        threads: usize,
        rng: &mut ChaCha8Rng,
    ) -> f64 {
        let adam = vec![Adam::new(self.range.len(), s.lr)];
        let mut params = Params { groups: vec![group.clone()], adam, beta: 0.0, adapted: 1.0, ranks: None };
        let schedule = Schedule { epochs: 1, minibatch: s.batch_size, threads, rate: 1.0, clip: 1.0 };
        let mut error = f64::NAN;
        for _ in 0..s.epochs {
            let report = optimise(self, &mut params, demos, &[0], schedule, rng);
            error = report[0].mean[0] / self.net.mlp.n_out() as f64;
        }
        if let Some(learned) = params.groups.pop() {
            *group = learned;
        }
        error
    }

    fn wanted<'b>(&self, batch: &'b Batch) -> &'b [f32] {
        match self.wanted {
            Wanted::Change => &batch.reached,
            Wanted::Action => &batch.action,
        }
    }
}

/// Buffers of one thread.
pub(super) struct Scratch {
    tape: Tape,
    obs: Vec<V>,
    wanted: Vec<V>,
}

/// `L_BC = sum |wanted - f(s)|^2 / 2`.
#[inline(always)]
fn body(c: &Cloning<'_>, group: &Group, t: &Tile<'_>, w: &mut Scratch, grad: &mut [V]) {
    let (n_in, n_out) = (c.net.mlp.n_in(), c.net.mlp.n_out());
    gather(&mut w.obs, n_in.div_ceil(LANES), 0, &t.batch.obs, n_in, t.idx);
    gather(&mut w.wanted, n_out.div_ceil(LANES), 0, c.wanted(t.batch), n_out, t.idx);
    let mut sum = ZERO;
    for (d, &y) in w.wanted.iter_mut().zip(c.net.forward(&group.p, &w.obs, &mut w.tape)) {
        let e = y - *d;
        sum = sum.fma(e, e);
        *d = e * V::splat(t.scale);
    }
    c.net.backward(&group.transposed, &w.obs, &w.wanted, &mut w.tape, Some(grad), false);
    add_sums(grad, &[sum.sum()]);
}
multiversion!(fn squared_error(c: &Cloning<'_>, group: &Group, t: &Tile<'_>, w: &mut Scratch, grad: &mut [V]) = body);

impl Phases for Cloning<'_> {
    type Scratch = Scratch;

    fn scratch(&self) -> Scratch {
        let [obs, wanted] = [self.net.mlp.n_in(), self.net.mlp.n_out()].map(|n| n.div_ceil(LANES));
        Scratch { tape: self.net.tape(TILE), obs: vec![ZERO; TILE * obs], wanted: vec![ZERO; TILE * wanted] }
    }
    fn group(&self, _: usize) -> usize {
        0
    }
    fn range(&self, _: usize) -> Range<usize> {
        self.range.clone()
    }
    fn tile(&self, _: usize, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) {
        squared_error(self, &params.groups[0], &t, w, grad);
    }
    fn refresh(&self, _: usize, params: &mut Params) {
        let Group { p, transposed } = &mut params.groups[0];
        self.net.transpose(p, transposed);
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
        let (n_in, n_out) = (self.net.mlp.n_in(), self.net.mlp.n_out());
        vec![Rows::new(&batch.obs, n_in), Rows::new(self.wanted(batch), n_out)]
    }
}
