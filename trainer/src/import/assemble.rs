//! From an imported network, a robot and a recipe to a snapshot.

use super::{ImportError, ImportedNetwork};
use super::{deploy, metadata};
use crate::blank::commands;
use crate::robot::{describe, describe_in_task, folder_of, format_of};
use crate::scene;
use nearl_runtime::constraints::description::JointKind;
use nearl_runtime::constraints::{Drive, Model, RobotDescription, StateLayout, read_task_text, read_text};
use nearl_runtime::motors::Motors;
use nearl_runtime::net::Activation;
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::recipe::{Numbers, Observer, PolicySection};
use nearl_runtime::snapshot::{FORMAT, ModelFormat, Simulation};
use nearl_runtime::task::TaskError;
use nearl_runtime::{Manifest, Networks, PolicyKind, Snapshot, Task};
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Outputs of a network without a clip are taken up to this size; those of a trained policy are a few.
const MOST: f64 = 100.0;
/// Logarithm of the standard deviation of a policy that says none: no noise.
const NO_NOISE: f32 = -20.0;

/// What a policy is imported with.
#[derive(Clone, Copy, Debug)]
pub struct Setting<'a> {
    /// Name of the task; letters of the policy's file.
    pub name: &'a str,
    /// Robot file, URDF or MJCF.
    pub robot: &'a Path,
    /// Recipe files: task files of which only `[time] dt` and `[policy]` are needed, or unitree's `deploy.yaml`. What a later one says
    /// comes before what those before it say.
    pub recipes: &'a [PathBuf],
}

/// The snapshot of a policy of actions. Whatever the recipe does not say is taken from the file's metadata.
///
/// # Errors
/// [`ImportError`]: what is missing, or what does not fit.
pub fn snapshot(network: &ImportedNetwork, setting: &Setting<'_>) -> Result<Snapshot, ImportError> {
    let mut files = vec![("the policy's metadata".to_string(), String::new())];
    let mut stated = Vec::new();
    for path in setting.recipes {
        let (over, text) = said(path, setting.robot)?;
        files.push((path.display().to_string(), text));
        stated.push(over);
    }
    let mut table = metadata::recipe(network, &stated)?;
    for over in stated.iter().cloned() {
        // joints that are sent forces have no use for the gains that another file says
        if over.get("command").and_then(|c| c.get("interface")).and_then(Value::as_str) == Some("effort") {
            table.remove("command");
        }
        merge(&mut table, over);
    }
    let said_by = files[files.len() - 1].0.clone();
    if !table.contains_key("policy") {
        if !setting.recipes.is_empty() {
            let given: Vec<String> =
                setting.recipes.iter().map(|file| format!("'{}'", file.display())).collect();
            return Err(ImportError::Recipe(format!(
                "{} has no [policy], which says what the {} entries of the policy's input '{}' are and what its outputs mean; write one \
                 (docs/POLICIES.md), or give the file as task= to nearl.import_torch or nearl.import_sb3 if it is the task that the policy learned",
                given.join(" with "),
                network.n_in(),
                network.input_name
            )));
        }
        return Err(ImportError::NoRecipe { input: network.input_name.clone(), n_in: network.n_in() });
    }
    let simulation = simulation(setting.robot)?;
    complete(&mut table, setting, simulation.format);
    let free = table.get("model").and_then(|m| m.get("free_flyer")).and_then(Value::as_bool).unwrap_or(false);
    // As the task is simulated.
    let add = match table.contains_key("scene") || table.contains_key("reward") {
        false => None,
        true => {
            let task = Task::merged(table.clone(), &files).map_err(|e| ImportError::Recipe(e.to_string()))?;
            let add = scene::of(&task, &simulation);
            Some(add.map_err(|m| recipe(&said_by, &format!("[{}] {}", m.key, m.reason)))?)
        }
    };
    let reset = table.get("reset").and_then(Value::as_table).cloned().unwrap_or_default();
    let mut robot =
        describe_in_task(&simulation, free, add.as_ref(), &reset).map_err(|e| unusable(setting.robot, &e))?;
    let file = setting.robot.display().to_string();
    let placed = metadata::place(&mut table, (network, &stated), (&file, &simulation.text, &robot))?;
    robot.notes.extend(placed);
    let unusable = |e: &dyn std::fmt::Display| unusable(setting.robot, e);
    let model = Model::from_description(robot.clone()).map_err(|e| unusable(&e))?;
    state(&mut table, &model, &files)?;
    let mut task = Task::merged(table, &files).map_err(|e| ImportError::Recipe(e.to_string()))?;
    let mut section = task.policy.take().unwrap_or_default();
    take_clip(&mut section, network).map_err(|e| recipe(&said_by, &e))?;
    let layout = layout(&model, &task).map_err(|e| recipe(&said_by, &e))?;
    check_widths(&section, network, &model, &layout).map_err(|e| recipe(&said_by, &e))?;
    let (action_lower, action_upper) =
        ranges(&section, &task, &model, &layout).map_err(|e| recipe(&said_by, &e))?;
    task.policy = Some(section);
    let manifest = Manifest {
        format: FORMAT,
        task,
        robot,
        simulation: Some(simulation),
        algo: "import".into(),
        policy: PolicyKind::Direct,
        activation: Activation::default(),
        functions: network.functions.clone(),
        version: 0,
        steps: 0,
        action_lower,
        action_upper,
        moved: None,
    };
    let snapshot = Snapshot { networks: networks(network, layout.n_state()), manifest };
    snapshot.check().map_err(|e| recipe(&said_by, &e.to_string()))?;
    Ok(snapshot)
}

