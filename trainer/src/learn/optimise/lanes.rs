//! Phases in two lanes side by side, for minibatches too small to be cut.
//!
//! Lane 1 reads nothing that lane 0 changes. Where lane 0 reads a group of lane 1, it takes it as it was before the same
//! minibatch; where gradients of both are clipped together, each tells the other the square of its length. Both do exactly
//! what one thread does in turn, to the bit.

use super::{Alarm, Group, Params, PhaseReport, Phases, Run, moments};
use nearl_runtime::net::kernel::V;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Minibatches that lane 1 may be ahead.
const AHEAD: usize = 4;

/// A group of lane 1 as it was before each of its last minibatches.
struct Trail {
    slots: [Mutex<Group>; AHEAD],
    written: AtomicUsize,
    read: AtomicUsize,
}

impl Trail {
    fn new(group: &Group) -> Self {
        let slots = std::array::from_fn(|_| Mutex::new(group.clone()));
        Self { slots, written: AtomicUsize::new(0), read: AtomicUsize::new(0) }
    }

    fn write(&self, step: usize, group: &Group, alarm: &Alarm) {
        alarm.wait_until(|| self.read.load(Ordering::Acquire) + AHEAD > step);
        let mut slot = self.slots[step % AHEAD].lock().unwrap_or_else(PoisonError::into_inner);
        copy(&mut slot, group);
        self.written.store(step + 1, Ordering::Release);
        alarm.ring();
    }

    fn read(&self, step: usize, group: &mut Group, alarm: &Alarm) {
        alarm.wait_until(|| self.written.load(Ordering::Acquire) > step);
        // the slot is written anew before it is read again
        std::mem::swap(group, &mut self.slots[step % AHEAD].lock().unwrap_or_else(PoisonError::into_inner));
        self.read.store(step + 1, Ordering::Release);
        alarm.ring();
    }
}

fn copy(to: &mut Group, from: &Group) {
    to.p.copy_from_slice(&from.p);
    to.transposed.copy_from_slice(&from.transposed);
}

/// Squared lengths of gradients, from one lane to the other. There are two slots a lane: it can only write a minibatch's after
/// it read the other's of the minibatch before.
#[derive(Default)]
struct Lengths {
    slots: [[AtomicU64; 2]; 2],
}

impl Lengths {
    fn tell(&self, lane: usize, step: usize, square: f32, alarm: &Alarm) {
        let stamped = (step as u64 + 1) << 32 | u64::from(square.to_bits());
        self.slots[lane][step % 2].store(stamped, Ordering::Release);
        alarm.ring();
    }

    /// What the other lane tells of this minibatch.
    fn ask(&self, lane: usize, step: usize, alarm: &Alarm) -> f32 {
        let slot = &self.slots[1 - lane][step % 2];
        alarm.wait_until(|| slot.load(Ordering::Acquire) >> 32 == step as u64 + 1);
        f32::from_bits(slot.load(Ordering::Acquire) as u32)
    }
}

impl<P: Phases> Run<'_, P> {
    /// Positions of the phases of both lanes, if both have some.
    pub(super) fn lanes(&self) -> Option<[Vec<usize>; 2]> {
        let of =
            |lane| (0..self.phases.len()).filter(|&k| self.algorithm.lane(self.phases[k]) == lane).collect();
        let lanes: [Vec<usize>; 2] = [of(0), of(1)];
        lanes.iter().all(|l| !l.is_empty()).then_some(lanes)
    }

    /// The lanes on two threads; what each phase reported, in their order.
    pub(super) fn side_by_side(&self, params: &mut Params, lanes: [Vec<usize>; 2]) -> Vec<PhaseReport> {
        let trail = self.algorithm.read_across().map(|group| (group, Trail::new(&params.groups[group])));
        let (lengths, alarm) = (Lengths::default(), &self.barrier.alarm);
        let mut theirs = params.clone();
        let (mut reports, others) = std::thread::scope(|scope| {
            let other = scope.spawn(|| {
                self.lane(1, &lanes[1], &lengths, &mut theirs, |step, params| {
                    if let Some((group, trail)) = &trail {
                        trail.write(step, &params.groups[*group], alarm);
                    }
                })
            });
            let reports = self.lane(0, &lanes[0], &lengths, params, |step, params| {
                if let Some((group, trail)) = &trail {
                    trail.read(step, &mut params.groups[*group], alarm);
                }
            });
            (reports, other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        });
        for &k in &lanes[1] {
            let phase = self.phases[k];
            let group = self.algorithm.group(phase);
            reports[k] = others[k];
            params.groups[group].clone_from(&theirs.groups[group]);
            params.adam[phase].clone_from(&theirs.adam[phase]);
        }
        params.beta = theirs.beta;
        reports
    }

    /// The phases at positions `mine` over every minibatch; `before` comes first in each.
    fn lane(
        &self,
        index: usize,
        mine: &[usize],
        lengths: &Lengths,
        params: &mut Params,
        before: impl Fn(usize, &mut Params),
    ) -> Vec<PhaseReport> {
        let _watch = self.barrier.alarm.watch();
        let mut scratch = self.algorithm.scratch();
        let mut lane = Lane { index, lengths, sums: self.sums(params), reports: self.reports(), held: None };
        for (step, idx) in self.minibatches().enumerate() {
            before(step, params);
            let advantage = moments(self.batch, idx);
            for &k in mine {
                if lane.held.is_some_and(|(held, _)| self.group(held) == self.group(k)) {
                    lane.release(self, step, params);
                }
                let len = params.groups[self.group(k)].p.len() + 1;
                self.shard(0, k, idx, advantage, params, &mut scratch, index, len);
                self.gather(&mut lane.sums[k][..len], index);
                if self.partner(k).is_some_and(|p| !mine.contains(&p)) {
                    let square = self.squared(k, &lane.sums[k], params);
                    lengths.tell(index, step, square, &self.barrier.alarm);
                    lane.held = Some((k, square));
                } else {
                    self.settle(k, &lane.sums, params, &mut lane.reports);
                }
            }
            lane.release(self, step, params);
        }
        lane.reports.iter_mut().for_each(|r| r.average(self.minibatches().count() as f64));
        lane.reports
    }
}

