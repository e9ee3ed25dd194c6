//! Reads the description of a robot from its file, and finds the robot file that the simulator compiles.

use std::path::{Path, PathBuf};

use nearl_runtime::Manifest;
use nearl_runtime::constraints::description::{JointKind, Range, RobotDescription};
use nearl_runtime::constraints::{Model, ModelError};
use nearl_runtime::snapshot::{ModelFormat, Simulation};
use toml::Table;

use crate::mj::{self, MjError, Options, Scene};

/// Why a robot file has no description.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RobotError {
    /// MuJoCo's side of it.
    #[error(transparent)]
    Physics(#[from] MjError),
    /// The same of a file that has a name.
    #[error("{file}: {error}")]
    File {
        /// Path as given.
        file: String,
        /// Why.
        error: MjError,
    },
    /// The URDF's side of it.
    #[error(transparent)]
    Model(#[from] ModelError),
}

/// Describes a robot file: an MJCF through MuJoCo, a URDF by our own reader. `floats`: the base of the URDF is free.
///
/// # Errors
/// [`RobotError`].
pub fn describe(file: &Simulation, floats: bool) -> Result<RobotDescription, RobotError> {
    match file.format {
        ModelFormat::Mjcf => Ok(compile(file, false)?.describe()?),
        ModelFormat::Urdf => read_urdf(&file.text, floats),
    }
}

/// Describes the robot file of a task, with what is to be known of where its episodes begin: as MuJoCo simulates it with what the task adds, else as
/// [`describe`] does. `reset` is the task's section.
///
/// # Errors
/// [`RobotError`].
pub fn describe_in_task(
    file: &Simulation,
    floats: bool,
    add: Option<&SceneOptions>,
    reset: &Table,
) -> Result<RobotDescription, RobotError> {
    let model = match (add, file.format) {
        (None, ModelFormat::Urdf) => return describe(file, floats),
        (None, ModelFormat::Mjcf) => compile(file, floats)?,
        (Some(add), _) => compile_in(file, floats, add)?,
    };
    let mut robot = match add {
        None => model.describe()?,
        Some(add) => describe_simulated(&model, file, floats, add)?,
    };
    robot.notes.extend(model.starts(reset));
    Ok(robot)
}

/// Describes a robot file as MuJoCo simulates it: of a URDF, joints and masses are MuJoCo's (a continuous joint is a hinge without
/// limits, a link without `<inertial>` weighs what its geometry does), limits and motors the file's.
fn describe_simulated(
    model: &mj::Model,
    file: &Simulation,
    floats: bool,
    options: &SceneOptions,
) -> Result<RobotDescription, RobotError> {
    let mut robot = model.describe()?;
    if file.format == ModelFormat::Mjcf {
        return Ok(robot);
    }
    // Drives of the scene are what [command] says of the file's motors.
    robot.solids.retain(|solid| solid.body.is_some() || options.scene.floor.is_none());
    let stated = read_urdf(&file.text, floats)?;
    for joint in robot.bodies.iter_mut().flat_map(|body| &mut body.joints) {
        let Some(own) = stated.joints().find(|own| own.name == joint.name) else { continue };
        (joint.velocity, joint.effort) = (own.velocity, own.effort);
        if own.range == Range::NotStated && joint.kind != JointKind::Free {
            joint.range = Range::NotStated;
        }
    }
    let is_there = |name: &str| robot.joints().any(|joint| joint.name == name);
    let motors = stated.motors.into_iter().filter(|motor| is_there(&motor.joint)).collect();
    robot.name = stated.name;
    robot.motors = motors;
    // A URDF's only equations are those of joints that mimic others, which a note of its own names.
    robot.notes.retain(|note| {
        !note.starts_with(mj::EQUATIONS) || !stated.notes.iter().any(|note| note.contains("' mimics '"))
    });
    let more: Vec<_> = stated.notes.into_iter().filter(|note| !note.contains("no mass")).collect();
    robot.notes.extend(more);
    Ok(robot)
}

/// Describes a file, an MJCF by its ending `.xml` or `.mjcf`. `floats`: the base of a URDF is free.
///
/// # Errors
/// [`RobotError`].
pub fn read(path: &Path, floats: bool) -> Result<RobotDescription, RobotError> {
    match (is_mjcf(path), floats) {
        (true, _) => read_mjcf(path),
        (false, true) => Ok(Model::from_urdf_free_flyer(path)?.description().clone()),
        (false, false) => Ok(Model::from_urdf(path)?.description().clone()),
    }
}

/// Contacts and sensors of an MJCF file, and where its episodes begin, a sentence each: they are the simulator's, and no controller knows them. None of
/// a URDF.
///
/// # Errors
/// As [`read`].
pub fn simulated_alone(path: &Path) -> Result<Vec<String>, RobotError> {
    if !is_mjcf(path) {
        return Ok(Vec::new());
    }
    let model = compile(&mjcf(path)?, false)?;
    Ok([model.simulated_alone(), model.starts(&Table::new())].concat())
}

/// Whether a physics step of an MJCF file is an Euler step that limits can count on ([`mj::Model::is_euler`]).
///
/// # Errors
/// [`RobotError`].
pub fn makes_euler_steps(path: &Path) -> Result<bool, RobotError> {
    Ok(compile(&mjcf(path)?, false)?.is_euler())
}

/// The format of a robot's text, by its outermost element: a URDF may hold `<mujoco>` too, with settings for MuJoCo.
pub(crate) fn format_of(text: &str) -> ModelFormat {
    let is_mjcf = element(text).is_some_and(|rest| rest.starts_with("<mujoco"));
    if is_mjcf { ModelFormat::Mjcf } else { ModelFormat::Urdf }
}

/// An XML text from its outermost element on.
fn element(text: &str) -> Option<&str> {
    let mut rest = text;
    while let Some(at) = rest.find('<') {
        rest = &rest[at..];
        let end = match rest {
            _ if rest.starts_with("<!--") => "-->",
            _ if rest.starts_with("<?") => "?>",
            _ if rest.starts_with("<!") => ">",
            _ => return Some(rest),
        };
        rest = rest.split_once(end).map_or("", |(_, after)| after);
    }
    None
}

/// Refuses a URDF where an MJCF is read: MuJoCo would take it, without the speeds of its joints.
fn refuse_urdf(text: &str, file: String) -> Result<(), ModelError> {
    if !element(text).is_some_and(|rest| rest.starts_with("<robot")) {
        return Ok(());
    }
    let reason = "its outermost element is <robot>, which is a URDF, to be read by `Model.from_urdf` and from a name that ends in .urdf";
    Err(ModelError::Malformed { file, format: "MJCF", reason: reason.into() })
}

fn is_mjcf(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending == "xml" || ending == "mjcf")
}