/// What a recipe file says, as sections of a task file, and its text where it is one.
fn said(path: &Path, robot: &Path) -> Result<(Table, String), ImportError> {
    let (said_by, text) = (path.display().to_string(), read(path, read_task_text)?);
    if !path.extension().is_some_and(|e| e == "yaml" || e == "yml") {
        let table = Task::table(&said_by, &text).map_err(|e| ImportError::Recipe(e.to_string()))?;
        return Ok((table, text));
    }
    let simulation = simulation(robot)?;
    let described = described(&simulation, false, robot)?;
    let joints: Vec<String> =
        described.joints().filter(|j| j.kind != JointKind::Free).map(|j| j.name.clone()).collect();
    let mut table = deploy::recipe(&text, &joints).map_err(|e| recipe(&said_by, &e))?;
    if simulation.format == ModelFormat::Urdf {
        // Robots of these files walk.
        let floats = Table::from_iter([("free_flyer".to_string(), Value::from(true))]);
        table.insert("model".into(), floats.into());
    }
    Ok((table, String::new()))
}

/// The robot file as it is simulated.
fn simulation(path: &Path) -> Result<Simulation, ImportError> {
    let text = read(path, read_text)?;
    let format = format_of(&text);
    let names_files = text.contains("file=") || text.contains("filename=");
    Ok(Simulation { format, text, folder: names_files.then(|| folder_of(path)) })
}

fn described(simulation: &Simulation, free: bool, robot: &Path) -> Result<RobotDescription, ImportError> {
    describe(simulation, free).map_err(|e| unusable(robot, &e))
}

fn unusable(robot: &Path, e: &dyn std::fmt::Display) -> ImportError {
    ImportError::Robot(format!("{}: {e}", robot.display()))
}

pub(super) fn recipe(said_by: &str, reason: &str) -> ImportError {
    ImportError::Recipe(format!("{said_by}: {reason}"))
}

fn read(path: &Path, text: fn(&Path) -> std::io::Result<String>) -> Result<String, ImportError> {
    text(path)
        .map_err(|e| ImportError::Unreadable { file: path.display().to_string(), reason: e.to_string() })
}

/// What `over` says, and what only `base` says.
fn merge(base: &mut Table, over: Table) {
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(inner)), Value::Table(value)) => merge(inner, value),
            (_, value) => drop(base.insert(key, value)),
        }
    }
}

