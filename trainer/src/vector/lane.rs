//! One environment of a vector, with its buffers, its random stream and its time limit.

use super::VectorError;
use crate::env::{ChaCha8Rng, Env, EnvError, Fault, SeedableRng, Step};
use crate::foresight::{Foresight, Verdict};
use crate::plant::watched_limits;
use crate::rollout::Tally;
use crate::train::limit_scale;
use nearl_runtime::constraints::Guard;
use nearl_runtime::controller::Parts;
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Controller, Noise, Output, Snapshot, State};

/// When an episode that ended is begun anew (<https://farama.org/Vector-Autoreset-Mode>).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Autoreset {
    /// In the next step, whose action is ignored.
    NextStep,
    /// In the same step; the last observation of the old episode is kept aside.
    SameStep,
}

/// What a round does in every lane.
#[derive(Clone, Copy, Debug)]
pub(super) enum Round {
    /// Begins an episode.
    Reset,
    /// One action.
    Step(Autoreset),
}

/// What an action of a constrained environment is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Meaning {
    /// The next state, entry by entry.
    State,
    /// The change of the state, in units of what the limits allow in a step, or three standard deviations of a trained agent's changes.
    Change,
    /// What the actuators get, where the guard allows it.
    Action,
    /// What the actuators get, where the task's limits on actions allow it.
    Limited,
}

impl Meaning {
    /// The action is the actuators' own, not a state.
    pub(super) fn is_actuators(self) -> bool {
        matches!(self, Meaning::Action | Meaning::Limited)
    }
}

/// A controller between action and actuators.
///
/// Its own policy is all zeros with unit deviation, so that the noise it is given is what it puts out: the change that is
/// proposed, `proposal_k = s_k + scale_k noise_k`, or the action. Either takes the way that a policy's takes.
pub(super) struct Proposing {
    meaning: Meaning,
    /// Change of an entry that an action of 1 asks for (n_state).
    unit: Vec<f64>,
    /// Asks the simulator where the action leads, instead of the robot model.
    foresight: Option<Foresight>,
    controller: Controller,
    scale: Vec<f64>,
    state: State,
    noise: Noise,
    out: Output,
}

/// One environment of a vector, as its last step left it.
pub struct Lane {
    pub(super) env: Box<dyn Env>,
    pub(super) proposing: Option<Proposing>,
    pub(super) rng: ChaCha8Rng,
    max_steps: usize,
    pub(super) action: Vec<f64>,
    pub(super) error: Option<EnvError>,
    ticks: usize,
    ended: bool,
    /// Observation (n_obs); of the new episode where one has begun.
    pub obs: Vec<f64>,
    /// Last observation of an episode that ended in the step, if a new one has begun in it.
    pub final_obs: Option<Vec<f64>>,
    /// Reward of the step.
    pub reward: f64,
    /// Cost of the step; 0 where the task has none.
    pub cost: f64,
    /// The task ended the episode.
    pub terminated: bool,
    /// The time limit cut it.
    pub truncated: bool,
    /// Why the step is not to be believed.
    pub fault: Fault,
    /// What projection or guard did over the control ticks of the step, as every rollout counts it; nothing where there is neither.
    pub tally: Tally,
    /// Largest distance between proposal and target in one of these ticks.
    pub moved: f64,
}

impl Lane {
    pub(super) fn new(
        env: Box<dyn Env>,
        proposing: Option<Proposing>,
        n_action: usize,
        max_steps: usize,
        seed: u64,
    ) -> Lane {
        let obs = vec![0.0; env.spec().n_obs()];
        Lane {
            env,
            proposing,
            rng: ChaCha8Rng::seed_from_u64(seed),
            max_steps,
            action: vec![0.0; n_action],
            obs,
            final_obs: None,
            reward: 0.0,
            cost: 0.0,
            terminated: false,
            truncated: false,
            fault: Fault::None,
            tally: Tally::default(),
            moved: 0.0,
            error: None,
            ticks: 0,
            ended: false,
        }
    }

    /// Configuration (nq), MuJoCo's convention.
    pub fn qpos(&self) -> &[f64] {
        self.env.qpos()
    }

    /// Velocity (nv), MuJoCo's convention.
    pub fn qvel(&self) -> &[f64] {
        self.env.qvel()
    }

    /// Whether the task counts a cost beside its reward.
    pub fn has_cost(&self) -> bool {
        self.env.spec().has_cost
    }

    /// Whether actions are proposals.
    pub fn is_projected(&self) -> bool {
        self.proposing.is_some()
    }

    /// What the actuators got in the last control period (n_act), not a number where the round only began an episode; nothing where they get the
    /// caller's own actions.
    pub fn executed(&self) -> &[f64] {
        self.proposing.as_ref().map_or(&[], |p| &p.out.action)
    }

    /// Does what the round says.
    pub(super) fn run(&mut self, round: Round) {
        (self.reward, self.cost, self.final_obs) = (0.0, 0.0, None);
        (self.terminated, self.truncated) = (false, false);
        (self.fault, self.tally, self.moved) = (Fault::None, Tally::default(), 0.0);
        if let Some(p) = &mut self.proposing {
            p.out.action.fill(f64::NAN);
        }
        match round {
            Round::Step(_) if !self.ended => self.step(),
            _ => self.reset(),
        }
        self.ended = self.terminated || self.truncated;
        if let (Round::Step(Autoreset::SameStep), true) = (round, self.ended) {
            self.final_obs = Some(self.obs.clone());
            self.reset();
            self.ended = false;
        }
    }

