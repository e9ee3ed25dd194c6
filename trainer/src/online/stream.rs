//! From the transitions of a running loop to rows for the learner.
//!
//! The stream carries states, versions and the seed of the noise; everything else is computed again by the same
//! [`Controller`] the loop has, with the networks of the version that acted. A tick whose target and action do not come out
//! bit for bit (the ramp of the first motion; what the projector remembers was lost in a gap) is counted and left out.

use crate::env::{Env, EnvError, Moment};
use crate::rollout::{Period, Rows};
use nearl_runtime::link::{STATE_RESET, STATE_TERMINATED, STATE_TRUNCATED, TransitionMessage};
use nearl_runtime::rt::Mode;
use nearl_runtime::{Controller, Networks, Noise, Output, Snapshot, SnapshotError, State};
use std::collections::VecDeque;

/// Versions whose networks are kept: the newest, and the one that still acts while it is built.
const KNOWN: usize = 3;

/// Transitions that were left out, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LeftOut {
    /// Of a version that this trainer did not push.
    pub foreign: u64,
    /// Of a version that this trainer has replaced.
    pub stale: u64,
    /// Not in mode Active.
    pub inactive: u64,
    /// Without the policy tick of their period.
    pub partial: u64,
    /// Computed again with another target or action.
    pub unlike: u64,
    /// Places where ticks or states in between are missing.
    pub gaps: u64,
}

/// Sums over the ticks of a policy step.
#[derive(Default)]
struct Sums {
    before: Vec<f64>,
    reward: f64,
    cost: f64,
    moved: f64,
    /// A tick of it is not usable.
    spoiled: bool,
}

/// An episode as far as it was seen.
#[derive(Default)]
struct Episode {
    whole: bool,
    total: f64,
    cost: f64,
    steps: usize,
}

/// Takes transitions in order and keeps the rows of the wanted version.
pub struct Stream {
    controller: Controller,
    env: Box<dyn Env>,
    proposes: bool,
    state: State,
    noise: Noise,
    out: Output,
    /// What the policy sees at the end of a period, before the normaliser (n_seen).
    seen: Vec<f64>,
    known: VecDeque<(u64, Networks)>,
    /// Version of the controller's networks.
    acting: Option<u64>,
    wanted: u64,
    /// The controller stands at the same tick of its period as the loop's.
    aligned: bool,
    /// Computed again, waiting for the state it led to.
    last: Option<Box<TransitionMessage>>,
    /// The tally has it.
    counted: bool,
    sums: Sums,
    episode: Episode,
    /// What was collected.
    pub rows: Rows,
    /// What was not.
    pub left_out: LeftOut,
}

impl Stream {
    /// A stream for the snapshot's task, scored by `env`.
    ///
    /// # Errors
    /// [`SnapshotError`].
    pub fn new(
        snapshot: &Snapshot,
        env: Box<dyn Env>,
        gamma: f64,
        moved_penalty: f64,
    ) -> Result<Self, SnapshotError> {
        let controller = Controller::new(snapshot)?;
        Ok(Self {
            env,
            proposes: snapshot.manifest.proposes(),
            state: controller.state(),
            noise: controller.noise(),
            out: controller.output(),
            seen: vec![0.0; controller.n_seen()],
            known: VecDeque::new(),
            acting: None,
            wanted: 0,
            aligned: false,
            last: None,
            counted: false,
            sums: Sums::default(),
            episode: Episode::default(),
            rows: Rows::new(&controller, gamma, moved_penalty),
            left_out: LeftOut::default(),
            controller,
        })
    }

    /// From now on the rows of `version`, which has these networks.
    pub fn want(&mut self, version: u64, networks: &Networks) {
        self.rows.interrupt();
        self.known.push_back((version, networks.clone()));
        if self.known.len() > KNOWN {
            self.known.pop_front();
        }
        self.wanted = version;
    }

    /// Takes the next transition.
    ///
    /// # Errors
    /// [`EnvError`] where the task cannot score its state.
    pub fn take(&mut self, next: &TransitionMessage) -> Result<(), EnvError> {
        if let Some(last) = self.last.take() {
            if follows(&last, next) {
                self.finish(&last, next)?;
            } else {
                self.left_out.gaps += 1;
                self.lose();
            }
        }
        if self.begin(next) {
            self.last = Some(Box::new(*next));
        }
        Ok(())
    }

    /// Nothing is known of what came before the next transition.
    fn lose(&mut self) {
        self.rows.interrupt();
        self.sums.spoiled = true;
        self.aligned = false;
        self.episode.whole = false;
    }

