//! The robot: joints, limits, inertias. Constants only; scratch is in [`Dynamics`](crate::Dynamics).

use crate::error::{ModelError, near_names};
use crate::mjcf::{self, Mjcf, MjcfJoint};
use crate::pinocchio::{RawFrame, RawJoint, RawModel};
use crate::urdf::{self, Stated};
use std::ffi::CString;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A joint and where its numbers stand in `q` and `v`.
///
/// Several MJCF joints of one body are several joints here. A continuous URDF joint has `nq` 2 (cosine, sine).
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

struct Inner {
    raw: RawModel,
    nq: usize,
    nv: usize,
    joints: Vec<Joint>,
    range_missing: Vec<bool>,
    lower: Vec<f64>,
    upper: Vec<f64>,
    velocity: Vec<f64>,
    effort: Vec<f64>,
    armature: Vec<f64>,
    damping: Vec<f64>,
    stiffness: Vec<f64>,
    spring_reference: Vec<f64>,
    total_mass: f64,
    neutral: Vec<f64>,
    notes: Vec<String>,
    frames: Vec<RawFrame>,
    /// Of Pinocchio's joints: the one before each, and its first and last dof.
    chain: Vec<(Option<usize>, std::ops::Range<usize>)>,
    collisions: Vec<urdf::LinkShape>,
}

impl Model {
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

    /// Reads an MJCF file and corrects what Pinocchio's reader leaves out, so that mass matrix, non-linear effects
    /// and passive joint forces equal MuJoCo's. Contacts, equalities, tendons, friction and fluids are not part of it:
    /// see [`Model::notes`].
    ///
    /// # Errors
    /// The file cannot be read, is not MJCF, holds impossible numbers, or uses what would be read wrongly.
    pub fn from_mjcf(path: &Path) -> Result<Model, ModelError> {
        mjcf_model(&text_of(path)?, path, &path.display().to_string())
    }

    /// Reads an MJCF text; see [`Model::from_mjcf`]. Mesh files are looked for in the current folder.
    ///
    /// # Errors
    /// As [`Model::from_mjcf`]; also when no temporary file can be written.
    pub fn from_mjcf_text(xml: &str) -> Result<Model, ModelError> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let name = format!("nearl-{}-{}.xml", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let path = std::env::temp_dir().join(name);
        let unreadable =
            |e: std::io::Error| ModelError::Unreadable { path: path.clone(), reason: e.to_string() };
        std::fs::write(&path, xml).map_err(unreadable)?; // Pinocchio's MJCF reader takes files only
        let model = mjcf_model(xml, &path, "the MJCF text");
        std::fs::remove_file(&path).map_err(unreadable)?;
        model
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

    /// Effort limits (nv) [N·m or N]; infinity is none. From MJCF: gear times control range of the joint's motors.
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

    /// Joint springs (nv) [N·m/rad or N/m].
    pub fn stiffness(&self) -> &[f64] {
        &self.0.stiffness
    }

    /// Position (nv) [rad or m] at which the joint's spring is at rest.
    pub fn spring_reference(&self) -> &[f64] {
        &self.0.spring_reference
    }

    /// Mass of everything that moves [kg].
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
        &self.0.notes
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
        let mut at = self.0.frames[frame.0].joint;
        while let Some(joint) = at {
            let (parent, dofs) = &self.0.chain[joint];
            dofs.clone().for_each(&mut f);
            at = *parent;
        }
    }

    /// True when some body hangs on several joints, which Pinocchio keeps as one whose axes turn with its configuration.
    pub(crate) fn has_composites(&self) -> bool {
        let joints =
            |dofs: &std::ops::Range<usize>| self.0.joints.iter().filter(|j| dofs.contains(&j.idx_v)).count();
        self.0.chain.iter().any(|(_, dofs)| joints(dofs) > 1)
    }

    /// True when two frames are on the same rigid body, or on two joined by one joint.
    pub(crate) fn neighbours(&self, a: FrameId, b: FrameId) -> bool {
        let (a, b) = (self.0.frames[a.0].joint, self.0.frames[b.0].joint);
        let below = |child: Option<usize>, parent| child.is_some_and(|j| self.0.chain[j].0 == parent);
        a == b || below(a, b) || below(b, a)
    }

