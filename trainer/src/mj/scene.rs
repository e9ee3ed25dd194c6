//! What a task file puts beside and into a robot file before it is compiled: a floor, spheres under the feet, drives.

use std::path::Path;

use mujoco_rs::error::MjEditError;
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use mujoco_rs::wrappers::mj_editing::{MjSpec, MjtLimited, PositionConfig, SpecItem};
use mujoco_rs::wrappers::mj_model::{MjModel, MjtGeomBase, MjtJoint, MjtTrn};

use super::{MjError, as_file, guard, terrain};

/// Things of a task that are not in its robot file. The default adds nothing.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scene {
    /// A plane at z = 0 with this coefficient of friction.
    pub floor: Option<f64>,
    /// Height of the bumps on it \[m\].
    pub bumps: Option<f64>,
    /// Spheres on bodies of the robot, which touch the floor.
    pub feet: Vec<Foot>,
    /// Drives `K (u - q) - D v` of joints with one degree of freedom, in the order of the action.
    pub drives: Vec<PdDrive>,
    /// Inertia of the rotors of the driven joints \[kg m² or kg\]; the file's own where absent.
    pub armature: Option<f64>,
    /// The robot file's own solids touch nothing and weigh nothing.
    pub without_solids: bool,
}

/// A sphere without mass on a body.
#[derive(Debug, Clone, PartialEq)]
pub struct Foot {
    /// The body.
    pub body: String,
    /// Centre of the sphere in the body's frame \[m\].
    pub position: [f64; 3],
    /// Its radius \[m\].
    pub radius: f64,
}

/// A position drive of a joint.
#[derive(Debug, Clone, PartialEq)]
pub struct PdDrive {
    /// Name of the actuator.
    pub name: String,
    /// The joint.
    pub joint: String,
    /// K \[N·m/rad or N/m\].
    pub stiffness: f64,
    /// D \[N·m s/rad or N s/m\].
    pub damping: f64,
    /// Largest force \[N·m or N\].
    pub effort: f64,
}

impl Scene {
    /// Whether the robot is compiled as its file has it.
    pub fn is_empty(&self) -> bool {
        *self == Scene::default()
    }
}

/// Compiles a text as if it stood in a file of `folder`, with the things of `scene`.
pub(super) fn compile(text: &str, folder: Option<&Path>, scene: &Scene) -> Result<MjModel, MjError> {
    let (mut spec, files) = specify(text, folder, scene)?;
    spec.compile_with_vfs(&files).map_err(words)
}

/// MuJoCo's own explanation.
pub(super) fn words(e: MjEditError) -> MjError {
    MjError::Load(guard::one_line(&e.to_string()))
}

/// What [`compile`] compiles, and the files that it names.
pub(super) fn specify(text: &str, folder: Option<&Path>, scene: &Scene) -> Result<(MjSpec, MjVfs), MjError> {
    let (path, files) = as_file(text, folder)?;
    let parsed = match folder {
        None => MjSpec::from_xml_string(text),
        Some(_) => MjSpec::from_xml_vfs(&path, &files),
    };
    let mut spec = parsed.map_err(|e| match e {
        MjEditError::ParseFailed(said) => guard::refused(&path, &files, &said),
        other => words(other),
    })?;
    scene.add_to(&mut spec)?;
    Ok((spec, files))
}

impl Scene {
    fn add_to(&self, spec: &mut MjSpec) -> Result<(), MjError> {
        if self.without_solids {
            for geom in spec.geom_iter_mut() {
                geom.with_contype(0).with_conaffinity(0).with_mass(0.0);
            }
        }
        if let Some(friction) = self.floor {
            // Of two of a name the library panics.
            let added = if self.bumps.is_some() { &["floor", "bumps"][..] } else { &["floor"] };
            let is_taken =
                |name: &&&str| spec.geom(name).is_some() || **name == "bumps" && spec.hfield(name).is_some();
            if let Some(name) = added.iter().find(is_taken) {
                return Err(MjError::Load(format!(
                    "[scene] floor adds '{name}', and the file has one of that name already; leave it out, or give that of the file another name"
                )));
            }
            let floor =
                spec.world_body_mut().add_geom().with_name("floor").with_type(MjtGeomBase::mjGEOM_PLANE);
            floor.with_size([0.0, 0.0, 1.0]).with_friction([friction, 0.005, 1e-4]);
            floor.with_contype(1).with_conaffinity(1).with_condim(3);
            if let Some(height) = self.bumps {
                terrain::add_to(spec, height, friction);
            }
        }
        for foot in &self.feet {
            let body = spec.body_mut(&foot.body).ok_or_else(|| MjError::NoBody(foot.body.clone()))?;
            let sphere = body.add_geom().with_type(MjtGeomBase::mjGEOM_SPHERE);
            sphere.with_size([foot.radius, 0.0, 0.0]).with_pos(foot.position).with_mass(0.0).with_condim(3);
            // The rougher of two solids decides in MuJoCo: friction is the floor's.
            sphere.with_contype(1).with_conaffinity(1).with_friction([0.0, 0.005, 1e-4]);
        }
        for drive in &self.drives {
            self.add_drive(drive, spec)?;
        }
        Ok(())
    }

    fn add_drive(&self, drive: &PdDrive, spec: &mut MjSpec) -> Result<(), MjError> {
        let PdDrive { name, joint, stiffness, damping, effort } = drive;
        let hinge = spec.joint_mut(joint);
        let Some(hinge) =
            hinge.filter(|j| matches!(j.type_(), MjtJoint::mjJNT_HINGE | MjtJoint::mjJNT_SLIDE))
        else {
            return Err(MjError::Load(format!(
                "joint '{joint}' has no single degree of freedom that a drive could move"
            )));
        };
        // MuJoCo would stop at the file's effort as well; the drive states it.
        hinge.set_actfrclimited(MjtLimited::mjLIMITED_FALSE);
        if let Some(armature) = self.armature {
            hinge.set_armature(armature);
        }
        let actuator = spec.add_actuator().with_name(name).with_target(joint);
        actuator.set_trntype(MjtTrn::mjTRN_JOINT);
        let gains = PositionConfig { kp: *stiffness, kv: Some(*damping), ..PositionConfig::default() };
        actuator
            .set_to_position(gains)
            .map_err(|e| MjError::Load(format!("drive of joint '{joint}': {e}")))?;
        actuator.set_forcelimited(MjtLimited::mjLIMITED_TRUE);
        actuator.with_forcerange([-effort, *effort]).set_ctrllimited(MjtLimited::mjLIMITED_FALSE);
        Ok(())
    }
}
