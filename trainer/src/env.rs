//! Tasks: a robot in MuJoCo, what it observes, what it is rewarded for.
//!
//! [`make`] builds one by name. The four locomotion tasks equal Gymnasium 1.4.0's v5 environments step for step (bit-equal
//! states, rewards to rounding) on MuJoCo 3.17.0. A time limit is no termination: the caller counts steps against
//! [`Spec::max_episode_steps`] and keeps the two apart.
//!
//! A new native task is one file with an `impl` of `Rules` and one line in [`REGISTRY`]; a user's own is a task file
//! ([`of_task`]).

pub mod bench;

mod ant;
mod commands;
mod half_cheetah;
mod hopper;
mod meter;
mod panda_reach;
mod planar;
mod robot_check;
mod rules;
mod simulated;
mod spec;
mod user;
mod walker2d;

use nearl_runtime::Manifest;
use nearl_runtime::constraints::Model;
use nearl_runtime::snapshot::Simulation;
use nearl_runtime::task::{IdmKind, Task};

use crate::mj::{MjError, ModelFormat, Sim};
use crate::robot;

pub use meter::{Excess, LimitError, Limits, Meter, Worst};
pub use rand_chacha::ChaCha8Rng;
pub use rand_chacha::rand_core::SeedableRng;
pub(crate) use simulated::convert;
use spec::EPISODE;
pub use spec::Spec;

/// What one control period gave.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// Reward of the period; 0 where `fault` is not [`Fault::None`].
    pub reward: f64,
    /// What the task's `[cost]` counts in the period; 0 where it has none.
    pub cost: f64,
    /// The episode ended in this state: no value is to be bootstrapped from it. True at every fault.
    pub terminated: bool,
    /// Whether the physics can be believed.
    pub fault: Fault,
}

/// A state as a plant sends it.
#[derive(Debug, Clone, Copy)]
pub struct Moment<'a> {
    /// Configuration (nq), Pinocchio's convention.
    pub q: &'a [f64],
    /// Velocity (nv), Pinocchio's convention.
    pub v: &'a [f64],
    /// Observation (n_obs); the goal is read from it.
    pub obs: &'a [f64],
    /// The plant's own time \[s\].
    pub time: f64,
}

/// Why a control period is not to be believed. The robot then needs [`Env::reset`] or [`Env::set_state`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// All is well.
    None,
    /// The action held NaN or infinity; nothing was simulated.
    Action,
    /// The state became non-finite or huge; MuJoCo put the robot back to its initial configuration (from where Gymnasium
    /// would go on in silence).
    Unstable,
    /// MuJoCo stopped with an error ([`Env::last_error`] has its words); the robot is back at its initial configuration.
    Engine,
}

/// Counts since the environment was made.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counters {
    /// Control periods simulated.
    pub steps: u64,
    /// Action entries outside their range, hence clamped by the plant.
    pub saturations: u64,
    /// Periods with a [`Fault`].
    pub faults: u64,
}

/// A task on one simulated robot. One thread at a time; give each thread its own.
///
/// # Example
/// ```no_run
/// use nearl_trainer::env::{self, ChaCha8Rng, SeedableRng};
/// # fn main() -> Result<(), env::EnvError> {
/// let mut env = env::make("HalfCheetah-v5")?;
/// let mut obs = vec![0.0; env.spec().n_obs()];
/// env.reset(&mut ChaCha8Rng::seed_from_u64(0))?;
/// for _ in 0..env.spec().max_episode_steps {
///     env.observe(&mut obs);
///     let step = env.step(&[0.1; 6]);
///     println!("{} {}", step.reward, step.terminated);
/// }
/// # Ok(()) }
/// ```
pub trait Env: Send {
    /// Names, sizes, times and ranges.
    fn spec(&self) -> &Spec;

    /// Starts an episode from the task's own distribution.
    ///
    /// # Errors
    /// [`EnvError::Physics`] when MuJoCo cannot evaluate the state.
    fn reset(&mut self, rng: &mut ChaCha8Rng) -> Result<(), EnvError>;