/// Describes an MJCF file, with what it includes and its meshes.
///
/// # Errors
/// [`RobotError`].
pub fn read_mjcf(path: &Path) -> Result<RobotDescription, RobotError> {
    let file = path.display().to_string();
    let robot = describe(&mjcf(path)?, false).map_err(|e| match e {
        RobotError::Physics(error) => RobotError::File { file: file.clone(), error },
        other => other,
    })?;
    robot.check(&file)?;
    Ok(robot)
}

fn mjcf(path: &Path) -> Result<Simulation, RobotError> {
    let unreadable = |reason: String| ModelError::Unreadable { path: path.to_path_buf(), reason };
    let text = nearl_runtime::constraints::read_text(path).map_err(|e| unreadable(e.to_string()))?;
    if text.trim().is_empty() {
        return Err(unreadable("the file is empty".to_string()).into());
    }
    refuse_urdf(&text, path.display().to_string())?;
    Ok(Simulation { format: ModelFormat::Mjcf, text, folder: Some(folder_of(path)) })
}

/// Describes an MJCF text; files that it names are looked for in the current folder.
///
/// # Errors
/// [`RobotError`].
pub fn read_mjcf_text(text: &str) -> Result<RobotDescription, RobotError> {
    refuse_urdf(text, "the text".into())?;
    describe(&Simulation { format: ModelFormat::Mjcf, text: text.to_string(), folder: None }, false)
}

/// The folder of a file, as seen from everywhere.
pub fn folder_of(file: &Path) -> PathBuf {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    folder.canonicalize().unwrap_or_else(|_| folder.to_path_buf())
}

/// Compiles a robot file for simulation.
///
/// # Errors
/// [`MjError::Load`].
pub fn compile(file: &Simulation, floats: bool) -> Result<mj::Model, MjError> {
    let options = Options { floats, ..Options::default() };
    mj::Model::from_text_in(&file.text, file.format, file.folder.as_deref(), options)
}

/// What a task adds to its robot file, and the physics step that it states \[s\].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SceneOptions {
    /// Floor, feet and drives.
    pub scene: Scene,
    /// Physics step; the file's own when absent.
    pub sim_dt: Option<f64>,
}

/// Compiles a robot file for simulation with what its task adds.
///
/// # Errors
/// [`MjError::Load`], [`MjError::NoBody`].
pub fn compile_in(file: &Simulation, floats: bool, add: &SceneOptions) -> Result<mj::Model, MjError> {
    let options = Options { floats, sim_dt: add.sim_dt, ..Options::default() };
    mj::Model::with_scene(&file.text, file.format, file.folder.as_deref(), options, &add.scene)
}

/// The robot file of a manifest: its own, else the bundled one that its task names.
pub fn simulation(manifest: &Manifest) -> Option<Simulation> {
    let bundled = || {
        let (file, format) = manifest.task.model.file()?;
        Some(Simulation { format, text: crate::tasks::robot(file)?.to_string(), folder: None })
    };
    manifest.simulation.clone().or_else(bundled)
}

fn read_urdf(text: &str, floats: bool) -> Result<RobotDescription, RobotError> {
    let read = if floats { Model::from_urdf_text_free_flyer } else { Model::from_urdf_text };
    Ok(read(text)?.description().clone())
}
