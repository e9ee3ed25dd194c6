//! Runs the phases of an algorithm over minibatches, on several threads, with the same bits for any number of them.
//!
//! A minibatch is cut into a number of shards that depends on its size alone. Each thread computes some shards; after a
//! barrier every thread adds all shards in order and applies the same step to its own replica of the parameters. A minibatch
//! too small to be cut runs its phases in two lanes side by side instead (`lanes`). Nothing is allocated per minibatch.
//!
//! Where a training has several [`Ranks`], each computes some shards, and gradients of shards go from rank to rank (`share`).

mod lanes;
mod rows;
mod share;

pub use rows::Rows;

use super::adam::{Adam, square};
use super::batch::Batch;
use crate::ranks::Ranks;
use nearl_runtime::net::kernel::{LANES, V, ZERO};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering, fence};
use std::sync::{Condvar, Mutex, PoisonError, RwLock};

/// Rows computed at a time by one thread.
pub const TILE: usize = 32;
/// Rows of a shard, where the minibatch allows.
const SHARD: usize = 256;

/// One vector of parameters with the transposed weights its networks read backwards.
#[derive(Clone, Debug)]
pub struct Group {
    /// Parameters.
    pub p: Vec<V>,
    /// Transposed weights.
    pub transposed: Vec<V>,
}

/// What the phases of an algorithm read and change.
#[derive(Clone, Debug)]
pub struct Params {
    /// Parameter groups.
    pub groups: Vec<Group>,
    /// One optimiser a phase.
    pub adam: Vec<Adam>,
    /// Multiplier of the information bottleneck.
    pub beta: f32,
    /// Factor on the rates of policy and value that holds the divergence of an update (`train.ppo.desired_kl`).
    pub adapted: f32,
    /// The other ranks of the training, which compute some of the shards.
    pub ranks: Option<Arc<Ranks>>,
}

/// What a tile of rows needs: the batch, the rows, and numbers of the whole minibatch.
#[derive(Clone, Copy)]
pub struct Tile<'a> {
    /// Experience.
    pub batch: &'a Batch,
    /// Rows, [`TILE`] of them.
    pub idx: &'a [u32],
    /// `1 / minibatch`.
    pub scale: f32,
    /// Mean and inverse standard deviation of the minibatch's advantages.
    pub advantage: (f32, f32),
    /// Clip range of the probability ratio.
    pub clip: f32,
}

/// Sums over rows that a phase reports, beside its gradient: lanes of one vector.
pub const SUMS: usize = LANES;

/// An algorithm as its phases. Phases run in order on each minibatch.
pub trait Phases: Sync {
    /// Buffers of one thread.
    type Scratch;
    /// Buffers for tiles of [`TILE`] rows.
    fn scratch(&self) -> Self::Scratch;
    /// Parameter group that phase `k` changes.
    fn group(&self, phase: usize) -> usize;
    /// Part of the group that phase `k` changes.
    fn range(&self, phase: usize) -> Range<usize>;
    /// Adds the gradient of a tile to `grad` (of the whole group) and its sums to the last vector of `grad`.
    fn tile(
        &self,
        phase: usize,
        params: &Params,
        tile: Tile<'_>,
        scratch: &mut Self::Scratch,
        grad: &mut [V],
    );
    /// Refreshes transposed weights after phase `k` changed its parameters.
    fn refresh(&self, phase: usize, params: &mut Params);
    /// Whether the rate of phase `k` follows the schedule of the run; the others are constant.
    fn is_paced(&self, phase: usize) -> bool;
    /// Largest norm of the gradient of phase `k`.
    fn max_norm(&self, phase: usize) -> f32;
    /// The phase before or after `k` whose gradient is clipped as one vector with that of `k`.
    fn clipped_with(&self, _phase: usize) -> Option<usize> {
        None
    }
    /// Lane of phase `k`, 0 or 1: phases of two lanes change no group in common, and lane 1 reads nothing that lane 0 changes.
    fn lane(&self, phase: usize) -> usize;
    /// The one group of lane 1 that lane 0 reads, as it was before the minibatch.
    fn read_across(&self) -> Option<usize> {
        None
    }
    /// The rows that a tile of phase `k` reads, so that the next ones can be on their way.
    fn rows<'b>(&'b self, phase: usize, batch: &'b Batch) -> Vec<Rows<'b>>;
    /// Changes what is not a parameter (the bottleneck's multiplier) from the sums of phase `k`, averaged over rows.
    fn after(&self, _phase: usize, _mean: &[f32; SUMS], _params: &mut Params) {}
}