    /// Starts an episode from `qpos` (nq) and `qvel` (nv) in MuJoCo's convention. What follows depends on these, the goal
    /// and the actions alone.
    ///
    /// # Errors
    /// [`EnvError::Physics`] for a wrong length or an entry that is not finite (the state is then unchanged).
    fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) -> Result<(), EnvError>;

    /// Sets the time in the episode \[s\], which [`Env::set_state`] begins at 0.
    fn set_time(&mut self, time: f64);

    /// Simulates one control period ([`Spec::dt`]) under `action` (n_act), held constant and clamped to its range by the
    /// plant.
    ///
    /// # Panics
    /// When `action` has not [`Spec::n_act`] entries.
    fn step(&mut self, action: &[f64]) -> Step;

    /// Simulates a control period under `action` (n_act) beside the environment, which stays as it is, and writes the state it ends in: `qpos` (nq)
    /// and `qvel` (nv) in MuJoCo's convention. A [`Env::step`] with the same bits that follows takes this one over. False when the physics
    /// cannot be believed, and nothing is written.
    fn foresee(&mut self, action: &[f64], qpos: &mut [f64], qvel: &mut [f64]) -> bool;

    /// Writes what the motors do (nv) [N·m or N] under `action` (n_act) in a state `q` (nq), `v` (nv) of Pinocchio's convention, beside the
    /// environment, which stays as it is.
    ///
    /// # Errors
    /// [`EnvError::Physics`] for a wrong length or an entry that is not finite.
    ///
    /// # Panics
    /// When `action` has not [`Spec::n_act`] entries.
    fn motor_forces(
        &mut self,
        q: &[f64],
        v: &[f64],
        action: &[f64],
        force: &mut [f64],
    ) -> Result<(), EnvError>;

    /// What a control period would have given that led from `from` to `to` under `action` (n_act): the task's own reward and end
    /// of what happened elsewhere, on a robot or in another process. The environment is left in `to`, with its goal. Rewards of
    /// contact forces are those of `to` at rest in its contacts, as far as MuJoCo can tell from the state alone.
    ///
    /// # Errors
    /// [`EnvError::Physics`] for a wrong length or an entry that is not finite.
    fn score(&mut self, from: &Moment<'_>, to: &Moment<'_>, action: &[f64]) -> Result<Step, EnvError>;

    /// Writes the observation (n_obs), in the order of [`Spec::obs`].
    fn observe(&self, obs: &mut [f64]);

    /// Writes `q` (nq) and `v` (nv) in Pinocchio's convention, joints in MuJoCo's order ([`Spec::joints`]): equal to
    /// [`Env::qpos`] and [`Env::qvel`] but for a free joint, whose quaternion is `x y z w` (and of unit length) and whose
    /// linear velocity is in the body's frame. With noise or a delay it is what is measured.
    fn state(&self, q: &mut [f64], v: &mut [f64]);

    /// The same as it is, whatever lies between the robot and its controller.
    fn actual_state(&self, q: &mut [f64], v: &mut [f64]);

    /// Configuration (nq), MuJoCo's convention.
    fn qpos(&self) -> &[f64] {
        self.sim().qpos()
    }

    /// Velocity (nv), MuJoCo's convention.
    fn qvel(&self) -> &[f64] {
        self.sim().qvel()
    }

    /// Whether the forces of the motors cannot be found again from motion and robot file: the robot is another one, or somebody pushes it.
    fn is_disturbed(&self) -> bool {
        false
    }

    /// The simulation, for those who watch it: the plant process, the limit meter, tests.
    fn sim(&self) -> &Sim;

    /// Velocity (nv) at the end of the last step, before what the task changes by itself for the next, as a push: what its action led to.
    fn ended(&self) -> &[f64] {
        self.sim().qvel()
    }

    /// What the task asks for (empty where it has no goal). With `qpos` and `qvel` it makes an episode repeatable.
    fn goal(&self) -> &[f64];

    /// Sets the goal.
    ///
    /// # Errors
    /// [`EnvError::Goal`] when the task has none or one of another length; [`EnvError::Physics`] when it is not finite.
    fn set_goal(&mut self, goal: &[f64]) -> Result<(), EnvError>;

    /// What the present episode drew beside its start and its goal; empty where a task draws nothing else. With `qpos`, `qvel` and the goal
    /// it makes an episode repeatable.
    fn circumstances(&self) -> Vec<f64> {
        Vec::new()
    }

    /// Sets what [`Env::circumstances`] gave, for the episode that [`Env::set_state`] begins next.
    fn set_circumstances(&mut self, _circumstances: &[f64]) {}

    /// Puts the task's curriculum, if it has one, at its start; from then on it rises and falls with the episodes. Without this call
    /// everything is drawn as at the curriculum's top.
    fn start_curriculum(&mut self) {}

    /// Writes what the value alone may see, in the order of [`Spec::privileged`].
    fn privileged(&self, _to: &mut [f64]) {}

    /// Sums of the named parts of the reward since the episode began, and what else is told of it, in the order of [`Spec::notes`].
    fn notes(&self) -> &[f64] {
        &[]
    }

    /// Counts since the environment was made.
    fn counters(&self) -> Counters;

    /// MuJoCo's words at the last [`Fault::Engine`].
    fn last_error(&self) -> Option<&MjError>;

    /// The robot file's text.
    fn model_text(&self) -> &str;

    /// The robot file's language.
    fn model_format(&self) -> ModelFormat;

    /// The same task once more, sharing the compiled robot: cheaper than [`make`].
    ///
    /// # Errors
    /// [`EnvError::Physics`] when there is no memory for it.
    fn another(&self) -> Result<Box<dyn Env>, EnvError>;
}

