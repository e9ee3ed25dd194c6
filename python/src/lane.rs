//! One environment of a vector, with its buffers, its random stream and its time limit.

use nearl_runtime::{Controller, Noise, Output, State};
use nearl_trainer::env::{ChaCha8Rng, Env, EnvError, Fault, SeedableRng};
use nearl_trainer::foresight::{Foresight, Verdict};

/// When an episode that ended is begun anew (<https://farama.org/Vector-Autoreset-Mode>).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Autoreset {
    /// In the next step, whose action is ignored.
    NextStep,
    /// In the same step; the last observation of the old episode is kept aside.
    SameStep,
}

/// What a round does in every lane.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Work {
    /// Begins an episode.
    Reset,
    /// One action.
    Step(Autoreset),
}

/// What an action of a constrained environment is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Meaning {
    /// The next state, entry by entry.
    State,
    /// The change of the state, in units of [`Proposing::unit`].
    Change,
    /// What the actuators get, where the guard allows it.
    Action,
}

/// A controller between action and actuators.
///
/// Its own policy is all zeros with unit deviation, so that the noise it is given is what it puts out: the change that is
/// proposed, `proposal_k = s_k + scale_k noise_k`, or the action. Either takes the way that a policy's takes.
pub(crate) struct Proposing {
    pub(crate) meaning: Meaning,
    /// Change of an entry that an action of 1 asks for (n_state).
    pub(crate) unit: Vec<f64>,
    /// Asks the simulator where the action leads, instead of the robot model.
    pub(crate) foresight: Option<Foresight>,
    pub(crate) controller: Controller,
    pub(crate) scale: Vec<f64>,
    pub(crate) state: State,
    pub(crate) noise: Noise,
    pub(crate) out: Output,
}

/// What the projection did in a step, over its control ticks.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Projected {
    /// Ticks whose raw proposal broke a limit.
    pub(crate) raw_violations: u32,
    /// Ticks whose target broke a limit, by the independent check.
    pub(crate) target_violations: u32,
    /// Weighted distance between proposal and target, the largest.
    pub(crate) moved: f64,
}

/// One environment of a vector.
pub(crate) struct Lane {
    pub(crate) env: Box<dyn Env>,
    pub(crate) proposing: Option<Proposing>,
    pub(crate) rng: ChaCha8Rng,
    pub(crate) max_steps: usize,
    pub(crate) action: Vec<f64>,
    pub(crate) obs: Vec<f64>,
    pub(crate) final_obs: Option<Vec<f64>>,
    pub(crate) reward: f64,
    pub(crate) cost: f64,
    pub(crate) terminated: bool,
    pub(crate) truncated: bool,
    pub(crate) fault: Fault,
    pub(crate) projected: Projected,
    pub(crate) error: Option<EnvError>,
    ticks: usize,
    ended: bool,
}

impl Lane {
    pub(crate) fn new(
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
            projected: Projected::default(),
            error: None,
            ticks: 0,
            ended: false,
        }
    }

    pub(crate) fn run(&mut self, work: Work) {
        (self.reward, self.cost, self.final_obs) = (0.0, 0.0, None);
        (self.terminated, self.truncated) = (false, false);
        (self.fault, self.projected) = (Fault::None, Projected::default());
        match work {
            Work::Step(_) if !self.ended => self.step(),
            _ => self.reset(),
        }
        self.ended = self.terminated || self.truncated;
        if let (Work::Step(Autoreset::SameStep), true) = (work, self.ended) {
            self.final_obs = Some(self.obs.clone());
            self.reset();
            self.ended = false;
        }
    }

    /// Ends the episode here, as if the task had.
    pub(crate) fn end(&mut self, autoreset: Autoreset) {
        match autoreset {
            Autoreset::NextStep => self.ended = true,
            Autoreset::SameStep => self.reset(),
        }
    }

    /// An episode that begins in `qpos` and `qvel`, MuJoCo's convention.
    pub(crate) fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) -> Result<(), EnvError> {
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
                    let step = p.tick(&mut *self.env, &mut self.projected);
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
            Meaning::Action => {
                self.noise.action.iter_mut().zip(action).for_each(|(noise, a)| *noise = *a as f32);
            }
        }
    }

    fn tick(&mut self, env: &mut dyn Env, projected: &mut Projected) -> nearl_trainer::env::Step {
        if let Some(foresight) = &mut self.foresight {
            let verdict = foresight.update(env, &mut self.out.action);
            projected.raw_violations += u32::from(verdict != Verdict::Kept);
            projected.target_violations += u32::from(verdict == Verdict::Outside);
            return env.step(&self.out.action);
        }
        env.observe(&mut self.state.obs);
        env.state(&mut self.state.q, &mut self.state.v);
        self.controller.update(&self.state, &self.noise, &mut self.out);
        let ledger = &self.out.next.ledger;
        projected.raw_violations += u32::from(ledger.raw_violations.total() > 0);
        projected.target_violations += u32::from(ledger.violations.total() > 0);
        projected.moved = projected.moved.max(ledger.moved);
        env.step(&self.out.action)
    }
}