/// How often and in what portions a batch is used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Passes over the batch.
    pub epochs: usize,
    /// Rows of a minibatch: a multiple of [`TILE`] that divides the batch.
    pub minibatch: usize,
    /// Threads.
    pub threads: usize,
    /// Factor on the learning rates of the phases that follow the schedule of the run.
    pub rate: f32,
    /// Clip range of the probability ratio.
    pub clip: f32,
}

/// What a phase reported, averaged over all minibatches.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhaseReport {
    /// Sums of the phase per row.
    pub mean: [f64; SUMS],
    /// Gradient norm before clipping.
    pub norm: f64,
}

impl PhaseReport {
    /// Adds another report.
    pub(super) fn add(&mut self, other: &Self) {
        self.mean.iter_mut().zip(other.mean).for_each(|(sum, m)| *sum += m);
        self.norm += other.norm;
    }

    /// From a sum over `steps` to a mean.
    pub(super) fn average(&mut self, steps: f64) {
        self.mean.iter_mut().for_each(|m| *m /= steps);
        self.norm /= steps;
    }
}

/// Counts the threads that arrived; each round needs all of them.
struct Barrier {
    threads: usize,
    arrived: AtomicUsize,
    alarm: Alarm,
}

impl Barrier {
    /// For one of the threads: each call waits until all threads have called equally often.
    fn rounds(&self) -> impl FnMut() + '_ {
        let mut round = 0;
        move || {
            round += 1;
            if self.threads > 1 {
                self.wait(round);
            }
        }
    }

    fn wait(&self, round: usize) {
        self.arrived.fetch_add(1, Ordering::AcqRel);
        self.alarm.ring();
        self.alarm.wait_until(|| self.arrived.load(Ordering::Acquire) >= self.threads * round);
    }
}

/// Looks before a thread that waits goes to sleep.
const LOOKS: u32 = 4000;

/// How the threads wait for each other: awake for a while, then asleep, so that a core others use too goes to the one waited for.
/// When one of them panics, none waits forever.
#[derive(Default)]
struct Alarm {
    panicked: AtomicBool,
    sleeping: AtomicUsize,
    bed: Mutex<()>,
    bell: Condvar,
}

/// Tells the others if its thread panics.
struct Watch<'a>(&'a Alarm);

impl Drop for Watch<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.panicked.store(true, Ordering::Release);
            self.0.ring();
        }
    }
}

impl Alarm {
    fn watch(&self) -> Watch<'_> {
        Watch(self)
    }

    /// Wakes who sleeps; comes after every change that another thread may wait for.
    fn ring(&self) {
        // Either this thread sees the sleeper, or the sleeper sees the change.
        fence(Ordering::SeqCst);
        if self.sleeping.load(Ordering::Relaxed) > 0 {
            drop(self.bed.lock().unwrap_or_else(PoisonError::into_inner));
            self.bell.notify_all();
        }
    }

    fn wait_until(&self, ready: impl Fn() -> bool) {
        let is_over = || ready() || self.panicked.load(Ordering::Acquire);
        if !(0..LOOKS).any(|_| {
            std::hint::spin_loop();
            is_over()
        }) {
            let mut bed = self.bed.lock().unwrap_or_else(PoisonError::into_inner);
            self.sleeping.fetch_add(1, Ordering::Relaxed);
            fence(Ordering::SeqCst);
            while !is_over() {
                bed = self.bell.wait(bed).unwrap_or_else(PoisonError::into_inner);
            }
            self.sleeping.fetch_sub(1, Ordering::Relaxed);
        }
        assert!(ready(), "another thread of the learner panicked");
    }
}

