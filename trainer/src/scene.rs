//! `[scene]` and the drives of `[command]`: what a task of one's own puts beside and into its robot file.
//!
//! ```toml
//! [scene]
//! timestep = 0.005                                                    # s, the physics step; the file's own when absent
//! floor = { friction = 0.8, bumps = 0.05 }                            # a plane at z = 0, and bumps of this height on it [m]
//! feet = { bodies = ["LF_FOOT", "RF_FOOT"], radius = 0.03 }           # spheres, `position` in each body's frame [m]
//! solids = false                                                      # the file's own solids touch nothing and weigh nothing
//! armature = 0.05                                                     # kg m², rotors of the driven joints
//! ```

use nearl_runtime::constraints::{Drive, Model};
use nearl_runtime::snapshot::{ModelFormat, Simulation};
use nearl_runtime::task::{Task, suggest};
use serde::Deserialize;

use crate::env;
use crate::mj::{Foot, PdDrive, Scene};
use crate::robot::SceneOptions;

/// A mistake in a task file: the key, and a sentence.
#[derive(Debug, Clone, PartialEq)]
pub struct Mistake {
    /// The key.
    pub key: String,
    /// One sentence.
    pub reason: String,
}

fn mistake(key: impl Into<String>, reason: impl Into<String>) -> Mistake {
    Mistake { key: key.into(), reason: reason.into() }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Section {
    timestep: Option<f64>,
    floor: Option<Floor>,
    feet: Option<Feet>,
    solids: bool,
    armature: Option<f64>,
}

impl Default for Section {
    fn default() -> Self {
        Section { timestep: None, floor: None, feet: None, solids: true, armature: None }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Floor {
    friction: f64,
    bumps: Option<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Feet {
    bodies: Vec<String>,
    radius: f64,
    #[serde(default)]
    position: [f64; 3],
}

/// What the task adds to the robot file `file`; nothing where a native environment simulates it.
///
/// # Errors
/// [`Mistake`] with the key that is wrong.
pub fn of(task: &Task, file: &Simulation) -> Result<SceneOptions, Mistake> {
    if task.reward.is_empty() && env::is_known(task) {
        return match task.scene.is_empty() {
            true => Ok(SceneOptions::default()),
            false => Err(mistake(
                "scene",
                "the native environments bring theirs; add a [reward] of your own or take it out",
            )),
        };
    }
    let section: Section = serde_path_to_error::deserialize(task.scene.clone())
        .map_err(|e| mistake(format!("scene.{}", e.path()), suggest(e.inner().message())))?;
    check(&section)?;
    let feet = section.feet.iter().flat_map(|feet| {
        let Feet { bodies, radius, position } = feet;
        bodies.iter().map(|body| Foot { body: body.clone(), position: *position, radius: *radius })
    });
    let scene = Scene {
        floor: section.floor.as_ref().map(|floor| floor.friction),
        bumps: section.floor.as_ref().and_then(|floor| floor.bumps),
        feet: feet.collect(),
        drives: drives(task, file)?,
        armature: section.armature,
        without_solids: !section.solids,
    };
    if scene.armature.is_some() && scene.drives.is_empty() {
        let reason =
            "it is that of drives, and [command] of a URDF gives none here; write it into the robot file";
        return Err(mistake("scene.armature", reason));
    }
    Ok(SceneOptions { scene, sim_dt: section.timestep })
}

fn check(section: &Section) -> Result<(), Mistake> {
    let Section { timestep, floor, feet, armature, .. } = section;
    let positive = |x: f64| x.is_finite() && x > 0.0;
    for (key, value, what) in [
        ("scene.timestep", *timestep, "a physics step; give seconds above 0"),
        (
            "scene.floor.friction",
            floor.as_ref().map(|f| f.friction),
            "a coefficient of friction; give a number above 0",
        ),
        (
            "scene.floor.bumps",
            floor.as_ref().and_then(|f| f.bumps),
            "a height of bumps; give metres above 0, or leave it out",
        ),
        ("scene.feet.radius", feet.as_ref().map(|f| f.radius), "a radius; give metres above 0"),
        ("scene.armature", armature.filter(|a| *a != 0.0), "an inertia; give kg m² of at least 0"),
    ] {
        if let Some(value) = value.filter(|x| !positive(*x)) {
            return Err(mistake(key, format!("{value} is not {what}")));
        }
    }
    Ok(())
}

/// The drives of a URDF whose joints are commanded `pd`, or `position` with gains of a servo; an MJCF brings its own actuators.
fn drives(task: &Task, file: &Simulation) -> Result<Vec<PdDrive>, Mistake> {
    if file.format != ModelFormat::Urdf || task.command.is_effort() {
        return Ok(Vec::new());
    }
    let read = if task.model.free_flyer { Model::from_urdf_text_free_flyer } else { Model::from_urdf_text };
    let Ok(model) = read(&file.text) else { return Ok(Vec::new()) }; // refused with its reason where the robot is described
    let mut motors = model.motors().to_vec();
    motors.sort_by_key(|motor| motor.order);
    let dof = |joint: &str| model.joint(joint).map(|joint| joint.idx_v);
    // Joints that nothing commands are held by drives of the same kind, where these have gains and the file says how strong they are.
    let is_commanded =
        |joint: &String| task.state.controllable.as_ref().is_none_or(|names| names.contains(joint));
    let has_gains = |joint: &str| matches!(task.command.gains(joint), Ok(Some(_)));
    motors.retain(|motor| {
        is_commanded(&motor.joint) || (has_gains(&motor.joint) && motor.control_range.is_some())
    });
    let driven: Vec<usize> = motors.iter().filter_map(|motor| dof(&motor.joint).ok()).collect();
    let wanted: Vec<usize> = driven.iter().copied().filter(|&i| is_commanded(&model.dof_name(i))).collect();
    let commanded = task.command.drives(&model, &wanted).map_err(|e| mistake("command", e))?;
    let mut gains = Vec::new();
    for &i in &driven {
        gains.push(match commanded[i] {
            _ if !wanted.contains(&i) => {
                task.command.gains(&model.dof_name(i)).map_err(|e| mistake("command", e))?
            }
            Drive::Pd { stiffness, damping } => Some((stiffness, damping)),
            Drive::Position => task.command.gains(&model.dof_name(i)).map_err(|e| mistake("command", e))?,
            _ => None,
        });
    }
    if gains.iter().all(Option::is_none) {
        return Ok(Vec::new());
    }
    if let Some((&other, _)) = driven.iter().zip(&gains).find(|(_, gains)| gains.is_none()) {
        return Err(mistake(
            "command.interface",
            format!(
                "joint '{}' is commanded {} without stiffness, where others have drives; a URDF has one interface for all its motors",
                model.dof_name(other),
                commanded[other].name()
            ),
        ));
    }
    let drive = |(motor, gains): (&nearl_runtime::constraints::description::Motor, &Option<(f64, f64)>)| {
        let (Some((stiffness, damping)), Some([_, effort])) = (*gains, motor.control_range) else {
            let reason = format!(
                "joint '{}' states no effort, which bounds its drive; write it into <limit>",
                motor.joint
            );
            return Err(mistake("model.urdf", reason));
        };
        let (name, joint) = (motor.name.clone(), motor.joint.clone());
        Ok(PdDrive { name, joint, stiffness, damping, effort })
    };
    motors.iter().zip(&gains).map(drive).collect()
}
