//! Many environments of one task stepped in one call, on all cores, as vectors of other languages ask for them.
//!
//! An action is the actuators' own, or, with constraints, what a policy would propose or do ([`Meaning`]).

mod lane;
mod pool;
pub(crate) mod space;

use std::sync::MutexGuard;

use crate::env::{ChaCha8Rng, EnvError, SeedableRng};
use crate::rollout::{RolloutError, lacks_memory};
use crate::tasks::{self, TaskLoadError};
use crate::train::TrainError;
use lane::{Proposing, Round};
use nearl_runtime::SnapshotError;
use pool::Pool;
use space::Space;

pub use lane::{Autoreset, Lane, Meaning};

/// What stands between the actions of a vector and the actuators.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Constraints {
    /// The task's limits, and its analytic inverse dynamics where an action is a state.
    Task,
    /// The same with the inverse model of a trained agent's snapshot file.
    Agent(String),
}

/// A vector of environments.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Environments.
    pub num_envs: usize,
    /// Limits that hold; without any, an action is what the actuators get.
    pub constraints: Option<Constraints>,
    /// What an action is where limits hold.
    pub actions: Meaning,
    /// Seed of the first environment; the others follow.
    pub seed: u64,
    /// Threads at most.
    pub threads: usize,
    /// Control periods after which an episode is cut; the task's own if `None`.
    pub max_episode_steps: Option<usize>,
    /// How an ended episode is begun anew.
    pub autoreset: Autoreset,
}

/// Why there is no vector, or no step.
#[derive(Debug, thiserror::Error)]
pub enum VectorError {
    /// No environments.
    #[error("num_envs is 0; ask for at least one environment")]
    Empty,
    /// The task.
    #[error(transparent)]
    Task(#[from] TaskLoadError),
    /// An environment.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// A snapshot, or what the task alone makes.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    /// What the task alone makes.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A rollout.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// Threads.
    #[error("{0}")]
    Threads(String),
    /// What was asked for cannot be: one sentence.
    #[error("{0}")]
    Unusable(String),
}

/// `n` environments of one task.
pub struct Vector {
    pool: Pool,
    autoreset: Autoreset,
    n: usize,
    obs: Vec<String>,
    space: Space,
    dt: f64,
    notes: Vec<String>,
}

impl Vector {
    /// Makes the environments of a bundled task or a TOML file.
    ///
    /// # Errors
    /// [`VectorError`].
    pub fn new(task: &str, settings: &Settings) -> Result<Vector, VectorError> {
        if settings.num_envs == 0 {
            return Err(VectorError::Empty);
        }
        let first = tasks::env(task)?;
        let spec = first.spec().clone();
        let of_actuators = settings.actions.is_actuators();
        let open = match &settings.constraints {
            None => None,
            Some(Constraints::Task) if settings.actions == Meaning::Action => {
                Some(space::guarded_snapshot(task)?)
            }
            Some(Constraints::Task) if of_actuators => Some(space::limited_snapshot(task)?),
            Some(Constraints::Task) => Some(space::task_snapshot(task)?),
            Some(Constraints::Agent(_)) if of_actuators => {
                let reason =
                    "'guarded' and 'limited' actions need no trained agent; give constraints=\"task\"";
                return Err(VectorError::Unusable(reason.into()));
            }
            Some(Constraints::Agent(file)) => Some(space::agent_snapshot(&spec.name, file)?),
        };
        let space = match &open {
            Some(snapshot) if !of_actuators => Space::proposals(snapshot, settings.actions)?,
            _ => Space::actions(&spec),
        };
        let ticks = open.as_ref().map_or(1, |snapshot| snapshot.manifest.task.time.policy_every);
        let notes = open.as_ref().map_or(Ok(Vec::new()), |open| space::notes(open, &spec))?;
        let max_steps = settings.max_episode_steps.unwrap_or(spec.max_episode_steps);
        let lanes = (0..settings.num_envs as u64)
            .map(|i| {
                if i % 64 == 0
                    && let Some(free) = lacks_memory(0)
                {
                    return Err(VectorError::Unusable(format!(
                        "num_envs is {}, and environments after the first {i} would take more memory than the {free} MB that are free; ask for fewer",
                        settings.num_envs
                    )));
                }
                let (env, seed) = (first.another()?, settings.seed.wrapping_add(i));
                let proposing =
                    open.as_ref().map(|s| Proposing::new(s, &*env, settings.actions)).transpose()?;
                Ok(Lane::new(env, proposing, space.names.len(), max_steps, seed))
            })
            .collect::<Result<Vec<_>, VectorError>>()?;
        let pool = Pool::new(lanes, settings.threads).map_err(|e| VectorError::Threads(e.to_string()))?;
        let (obs, dt) = (spec.obs, spec.dt * ticks as f64);
        Ok(Vector { pool, autoreset: settings.autoreset, n: settings.num_envs, obs, space, dt, notes })
    }

