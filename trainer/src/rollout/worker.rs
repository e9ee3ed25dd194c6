//! One environment behind its own controller.

mod stream;

use super::demonstrated::Demonstrated;
use super::resume::Episode;
use super::{Period, RolloutError, Rows, Scorer};
use crate::demos::{self, Frame, Frames};
use crate::env::{Env, EnvError, Fault};
use crate::foresight::{Foresight, Verdict};
use crate::plant::watched_limits;
use crate::watch::Watch;
use nearl_runtime::constraints::{Guard, LimitSet};
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Controller, Excess, Networks, Noise, Output, PolicyKind, Snapshot, State};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use std::sync::Arc;

/// One environment with its controller and its random stream.
pub struct Worker {
    pub(super) env: Box<dyn Env>,
    pub(crate) controller: Controller,
    kind: PolicyKind,
    learned: bool,
    pub(super) rng: ChaCha8Rng,
    /// What gives reward and end of a control period in the task's place, and the observation at its begin.
    scorer: Option<(Scorer, Vec<f64>)>,
    /// Asks the simulator where an action leads, if the task says so.
    foresight: Option<Foresight>,
    foresees: bool,
    /// Actions that [`Foresight`] replaced, and those for which it found none.
    pub(crate) foreseen: [u64; 2],
    pub(super) state: State,
    /// Configuration and velocity as the simulator has them, where noise or a delay lies before `state`; its observation is never read.
    actual: State,
    /// Observation at the begin of this policy step.
    before: Vec<f64>,
    /// What the policy sees at its end, before the normaliser.
    seen: Vec<f64>,
    /// What the value alone sees at its begin and at its end.
    privileged: [Vec<f64>; 2],
    noise: Noise,
    out: Output,
    /// Distance the projection moved the targets of this policy step.
    moved: f64,
    pub(super) episode: (f64, usize),
    pub(super) cost: f64,
    pub(super) ticks: usize,
    /// Ticks that ended outside a position limit, and row by row those of [`Controller::margins`].
    pub(crate) outside: (u64, Vec<u64>),
    /// Furthest that a position and a velocity came beyond its limit.
    pub(crate) excess: [Option<Excess>; 2],
    /// Limits that an evaluation measures too, and how far these were left.
    pub(crate) beyond: Option<(LimitSet, [Option<Excess>; 2])>,
    /// The simulator's own state against the limits, in an evaluation.
    pub(crate) watch: Option<Watch>,
    /// Policy steps left in the segment.
    left: usize,
    pub(super) history: Episode,
    /// Demonstrations in whose states episodes begin.
    pub(super) demonstrated: Option<Demonstrated>,
    /// What was collected in the segment.
    pub rows: Rows,
}

impl Worker {
    /// An environment at the start of an episode.
    ///
    /// # Errors
    /// [`RolloutError`].
    pub fn new(
        env: Box<dyn Env>,
        snapshot: &Snapshot,
        gamma: f64,
        rng: ChaCha8Rng,
    ) -> Result<Self, RolloutError> {
        let controller = Controller::new(snapshot)?;
        let asks = snapshot.manifest.task.constraints.guard == Guard::Simulator;
        let limits = watched_limits(&*env, controller.model(), controller.limits());
        let mut worker = Self {
            foresight: asks.then(|| Foresight::new(&*env, &limits)),
            scorer: None,
            foresees: true,
            foreseen: [0; 2],
            kind: snapshot.manifest.policy,
            learned: snapshot.manifest.task.idm.kind == IdmKind::Learned,
            state: controller.state(),
            actual: controller.state(),
            before: vec![0.0; controller.layout().n_obs()],
            seen: vec![0.0; controller.n_seen()],
            privileged: [(); 2].map(|()| vec![0.0; env.spec().privileged.len()]),
            noise: controller.noise(),
            out: controller.output(),
            outside: (0, vec![0; controller.margins().len()]),
            rows: Rows::new(&controller, gamma, 0.0),
            env,
            controller,
            rng,
            moved: 0.0,
            episode: (0.0, 0),
            cost: 0.0,
            ticks: 0,
            excess: [None; 2],
            beyond: None,
            watch: None,
            left: 0,
            history: Episode::default(),
            demonstrated: None,
        };
        worker.restart()?;
        Ok(worker)
    }

    /// What the environment tells of its episodes, by name.
    pub fn notes(&self) -> &[String] {
        &self.env.spec().notes
    }

    /// Hands new networks to the controller.
    pub fn set_networks(&mut self, networks: &Networks) {
        self.controller.set_networks(networks);
    }

    /// Measures from now on how the simulator keeps the limits.
    ///
    /// # Errors
    /// [`RolloutError::Watch`].
    pub(crate) fn set_watch(&mut self) -> Result<(), RolloutError> {
        let limits = watched_limits(&*self.env, self.controller.model(), self.controller.limits());
        self.watch = Some(Watch::new(&*self.env, limits)?);
        Ok(())
    }