    /// Ends the episode here, as if the task had.
    pub(super) fn end(&mut self, autoreset: Autoreset) {
        match autoreset {
            Autoreset::NextStep => self.ended = true,
            Autoreset::SameStep => self.reset(),
        }
    }

    /// An episode that begins in `qpos` and `qvel`, MuJoCo's convention.
    pub(super) fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) -> Result<(), EnvError> {
        self.env.set_state(qpos, qvel)?;
        self.begin();
        Ok(())
    }

    fn reset(&mut self) {
        self.error = self.env.reset(&mut self.rng).err();
        self.begin();
    }

    fn begin(&mut self) {
        (self.ticks, self.ended) = (0, false);
        if let Some(p) = &mut self.proposing {
            p.controller.reset();
        }
        self.env.observe(&mut self.obs);
    }

    fn step(&mut self) {
        match &mut self.proposing {
            None => {
                let step = self.env.step(&self.action);
                (self.reward, self.cost) = (step.reward, step.cost);
                (self.terminated, self.fault) = (step.terminated, step.fault);
                self.ticks += 1;
            }
            Some(p) => {
                p.want(&self.action, &*self.env);
                while self.ticks < self.max_steps && !self.terminated {
                    let step = p.tick(&mut *self.env, &mut self.tally, &mut self.moved);
                    (self.reward, self.cost) = (self.reward + step.reward, self.cost + step.cost);
                    (self.terminated, self.fault) = (step.terminated, step.fault);
                    self.ticks += 1;
                    if self.ticks.is_multiple_of(p.controller.policy_every()) {
                        break;
                    }
                }
            }
        }
        self.truncated = self.ticks >= self.max_steps && !self.terminated;
        self.env.observe(&mut self.obs);
    }
}

impl Proposing {
    /// `snapshot` holds a policy of zeros and unit deviation.
    pub(super) fn new(
        snapshot: &Snapshot,
        env: &dyn Env,
        meaning: Meaning,
    ) -> Result<Proposing, VectorError> {
        let controller = Controller::new(snapshot)?;
        let (state, noise, out) = (controller.state(), controller.noise(), controller.output());
        let scale = controller.normaliser().scale.clone();
        let unit = if meaning == Meaning::Change { units(snapshot, &controller)? } else { Vec::new() };
        let asks = meaning == Meaning::Action && snapshot.manifest.task.constraints.guard == Guard::Simulator;
        let limits = || watched_limits(env, controller.model(), controller.limits());
        let foresight = asks.then(|| Foresight::new(env, &limits()));
        Ok(Proposing { meaning, unit, foresight, scale, controller, state, noise, out })
    }

    /// Noise that makes the controller propose, or do, what `action` means.
    fn want(&mut self, action: &[f64], env: &dyn Env) {
        env.observe(&mut self.state.obs);
        let layout = self.controller.layout();
        match self.meaning {
            Meaning::State => {
                for (k, s) in action.iter().enumerate() {
                    self.noise.proposal[k] = ((s - self.state.obs[layout.state()[k]]) / self.scale[k]) as f32;
                }
            }
            Meaning::Change => {
                for (k, change) in action.iter().enumerate() {
                    self.noise.proposal[k] = (change * self.unit[k] / self.scale[k]) as f32;
                }
            }
            Meaning::Action if self.foresight.is_some() => self.out.action.copy_from_slice(action),
            Meaning::Action | Meaning::Limited => {
                self.noise.action.iter_mut().zip(action).for_each(|(noise, a)| *noise = *a as f32);
            }
        }
    }

    /// One control period, with what the projection or the guard did in it.
    fn tick(&mut self, env: &mut dyn Env, tally: &mut Tally, moved: &mut f64) -> Step {
        if let Some(foresight) = &mut self.foresight {
            let verdict = foresight.update(env, &mut self.out.action);
            tally.ticks += 1;
            tally.raw_violations += u64::from(verdict != Verdict::Kept);
            tally.target_violations += u64::from(verdict == Verdict::Outside);
            return env.step(&self.out.action);
        }
        env.observe(&mut self.state.obs);
        env.state(&mut self.state.q, &mut self.state.v);
        self.controller.update(&self.state, &self.noise, &mut self.out);
        let ledger = &self.out.next.ledger;
        tally.count(ledger);
        *moved = moved.max(ledger.moved);
        env.step(&self.out.action)
    }
}

/// The change that an action of 1 asks for.
fn units(snapshot: &Snapshot, controller: &Controller) -> Result<Vec<f64>, VectorError> {
    if snapshot.manifest.task.idm.kind == IdmKind::Learned {
        return Ok(controller.normaliser().scale.iter().map(|s| 3.0 * s).collect());
    }
    Ok(limit_scale(&Parts::new(&snapshot.manifest)?, &snapshot.manifest)?)
}