/// Why a task could not be made or set.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EnvError {
    /// No task of this name.
    #[error("there is no task '{name}': {}", nearest(near))]
    Unknown {
        /// What was asked for.
        name: String,
        /// Names like it, the most alike first.
        near: Vec<&'static str>,
    },
    /// The robot file or the state is not acceptable to MuJoCo.
    #[error("task '{task}': {source}")]
    Physics {
        /// The task.
        task: String,
        /// MuJoCo's side of it.
        source: MjError,
    },
    /// A section of a task file that describes an environment.
    #[error("{origin} [{key}]: {reason}")]
    Task {
        /// The file, or the task where it came out of a snapshot.
        origin: String,
        /// The key.
        key: String,
        /// One sentence.
        reason: String,
    },
    /// A goal the task cannot have.
    #[error("task '{task}' has a goal of {expected} entries, not {got}")]
    Goal {
        /// The task.
        task: String,
        /// Entries of its goal, 0 when it has none.
        expected: usize,
        /// Entries given.
        got: usize,
    },
}

fn nearest(near: &[&str]) -> String {
    match near {
        [] => format!("it is one of {}", names().collect::<Vec<_>>().join(", ")),
        near => format!("did you mean '{}'?", near.join("' or '")),
    }
}

/// A task, or why there is none.
type Made = Result<Box<dyn Env>, EnvError>;

/// A task that can be made by name.
pub struct Registered {
    /// Its name.
    pub name: &'static str,
    /// What it is, in one line.
    pub about: &'static str,
    /// Control periods in an episode.
    pub max_episode_steps: usize,
    build: fn() -> Made,
    /// The same with a control period of one physics step of any length [s], where the task allows it.
    build_at: Option<fn(f64) -> Made>,
}

impl Registered {
    const fn fixed(name: &'static str, about: &'static str, build: fn() -> Made) -> Registered {
        Registered { name, about, max_episode_steps: EPISODE, build, build_at: None }
    }
}

