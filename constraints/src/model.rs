//! The robot: joints, limits, inertias. Constants only; scratch is in [`Dynamics`](crate::Dynamics).

use crate::assemble::assemble;
use crate::description::{FrictionLaw, Motor, Onset, Payload, RobotDescription};
use crate::error::{ModelError, near_names};
use crate::pinocchio::RawModel;
use crate::urdf;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A joint and where its numbers stand in `q` and `v`.
///
/// A continuous joint has `nq` 2 (cosine, sine).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Joint {
    /// Name in the robot file.
    pub name: String,
    /// First entry in a configuration.
    pub idx_q: usize,
    /// Number of configuration entries.
    pub nq: usize,
    /// First entry in a velocity.
    pub idx_v: usize,
    /// Number of velocity entries (dofs).
    pub nv: usize,
}

/// A frame of a [`Model`]: a link, a joint or a site, by number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct FrameId(pub(crate) usize);

impl FrameId {
    /// The world: the frame that never moves.
    pub const WORLD: FrameId = FrameId(0);
}

/// A robot model, immutable and shared: cloning copies a pointer.
///
/// Configurations and velocities are in Pinocchio's convention everywhere; [`convention`](crate::convention)
/// translates a floating base from and to MuJoCo's.
#[derive(Clone)]
pub struct Model(Arc<Inner>);

pub(crate) struct Inner {
    pub(crate) raw: RawModel,
    pub(crate) description: RobotDescription,
    pub(crate) nq: usize,
    pub(crate) nv: usize,
    pub(crate) joints: Vec<Joint>,
    pub(crate) range_missing: Vec<bool>,
    pub(crate) lower: Vec<f64>,
    pub(crate) upper: Vec<f64>,
    pub(crate) velocity: Vec<f64>,
    pub(crate) effort: Vec<f64>,
    pub(crate) armature: Vec<f64>,
    pub(crate) damping: Vec<f64>,
    pub(crate) drive_damping: Vec<f64>,
    pub(crate) held: Vec<bool>,
    pub(crate) stiffness: Vec<f64>,
    pub(crate) spring_reference: Vec<f64>,
    pub(crate) friction: Vec<f64>,
    /// Of the dofs with friction.
    pub(crate) onset: Vec<Option<Onset>>,
    pub(crate) law: Vec<FrictionLaw>,
    pub(crate) total_mass: f64,
    pub(crate) neutral: Vec<f64>,
    pub(crate) frames: Vec<ModelFrame>,
    /// Of the moving bodies: the one before each, and its first and last dof.
    pub(crate) chain: Vec<(Option<usize>, std::ops::Range<usize>)>,
}

/// One frame: a link, a joint, or what an MJCF calls a site.
pub(crate) struct ModelFrame {
    pub(crate) name: String,
    /// True for a link.
    pub(crate) body: bool,
    /// Number of the moving body it is on; `None` for what is fixed to the world.
    pub(crate) moved_by: Option<usize>,
}

impl Model {
    /// Builds a robot from its numbers, which any reader of robot files may have made.
    ///
    /// # Errors
    /// What [`RobotDescription::check`] finds.
    pub fn from_description(description: RobotDescription) -> Result<Model, ModelError> {
        let file = format!("the robot '{}'", description.name);
        Ok(Model(Arc::new(assemble(description, &file)?)))
    }

    /// The robot with a payload in one of its frames: a model of its own, as everything built from the one without knows nothing of it.
    ///
    /// # Errors
    /// [`RobotDescription::carry`].
    pub fn with_payload(&self, payload: &Payload) -> Result<Model, ModelError> {
        let mut description = self.0.description.clone();
        description.carry(payload)?;
        Model::from_description(description)
    }

    /// The robot with all its dry friction by this law: MuJoCo's of a simulation, Coulomb's of a robot. A model of its own.
    ///
    /// # Errors
    /// [`RobotDescription::check`].
    pub fn with_friction_law(&self, law: FrictionLaw) -> Result<Model, ModelError> {
        let mut description = self.0.description.clone();
        for joint in description.bodies.iter_mut().flat_map(|body| &mut body.joints) {
            joint.friction_law = law;
        }
        Model::from_description(description)
    }

    /// Reads a URDF file; the base is fixed to the world.
    ///
    /// # Errors
    /// The file cannot be read, is not URDF, or holds impossible numbers.
    pub fn from_urdf(path: &Path) -> Result<Model, ModelError> {
        urdf_model(&text_of(path)?, &path.display().to_string(), false)
    }

    /// Reads a URDF file; the base floats: the first joint is a free joint called `root_joint` with 7 configuration
    /// entries and 6 dofs in Pinocchio's convention (see [`convention`](crate::convention)), which no motor drives.
    ///
    /// # Errors
    /// As [`Model::from_urdf`].
    pub fn from_urdf_free_flyer(path: &Path) -> Result<Model, ModelError> {
        urdf_model(&text_of(path)?, &path.display().to_string(), true)
    }