/// Runs `phases` (indices) over every minibatch of every epoch and returns what each reported.
///
/// # Panics
/// When the minibatch is not a multiple of [`TILE`] that divides the batch; settings are checked before.
pub fn optimise<P: Phases>(
    algorithm: &P,
    params: &mut Params,
    batch: &Batch,
    phases: &[usize],
    schedule: Schedule,
    rng: &mut ChaCha8Rng,
) -> Vec<PhaseReport> {
    let mb = schedule.minibatch;
    assert!(
        mb.is_multiple_of(TILE) && mb > 0 && batch.n.is_multiple_of(mb),
        "minibatch {mb} of batch {}",
        batch.n
    );
    let orders: Vec<Vec<u32>> = (0..schedule.epochs).map(|_| shuffled(batch.n, rng)).collect();
    let shards = if mb.is_multiple_of(SHARD) { mb / SHARD } else { 1 };
    let longest = longest(params);
    let ranks = params.ranks.clone().filter(|_| shards > 1);
    let (rank, n_ranks) = ranks.as_ref().map_or((0, 1), |r| (r.rank(), r.size()));
    let threads = schedule.threads.clamp(1, shards.div_ceil(n_ranks));
    let run = Run {
        algorithm,
        batch,
        phases,
        schedule,
        orders: &orders,
        rows: rows::scattered(algorithm, phases, batch),
        shards,
        ranks,
        rank,
        n_ranks,
        threads,
        // two buffers a shard: one barrier an optimiser step
        gradients: (0..shards).map(|_| std::array::from_fn(|_| RwLock::new(vec![ZERO; longest]))).collect(),
        barrier: Barrier { threads, arrived: AtomicUsize::new(0), alarm: Alarm::default() },
    };
    if shards == 1
        && schedule.threads > 1
        && let Some(lanes) = run.lanes()
    {
        return run.side_by_side(params, lanes);
    }
    std::thread::scope(|scope| {
        for t in 1..threads {
            let mut replica = params.clone();
            let run = &run;
            scope.spawn(move || run.worker(t, &mut replica));
        }
        run.worker(0, params)
    })
}

/// Vectors of the gradient of the largest group, with what is reported.
fn longest(params: &Params) -> usize {
    params.groups.iter().map(|g| g.p.len()).max().unwrap_or(0) + 1
}

struct Run<'a, P: Phases> {
    algorithm: &'a P,
    batch: &'a Batch,
    phases: &'a [usize],
    schedule: Schedule,
    orders: &'a [Vec<u32>],
    /// What is fetched ahead of its use, for each phase.
    rows: Vec<Vec<Rows<'a>>>,
    shards: usize,
    /// The ranks that shards are shared out to, if there are several of both; this one, and their number.
    ranks: Option<Arc<Ranks>>,
    rank: usize,
    n_ranks: usize,
    threads: usize,
    gradients: Vec<[RwLock<Vec<V>>; 2]>,
    barrier: Barrier,
}

