//! Bundled tasks and robots, and how a task name or file becomes a manifest.

use crate::env::{self, Env, EnvError};
use crate::preset::Preset;
use crate::robot::{self, RobotError};
use crate::scene;
use nearl_runtime::net::Activation;
use nearl_runtime::snapshot::{FORMAT, Simulation};
use nearl_runtime::task::{Task, TaskError};
use nearl_runtime::{Manifest, PolicyKind};
use std::path::Path;

macro_rules! bundled {
    ($folder:literal: $($name:literal),* $(,)?) => {
        &[$(($name, include_str!(concat!("../../examples/", $folder, "/", $name)))),*]
    };
}

/// Task files by name (with `.toml`).
const TASKS: &[(&str, &str)] = bundled!("tasks": "HalfCheetah-v5.toml", "Hopper-v5.toml", "Walker2d-v5.toml", "Ant-v5.toml", "Panda-reach.toml",
    "HalfCheetah-velocity.toml", "Hopper-velocity.toml", "Walker2d-velocity.toml", "Ant-velocity.toml");

/// Robot files by name.
const ROBOTS: &[(&str, &str)] = bundled!("robots": "gymnasium/half_cheetah.xml", "gymnasium/hopper.xml",
    "gymnasium/walker2d_v5.xml", "gymnasium/ant.xml", "panda/panda.urdf");

/// Why a task could not be used.
#[derive(Debug, thiserror::Error)]
pub enum TaskLoadError {
    /// The file itself.
    #[error(transparent)]
    Task(#[from] TaskError),
    /// The environment that the file describes.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// The robot file cannot be used.
    #[error("task '{task}' names the robot file '{robot}', which cannot be used: {source}")]
    Description {
        /// Task name.
        task: String,
        /// As written.
        robot: String,
        /// Why.
        source: RobotError,
    },
    /// A name that is neither bundled nor a file.
    #[error(
        "no task '{name}'{near}; give one of {all} or a TOML file, as `nearl.from_gymnasium` of Python writes one of an environment of Gymnasium"
    )]
    Unknown {
        /// As given.
        name: String,
        /// `; did you mean ...`.
        near: String,
        /// Bundled names.
        all: String,
    },
    /// A robot file in place of a task file.
    #[error("'{file}' is a robot file; give the TOML task file that names it under [model]")]
    NoTask {
        /// As given.
        file: String,
    },
    /// The robot file of the task.
    #[error(
        "task '{task}' names the robot file '{robot}', which cannot be read: {reason}; give a path relative to the task file"
    )]
    Robot {
        /// Task name.
        task: String,
        /// As written.
        robot: String,
        /// What the system said.
        reason: String,
    },
}

/// Names of the bundled tasks.
pub fn names() -> Vec<&'static str> {
    TASKS.iter().map(|(n, _)| n.trim_end_matches(".toml")).collect()
}

/// Control periods in an episode of the bundled task `name`. Nothing is compiled for it.
pub fn max_episode_steps(name: &str) -> Option<usize> {
    let (_, text) = TASKS.iter().find(|(n, _)| n.trim_end_matches(".toml") == name)?;
    let task: toml::Table = toml::from_str(text).ok()?;
    let env = task.get("env").and_then(toml::Value::as_str).unwrap_or(name);
    env::REGISTRY.iter().find(|entry| entry.name == env).map(|entry| entry.max_episode_steps)
}

/// Text of a bundled robot file, by its path or file name under `examples/robots`.
pub fn robot(name: &str) -> Option<&'static str> {
    ROBOTS.iter().find(|(n, _)| *n == name || n.rsplit('/').next() == Some(name)).map(|(_, t)| *t)
}