    /// Reads a URDF text; the base is fixed to the world.
    ///
    /// # Errors
    /// As [`Model::from_urdf`].
    pub fn from_urdf_text(xml: &str) -> Result<Model, ModelError> {
        urdf_model(xml, "the URDF text", false)
    }

    /// Reads a URDF text with a floating base; see [`Model::from_urdf_free_flyer`].
    ///
    /// # Errors
    /// As [`Model::from_urdf`].
    pub fn from_urdf_text_free_flyer(xml: &str) -> Result<Model, ModelError> {
        urdf_model(xml, "the URDF text", true)
    }

    /// The numbers this model was built from.
    pub fn description(&self) -> &RobotDescription {
        &self.0.description
    }

    /// What drives the joints.
    pub fn motors(&self) -> &[Motor] {
        &self.0.description.motors
    }

    /// Number of configuration entries.
    pub fn nq(&self) -> usize {
        self.0.nq
    }

    /// Number of velocity entries (dofs).
    pub fn nv(&self) -> usize {
        self.0.nv
    }

    /// All movable joints in the order of the dofs.
    pub fn joints(&self) -> &[Joint] {
        &self.0.joints
    }

    /// The joint called `name`.
    ///
    /// # Errors
    /// There is none; the message lists near names.
    pub fn joint(&self, name: &str) -> Result<&Joint, ModelError> {
        self.find(name).map_err(|near| ModelError::UnknownJoint { name: name.to_string(), near })
    }

    /// The joint called `name`, or the end of a sentence about near names.
    pub(crate) fn find(&self, name: &str) -> Result<&Joint, String> {
        let found = self.0.joints.iter().find(|j| j.name == name);
        found.ok_or_else(|| near_names(name, self.0.joints.iter().map(|j| j.name.as_str())))
    }

    /// The joint that dof `dof` belongs to.
    pub fn joint_of_dof(&self, dof: usize) -> &Joint {
        let at = self.0.joints.partition_point(|j| j.idx_v + j.nv <= dof);
        &self.0.joints[at]
    }

    /// Name of a dof in messages: the joint's, with the entry's number for joints with several dofs.
    pub fn dof_name(&self, dof: usize) -> String {
        let joint = self.joint_of_dof(dof);
        if joint.nv == 1 { joint.name.clone() } else { format!("{}[{}]", joint.name, dof - joint.idx_v) }
    }

    /// True for a revolute or prismatic joint for which the robot file states no position limits.
    pub fn position_limit_missing(&self, dof: usize) -> bool {
        let at = self.0.joints.partition_point(|j| j.idx_v + j.nv <= dof);
        self.0.range_missing[at]
    }

    /// Lower position limits (nq) [rad or m]; minus infinity is none.
    pub fn lower_position_limit(&self) -> &[f64] {
        &self.0.lower
    }

    /// Upper position limits (nq) [rad or m]; infinity is none.
    pub fn upper_position_limit(&self) -> &[f64] {
        &self.0.upper
    }

    /// Velocity limits (nv) [rad/s or m/s]; infinity is none. MJCF never states any.
    pub fn velocity_limit(&self) -> &[f64] {
        &self.0.velocity
    }

    /// Effort limits (nv) [N·m or N]; infinity is none: what the joint states or all its motors give together ([`Motor::strength`]),
    /// whichever is less.
    pub fn effort_limit(&self) -> &[f64] {
        &self.0.effort
    }

    /// Rotor inertia reflected to the joint (nv) [kg·m² or kg]; already in the mass matrix.
    pub fn armature(&self) -> &[f64] {
        &self.0.armature
    }

    /// Viscous damping (nv) [N·m·s/rad or N·s/m]. It acts on the velocity during the period:
    /// [`crate::Period::resistance`].
    pub fn damping(&self) -> &[f64] {
        &self.0.damping
    }

    /// What drives damp (nv) [N·m·s/rad or N·s/m], where a physics step takes that implicitly: it acts on the change of the velocity within the step
    /// ([`crate::Period::resistance`]), and its motor's force has the rest.
    pub fn drive_damping(&self) -> &[f64] {
        &self.0.drive_damping
    }

    /// Dofs (nv) that something holds where they are while nobody commands them: a drive of positions or velocities, or what the robot file holds them by.
    pub fn held(&self) -> &[bool] {
        &self.0.held
    }

    /// Joint springs (nv) [N·m/rad or N/m].
    pub fn stiffness(&self) -> &[f64] {
        &self.0.stiffness
    }

    /// Position (nv) [rad or m] at which the joint's spring is at rest.
    pub fn spring_reference(&self) -> &[f64] {
        &self.0.spring_reference
    }

    /// Dry friction (nv) [N·m or N]: the force that a joint withstands before it moves. Joints with several dofs have none here.
    pub fn friction(&self) -> &[f64] {
        &self.0.friction
    }