    /// The collision primitives of a URDF, and the links whose collision geometry is a mesh; empty for an MJCF.
    pub(crate) fn collisions(&self) -> &[urdf::LinkShape] {
        &self.0.collisions
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
    let text = std::fs::read_to_string(path).map_err(|e| fail(e.to_string()))?;
    if text.trim().is_empty() { Err(fail("the file is empty".to_string())) } else { Ok(text) }
}

fn c_text(text: &str, file: &str, format: &'static str) -> Result<CString, ModelError> {
    let reason = |e: std::ffi::NulError| format!("it holds a NUL byte at offset {}", e.nul_position());
    CString::new(text).map_err(|e| ModelError::Malformed {
        file: file.to_string(),
        format,
        reason: reason(e),
    })
}

/// Quaternions and (cos, sin) pairs may be this far from length 1.
const UNIT: f64 = 1e-3;

fn urdf_model(xml: &str, file: &str, free_flyer: bool) -> Result<Model, ModelError> {
    let (stated, collisions, mimics) = urdf::read(xml, file)?;
    let refused = |reason| ModelError::Refused { file: file.to_string(), format: "URDF", reason };
    let raw = RawModel::from_urdf_text(&c_text(xml, file, "URDF")?, free_flyer).map_err(refused)?;
    let (limits, nv) = (raw.limits(), raw.nv());
    let mut inner = Inner::new(raw, nv);
    for j in inner.raw.joints() {
        let stated = stated.iter().find(|(name, _)| *name == j.name).map_or(Stated::Unlimited, |(_, s)| *s);
        if j.nq == 1 && stated == Stated::Range {
            inner.lower[j.idx_q] = limits.lower[j.idx_q];
            inner.upper[j.idx_q] = limits.upper[j.idx_q];
        }
        inner.range_missing.push(stated == Stated::Missing);
        inner.joints.push(Joint { name: j.name, idx_q: j.idx_q, nq: j.nq, idx_v: j.idx_v, nv: j.nv });
    }
    // In URDF a zero velocity or effort means that nobody filled it in; of a free joint, Pinocchio says the largest number.
    let some = |x: &f64| if *x > 0.0 && *x < f64::MAX { *x } else { f64::INFINITY };
    inner.velocity = limits.velocity.iter().map(some).collect();
    inner.effort = limits.effort.iter().map(some).collect();
    if limits.friction.iter().any(|x| *x > 0.0) {
        inner.notes.push("dry joint friction is not modelled".to_string());
    }
    inner.notes.extend(mimics);
    inner.damping = limits.damping;
    inner.collisions = collisions;
    inner.finish(file)
}

fn mjcf_model(xml: &str, path: &Path, file: &str) -> Result<Model, ModelError> {
    let mjcf = mjcf::read(xml, file)?;
    let refused = |reason| ModelError::Refused { file: file.to_string(), format: "MJCF", reason };
    let path = c_text(&path.display().to_string(), file, "MJCF")?;
    let mut raw = RawModel::from_mjcf_file(&path).map_err(refused)?;
    raw.set_gravity(mjcf.gravity);
    if let Some(base) = &mjcf.base {
        raw.place_base(base);
    }
    if let Some(total) = mjcf.total_mass {
        let factor = total / raw.mass();
        raw.scale_mass(factor);
    }
    let nv = raw.nv();
    let mut inner = Inner::new(raw, nv);
    for j in inner.raw.joints() {
        let body = body_of(&mjcf, &j.name, (j.nq, j.nv)).ok_or_else(|| ModelError::Unsupported {
            file: file.to_string(),
            feature: format!("a joint read as '{}' ({}) that its text does not explain", j.name, j.kind),
            next: "name every joint and every body",
        })?;
        let (mut idx_q, mut idx_v) = (j.idx_q, j.idx_v);
        for joint in body {
            inner.add_mjcf_joint(joint, idx_q, idx_v);
            idx_q += joint.kind.size().0;
            idx_v += joint.kind.size().1;
        }
    }
    inner.notes = mjcf.notes;
    let armature = inner.armature.clone();
    inner.raw.set_armature(&armature);
    inner.finish(file)
}

/// The joints of the MJCF body that Pinocchio's joint `name` stands for: the joint itself, or all joints of a body.
fn body_of<'a>(mjcf: &'a Mjcf, name: &str, size: (usize, usize)) -> Option<&'a [MjcfJoint]> {
    let total = |body: &[MjcfJoint]| {
        body.iter().map(|j| j.kind.size()).fold((0, 0), |sum, s| (sum.0 + s.0, sum.1 + s.1))
    };
    let called = |body: &&Vec<MjcfJoint>| match &body[..] {
        [one] => one.name == name,
        many => name.strip_prefix("Composite_") == Some(many[0].name.as_str()),
    };
    mjcf.bodies.iter().find(called).map(Vec::as_slice).filter(|body| total(body) == size)
}

impl Inner {
    fn new(raw: RawModel, nv: usize) -> Inner {
        let (nq, zero, none) = (raw.nq(), vec![0.0; nv], vec![f64::INFINITY; nv]);
        let link = |j: RawJoint| (j.parent, j.idx_v..j.idx_v + j.nv);
        Inner {
            nq,
            nv,
            joints: Vec::new(),
            range_missing: Vec::new(),
            lower: vec![f64::NEG_INFINITY; nq],
            upper: vec![f64::INFINITY; nq],
            velocity: none.clone(),
            effort: none,
            armature: zero.clone(),
            damping: zero.clone(),
            stiffness: zero.clone(),
            spring_reference: zero,
            total_mass: raw.mass(),
            neutral: raw.neutral(),
            notes: Vec::new(),
            frames: raw.frames(),
            chain: raw.joints().into_iter().map(link).collect(),
            collisions: Vec::new(),
            raw,
        }
    }

    fn add_mjcf_joint(&mut self, joint: &MjcfJoint, idx_q: usize, idx_v: usize) {
        let (nq, nv) = joint.kind.size();
        if let Some((lower, upper)) = joint.range {
            (self.lower[idx_q], self.upper[idx_q]) = (lower, upper);
        }
        for i in idx_v..idx_v + nv {
            self.armature[i] = joint.armature;
            self.damping[i] = joint.damping;
            self.stiffness[i] = joint.stiffness;
            self.spring_reference[i] = joint.spring_reference;
            self.effort[i] = joint.effort;
        }
        self.joints.push(Joint { name: joint.name.clone(), idx_q, nq, idx_v, nv });
        self.range_missing.push(false);
    }

    fn finish(self, file: &str) -> Result<Model, ModelError> {
        let mut wrong = Vec::new();
        for j in self.raw.joints().iter().filter(|j| j.mass.is_nan() || j.mass < 0.0) {
            wrong.push(format!("the body moved by '{}' has mass {} kg", j.name, j.mass));
        }
        if self.nv == 0 {
            wrong.push("it has no movable joint".to_string());
        }
        if !wrong.is_empty() {
            return Err(ModelError::Impossible { file: file.to_string(), list: wrong.join("; ") });
        }
        Ok(Model(Arc::new(self)))
    }
}
