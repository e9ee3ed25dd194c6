//! The task file: robot, time, state, constraints, inverse dynamics. `[train]` is kept for the trainer.
//!
//! An unknown key, a wrong type or a value out of range is one sentence with file, line and key.

pub mod names;
mod wrong;

use crate::command::CommandSection;
use crate::recipe::PolicySection;
use crate::snapshot::ModelFormat;
use nearl_constraints::description::FrictionLaw;
use nearl_constraints::{ConstraintSettings, Period};
use serde::{Deserialize, Serialize};
use std::path::Path;
use wrong::{Step, bracket, first_line, first_odd, line_of, line_of_key, listed, odd, steps};
pub use wrong::{place, suggest};

/// The whole task file.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Task {
    /// Name of the task; where neither `env` nor `[reward]` is given, also of the native environment, e.g. `HalfCheetah-v5`.
    pub name: String,
    /// Native environment that the task adds constraints or a cost to; that of `name` when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub env: Option<String>,
    /// The robot file.
    pub model: ModelSection,
    /// Periods.
    #[serde(default)]
    pub time: TimeSection,
    /// Observation, proposal and controllable subset.
    #[serde(default)]
    pub state: StateSection,
    /// Named expressions whose sum is the reward: makes the task an environment of its own. These four sections are kept for
    /// the trainer, which reads and checks them.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub reward: toml::Table,
    /// Named expressions whose sum is counted beside the reward.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub cost: toml::Table,
    /// Named conditions any of which ends an episode.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub termination: toml::Table,
    /// How an episode starts.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub reset: toml::Table,
    /// Floor, feet and drives beside the robot file, for the trainer as the four sections above.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub scene: toml::Table,
    /// What the robot is asked to do, drawn as an episode goes on.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub commands: toml::Table,
    /// Sudden changes of velocity.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub pushes: toml::Table,
    /// How the robot differs from episode to episode.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub random: toml::Table,
    /// What is added to what is measured of the robot.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub noise: toml::Table,
    /// How late actions arrive and the state is known.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub delay: toml::Table,
    /// When what is drawn becomes harder.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub curriculum: toml::Table,
    /// Named expressions that are told of each episode beside the reward.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub metrics: toml::Table,
    /// What the joints are commanded.
    #[serde(default, skip_serializing_if = "CommandSection::is_effort")]
    pub command: CommandSection,
    /// How a policy made elsewhere sees the state, and what its outputs mean.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub policy: Option<PolicySection>,
    /// Prior constraints.
    pub constraints: ConstraintSettings,
    /// Inverse dynamics.
    pub idm: IdmSection,
    /// Settings of the learner; the trainer reads and checks them.
    #[serde(default)]
    pub train: toml::Table,
}

/// `[model]`: exactly one of `urdf` and `mjcf`.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ModelSection {
    /// URDF file, relative to the task file, or the name of a bundled robot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub urdf: Option<String>,
    /// MJCF file, relative to the task file, or the name of a bundled robot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mjcf: Option<String>,
    /// The base of the URDF floats instead of being fixed to the world.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub free_flyer: bool,
    /// What the dry friction of the joints is taken to be: `mujoco` or `coulomb`.
    #[serde(default, skip_serializing_if = "is_mujoco")]
    pub friction: FrictionLaw,
}

fn is_mujoco(law: &FrictionLaw) -> bool {
    *law == FrictionLaw::Mujoco
}

impl ModelSection {
    /// The robot file and its language; none where the section names no file, which [`Task::parse`] refuses.
    pub fn file(&self) -> Option<(&str, ModelFormat)> {
        let urdf = self.urdf.as_deref().map(|file| (file, ModelFormat::Urdf));
        urdf.or(self.mjcf.as_deref().map(|file| (file, ModelFormat::Mjcf)))
    }
}

/// `[time]`.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct TimeSection {
    /// Control period in \[s\]; of a native environment its own when absent.
    #[serde(default = "unstated", deserialize_with = "stated")]
    pub dt: f64,
    /// The policy proposes every k-th control tick; its proposal is for the end of those k ticks.
    #[serde(default = "one")]
    pub policy_every: usize,
    /// Physics step of the plant in \[s\]; 0 for a zero-order-hold plant (a robot, or RK4). Of a native environment its own when absent.
    #[serde(default = "unstated", deserialize_with = "stated")]
    pub sim_dt: f64,
    /// Control ticks after which an episode of the user's own environment is cut.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_episode_steps: Option<usize>,
}

impl Default for TimeSection {
    /// Nothing but the policy's period is stated.
    fn default() -> Self {
        TimeSection { dt: unstated(), policy_every: one(), sim_dt: unstated(), max_episode_steps: None }
    }
}