impl<P: Phases> Run<'_, P> {
    fn worker(&self, thread: usize, params: &mut Params) -> Vec<PhaseReport> {
        let _watch = self.barrier.alarm.watch();
        let mut scratch = self.algorithm.scratch();
        let (mut sums, mut reports, mut round) = (self.sums(params), self.reports(), 0);
        let mut meet = self.barrier.rounds();
        for idx in self.minibatches() {
            let advantage = moments(self.batch, idx);
            for k in 0..self.phases.len() {
                let len = params.groups[self.group(k)].p.len() + 1;
                let odd = round % 2;
                round += 1;
                let mut compute = |shards: &mut dyn Iterator<Item = usize>| {
                    shards.for_each(|s| self.shard(s, k, idx, advantage, params, &mut scratch, odd, len));
                };
                compute(&mut self.own(thread));
                meet();
                if self.ranks.is_some() {
                    if thread == 0 {
                        self.share(k, odd, params);
                    }
                    meet();
                    if self.is_alone() {
                        compute(&mut self.missing(thread));
                        meet();
                    }
                }
                self.gather(&mut sums[k][..len], odd);
                self.settle(k, &sums, params, &mut reports);
            }
        }
        reports.iter_mut().for_each(|r| r.average(self.minibatches().count() as f64));
        reports
    }

    /// Rows of every minibatch of every epoch.
    fn minibatches(&self) -> impl Iterator<Item = &[u32]> {
        self.orders.iter().flat_map(|o| o.chunks_exact(self.schedule.minibatch))
    }

    /// A gradient for each phase.
    fn sums(&self, params: &Params) -> Vec<Vec<V>> {
        vec![vec![ZERO; longest(params)]; self.phases.len()]
    }

    fn reports(&self) -> Vec<PhaseReport> {
        vec![PhaseReport::default(); self.phases.len()]
    }

    /// Parameter group of the phase at `k`.
    fn group(&self, k: usize) -> usize {
        self.algorithm.group(self.phases[k])
    }

    /// The position of the phase that the one at `k` is clipped with, if it runs.
    fn partner(&self, k: usize) -> Option<usize> {
        let with = self.algorithm.clipped_with(self.phases[k])?;
        self.phases.iter().position(|&phase| phase == with)
    }

    /// Steps the phase at `k`, and before it the one it is clipped with; the first of the two waits for the second.
    fn settle(&self, k: usize, sums: &[Vec<V>], params: &mut Params, reports: &mut [PhaseReport]) {
        let squared = |k: usize, params: &Params| self.squared(k, &sums[k], params);
        match self.partner(k) {
            Some(p) if p > k => {}
            Some(p) => {
                let length = (squared(p, params) + squared(k, params)).sqrt();
                self.step(p, length, &sums[p], params, &mut reports[p]);
                self.step(k, length, &sums[k], params, &mut reports[k]);
            }
            None => {
                let length = squared(k, params).sqrt();
                self.step(k, length, &sums[k], params, &mut reports[k]);
            }
        }
    }

    /// Squared length of the gradient of the phase at `k`.
    fn squared(&self, k: usize, sum: &[V], params: &Params) -> f32 {
        let (grad, _) = self.parts(k, sum, params);
        square(grad)
    }

    /// The gradient of the phase at `k`, and what it reports.
    fn parts<'s>(&self, k: usize, sum: &'s [V], params: &Params) -> (&'s [V], &'s V) {
        let phase = self.phases[k];
        let len = params.groups[self.group(k)].p.len();
        (&sum[self.algorithm.range(phase)], &sum[len])
    }

    fn shard(
        &self,
        s: usize,
        k: usize,
        idx: &[u32],
        advantage: (f32, f32),
        params: &Params,
        scratch: &mut P::Scratch,
        odd: usize,
        len: usize,
    ) {
        let rows = idx.len() / self.shards;
        let mut grad = self.gradients[s][odd].write().unwrap_or_else(PoisonError::into_inner);
        grad[..len].fill(ZERO);
        let (scale, all) = (1.0 / self.schedule.minibatch as f32, idx);
        for at in (s * rows..(s + 1) * rows).step_by(TILE) {
            // after the last tile of a shard comes the first of this thread's next one
            let next =
                if at + TILE < (s + 1) * rows { at + TILE } else { (s + self.n_ranks * self.threads) * rows };
            rows::prefetch(&self.rows[k], all.get(next..next + TILE).unwrap_or(&[]));
            let clip = self.schedule.clip;
            let tile = Tile { batch: self.batch, idx: &all[at..at + TILE], scale, advantage, clip };
            self.algorithm.tile(self.phases[k], params, tile, scratch, &mut grad[..len]);
        }
    }

    fn gather(&self, sum: &mut [V], odd: usize) {
        let read = |s: usize| self.gradients[s][odd].read().unwrap_or_else(PoisonError::into_inner);
        let n = sum.len();
        sum.copy_from_slice(&read(0)[..n]);
        for s in 1..self.shards {
            for (a, &x) in sum.iter_mut().zip(read(s).iter()) {
                *a = *a + x;
            }
        }
    }

    /// One step of the phase at `k`, clipped by `length`.
    fn step(&self, k: usize, length: f32, sum: &[V], params: &mut Params, report: &mut PhaseReport) {
        let phase = self.phases[k];
        let (grad, reported) = self.parts(k, sum, params);
        let mean = reported.0.map(|x| x / self.schedule.minibatch as f32);
        let limit = self.algorithm.max_norm(phase);
        let scale = if length > limit { limit / length } else { 1.0 };
        let rate = if self.algorithm.is_paced(phase) { self.schedule.rate * params.adapted } else { 1.0 };
        let group = &mut params.groups[self.group(k)];
        params.adam[phase].step(&mut group.p[self.algorithm.range(phase)], grad, scale, rate);
        self.algorithm.refresh(phase, params);
        self.algorithm.after(phase, &mean, params);
        report.norm += f64::from(length);
        report.mean.iter_mut().zip(mean).for_each(|(r, m)| *r += f64::from(m));
    }
}