/// Keys that follow from the files.
fn complete(table: &mut Table, setting: &Setting<'_>, format: ModelFormat) {
    let mut default = |key: &str, value: Value| {
        table.entry(key).or_insert(value);
    };
    default("name", setting.name.into());
    default("model", Table::new().into());
    default("time", Table::new().into());
    default("idm", Table::from_iter([("kind".to_string(), Value::from("pinocchio"))]).into());
    // A limit that is not named does not hold.
    default("constraints", Table::new().into());
    let key = if format == ModelFormat::Mjcf { "mjcf" } else { "urdf" };
    if let Some(model) = table.get_mut("model").and_then(Value::as_table_mut) {
        model.insert(key.into(), setting.robot.display().to_string().into());
    }
    if let Some(time) = table.get_mut("time").and_then(Value::as_table_mut) {
        time.entry("sim_dt").or_insert(Value::from(0.0));
    }
}

/// `[state]`: positions and velocities of the policy's joints in the robot's order, and what the terms read of the plant.
fn state(table: &mut Table, model: &Model, files: &[(String, String)]) -> Result<(), ImportError> {
    let said_by = files.last().map_or("", |(file, _)| file.as_str());
    let missing = |what: &str| recipe(said_by, what);
    if table.get("time").and_then(|t| t.get("dt")).is_none() {
        return Err(missing(
            "the control period is not known; give a recipe with [time] dt = 0.02, in seconds",
        ));
    }
    let policy = table.get("policy").cloned().unwrap_or(Table::new().into());
    let policy: PolicySection = serde_path_to_error::deserialize(policy).map_err(|e| {
        // with its line, where the task as a whole is read
        let whole = Task::merged(table.clone(), files).err();
        let told = |e: TaskError| ImportError::Recipe(e.to_string());
        whole.map_or_else(
            || missing(&format!("[policy.{}] {}", e.path(), e.inner().to_string().trim_end())),
            told,
        )
    })?;
    let state = table.entry("state").or_insert(Table::new().into());
    let Some(state) = state.as_table_mut() else { return Err(missing("[state] is no section")) };
    let mut joints = Vec::new();
    for name in &policy.joints {
        joints.push(model.joint(name).map_err(|e| missing(&format!("[policy.joints] {e}")))?);
    }
    joints.sort_by_key(|j| j.idx_v);
    joints.dedup_by_key(|j| j.idx_v);
    let strings = |names: &[String]| Value::Array(names.iter().map(|n| Value::from(n.as_str())).collect());
    let names = |kind: &str| joints.iter().map(|j| format!("{kind}.{}", j.name)).collect::<Vec<_>>();
    let proposed = [names("q"), names("v")].concat();
    state.entry("propose").or_insert(strings(&proposed));
    let controllable: Vec<String> = joints.iter().map(|j| j.name.clone()).collect();
    state.entry("controllable").or_insert(strings(&controllable));
    if state.contains_key("observation") {
        return Ok(());
    }
    if policy.observation.is_empty() {
        return Err(missing(
            "[policy] has no observation and [state] neither; give the terms of the policy's observation, or state.observation with the \
             entries that the plant gives in its order",
        ));
    }
    let mut observed = proposed;
    for name in policy.observation.iter().flat_map(|t| &t.entries) {
        if !observed.contains(name) {
            observed.push(name.clone());
        }
    }
    state.insert("observation".into(), strings(&observed));
    Ok(())
}

fn layout(model: &Model, task: &Task) -> Result<StateLayout, String> {
    let s = &task.state;
    StateLayout::new(model, &s.observation, s.propose.as_deref(), s.controllable.as_deref())
        .map_err(|e| e.to_string())
}

/// The clip that the network ends with, within the one of the recipe.
fn take_clip(section: &mut PolicySection, network: &ImportedNetwork) -> Result<(), String> {
    const FAR: f64 = 1e30; // stands for no clip: numbers in a task file are finite
    if network.output.iter().all(|[l, u]| l.is_infinite() && u.is_infinite()) {
        return Ok(());
    }
    let n = network.n_out();
    let side = |side: usize| network.output.iter().map(|c| c[side].clamp(-FAR, FAR)).collect::<Vec<f64>>();
    let (mut lower, mut upper) = (side(0), side(1));
    if let Some([l, u]) = &section.action.clip {
        let (l, u) = (l.spread("policy.action.clip", n)?, u.spread("policy.action.clip", n)?);
        (0..n).for_each(|i| (lower[i], upper[i]) = (lower[i].max(l[i]), upper[i].min(u[i])));
    }
    section.action.clip = Some([Numbers::Each(lower), Numbers::Each(upper)]);
    Ok(())
}