/// A period that the file leaves to its environment.
fn unstated() -> f64 {
    f64::NAN
}

/// A period that the file states; one that is not a number would pass for one that it does not.
fn stated<'de, D: serde::Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    let seconds = f64::deserialize(from)?;
    match seconds.is_nan() {
        true => Err(serde::de::Error::custom("NaN s is no period; give seconds")),
        false => Ok(seconds),
    }
}

/// Control period and physics step \[s\] of the environment that a task names, for those that its file does not state; `None` where the file
/// has to state them.
pub type OwnTime<'a> = &'a dyn Fn(&Task) -> Option<(f64, f64)>;

/// `[state]`: entries by name, see [`nearl_constraints::StateLayout`].
#[derive(Clone, Debug, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct StateSection {
    /// Every observation entry, in the environment's order; the environment's own names when absent.
    #[serde(default, deserialize_with = "names::list")]
    pub observation: Vec<String>,
    /// Expressions that the value sees beside what the policy sees, in training alone.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub privileged: Vec<String>,
    /// Entries the policy proposes; all when absent.
    #[serde(default, deserialize_with = "names::optional", skip_serializing_if = "Option::is_none")]
    pub propose: Option<Vec<String>>,
    /// Joints the projector may move; all proposed joints when absent.
    #[serde(default, deserialize_with = "names::optional", skip_serializing_if = "Option::is_none")]
    pub controllable: Option<Vec<String>>,
}

/// `[idm]`.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct IdmSection {
    /// Where the action comes from.
    pub kind: IdmKind,
    /// What a learned model sees.
    #[serde(default)]
    pub input: IdmInput,
}

/// Kinds of inverse dynamics.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum IdmKind {
    /// A Gaussian network I(a | s_c, s'_c).
    Learned,
    /// Recursive Newton-Euler on the robot model: torque for the projected acceleration.
    Pinocchio,
}

/// Entries of state and target that a learned inverse model sees.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase", expecting = "expected \"controllable\", \"full\" or a list of names")]
pub enum IdmInput {
    /// The controllable subset S_c.
    #[default]
    Controllable,
    /// Every proposed entry.
    Full,
    /// Entries by name.
    #[serde(untagged, deserialize_with = "names::list")]
    Names(Vec<String>),
}

/// Why a task file was refused.
#[derive(Debug, thiserror::Error)]
pub enum TaskError {
    /// The file cannot be read.
    #[error("cannot read task file '{file}': {reason}; give a task name (see 'nearl tasks') or a TOML file")]
    Unreadable {
        /// Path as given.
        file: String,
        /// What the system said.
        reason: String,
    },
    /// The text is not a task.
    #[error("{file}{place}: {reason}")]
    Invalid {
        /// Path or task name.
        file: String,
        /// `:line` and key where known.
        place: String,
        /// One sentence.
        reason: String,
    },
    /// A `--set` that cannot be applied.
    #[error("--set {set}: {reason}")]
    Override {
        /// As written.
        set: String,
        /// One sentence.
        reason: String,
    },
}

/// Longest period of a policy in control ticks.
const MOST_TICKS: usize = 100_000;

impl Task {
    /// Reads `path` and applies `overrides` (`constraints.velocity.scale=0.8`).
    ///
    /// # Errors
    /// [`TaskError`] naming file, line and key.
    pub fn read(path: &Path, overrides: &[String]) -> Result<Self, TaskError> {
        Self::read_with(path, overrides, &|_| None)
    }

    /// The same where the environments are known, whose periods need not be stated.
    ///
    /// # Errors
    /// As [`Task::read`].
    pub fn read_with(path: &Path, overrides: &[String], own: OwnTime<'_>) -> Result<Self, TaskError> {
        let file = path.display().to_string();
        let text = nearl_constraints::read_task_text(path)
            .map_err(|e| TaskError::Unreadable { file: file.clone(), reason: e.to_string() })?;
        Self::parse_with(&file, &text, overrides, own)
    }

    /// The same from text; `file` is the name used in messages.
    ///
    /// # Errors
    /// As [`Task::read`].
    pub fn parse(file: &str, text: &str, overrides: &[String]) -> Result<Self, TaskError> {
        Self::parse_with(file, text, overrides, &|_| None)
    }