/// Every task.
pub const REGISTRY: &[Registered] = &[
    Registered::fixed(half_cheetah::NAME, half_cheetah::ABOUT, half_cheetah::build),
    Registered::fixed(hopper::NAME, hopper::ABOUT, hopper::build),
    Registered::fixed(walker2d::NAME, walker2d::ABOUT, walker2d::build),
    Registered::fixed(ant::NAME, ant::ABOUT, ant::build),
    Registered {
        build_at: Some(panda_reach::build_at),
        max_episode_steps: panda_reach::periods(panda_reach::DT),
        ..Registered::fixed(panda_reach::NAME, panda_reach::ABOUT, panda_reach::build)
    },
];

/// Names of all tasks.
pub fn names() -> impl Iterator<Item = &'static str> {
    REGISTRY.iter().map(|entry| entry.name)
}

/// Makes a task. Its state is the robot's initial configuration until [`Env::reset`] or [`Env::set_state`].
///
/// # Errors
/// [`EnvError::Unknown`] with the names that look alike; [`EnvError::Physics`] when its robot does not compile.
pub fn make(name: &str) -> Result<Box<dyn Env>, EnvError> {
    (entry(name)?.build)()
}

fn entry(name: &str) -> Result<&'static Registered, EnvError> {
    let unknown = || EnvError::Unknown { name: name.to_owned(), near: near_names(name) };
    REGISTRY.iter().find(|entry| entry.name == name).ok_or_else(unknown)
}

/// Makes the environment of a task: the user's own if it has a `[reward]`, else the native one it names with `env`, or by its own
/// name. `origin` is the file or task in messages.
///
/// # Errors
/// As [`make`]; [`EnvError::Task`] names the key that is wrong.
pub fn of_task(manifest: &Manifest, origin: &str) -> Result<Box<dyn Env>, EnvError> {
    let task = &manifest.task;
    if user::is_own(task) {
        return of_user(manifest, origin);
    }
    if manifest.algo == "import" && !is_known(task) {
        let reason = "an imported policy has no task of its own to be simulated in; import it with --recipe FILE.toml that has [reward], or run it with \
                      'nearl run'";
        return Err(EnvError::Task { origin: origin.into(), key: "reward".into(), reason: reason.into() });
    }
    let own = [
        ("termination", !task.termination.is_empty()),
        ("reset", !task.reset.is_empty()),
        ("time.max_episode_steps", task.time.max_episode_steps.is_some()),
    ];
    if let Some((key, _)) = own.iter().find(|(_, given)| *given) {
        let reason = "only a task with its own [reward] has it, the native environments bring theirs; add [reward] or take it out";
        return Err(EnvError::Task { origin: origin.into(), key: (*key).into(), reason: reason.into() });
    }
    if task.env.is_none() && manifest.simulation.is_some() && !is_known(task) {
        let reason = "there is none, so that nothing can be earned with this robot; add [reward], or run it with 'nearl plant' and 'nearl run'";
        return Err(EnvError::Task { origin: origin.into(), key: "reward".into(), reason: reason.into() });
    }
    let (entry, time) = (entry(task.env.as_deref().unwrap_or(&task.name))?, &task.time);
    let env = match entry.build_at {
        Some(build_at) if time.dt == time.sim_dt => build_at(time.dt)?,
        _ => (entry.build)()?,
    };
    check_time(task, env.spec(), origin)?;
    check_robot(manifest, env.as_ref(), origin)?;
    commands::check(manifest, env.as_ref(), origin)?;
    user::with_cost(env, task, origin)
}

/// The environment of a plant: that of the task, or a robot without reward, which starts anew only where it cannot be simulated.
///
/// # Errors
/// As [`of_task`].
pub fn of_plant(manifest: &Manifest, origin: &str) -> Result<Box<dyn Env>, EnvError> {
    if is_known(&manifest.task) { of_task(manifest, origin) } else { of_user(manifest, origin) }
}

fn of_user(manifest: &Manifest, origin: &str) -> Result<Box<dyn Env>, EnvError> {
    let env = user::build(manifest, origin)?;
    commands::check(manifest, env.as_ref(), origin)?;
    Ok(env)
}