/// The recipe's terms and joints against the network's inputs and outputs.
fn check_widths(
    section: &PolicySection,
    network: &ImportedNetwork,
    model: &Model,
    layout: &StateLayout,
) -> Result<(), String> {
    let (joints, n_out) = (section.joints.len(), network.n_out());
    if joints != n_out {
        return Err(format!(
            "[policy] has {joints} joints, but the policy's output '{}' has {n_out} entries",
            network.output_name
        ));
    }
    let observer = Observer::new(section, model, layout)?;
    let (seen, n_in) = (observer.as_ref().map_or(layout.n_obs(), Observer::len), network.n_in());
    if seen == n_in {
        return Ok(());
    }
    let widths = observer.map_or(String::new(), |o| {
        let each = section.observation.iter().zip(o.widths()).map(|(t, n)| format!("{} {n}", t.term.name()));
        format!(" ({})", each.collect::<Vec<_>>().join(", "))
    });
    Err(format!(
        "the observation has {seen} entries{widths}, but the policy's input '{}' has {n_in}",
        network.input_name
    ))
}

/// The range of what each motor is sent, in the motors' order: that of motors and drives, as a task has it that was trained here. The clip of the
/// recipe is of outputs, and a guard may have to send more than the policy can ask for. Where the robot file does not bound the commands of a joint
/// it is what the policy can ask for.
fn ranges(
    section: &PolicySection,
    task: &Task,
    model: &Model,
    layout: &StateLayout,
) -> Result<(Vec<f64>, Vec<f64>), String> {
    let n = section.joints.len();
    let scale = section.action.scale.spread("policy.action.scale", n)?;
    let clip = match &section.action.clip {
        None => vec![[-MOST, MOST]; n],
        Some([l, u]) => {
            let (l, u) = (l.spread("policy.action.clip", n)?, u.spread("policy.action.clip", n)?);
            l.into_iter().zip(u).map(|(l, u)| [l.max(-MOST), u.min(MOST)]).collect()
        }
    };
    let drives = task.command.drives(model, layout.controllable())?;
    let takes_position =
        |name: &String| model.joint(name).is_ok_and(|joint| drives[joint.idx_v].takes_position());
    let offset = section.offset(&section.joints.iter().map(takes_position).collect::<Vec<_>>())?;
    let motors = Motors::new(model, layout.controllable(), &drives)?;
    let mut sent = vec![(0.0, 0.0); layout.controllable().len()];
    for (k, &dof) in layout.controllable().iter().enumerate() {
        let joint = model.dof_name(dof);
        let at = section.joints.iter().position(|j| *j == joint);
        let i =
            at.ok_or_else(|| format!("the policy gives no command for the controllable joint '{joint}'"))?;
        let range = commands(task, model, drives[dof], dof);
        let asked = clip[i].map(|x| offset[i] + scale[i] * x);
        let asked = [asked[0].min(asked[1]), asked[0].max(asked[1])];
        let [low, high] = match drives[dof] {
            Drive::Effort if range[1].is_infinite() => {
                return Err(format!(
                    "the robot file does not say how strong the motor of joint '{joint}' is; give its effort limit"
                ));
            }
            // Without gains nobody knows how far ahead of a joint its servo may be sent.
            Drive::Position
                if task.command.gains(&joint)?.is_none() && range.iter().all(|x| x.is_finite()) =>
            {
                [range[0].min(asked[0]), range[1].max(asked[1])]
            }
            _ if range.iter().all(|x| x.is_finite()) => range,
            _ => asked,
        };
        let ends = [low, high].map(|command| motors.action(k, command));
        sent[motors.place(k)] = (ends[0].min(ends[1]), ends[0].max(ends[1]));
    }
    Ok(sent.into_iter().unzip())
}

pub(super) fn networks(network: &ImportedNetwork, n_state: usize) -> Networks {
    let clip = network.clip.clone();
    Networks {
        normaliser: Normaliser {
            mean: network.mean.clone(),
            std: network.std.clone(),
            scale: vec![1.0; n_state],
            clip,
        },
        policy: network.dense.clone(),
        policy_log_std: vec![NO_NOISE; network.n_out()],
        idm: None,
        margins: Vec::new(),
    }
}