    /// Name of the joint of a dof of the simulation.
    pub(crate) fn joint_of(&self, dof: usize) -> String {
        let joints = &self.env.spec().joints;
        joints.iter().rfind(|joint| joint.idx_v <= dof).map_or_else(String::new, |joint| joint.name.clone())
    }

    /// Switches the projection, for comparisons.
    pub fn set_projection(&mut self, on: bool) {
        self.controller.set_projection(on);
        self.foresees = on;
    }

    /// Lowers the learner's reward by `penalty` for each unit of distance the projection moved a target
    /// [1 / (weight rad/s)], summed over the ticks of a policy step.
    pub fn set_moved_penalty(&mut self, penalty: f64) {
        self.rows.moved_penalty = penalty;
    }

    /// Lets somebody else's code give reward and end of every control period to come.
    pub fn set_scorer(&mut self, scorer: Scorer) {
        self.scorer = Some((scorer, vec![0.0; self.state.obs.len()]));
    }

    /// Lets that share of the episodes to come begin in one of the frames. With `tracked` the reward of the learner is how near they are
    /// followed, and an episode ends once a step is worth less than it.
    pub(crate) fn begin_in(&mut self, frames: Arc<Frames>, share: f64, tracked: Option<f64>) {
        self.demonstrated = Demonstrated::new(frames, share, tracked);
    }

    fn restart(&mut self) -> Result<(), EnvError> {
        self.env.reset(&mut self.rng)?;
        if let Some(demonstrated) = &mut self.demonstrated
            && let Some(Frame { qpos, qvel, time, .. }) = demonstrated.begin(self.env.qpos(), &mut self.rng)
        {
            self.env.set_state(qpos, qvel)?;
            self.env.set_time(*time);
        }
        self.history.begin(&*self.env);
        self.controller.reset();
        self.rows.interrupt();
        (self.episode, self.cost, self.ticks) = ((0.0, 0), 0.0, 0);
        self.observe();
        Ok(())
    }

    pub(super) fn observe(&mut self) {
        self.env.observe(&mut self.state.obs);
        self.env.state(&mut self.state.q, &mut self.state.v);
    }

    /// Collects `n_steps` policy steps.
    ///
    /// # Errors
    /// [`EnvError`] of a reset.
    pub fn collect(&mut self, n_steps: usize) -> Result<(), EnvError> {
        self.begin(n_steps);
        self.go_on(n_steps)
    }

    /// Begins a segment of `n_steps` policy steps.
    pub(crate) fn begin(&mut self, n_steps: usize) {
        self.rows.clear();
        self.left = n_steps;
    }

    /// Collects the next `n` policy steps of the segment, or those that are left.
    ///
    /// # Errors
    /// [`EnvError`] of a reset: one's own may be undefined for some of its draws.
    pub(crate) fn go_on(&mut self, n: usize) -> Result<(), EnvError> {
        for _ in 0..n.min(self.left) {
            self.left -= 1;
            if self.episode.1 == 0 {
                self.controller.peek(&self.state, &mut self.seen);
                self.rows.collected.see(&self.seen);
            }
            self.draw(true);
            self.env.privileged(&mut self.privileged[0]);
            let costed = self.cost;
            let (mut reward, mut terminated) = self.policy_step();
            let cost = self.cost - costed;
            let mut truncated = self.ticks >= self.env.spec().max_episode_steps;
            if let Some(f) = self.demonstrated.as_mut().and_then(|d| d.step(&self.state.obs)) {
                (reward, terminated, truncated) = (f.worth, terminated || f.strayed, truncated || f.ended);
            }
            self.controller.peek(&self.state, &mut self.seen);
            let (before, after, seen, moved) =
                (&self.before[..], &self.state.obs[..], &self.seen[..], self.moved);
            self.env.privileged(&mut self.privileged[1]);
            let privileged = self.privileged.each_ref().map(Vec::as_slice);
            let period = Period {
                out: &self.out,
                before,
                after,
                seen,
                privileged,
                reward,
                cost,
                moved,
                terminated,
                truncated,
            };
            self.rows.push(&period, self.controller.normaliser());
            if terminated || truncated {
                if !self.demonstrated.as_ref().is_some_and(|d| d.from_frame) {
                    self.rows.collected.tally.episodes.push(self.episode);
                    self.rows.collected.tally.costs.push(self.cost);
                    self.rows.collected.tally.note(self.env.notes());
                }
                self.restart()?;
            } else if self.left == 0 {
                self.rows.cut();
            }
        }
        if self.left == 0 {
            self.rows.collected.margins = self.controller.learned_margins();
        }
        Ok(())
    }