/// One of the two threads.
struct Lane<'l> {
    index: usize,
    lengths: &'l Lengths,
    /// Gradient of each phase.
    sums: Vec<Vec<V>>,
    reports: Vec<PhaseReport>,
    /// The phase that waits for the other lane's length, and the square of its own.
    held: Option<(usize, f32)>,
}

impl Lane<'_> {
    /// Steps the phase that waits; as late as possible, so that the other lane has had time.
    fn release<P: Phases>(&mut self, run: &Run<'_, P>, step: usize, params: &mut Params) {
        if let Some((k, square)) = self.held.take() {
            let length = (square + self.lengths.ask(self.index, step, &run.barrier.alarm)).sqrt();
            run.step(k, length, &self.sums[k], params, &mut self.reports[k]);
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::learn::{
        Batch, Gradient, Kind, Learner, Nearl, NearlSettings, NetSettings, Pace, Pid2, Pid2Settings, Ppo,
        PpoSettings, reference, reference::dims,
    };

    fn learner(algo: &str, threads: usize) -> Box<dyn Learner> {
        let (nets, ppo) = (NetSettings::default(), PpoSettings::default());
        let mut rng = crate::rollout::stream(1, 1);
        if algo == "ppo" {
            return Box::new(Ppo::new(dims(), &nets, ppo, threads, &mut rng));
        }
        let kind = Kind { stochastic: false, learned: true };
        if algo == "nearl" {
            return Box::new(Nearl::new(
                dims(),
                &nets,
                ppo,
                NearlSettings::default(),
                kind,
                threads,
                &mut rng,
            ));
        }
        // the supervised phase of the inverse model takes part, on the policy's side
        let settings =
            Pid2Settings { idm_threshold: 0.0, gradient: Gradient::Projection, ..Pid2Settings::default() };
        Box::new(Pid2::new(dims(), &nets, ppo, settings, kind, true, threads, &mut rng))
    }

    /// Every parameter, moment and multiplier, and what was reported, as bits.
    fn updated(algo: &str, threads: usize, batch: &Batch) -> (Vec<u32>, Vec<u64>) {
        let (mut learner, mut rng) = (learner(algo, threads), crate::rollout::stream(2, 2));
        let mut reports = Vec::new();
        for _ in 0..3 {
            let metrics = learner.update(&mut batch.clone(), Pace::default(), &mut rng);
            reports.extend(metrics.iter().map(|(_, value)| value.to_bits()));
        }
        let params = learner.params();
        let moments = params.adam.iter().flat_map(|a| a.m.iter().chain(&a.v));
        let all = params.groups.iter().flat_map(|g| g.p.iter().chain(&g.transposed)).chain(moments);
        let mut bits: Vec<u32> = all.flat_map(|v| v.0.map(f32::to_bits)).collect();
        bits.push(params.beta.to_bits());
        (bits, reports)
    }

    /// A clip range below zero panics in the policy's lane; the discriminator's would wait for it forever.
    #[test]
    fn a_panic_in_one_lane_ends_the_other() {
        let (nets, ppo) =
            (NetSettings::default(), PpoSettings { clip_range: -0.2, ..PpoSettings::default() });
        let (mut rng, kind) = (crate::rollout::stream(1, 1), Kind { stochastic: false, learned: true });
        let mut learner = Pid2::new(dims(), &nets, ppo, Pid2Settings::default(), kind, true, 2, &mut rng);
        let mut batch = reference::batch(&dims(), 1024, 3);
        let update =
            std::panic::AssertUnwindSafe(|| drop(learner.update(&mut batch, Pace::default(), &mut rng)));
        assert!(std::panic::catch_unwind(update).is_err());
    }

    #[test]
    fn side_by_side_equals_in_turn() {
        let batch = reference::batch(&dims(), 512, 3);
        for algo in ["ppo", "nearl", "pid2-ib"] {
            let (one, two) = (updated(algo, 1, &batch), updated(algo, 2, &batch));
            assert!(one.0 == two.0, "{algo}: two threads gave other parameters than one");
            assert_eq!(one.1, two.1, "{algo}: two threads reported something else than one");
        }
    }
}
