//! Parameter groups that learn side by side, for minibatches too small to be cut.
//!
//! The phases of the first phase's group are the leader, all others the follower. The follower reads nothing the leader
//! changes. Where the leader reads the follower's group, it takes it as it was before the same minibatch: both do exactly
//! what one thread does in turn, to the bit.

use super::{Group, Params, PhaseReport, Phases, Run, moments, wait_until};
use nearl_runtime::net::kernel::ZERO;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Minibatches the follower may be ahead.
const AHEAD: usize = 4;

/// The follower's group as it was before each of its last minibatches.
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

    fn write(&self, step: usize, group: &Group) {
        wait_until(|| self.read.load(Ordering::Acquire) + AHEAD > step);
        let mut slot = self.slots[step % AHEAD].lock().unwrap_or_else(PoisonError::into_inner);
        copy(&mut slot, group);
        self.written.store(step + 1, Ordering::Release);
    }

    fn read(&self, step: usize, group: &mut Group) {
        wait_until(|| self.written.load(Ordering::Acquire) > step);
        copy(group, &self.slots[step % AHEAD].lock().unwrap_or_else(PoisonError::into_inner));
        self.read.store(step + 1, Ordering::Release);
    }
}

fn copy(to: &mut Group, from: &Group) {
    to.p.copy_from_slice(&from.p);
    to.transposed.copy_from_slice(&from.transposed);
}

impl<P: Phases> Run<'_, P> {
    /// Positions of the leader's and the follower's phases, if there are two lanes.
    pub(super) fn lanes(&self) -> Option<(Vec<usize>, Vec<usize>)> {
        let group = |k: usize| self.algorithm.group(self.phases[k]);
        let (leader, follower): (Vec<_>, Vec<_>) =
            (0..self.phases.len()).partition(|&k| group(k) == group(0));
        let first = group(*follower.first()?);
        follower.iter().all(|&k| group(k) == first).then_some((leader, follower))
    }

    /// The lanes on two threads; what each phase reported, in their order.
    pub(super) fn side_by_side(
        &self,
        params: &mut Params,
        (leader, follower): (Vec<usize>, Vec<usize>),
    ) -> Vec<PhaseReport> {
        let group = self.algorithm.group(self.phases[follower[0]]);
        let trail = self.algorithm.reads_other_group().then(|| Trail::new(&params.groups[group]));
        let mut reports = vec![PhaseReport::default(); self.phases.len()];
        let mut theirs = params.clone();
        let (ahead, behind) = std::thread::scope(|scope| {
            let other = scope.spawn(|| {
                self.lane(1, &follower, &mut theirs, |step, params| {
                    if let Some(trail) = &trail {
                        trail.write(step, &params.groups[group]);
                    }
                })
            });
            let ahead = self.lane(0, &leader, params, |step, params| {
                if let Some(trail) = &trail {
                    trail.read(step, &mut params.groups[group]);
                }
            });
            (ahead, other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        });
        for (&k, report) in leader.iter().chain(&follower).zip(ahead.into_iter().chain(behind)) {
            reports[k] = report;
        }
        params.groups[group] = theirs.groups.swap_remove(group);
        for &k in &follower {
            params.adam[self.phases[k]].clone_from(&theirs.adam[self.phases[k]]);
        }
        params.beta = theirs.beta;
        reports
    }

    /// The phases at positions `mine` over every minibatch; `before` comes first in each.
    fn lane(
        &self,
        buffer: usize,
        mine: &[usize],
        params: &mut Params,
        before: impl Fn(usize, &mut Params),
    ) -> Vec<PhaseReport> {
        let mut work = self.algorithm.work();
        let longest = params.groups.iter().map(|g| g.p.len()).max().unwrap_or(0) + 1;
        let mut sum = vec![ZERO; longest];
        let mut reports = vec![PhaseReport::default(); mine.len()];
        let minibatches = self.orders.iter().flat_map(|o| o.chunks_exact(self.schedule.minibatch));
        let mut steps = 0;
        for idx in minibatches {
            before(steps, params);
            let advantage = moments(self.batch, idx);
            for (report, &k) in reports.iter_mut().zip(mine) {
                let phase = self.phases[k];
                let len = params.groups[self.algorithm.group(phase)].p.len() + 1;
                self.shard(0, phase, idx, advantage, params, &mut work, buffer, len);
                self.gather(&mut sum[..len], buffer);
                self.step(phase, &mut sum[..len], params, report);
            }
            steps += 1;
        }
        reports.iter_mut().for_each(|r| r.average(steps as f64));
        reports
    }
}

#[cfg(test)]
mod tests {
    use crate::learn::{
        Batch, Dims, Gradient, Kind, Learner, NetSettings, Pid2, Pid2Settings, Ppo, PpoSettings, reference,
    };

    fn dims() -> Dims {
        Dims { n_obs: 7, n_state: 5, n_act: 3, seen_obs: vec![1, 2, 6], seen_state: vec![0, 2, 4] }
    }

    fn learner(algo: &str, threads: usize) -> Box<dyn Learner> {
        let (nets, ppo) = (NetSettings::default(), PpoSettings::default());
        let mut rng = crate::rollout::stream(1, 1);
        if algo == "ppo" {
            return Box::new(Ppo::new(dims(), &nets, ppo, threads, &mut rng));
        }
        // the supervised phase of the inverse model takes part, on the policy's side
        let settings =
            Pid2Settings { idm_threshold: 0.0, gradient: Gradient::Projection, ..Pid2Settings::default() };
        let kind = Kind { stochastic: false, learned: true };
        Box::new(Pid2::new(dims(), &nets, ppo, settings, kind, true, threads, &mut rng))
    }

    /// Every parameter, moment and multiplier, and what was reported, as bits.
    fn updated(algo: &str, threads: usize, batch: &Batch) -> (Vec<u32>, Vec<u64>) {
        let (mut learner, mut rng) = (learner(algo, threads), crate::rollout::stream(2, 2));
        let mut reports = Vec::new();
        for _ in 0..3 {
            let metrics = learner.update(batch, 1.0, &mut rng);
            reports.extend(metrics.iter().map(|(_, value)| value.to_bits()));
        }
        let params = learner.params();
        let moments = params.adam.iter().flat_map(|a| a.m.iter().chain(&a.v));
        let all = params.groups.iter().flat_map(|g| g.p.iter().chain(&g.transposed)).chain(moments);
        let mut bits: Vec<u32> = all.flat_map(|v| v.0.map(f32::to_bits)).collect();
        bits.push(params.beta.to_bits());
        (bits, reports)
    }

    #[test]
    fn side_by_side_equals_in_turn() {
        let batch = reference::batch(&dims(), 512, 3);
        for algo in ["ppo", "pid2-ib"] {
            let (one, two) = (updated(algo, 1, &batch), updated(algo, 2, &batch));
            assert!(one.0 == two.0, "{algo}: two threads gave other parameters than one");
            assert_eq!(one.1, two.1, "{algo}: two threads reported something else than one");
        }
    }
}