/// Whether a task file describes or names an environment: by `[reward]`, by `env`, or by the name of a native one.
pub fn is_known(task: &Task) -> bool {
    user::is_own(task) || task.env.is_some() || entry(&task.name).is_ok()
}

/// Control period and physics step \[s\] of the native environment that a task names, the step 0 where it is none that the projector can
/// count on; `None` for a task of one's own and for one without an environment.
pub fn own_time(task: &Task) -> Option<(f64, f64)> {
    if user::is_own(task) {
        return None;
    }
    let env = (entry(task.env.as_deref().unwrap_or(&task.name)).ok()?.build)().ok()?;
    let spec = env.spec();
    Some((spec.dt, if spec.semi_implicit_euler { spec.sim_dt } else { 0.0 }))
}

/// Says so where limits reckon with constant acceleration over a period and the simulation makes physics steps of it that they could count on.
pub fn unstated_steps(manifest: &Manifest, spec: &Spec) -> Option<String> {
    let task = &manifest.task;
    let by_forces = manifest.guards() || (manifest.proposes() && task.idm.kind == IdmKind::Pinocchio);
    (by_forces && user::is_own(task) && spec.semi_implicit_euler && task.time.sim_dt == 0.0).then(|| {
        format!(
            "time.sim_dt is 0 or not stated: limits reckon with constant acceleration, as of a robot, and the simulated robot, which makes Euler steps of {} \
             s, leaves them by the difference; write sim_dt = {} under [time] for this simulation",
            spec.sim_dt, spec.sim_dt
        )
    })
}

/// The constraints reckon with the task's periods: what is simulated must have them.
fn check_time(task: &Task, spec: &Spec, origin: &str) -> Result<(), EnvError> {
    let time = &task.time;
    let differs = |given: f64, own: f64| (given - own).abs() > 1e-12;
    let (key, given, own) = if differs(time.dt, spec.dt) {
        ("time.dt", time.dt, spec.dt)
    } else if time.sim_dt != 0.0 && differs(time.sim_dt, spec.sim_dt) {
        ("time.sim_dt", time.sim_dt, spec.sim_dt)
    } else {
        return Ok(());
    };
    let any = entry(&spec.name).is_ok_and(|entry| entry.build_at.is_some());
    let or = if any { ", or the same number for time.dt and time.sim_dt" } else { "" };
    let reason = format!("{given} s, but the environment '{}' simulates {own} s; write that{or}", spec.name);
    Err(EnvError::Task { origin: origin.into(), key: key.into(), reason })
}

/// A native environment brings its robot: constraints for another one would hold nowhere.
fn check_robot(manifest: &Manifest, env: &dyn Env, origin: &str) -> Result<(), EnvError> {
    if manifest.simulation.as_ref().is_some_and(|given| given.text == env.model_text()) {
        return Ok(());
    }
    let Some((file, _)) = manifest.task.model.file() else { return Ok(()) };
    let own = Simulation { format: env.model_format(), text: env.model_text().to_string(), folder: None };
    let own = robot::describe(&own, manifest.task.model.free_flyer).map(Model::from_description);
    // A robot of which no model can be built is refused, with the reason, where the constraints are built.
    let (Ok(given), Ok(Ok(own))) = (Model::from_description(manifest.robot.clone()), own) else {
        return Ok(());
    };
    let Some(what) = robot_check::difference(&given, &own) else { return Ok(()) };
    let reason = format!(
        "the environment '{}' simulates a robot of its own, from which '{file}' differs in {what}; leave that file as it is, or \
         describe the task of another robot with [reward]",
        env.spec().name
    );
    Err(EnvError::Task { origin: origin.into(), key: "model".into(), reason })
}

fn near_names(name: &str) -> Vec<&'static str> {
    let asked = name.to_lowercase();
    let mut scored: Vec<_> = names().map(|n| (strsim::jaro(&asked, &n.to_lowercase()), n)).collect();
    scored.retain(|(score, _)| *score > 0.75);
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    scored.into_iter().map(|(_, n)| n).take(2).collect()
}