    /// The same where the environments are known, whose periods need not be stated.
    ///
    /// # Errors
    /// As [`Task::read`].
    pub fn parse_with(
        file: &str,
        text: &str,
        overrides: &[String],
        own: OwnTime<'_>,
    ) -> Result<Self, TaskError> {
        let mut table = Self::table(file, text)?;
        for set in overrides {
            apply(&mut table, set)?;
        }
        if let Some((path, value)) = first_odd(&table) {
            let line = if overrides.is_empty() { line_of_key(text, &path).0 } else { String::new() };
            return Err(odd(file, &line, &path, value));
        }
        if let Some((key, reason)) = listed(&table) {
            return Err(TaskError::Invalid {
                file: file.into(),
                place: bracket(&key),
                reason: reason.into(),
            });
        }
        let mut task: Task = serde_path_to_error::deserialize(table).map_err(|e| {
            let key = e.path().to_string();
            let below = overrides.iter().find(|set| set.trim_start().starts_with(&format!("{key}.")));
            if let (Some(set), Some(last)) = (below, key.rsplit('.').next())
                && e.inner().message().starts_with("invalid type: map")
            {
                let reason = format!("'{last}' is a value, not a section");
                return TaskError::Override { set: set.clone(), reason };
            }
            let line =
                if overrides.is_empty() { line_of_key(text, &steps(e.path())).0 } else { String::new() };
            let place = format!("{line}{}", bracket(&key));
            TaskError::Invalid { file: file.into(), place, reason: suggest(e.into_inner().message()) }
        })?;
        task.state_time(own);
        task.check(file)?;
        Ok(task)
    }

    /// A task whose sections several files said, each `(name, text)`, later ones over earlier ones. What is wrong is told with the line of the last
    /// file that says it.
    ///
    /// # Errors
    /// As [`Task::read`].
    pub fn merged(table: toml::Table, files: &[(String, String)]) -> Result<Self, TaskError> {
        let last = files.last().map_or("", |(file, _)| file.as_str());
        let said_at = |path: &[Step]| {
            let found = files.iter().map(|(file, text)| (file.as_str(), line_of_key(text, path)));
            let (file, (line, depth)) =
                found.max_by_key(|(_, (_, depth))| *depth).unwrap_or((last, (String::new(), 0)));
            if depth == 0 { (last, String::new()) } else { (file, line) }
        };
        if let Some((path, value)) = first_odd(&table) {
            let (file, line) = said_at(&path);
            return Err(odd(file, &line, &path, value));
        }
        let task: Task = serde_path_to_error::deserialize(table).map_err(|e| {
            let (file, line) = said_at(&steps(e.path()));
            let place = format!("{line}{}", bracket(&e.path().to_string()));
            TaskError::Invalid { file: file.into(), place, reason: suggest(e.into_inner().message()) }
        })?;
        task.check(last)?;
        Ok(task)
    }

    /// The sections of a text; `file` is the name used in messages.
    ///
    /// # Errors
    /// [`TaskError::Invalid`] for what is no TOML, with its line.
    pub fn table(file: &str, text: &str) -> Result<toml::Table, TaskError> {
        toml::from_str(text).map_err(|e| TaskError::Invalid {
            file: file.into(),
            place: line_of(text, e.span()),
            reason: first_line(e.message()),
        })
    }

    /// Takes what the file leaves out from the environment.
    fn state_time(&mut self, own: OwnTime<'_>) {
        if (self.time.dt.is_nan() || self.time.sim_dt.is_nan())
            && let Some((dt, sim_dt)) = own(self)
        {
            let time = &mut self.time;
            time.dt = if time.dt.is_nan() { dt } else { time.dt };
            time.sim_dt = if time.sim_dt.is_nan() { sim_dt } else { time.sim_dt };
        }
    }

    /// The section `[constraints]` of the TOML file `path`: a task file, or one with that section alone.
    ///
    /// # Errors
    /// As [`Task::read`].
    pub fn read_constraints(path: &Path) -> Result<ConstraintSettings, TaskError> {
        let file = path.display().to_string();
        let text = nearl_constraints::read_task_text(path)
            .map_err(|e| TaskError::Unreadable { file: file.clone(), reason: e.to_string() })?;
        let at = |place, reason| TaskError::Invalid { file: file.clone(), place, reason };
        let mut table = Self::table(&file, &text)?;
        if let Some((path, value)) = first_odd(&table) {
            return Err(odd(&file, &line_of_key(&text, &path).0, &path, value));
        }
        if let Some((key, reason)) = listed(&table) {
            return Err(at(bracket(&key), reason.into()));
        }
        let Some(section) = table.remove("constraints") else {
            return Err(at(String::new(), "it has no section [constraints]; write one".into()));
        };
        Self::constraints_of(section)
            .map_err(|(key, reason)| at(bracket(&format!("constraints.{key}")), reason))
    }

    /// What a section `[constraints]` says.
    ///
    /// # Errors
    /// The key, and a sentence.
    pub fn constraints_of(section: toml::Value) -> Result<ConstraintSettings, (String, String)> {
        serde_path_to_error::deserialize(section)
            .map_err(|e| (e.path().to_string(), suggest(e.into_inner().message())))
    }