    /// Begins an episode everywhere; `seeds` (n), if given, restart the random streams.
    ///
    /// # Errors
    /// [`VectorError::Env`] of a start, [`VectorError::Threads`], [`VectorError::Unusable`] for another number of seeds.
    pub fn reset(&mut self, seeds: Option<&[Option<u64>]>) -> Result<(), VectorError> {
        if let Some(seeds) = seeds {
            self.one_each("seeds", seeds.len())?;
            for (mut lane, seed) in self.pool.lanes().zip(seeds) {
                if let Some(seed) = seed {
                    lane.rng = ChaCha8Rng::seed_from_u64(*seed);
                }
            }
        }
        self.run(Round::Reset)
    }

    /// One step everywhere under `actions` (n x width, row by row); [`Vector::lanes`] then say what came of it.
    ///
    /// # Errors
    /// As [`Vector::reset`]; [`VectorError::Unusable`] for an entry that is not finite.
    ///
    /// # Panics
    /// When `actions` has another length.
    pub fn step(&mut self, actions: &[f64]) -> Result<(), VectorError> {
        let width = self.space.names.len();
        assert_eq!(actions.len(), self.n * width, "one action for each environment");
        if let Some(i) = actions.iter().position(|a| !a.is_finite()) {
            let (row, column) = (i / width, i % width);
            return Err(VectorError::Unusable(format!(
                "actions[{row}, {column}] ('{}') is {}: every entry must be finite; check the policy's output",
                self.space.names[column], actions[i]
            )));
        }
        for (mut lane, action) in self.pool.lanes().zip(actions.chunks(width)) {
            lane.action.copy_from_slice(action);
        }
        self.run(Round::Step(self.autoreset))
    }

    /// Ends the episodes chosen (n), as if the task had: by the autoreset mode, a new one begins in the next step, or at once.
    ///
    /// # Errors
    /// As [`Vector::reset`].
    pub fn end(&mut self, ended: &[bool]) -> Result<(), VectorError> {
        self.one_each("flags", ended.len())?;
        for (mut lane, _) in self.pool.lanes().zip(ended).filter(|(_, ended)| **ended) {
            lane.end(self.autoreset);
        }
        self.refused()
    }

    /// Puts environment `index` into a state, MuJoCo's convention; an episode begins there.
    ///
    /// # Errors
    /// [`VectorError::Env`] for a state that it does not take, [`VectorError::Unusable`] for an index beyond the last.
    pub fn set_state(&mut self, index: usize, qpos: &[f64], qvel: &[f64]) -> Result<(), VectorError> {
        let n = self.n;
        let beyond = || format!("environment {index} of {n} does not exist; count from 0");
        let mut lane = self.pool.lanes().nth(index).ok_or_else(|| VectorError::Unusable(beyond()))?;
        Ok(lane.set_state(qpos, qvel)?)
    }

    fn run(&mut self, round: Round) -> Result<(), VectorError> {
        self.pool.run(round).map_err(VectorError::Threads)?;
        self.refused()
    }

    fn refused(&self) -> Result<(), VectorError> {
        match self.pool.lanes().find_map(|mut lane| lane.error.take()) {
            Some(error) => Err(error.into()),
            None => Ok(()),
        }
    }

    fn one_each(&self, what: &str, given: usize) -> Result<(), VectorError> {
        let n = self.n;
        match given == n {
            true => Ok(()),
            false => {
                Err(VectorError::Unusable(format!("{given} {what} for {n} environments; give one each")))
            }
        }
    }

    /// The environments as the last step left them.
    pub fn lanes(&self) -> impl Iterator<Item = MutexGuard<'_, Lane>> {
        self.pool.lanes()
    }

    /// Number of environments.
    pub fn n(&self) -> usize {
        self.n
    }

    /// Entries of an observation.
    pub fn n_obs(&self) -> usize {
        self.obs.len()
    }

    /// What each entry of an observation is.
    pub fn obs_names(&self) -> &[String] {
        &self.obs
    }

    /// What each entry of an action is: an actuator, or an entry of the proposed state.
    pub fn action_names(&self) -> &[String] {
        &self.space.names
    }

    /// Smallest and largest action.
    pub fn action_range(&self) -> (&[f64], &[f64]) {
        (&self.space.low, &self.space.high)
    }

    /// What of the robot file the limits do not reckon with, and limits that are hardly meant, one sentence each; where the robot model tells what
    /// actions lead to.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Time of one step \[s\].
    pub fn dt(&self) -> f64 {
        self.dt
    }
}