/// Reads a bundled task by name, or a TOML file, with `--set` overrides, and finds its robot.
///
/// The returned manifest has no action range yet: the environment or the robot's limits give it.
///
/// # Errors
/// [`TaskLoadError`] in one sentence.
pub fn load(task: &str, overrides: &[String]) -> Result<Manifest, TaskLoadError> {
    let path = Path::new(task);
    let bundled = TASKS.iter().find(|(n, _)| n.trim_end_matches(".toml") == task);
    if path.extension().is_some_and(|e| ["xml", "urdf", "mjcf"].iter().any(|robot| e == *robot)) {
        return Err(TaskLoadError::NoTask { file: task.into() });
    }
    let parsed = match bundled {
        Some((name, text)) => Task::parse_with(name, text, overrides, &env::own_time)?,
        None if path.extension().is_some_and(|e| e == "toml") || path.exists() => {
            Task::read_with(path, overrides, &env::own_time)?
        }
        None => return Err(unknown(task)),
    };
    let (simulation, is_bundled) = robot_file(&parsed, path, bundled.is_some())?;
    let floats = parsed.model.free_flyer;
    let add = match parsed.reward.is_empty() && parsed.scene.is_empty() {
        true => None,
        false => Some(scene::of(&parsed, &simulation).map_err(|m| EnvError::Task {
            origin: task.into(),
            key: m.key,
            reason: m.reason,
        })?),
    };
    let described = robot::describe_in_task(&simulation, floats, add.as_ref(), &parsed.reset);
    let description = described.map_err(|source| TaskLoadError::Description {
        task: parsed.name.clone(),
        robot: parsed.model.file().map_or(String::new(), |(file, _)| file.to_string()),
        source,
    })?;
    let manifest = Manifest {
        format: FORMAT,
        task: parsed,
        robot: description,
        simulation: (!is_bundled).then_some(simulation),
        algo: String::new(),
        policy: PolicyKind::Deterministic,
        activation: Activation::default(),
        functions: Vec::new(),
        version: 0,
        steps: 0,
        action_lower: Vec::new(),
        action_upper: Vec::new(),
        moved: None,
    };
    let of = &manifest.task;
    if !(of.reward.is_empty() && of.cost.is_empty() && of.env.is_none()) {
        // mistakes in what describes the environment are found here, where the file's name is known
        env::of_task(&manifest, task)?;
    }
    Ok(manifest)
}

/// The robot file that a task read from `path` names, and whether it is a bundled one.
fn robot_file(task: &Task, path: &Path, is_bundled: bool) -> Result<(Simulation, bool), TaskLoadError> {
    let Some((file, format)) = task.model.file() else { unreachable!("Task::parse requires a robot file") };
    let beside = path.parent().unwrap_or(Path::new(".")).join(file);
    if let Some(text) = self::robot(file)
        && (is_bundled || !beside.exists())
    {
        return Ok((Simulation { format, text: text.to_string(), folder: None }, true));
    }
    let text = nearl_runtime::constraints::read_text(&beside).map_err(|e| TaskLoadError::Robot {
        task: task.name.clone(),
        robot: beside.display().to_string(),
        reason: e.to_string(),
    })?;
    let names_files = text.contains("file=") || text.contains("filename=");
    let folder = names_files.then(|| robot::folder_of(&beside));
    let is_copy = robot(file).is_some_and(|bundled| bundled == text);
    Ok((Simulation { format, text, folder }, is_copy))
}

/// The same with the settings of a preset, which come before `overrides`.
///
/// # Errors
/// [`TaskLoadError`] in one sentence.
pub fn load_with(
    task: &str,
    preset: Option<Preset>,
    overrides: &[String],
) -> Result<Manifest, TaskLoadError> {
    let plain = load(task, overrides)?;
    let Some(preset) = preset else { return Ok(plain) };
    load(task, &[&preset.overrides(&plain.task.name), overrides].concat())
}

/// Makes the environment of a bundled task or a TOML file.
///
/// # Errors
/// [`TaskLoadError`]; [`TaskLoadError::Env`] also where MuJoCo does not take the robot.
pub fn env(task: &str) -> Result<Box<dyn Env>, TaskLoadError> {
    let manifest = load(task, &[])?;
    Ok(env::of_task(&manifest, task)?)
}

/// What a bundled task is, in one sentence: that of its environment, or the first of its file.
pub fn about(name: &str) -> String {
    let native = env::REGISTRY.iter().find(|e| e.name == name).map(|e| e.about.to_owned());
    let comment = || {
        let text = TASKS.iter().find(|(n, _)| n.trim_end_matches(".toml") == name).map_or("", |(_, t)| t);
        let words: Vec<_> = text.lines().map_while(|line| line.strip_prefix("# ")).collect();
        let words = words.join(" ");
        words.split_once(". ").map_or(words.trim_end_matches('.'), |(first, _)| first).to_owned()
    };
    native.unwrap_or_else(comment)
}

fn unknown(task: &str) -> TaskLoadError {
    let near = names()
        .into_iter()
        .map(|n| (strsim::jaro(&n.to_lowercase(), &task.to_lowercase()), n))
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .filter(|(score, _)| *score > 0.8)
        .map_or(String::new(), |(_, n)| format!("; did you mean '{n}'?"));
    TaskLoadError::Unknown { name: task.into(), near, all: names().join(", ") }
}