    /// Physics sub-steps in one control period; 0 for a zero-order-hold plant.
    pub fn sub_steps(&self) -> usize {
        if self.time.sim_dt == 0.0 { 0 } else { (self.time.dt / self.time.sim_dt).round() as usize }
    }

    /// The control period with its sub-steps.
    pub fn period(&self) -> Period {
        Period::new(self.time.dt, self.sub_steps() as u32)
    }

    /// Refuses what no task can have; `file` is named.
    pub(crate) fn check(&self, file: &str) -> Result<(), TaskError> {
        let refuse = |key: &str, reason: String| {
            Err(TaskError::Invalid { file: file.into(), place: format!(" [{key}]"), reason })
        };
        let is_path = self.name.contains(['/', '\\']) || matches!(self.name.trim(), "" | "." | "..");
        if is_path {
            return refuse(
                "name",
                format!("'{}' must name a folder of runs; write it without '/' and '\\'", self.name),
            );
        }
        let t = &self.time;
        for (key, value, what) in
            [("time.dt", t.dt, "the control period"), ("time.sim_dt", t.sim_dt, "the physics step, or 0")]
        {
            if value.is_nan() {
                let whose = "only a task of a native environment may leave it out";
                return refuse(key, format!("{what} is not stated, and {whose}; give seconds"));
            }
        }
        if !(t.dt.is_finite() && t.dt > 0.0) {
            return refuse(
                "time.dt",
                format!("{} s is not a control period; give a positive number of seconds", t.dt),
            );
        }
        if !(t.sim_dt.is_finite() && t.sim_dt >= 0.0) {
            return refuse(
                "time.sim_dt",
                format!(
                    "{} s is not a physics step; give seconds, or 0 for a zero-order-hold plant",
                    t.sim_dt
                ),
            );
        }
        if t.sim_dt > 0.0 && (t.dt / t.sim_dt - (t.dt / t.sim_dt).round()).abs() > 1e-9 {
            return refuse(
                "time.sim_dt",
                format!("dt = {} s is not a whole number of physics steps of {} s", t.dt, t.sim_dt),
            );
        }
        if t.sim_dt > 0.0 && t.dt / t.sim_dt > 1000.5 {
            return refuse(
                "time.dt",
                format!(
                    "{} s are more than 1000 physics steps of {} s; give the period in seconds",
                    t.dt, t.sim_dt
                ),
            );
        }
        if t.policy_every == 0 {
            return refuse("time.policy_every", "0 ticks; the policy needs at least every tick = 1".into());
        }
        if t.policy_every > MOST_TICKS {
            return refuse(
                "time.policy_every",
                format!(
                    "{} ticks of {} s are {:.0} s in which the policy sees nothing; give at most {MOST_TICKS} ticks",
                    t.policy_every,
                    t.dt,
                    t.policy_every as f64 * t.dt
                ),
            );
        }
        if self.idm.kind == IdmKind::Learned && t.policy_every != 1 {
            return refuse(
                "time.policy_every",
                format!(
                    "{} ticks, but a learned inverse model answers each proposal with one action; use 1",
                    t.policy_every
                ),
            );
        }
        if t.max_episode_steps == Some(0) {
            return refuse("time.max_episode_steps", "0 ticks hold no episode; give at least 1".into());
        }
        if self.model.urdf.is_some() == self.model.mjcf.is_some() {
            return refuse("model", "give exactly one of 'urdf' and 'mjcf'".into());
        }
        if self.model.free_flyer && self.model.mjcf.is_some() {
            let next =
                "free_flyer is for URDF files; an MJCF file says itself whether its base floats, so drop it";
            return refuse("model.free_flyer", next.into());
        }
        Ok(())
    }
}

fn one() -> usize {
    1
}

/// `a.b.c=value`: the value is TOML, or a bare string.
fn apply(table: &mut toml::Table, set: &str) -> Result<(), TaskError> {
    let refuse = |reason: String| TaskError::Override { set: set.into(), reason };
    let (key, value) = set
        .split_once('=')
        .ok_or_else(|| refuse("write key=value, for example constraints.velocity.scale=0.8".into()))?;
    let value = toml::from_str::<toml::Table>(&format!("x = {value}"))
        .ok()
        .and_then(|mut t| t.remove("x"))
        .unwrap_or_else(|| toml::Value::String(value.into()));
    let path: Vec<&str> = key.trim().split('.').collect();
    let (last, parents) =
        path.split_last().filter(|(l, _)| !l.is_empty()).ok_or_else(|| refuse("the key is empty".into()))?;
    let mut here = table;
    for part in parents {
        here = here
            .entry((*part).to_string())
            .or_insert_with(|| toml::Value::Table(toml::Table::new()))
            .as_table_mut()
            .ok_or_else(|| refuse(format!("'{part}' is a value, not a section")))?;
    }
    here.insert((*last).to_string(), value);
    Ok(())
}