    /// How the dry friction of each dof sets in (nv); of those that have some.
    pub fn friction_onset(&self) -> &[Option<Onset>] {
        &self.0.onset
    }

    /// What the dry friction of each dof is taken to be (nv).
    pub fn friction_law(&self) -> &[FrictionLaw] {
        &self.0.law
    }

    /// Mass of everything that moves \[kg\].
    pub fn total_mass(&self) -> f64 {
        self.0.total_mass
    }

    /// The neutral configuration (nq): zeros, identity rotations.
    pub fn neutral(&self) -> Vec<f64> {
        self.0.neutral.clone()
    }

    /// Refuses a configuration (nq) that is none: quaternions and (cos, sin) pairs must have length 1 to a thousandth. NaN passes, which the
    /// projector answers for.
    ///
    /// # Errors
    /// A sentence that names the joint.
    pub fn check_configuration(&self, q: &[f64]) -> Result<(), String> {
        for joint in self.joints() {
            let (what, at) = match (joint.nq, joint.nv) {
                (2, 1) => ("(cos, sin) of continuous joint", joint.idx_q),
                (4, 3) => ("quaternion of joint", joint.idx_q),
                (7, 6) => ("quaternion of joint", joint.idx_q + 3),
                _ => continue,
            };
            let length = q[at..joint.idx_q + joint.nq].iter().map(|x| x * x).sum::<f64>().sqrt();
            if (length - 1.0).abs() > UNIT {
                let next = match joint.nq {
                    2 => "write [cos(angle), sin(angle)]",
                    _ => "write x, y, z, w of a unit quaternion",
                };
                return Err(format!("{what} '{}' has length {length}, not 1; {next}", joint.name));
            }
        }
        Ok(())
    }

    /// What the robot file describes that is not part of this model: forces, mimic joints; empty when there is nothing.
    pub fn notes(&self) -> &[String] {
        &self.0.description.notes
    }

    /// The frame called `name`: a link, else a joint or a site. `"universe"` is the world.
    ///
    /// # Errors
    /// There is none; the message lists near names.
    pub fn frame(&self, name: &str) -> Result<FrameId, ModelError> {
        self.find_frame(name).map_err(|near| ModelError::UnknownFrame { name: name.to_string(), near })
    }

    /// The frame called `name`, or the end of a sentence about near names.
    pub(crate) fn find_frame(&self, name: &str) -> Result<FrameId, String> {
        let called = |body: bool| self.0.frames.iter().position(|f| f.name == name && (f.body || !body));
        let found = called(true).or_else(|| called(false)).map(FrameId);
        found.ok_or_else(|| near_names(name, self.frame_names()))
    }

    /// Names of all frames by number; a link and a joint may share one.
    pub fn frame_names(&self) -> impl Iterator<Item = &str> {
        self.0.frames.iter().map(|f| f.name.as_str())
    }

    /// Name of a frame.
    pub fn frame_name(&self, frame: FrameId) -> &str {
        &self.0.frames[frame.0].name
    }

    /// True when a motion of `dof` can change where `frame` is.
    pub fn moves(&self, dof: usize, frame: FrameId) -> bool {
        let mut found = false;
        self.for_each_dof(frame, |i| found |= i == dof);
        found
    }

    /// The dofs that move `frame`, from the frame back to the base.
    pub(crate) fn for_each_dof(&self, frame: FrameId, mut f: impl FnMut(usize)) {
        let mut at = self.0.frames[frame.0].moved_by;
        while let Some(body) = at {
            let (parent, dofs) = &self.0.chain[body];
            dofs.clone().for_each(&mut f);
            at = *parent;
        }
    }

    /// True when two frames are on the same rigid body, or on two of which one hangs on the other.
    pub(crate) fn neighbours(&self, a: FrameId, b: FrameId) -> bool {
        let (a, b) = (self.0.frames[a.0].moved_by, self.0.frames[b.0].moved_by);
        let below = |child: Option<usize>, parent| child.is_some_and(|j| self.0.chain[j].0 == parent);
        a == b || below(a, b) || below(b, a)
    }

    pub(crate) fn raw_neutral(&self) -> &[f64] {
        &self.0.neutral
    }

    pub(crate) fn raw(&self) -> &RawModel {
        &self.0.raw
    }
}

fn text_of(path: &Path) -> Result<String, ModelError> {
    let fail = |reason: String| ModelError::Unreadable { path: PathBuf::from(path), reason };
    let text = crate::read_text(path).map_err(|e| fail(e.to_string()))?;
    if text.trim().is_empty() { Err(fail("the file is empty".to_string())) } else { Ok(text) }
}

/// Quaternions and (cos, sin) pairs may be this far from length 1.
const UNIT: f64 = 1e-3;

fn urdf_model(xml: &str, file: &str, free_flyer: bool) -> Result<Model, ModelError> {
    Ok(Model(Arc::new(assemble(urdf::read(xml, file, free_flyer)?, file)?)))
}