    /// The tick `last` led to the state of `next`.
    fn finish(&mut self, last: &TransitionMessage, next: &TransitionMessage) -> Result<(), EnvError> {
        if last.next_bits & STATE_RESET != 0 {
            // From an episode's end to the next one's begin: nobody acted. The loop forgets what it remembered.
            self.controller.reset();
            self.aligned = true;
            self.episode = Episode { whole: true, ..Episode::default() };
            return Ok(());
        }
        self.state.q.copy_from_slice(next.q());
        self.state.v.copy_from_slice(next.v());
        self.state.obs.copy_from_slice(next.obs());
        if self.counted {
            let tally = &mut self.rows.collected.tally;
            tally.reached_violations += u64::from(self.controller.excess(&self.state) != [None; 2]);
            tally.residual += self.controller.residual(next.obs(), &self.out);
        }
        let step = self.env.score(&moment(last), &moment(next), last.action())?;
        self.sums.reward += step.reward;
        self.sums.cost += step.cost;
        self.episode.total += step.reward;
        self.episode.cost += step.cost;
        let terminated = step.terminated || last.next_bits & STATE_TERMINATED != 0;
        let truncated = last.next_bits & STATE_TRUNCATED != 0;
        let ended = terminated || truncated;
        if next.period_tick == 0 || ended {
            self.episode.steps += 1;
            let whole = last.period_tick as usize + 1 == self.controller.policy_every() || ended;
            if last.policy_version == self.wanted && whole && !self.sums.spoiled {
                let Sums { before, reward, cost, moved, .. } = &self.sums;
                let (reward, cost, moved) = (*reward, *cost, *moved);
                self.controller.peek(&self.state, &mut self.seen);
                let period = Period {
                    out: &self.out,
                    before,
                    after: next.obs(),
                    seen: &self.seen,
                    privileged: [&[], &[]],
                    reward,
                    cost,
                    moved,
                    terminated,
                    truncated,
                };
                self.rows.push(&period, self.controller.normaliser());
            } else {
                self.rows.interrupt();
            }
        }
        if ended {
            if self.episode.whole {
                self.rows.collected.tally.episodes.push((self.episode.total, self.episode.steps));
                self.rows.collected.tally.costs.push(self.episode.cost);
            }
            // A robot that goes on after the end is not in a new episode.
            self.episode = Episode::default();
        }
        Ok(())
    }

    /// Computes the tick again; true if it is the loop's.
    fn begin(&mut self, tick: &TransitionMessage) -> bool {
        if tick.mode != Mode::Active.code() || !self.fits(tick) {
            self.left_out.inactive += 1;
            self.lose();
            return false;
        }
        if self.acting != Some(tick.policy_version) && !self.switch(tick) {
            self.left_out.foreign += 1;
            self.lose();
            return false;
        }
        if tick.period_tick == 0 && !self.aligned {
            self.controller.reset();
            self.aligned = true;
        }
        self.aligned &= self.controller.begins_period() == (tick.period_tick == 0);
        if !self.aligned {
            self.left_out.partial += 1;
            self.lose();
            return false;
        }
        if tick.period_tick == 0 {
            self.begin_period(tick);
        }
        self.state.q.copy_from_slice(tick.q());
        self.state.v.copy_from_slice(tick.v());
        self.state.obs.copy_from_slice(tick.obs());
        self.controller.update(&self.state, &self.noise, &mut self.out);
        self.sums.moved += self.out.next.ledger.moved;
        self.counted = false;
        if !self.is_like(tick) {
            self.left_out.unlike += 1;
            self.sums.spoiled = true;
        } else if tick.policy_version == self.wanted {
            self.rows.collected.tally.count(&self.out.next.ledger);
            self.counted = true;
        } else {
            self.left_out.stale += 1;
        }
        true
    }

    fn fits(&self, tick: &TransitionMessage) -> bool {
        let s = &self.state;
        let sizes = (tick.q().len(), tick.v().len(), tick.obs().len(), tick.action().len());
        sizes == (s.q.len(), s.v.len(), s.obs.len(), self.out.action.len())
    }

    /// Takes the networks of another version; what the projector remembers stays, as in the loop.
    fn switch(&mut self, tick: &TransitionMessage) -> bool {
        self.acting = None;
        let Some((version, networks)) = self.known.iter().find(|(v, _)| *v == tick.policy_version) else {
            return false;
        };
        self.acting = Some(*version);
        self.controller.set_networks(networks);
        self.rows.interrupt();
        self.sums.spoiled = true;
        if self.aligned {
            // The loop begins a period with the new controller.
            let memory = self.controller.memory();
            self.controller.set_memory(&memory);
        }
        true
    }

    fn begin_period(&mut self, tick: &TransitionMessage) {
        let mut before = std::mem::take(&mut self.sums.before);
        before.clear();
        before.extend_from_slice(tick.obs());
        self.sums = Sums { before, ..Sums::default() };
        if tick.explores == 1 {
            self.noise.draw(tick.explore, tick.tick);
        } else {
            self.noise.proposal.fill(0.0);
            self.noise.action.fill(0.0);
        }
    }

    /// Target and action are the loop's, bit for bit.
    fn is_like(&self, tick: &TransitionMessage) -> bool {
        let same = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits());
        let target = &self.out.next;
        let targets =
            !self.proposes || (same(&target.q, tick.target_q()) && same(&target.v, tick.target_v()));
        targets && same(&self.out.action, tick.action())
    }
}

/// `next` begins in the state that `last` led to.
fn follows(last: &TransitionMessage, next: &TransitionMessage) -> bool {
    last.state_epoch == next.state_epoch
        && last.next_state_seq == next.state_seq
        && last.tick + 1 == next.tick
}

fn moment(tick: &TransitionMessage) -> Moment<'_> {
    Moment { q: tick.q(), v: tick.v(), obs: tick.obs(), time: tick.time }
}