    /// One episode without noise: return and length in policy steps.
    ///
    /// # Errors
    /// [`EnvError`] of a reset.
    pub fn evaluate(&mut self) -> Result<(f64, usize), EnvError> {
        self.rows.clear();
        self.draw(false);
        self.rows.collected.see(&self.state.obs);
        if let Some(watch) = &mut self.watch {
            watch.begin(&*self.env);
        }
        loop {
            let (_, terminated) = self.policy_step();
            self.rows.collected.see(&self.state.obs);
            if terminated || self.ticks >= self.env.spec().max_episode_steps {
                let episode = self.episode;
                self.rows.collected.tally.costs.push(self.cost);
                self.rows.collected.tally.note(self.env.notes());
                self.restart()?;
                return Ok(episode);
            }
        }
    }

    /// One episode without noise as a demonstration, and its return.
    ///
    /// # Errors
    /// [`EnvError`] of a reset.
    pub fn demonstrate(&mut self) -> Result<(demos::Episode, f64), EnvError> {
        self.rows.clear();
        self.draw(false);
        let mut e = demos::Episode::default();
        let look = |worker: &Self, e: &mut demos::Episode| {
            e.observations.extend_from_slice(&worker.state.obs);
            e.qpos.extend_from_slice(worker.env.qpos());
            e.qvel.extend_from_slice(worker.env.qvel());
        };
        look(self, &mut e);
        loop {
            let (_, terminated) = self.policy_step();
            e.actions.extend_from_slice(&self.out.action);
            e.length += 1;
            look(self, &mut e);
            if terminated || self.ticks >= self.env.spec().max_episode_steps {
                let total = self.episode.0;
                self.restart()?;
                return Ok((e, total));
            }
        }
    }

    fn draw(&mut self, explore: bool) {
        let normal = |rng: &mut ChaCha8Rng| if explore { StandardNormal.sample(rng) } else { 0.0 };
        match self.kind {
            PolicyKind::Stochastic => self.noise.proposal.fill_with(|| normal(&mut self.rng)),
            PolicyKind::Direct | PolicyKind::Deterministic | PolicyKind::State => {}
        }
        // an analytic inverse model has no noise of its own
        if self.kind != PolicyKind::Stochastic || self.learned {
            self.noise.action.fill_with(|| normal(&mut self.rng));
        }
    }

    /// One proposal and the control ticks it spans.
    fn policy_step(&mut self) -> (f64, bool) {
        self.before.copy_from_slice(&self.state.obs);
        let (mut reward, mut terminated) = (0.0, false);
        self.moved = 0.0;
        for _ in 0..self.controller.policy_every() {
            let (r, is_end) = self.tick();
            reward += r;
            terminated = is_end;
            if terminated || self.ticks >= self.env.spec().max_episode_steps {
                break;
            }
        }
        self.episode.0 += reward;
        self.episode.1 += 1;
        (reward, terminated)
    }

    fn tick(&mut self) -> (f64, bool) {
        self.controller.update(&self.state, &self.noise, &mut self.out);
        if let Some(foresight) = self.foresight.as_mut().filter(|_| self.foresees) {
            match foresight.update(&mut *self.env, &mut self.out.action) {
                Verdict::Kept => {}
                Verdict::Replaced => self.foreseen[0] += 1,
                Verdict::Outside => self.foreseen[1] += 1,
            }
        }
        self.history.push(&self.out.action);
        if let Some((_, obs)) = &mut self.scorer {
            obs.copy_from_slice(&self.state.obs);
        }
        let mut step = self.env.step(&self.out.action);
        self.ticks += 1;
        self.cost += step.cost;
        self.observe();
        if let Some((scorer, obs)) = self.scorer.as_ref().filter(|_| step.fault == Fault::None) {
            step = scorer.score(obs, &self.out.action, &self.state.obs, step);
        }
        let (ledger, tally) = (&self.out.next.ledger, &mut self.rows.collected.tally);
        tally.count(ledger);
        self.moved += ledger.moved;
        tally.faults += u64::from(step.fault != Fault::None);
        self.env.actual_state(&mut self.actual.q, &mut self.actual.v);
        let excess = self.controller.excess(&self.actual);
        tally.reached_violations += u64::from(excess != [None; 2]);
        for (count, is) in self.outside.1.iter_mut().zip(self.controller.outside(&self.actual.q)) {
            *count += u64::from(is);
        }
        self.outside.0 += u64::from(excess[0].is_some());
        tally.residual += self.controller.residual(&self.state.obs, &self.out);
        let larger = |most: &[_; 2], new: [_; 2]| [0, 1].map(|k| Excess::larger(most[k], new[k]));
        self.excess = larger(&self.excess, excess);
        if let Some((limits, most)) = &mut self.beyond {
            *most = larger(most, self.controller.excess_over(limits, &self.actual));
        }
        if let Some(watch) = &mut self.watch {
            watch.observe(&*self.env);
        }
        (step.reward, step.terminated)
    }
}