/// Mean and inverse standard deviation of the advantages of a minibatch.
fn moments(batch: &Batch, idx: &[u32]) -> (f32, f32) {
    let n = idx.len() as f64;
    let at = |&i: &u32| f64::from(batch.advantage[i as usize]);
    // around the first one, which loses nothing that matters to two passes over rows in random order
    let first = at(&idx[0]);
    let (mut sum, mut squares) = ([0.0; 4], [0.0; 4]);
    for idx in idx.chunks_exact(4) {
        for (k, i) in idx.iter().enumerate() {
            let e = at(i) - first;
            sum[k] += e;
            squares[k] += e * e;
        }
    }
    let offset = sum.iter().sum::<f64>() / n;
    let mean = first + offset;
    let variance = (squares.iter().sum::<f64>() / n - offset * offset).max(0.0);
    (mean as f32, (1.0 / (variance.sqrt() + 1e-8)) as f32)
}

fn shuffled(n: usize, rng: &mut ChaCha8Rng) -> Vec<u32> {
    let mut order: Vec<u32> = (0..n as u32).collect();
    for i in (1..n).rev() {
        order.swap(i, rng.random_range(0..=i));
    }
    order
}

/// Adds `values` to the sums in the last vector of `grad`.
#[inline(always)]
pub fn add_sums(grad: &mut [V], values: &[f32]) {
    let last = grad.len() - 1;
    for (lane, v) in grad[last].0.iter_mut().zip(values) {
        *lane += v;
    }
}

#[cfg(test)]
mod tests {
    use super::{Alarm, Ordering};
    use std::panic::{AssertUnwindSafe, catch_unwind};
    use std::sync::atomic::AtomicBool;

    /// Long after it went to sleep.
    fn after_a_while(alarm: &Alarm, then: impl FnOnce()) {
        while alarm.sleeping.load(Ordering::Acquire) == 0 {
            std::thread::yield_now();
        }
        std::thread::sleep(std::time::Duration::from_millis(5));
        then();
    }

    #[test]
    fn who_sleeps_is_woken_by_what_it_waits_for_and_by_a_panic() {
        let (alarm, ready) = (Alarm::default(), AtomicBool::new(false));
        std::thread::scope(|scope| {
            scope.spawn(|| alarm.wait_until(|| ready.load(Ordering::Acquire)));
            after_a_while(&alarm, || {
                ready.store(true, Ordering::Release);
                alarm.ring();
            });
        });
        assert_eq!(alarm.sleeping.load(Ordering::Acquire), 0);
        std::thread::scope(|scope| {
            let waits = scope.spawn(|| catch_unwind(AssertUnwindSafe(|| alarm.wait_until(|| false))));
            after_a_while(&alarm, || {
                let panics = catch_unwind(AssertUnwindSafe(|| {
                    let _watch = alarm.watch();
                    panic!("on purpose");
                }));
                assert!(panics.is_err());
            });
            assert!(waits.join().expect("a thread").is_err(), "it waited for what never comes");
        });
    }
}
