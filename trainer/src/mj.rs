//! MuJoCo 3.17.0: the only module of the project that calls it.
//!
//! [`Model`] is the compiled robot (immutable, shared between threads), [`Sim`] the state of one simulation.
//! MuJoCo's fatal errors arrive as [`MjError::Engine`], its warnings are counted ([`warnings`]) and never written to a
//! file. A newer MuJoCo is a change of this module and of a version number.

mod describe;
mod guard;
mod inverse;
mod motors;
mod packages;
mod pairs;
mod perturb;
mod scene;
mod sim;
mod sizes;
mod start;
mod terrain;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use mujoco_rs::error::MjModelError;
use mujoco_rs::mujoco_c::mjtDisableBit;
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use mujoco_rs::wrappers::mj_model::{MjModel, MjtBias, MjtDyn, MjtGain, MjtJoint, MjtObjBase};

pub(crate) use describe::EQUATIONS;
pub use guard::{last_warning, warnings};
pub use inverse::Inverse;
pub use perturb::Physique;
pub use scene::{Foot, PdDrive, Scene};
pub use sim::Sim;

/// Why MuJoCo could not do what was asked.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MjError {
    /// The robot file does not compile.
    #[error("MuJoCo cannot load the robot file: {0}")]
    Load(String),
    /// MuJoCo gave up inside a computation; the simulation was put back to its initial state.
    #[error("MuJoCo stopped with an error and the simulation was reset: {0}")]
    Engine(String),
    /// A state of the wrong length.
    #[error("{what} has {got} entries, the robot has {expected}")]
    Length {
        /// Which vector.
        what: &'static str,
        /// What the robot has.
        expected: usize,
        /// What was given.
        got: usize,
    },
    /// A rotation that is none.
    #[error("qpos[{index}] to [{}] are 0, and a quaternion has the length 1; give w x y z, 1 0 0 0 where nothing is turned", index + 3)]
    NoRotation {
        /// The first of the four.
        index: usize,
    },
    /// A state with NaN or infinity in it.
    #[error("{what}[{index}] is {value}: every entry must be finite")]
    NotFinite {
        /// Which vector.
        what: &'static str,
        /// Which entry.
        index: usize,
        /// What was given.
        value: f64,
    },
    /// A robot whose equations of motion plain numbers cannot say.
    #[error("MuJoCo reads the robot file, but a controller cannot reckon with it: {0}")]
    NoDescription(String),
    /// A physics step that is none \[s\].
    #[error("<option timestep> of the robot file is {0} s, which is no physics step; give seconds above 0")]
    Timestep(f64),
    /// The robot file has no such body.
    #[error("the robot has no body '{0}'")]
    NoBody(String),
}

pub use nearl_runtime::snapshot::ModelFormat;

/// What of a robot file's simulation settings to replace. The default replaces nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct Options {
    /// Physics step \[s\].
    pub sim_dt: Option<f64>,
    /// Leave contacts out.
    pub without_contacts: bool,
    /// The base of a URDF floats on a free joint called `root_joint`.
    pub floats: bool,
}

/// Kind of a joint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointKind {
    /// Six degrees of freedom, seven entries: position \[m\] and unit quaternion.
    Free,
    /// Three degrees of freedom, four entries: unit quaternion.
    Ball,
    /// One translation \[m\].
    Slide,
    /// One rotation \[rad\].
    Hinge,
}

/// A joint and where its entries are in `qpos` and `qvel`.
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// Name in the robot file (`joint<id>` where the file gives none).
    pub name: String,
    /// What it lets move.
    pub kind: JointKind,
    /// First entry in `qpos`.
    pub idx_q: usize,
    /// Number of entries in `qpos`.
    pub nq: usize,
    /// First entry in `qvel`.
    pub idx_v: usize,
    /// Number of entries in `qvel`.
    pub nv: usize,
    /// Range of a slide or hinge \[m or rad\]; infinite where the file sets none.
    pub range: [f64; 2],
    /// Force or torque limit \[N or N·m\] a URDF gives as `effort`; infinite where the file sets none.
    pub effort: f64,
}

/// One entry of the action: what moves which degree of freedom.
#[derive(Debug, Clone, PartialEq)]
pub struct Actuator {
    /// Name of the actuator, or of its joint where the file gives none.
    pub name: String,
    /// Joint it moves.
    pub joint: String,
    /// Degree of freedom it moves (index into `qvel`).
    pub dof: usize,
    /// Joint force or torque per unit of the actuator's force.
    pub gear: f64,
    /// The action is the actuator's force: no gain, bias, delay or dynamics of its own.
    pub is_plain: bool,
    /// Its number among all motors of the robot: of MuJoCo's controls, or of the motors of a URDF.
    pub control: usize,
    /// Smallest action that has an effect of its own.
    pub low: f64,
    /// Largest action that has an effect of its own.
    pub high: f64,
}

/// An actuator that nothing commands.
#[derive(Debug, Clone, PartialEq)]
pub struct Hold {
    /// Its number among MuJoCo's controls.
    pub control: usize,
    /// The entry of `qpos` that it keeps; none where its control is no position.
    pub idx_q: Option<usize>,
    /// Position of the actuator for a unit of the joint's.
    pub gear: f64,
}

/// A compiled robot. Cloning shares it.
#[derive(Debug, Clone)]
pub struct Model(Arc<MjModel>);

impl Model {
    /// Compiles a robot from its text; files that it names are looked for in the current folder.
    ///
    /// A URDF keeps its fixed links as bodies (MuJoCo would merge them and lose a tool frame's name), unless the file
    /// brings its own `<mujoco>` settings.
    ///
    /// # Errors
    /// [`MjError::Load`] with MuJoCo's own explanation; [`MjError::Timestep`].
    pub fn from_text(text: &str, format: ModelFormat, options: Options) -> Result<Model, MjError> {
        Model::from_text_in(text, format, None, options)
    }

    /// The same for a text that stands, or stood, in a file of `folder`: there are the files it includes and its meshes.
    ///
    /// # Errors
    /// As [`Model::from_text`].
    pub fn from_text_in(
        text: &str,
        format: ModelFormat,
        folder: Option<&Path>,
        options: Options,
    ) -> Result<Model, MjError> {
        Model::with_scene(text, format, folder, options, &Scene::default())
    }

    /// The same with what a task puts beside the robot.
    ///
    /// # Errors
    /// As [`Model::from_text`]; [`MjError::NoBody`] for a foot on no body; [`MjError::Timestep`].
    pub fn with_scene(
        text: &str,
        format: ModelFormat,
        folder: Option<&Path>,
        options: Options,
        scene: &Scene,
    ) -> Result<Model, MjError> {
        let text = match format {
            ModelFormat::Mjcf => text.to_owned(),
            ModelFormat::Urdf if options.floats => keep_fixed_links(&set_afloat(text)?),
            ModelFormat::Urdf => keep_fixed_links(text),
        };
        let text = packages::resolve(text, folder);
        sizes::check(&text, folder).map_err(MjError::Load)?;
        let loaded = guard::counting_warnings(|| {
            let model = match scene.is_empty() {
                true => compile(&text, folder),
                false => scene::compile(&text, folder, scene),
            };
            model.and_then(|model| pairs::list(&text, folder, scene, model))
        });
        let mut model = loaded.map_err(|e| match (e, packages::advice(&text)) {
            (MjError::Load(reason), Some(advice)) => MjError::Load(reason + &advice),
            (MjError::Load(reason), None) if scene.without_solids && reason.contains("mass and inertia") => {
                MjError::Load(reason + "; [scene] solids = false leaves links without <inertial> no mass: take it out, or write <inertial>")
            }
            (e, _) => e,
        })?;
        let opt = model.opt_mut();
        if let Some(sim_dt) = options.sim_dt {
            opt.timestep = sim_dt;
        }
        if !(opt.timestep.is_finite() && opt.timestep > 0.0) {
            return Err(MjError::Timestep(opt.timestep));
        }
        if options.without_contacts {
            opt.disableflags |= mjtDisableBit::mjDSBL_CONTACT as i32;
        }
        // The constraints of one tree are one island, at most: to look for it takes 4 to 9 % of the time and changes no bit.
        if model.ntree() == 1 && !pairs::sleeps(&model) {
            model.opt_mut().disableflags |= mjtDisableBit::mjDSBL_ISLAND as i32;
        }
        Ok(Model(Arc::new(model)))
    }

    /// Entries of a configuration.
    pub fn nq(&self) -> usize {
        self.0.nq() as usize
    }

    /// Degrees of freedom.
    pub fn nv(&self) -> usize {
        self.0.nv() as usize
    }

    /// Controls.
    pub fn nu(&self) -> usize {
        self.0.nu() as usize
    }

    /// Bodies, the world included.
    pub fn n_bodies(&self) -> usize {
        self.0.nbody() as usize
    }

    /// Physics step \[s\].
    pub fn sim_dt(&self) -> f64 {
        self.0.opt().timestep
    }

    /// Whether a physics step is an Euler step (velocity first, then position with the new velocity) that is implicit in dampers of joints and of
    /// their drives alone: MuJoCo's `Euler`, and its `implicitfast` where nothing else damps: no actuator otherwise, no fluid, and no tendon but one
    /// of joints that no motor drives, as the fingers of a hand.
    pub fn is_euler(&self) -> bool {
        use mujoco_rs::mujoco_c::mjtIntegrator::{mjINT_EULER, mjINT_IMPLICITFAST};
        let (m, option) = (&self.0, self.0.opt());
        if option.integrator != mjINT_IMPLICITFAST as i32 {
            return option.integrator == mjINT_EULER as i32;
        }
        let is_known = |id: usize| {
            self.implicit_damping(id).is_some() || self.tendon_of(id).is_some_and(|t| self.is_apart(t))
        };
        let tendons = m.tendon_damping().iter().enumerate();
        (0..m.actuator_trntype().len()).all(is_known)
            && tendons.filter(|(_, damping)| **damping != 0.0).all(|(tendon, _)| self.is_apart(tendon))
            && option.density == 0.0
            && option.viscosity == 0.0
    }

    /// What keeps a physics step from being one ([`Model::is_euler`]), and what to change.
    pub fn not_euler(&self) -> &'static str {
        use mujoco_rs::mujoco_c::mjtIntegrator::{mjINT_IMPLICITFAST, mjINT_RK4};
        let option = self.0.opt();
        let is = |integrator| option.integrator == integrator as i32;
        if is(mjINT_RK4) {
            "the robot file's integrator is Runge-Kutta; take integrator=\"implicitfast\" there"
        } else if !is(mjINT_IMPLICITFAST) {
            "the robot file's integrator is implicit in Coriolis forces; take integrator=\"implicitfast\" there"
        } else if option.density != 0.0 || option.viscosity != 0.0 {
            "the robot file's implicitfast is implicit in what air or water do (density, viscosity); take these out, or integrator=\"Euler\""
        } else {
            "the robot file's implicitfast is implicit in dampers of tendons or actuators that act on more than a joint; take these out, or \
             integrator=\"Euler\""
        }
    }

    /// Whether a physics step is MuJoCo's Runge-Kutta of fourth order.
    pub fn is_runge_kutta(&self) -> bool {
        self.0.opt().integrator == mujoco_rs::mujoco_c::mjtIntegrator::mjINT_RK4 as i32
    }

    /// Mass of all bodies \[kg\].
    pub fn total_mass(&self) -> f64 {
        self.0.totalmass()
    }

    /// Initial configuration of the file (nq).
    pub fn qpos0(&self) -> &[f64] {
        self.0.qpos0()
    }

    /// Number of a body.
    ///
    /// # Errors
    /// [`MjError::NoBody`].
    pub fn body(&self, name: &str) -> Result<usize, MjError> {
        self.0.name_to_id(MjtObjBase::mjOBJ_BODY, name).ok_or_else(|| MjError::NoBody(name.to_owned()))
    }

    /// Name of a body; a nameless one takes the name of its first joint, else `body<id>`.
    pub fn body_name(&self, body: usize) -> String {
        if let Some(name) = self.name(MjtObjBase::mjOBJ_BODY, body) {
            return name;
        }
        let first = self.0.jnt_bodyid().iter().position(|&b| b as usize == body);
        first.map_or_else(|| format!("body{body}"), |joint| self.joint_name(joint))
    }

    /// Joints in MuJoCo's order.
    pub fn joints(&self) -> Vec<Joint> {
        (0..self.0.jnt_type().len()).map(|id| self.joint(id)).collect()
    }

    /// Actuators that drive a joint, in the order of the action.
    pub fn actuators(&self) -> Vec<Actuator> {
        (0..self.nu()).map(|id| self.actuator(id)).collect()
    }

    fn actuator(&self, id: usize) -> Actuator {
        let joint = self.0.actuator_trnid()[id][0] as usize;
        let [low, high] = self.0.actuator_ctrlrange()[id];
        Actuator {
            name: self.name(MjtObjBase::mjOBJ_ACTUATOR, id).unwrap_or_else(|| self.joint_name(joint)),
            joint: self.joint_name(joint),
            dof: self.0.jnt_dofadr()[joint] as usize,
            gear: self.0.actuator_gear()[id][0],
            is_plain: self.is_plain(id),
            control: id,
            low,
            high,
        }
    }

    /// What actuator `id` gives for its control, the position and the velocity of its joint: `gain u + by_q q + by_v v`; none where it is
    /// another kind, has dynamics or a delay.
    pub fn gains(&self, id: usize) -> Option<[f64; 3]> {
        let (gain, bias) = (self.0.actuator_gainprm().get(id)?, &self.0.actuator_biasprm()[id]);
        let linear = self.0.actuator_gaintype()[id] == MjtGain::mjGAIN_FIXED
            && self.0.actuator_dyntype()[id] == MjtDyn::mjDYN_NONE
            && self.0.actuator_delay()[id] == 0.0;
        match self.0.actuator_biastype()[id] {
            MjtBias::mjBIAS_NONE if linear => Some([gain[0], 0.0, 0.0]),
            MjtBias::mjBIAS_AFFINE if linear && bias[0] == 0.0 => Some([gain[0], bias[1], bias[2]]),
            _ => None,
        }
    }

    /// The largest force of actuator `id` [N·m or N], of one that has a range of it.
    pub fn strength(&self, id: usize) -> f64 {
        self.0.actuator_forcerange()[id][1]
    }

    fn is_plain(&self, id: usize) -> bool {
        self.0.actuator_gaintype()[id] == MjtGain::mjGAIN_FIXED
            && self.0.actuator_gainprm()[id][0] == 1.0
            && self.0.actuator_biastype()[id] == MjtBias::mjBIAS_NONE
            && self.0.actuator_dyntype()[id] == MjtDyn::mjDYN_NONE
            && self.0.actuator_delay()[id] == 0.0
    }

    /// The actuators of the joints that `wanted` names, or all, each of which drives a joint with one degree of freedom within a range.
    ///
    /// # Errors
    /// A sentence naming the actuator that does not.
    pub fn joint_actuators(&self, wanted: Option<&[String]>) -> Result<Vec<Actuator>, String> {
        if self.nu() == 0 {
            return Err("the robot has no actuator; add an <actuator> section".into());
        }
        let mut found = Vec::new();
        for id in 0..self.nu() {
            let driven = self.driven_joint(id);
            if wanted.is_some_and(|names| !driven.as_ref().is_some_and(|joint| names.contains(joint))) {
                continue;
            }
            let name = self.actuator_name(id);
            if driven.is_none() {
                return Err(format!(
                    "actuator '{name}' does not drive a joint with one degree of freedom; use joint transmissions, or name the joints that are to be \
                     commanded in state.controllable, with idm.kind = \"pinocchio\" or guard = true: the actuator is then held at control 0"
                ));
            }
            let [low, high] = self.0.actuator_ctrlrange()[id];
            if !self.0.actuator_ctrllimited()[id] || low >= high {
                return Err(format!(
                    "actuator '{name}' has no ctrlrange; give it one, the action is chosen within it"
                ));
            }
            found.push(self.actuator(id));
        }
        Ok(found)
    }

    /// What holds the actuators that are not in `commanded` where their joints are in `qpos`: control, entry of `qpos` that it is, and its value
    /// elsewhere. An actuator whose control is a position holds its joint; any other does nothing.
    pub fn held(&self, commanded: &[Actuator]) -> Vec<Hold> {
        let rest = (0..self.nu()).filter(|id| !commanded.iter().any(|actuator| actuator.control == *id));
        let hold = |control: usize| {
            let by_position = self.gains(control).filter(|[gain, by_q, _]| *gain > 0.0 && *gain == -by_q);
            let joint = by_position.and_then(|_| self.driven_joint(control));
            let joint = joint.and_then(|name| self.joints().into_iter().find(|joint| joint.name == name));
            Hold { control, idx_q: joint.map(|joint| joint.idx_q), gear: self.0.actuator_gear()[control][0] }
        };
        rest.map(hold).collect()
    }

    fn joint(&self, id: usize) -> Joint {
        let (kind, nq, nv) = match self.0.jnt_type()[id] {
            MjtJoint::mjJNT_FREE => (JointKind::Free, 7, 6),
            MjtJoint::mjJNT_BALL => (JointKind::Ball, 4, 3),
            MjtJoint::mjJNT_SLIDE => (JointKind::Slide, 1, 1),
            MjtJoint::mjJNT_HINGE => (JointKind::Hinge, 1, 1),
        };
        let limited = self.0.jnt_limited()[id] && nv == 1;
        Joint {
            name: self.joint_name(id),
            kind,
            idx_q: self.0.jnt_qposadr()[id] as usize,
            nq,
            idx_v: self.0.jnt_dofadr()[id] as usize,
            nv,
            range: if limited { self.0.jnt_range()[id] } else { [f64::NEG_INFINITY, f64::INFINITY] },
            effort: if self.0.jnt_actfrclimited()[id] {
                self.0.jnt_actfrcrange()[id][1]
            } else {
                f64::INFINITY
            },
        }
    }

    /// First entries in `qpos` of the quaternions of free and ball joints.
    pub(super) fn quaternions(&self) -> impl Iterator<Item = usize> + '_ {
        let starts = self.0.jnt_type().iter().zip(self.0.jnt_qposadr());
        starts.filter_map(|(kind, at)| match kind {
            MjtJoint::mjJNT_FREE => Some(*at as usize + 3),
            MjtJoint::mjJNT_BALL => Some(*at as usize),
            _ => None,
        })
    }

    /// Its own, or `joint<id>`; with as many `_` behind as it takes to be no other joint's.
    fn joint_name(&self, id: usize) -> String {
        self.name(MjtObjBase::mjOBJ_JOINT, id).unwrap_or_else(|| {
            let mut name = format!("joint{id}");
            while self.0.name_to_id(MjtObjBase::mjOBJ_JOINT, &name).is_some() {
                name.push('_');
            }
            name
        })
    }

    fn name(&self, kind: MjtObjBase, id: usize) -> Option<String> {
        self.0.id_to_name(kind, id).filter(|name| !name.is_empty()).map(str::to_owned)
    }
}

/// Compiles a text as if it stood in a file of `folder`.
fn compile(text: &str, folder: Option<&Path>) -> Result<MjModel, MjError> {
    let (path, files) = as_file(text, folder)?;
    MjModel::from_xml_vfs(&path, &files).map_err(|e| match e {
        MjModelError::LoadFailed(said) => guard::refused(&path, &files, &said),
        other => MjError::Load(guard::one_line(&other.to_string())),
    })
}

/// A robot file's text with the places of the files that it names by a package of ROS; `folder` is where it lies.
pub fn placed(text: &str, folder: Option<&Path>) -> String {
    packages::resolve(text.to_owned(), folder)
}

/// A text as a file of `folder`, or of no folder.
fn as_file(text: &str, folder: Option<&Path>) -> Result<(PathBuf, MjVfs), MjError> {
    let path = folder.map_or(PathBuf::from("model.xml"), |folder| folder.join("nearl-robot.xml"));
    let mut files = MjVfs::new();
    let added = files.add_from_buffer(&path, text.as_bytes());
    added.map_err(|e| MjError::Load(guard::one_line(&e.to_string())))?;
    Ok((path, files))
}

/// Hangs a URDF's root link on the world by a free joint.
fn set_afloat(urdf: &str) -> Result<String, MjError> {
    let model = nearl_runtime::constraints::Model::from_urdf_text(urdf);
    let root =
        model.map(|m| m.description().bodies[0].name.clone()).map_err(|e| MjError::Load(e.to_string()))?;
    if root == "world" {
        let reason = "the root link of the URDF is called 'world', which is MuJoCo's own, and a base that floats hangs on it; call the link otherwise";
        return Err(MjError::Load(reason.into()));
    }
    let end = urdf.rfind("</robot>").unwrap_or(urdf.len());
    let joint = format!(
        "<link name=\"world\"/><joint name=\"root_joint\" type=\"floating\"><parent link=\"world\"/><child link=\"{root}\"/></joint>"
    );
    Ok(format!("{}{joint}{}", &urdf[..end], &urdf[end..]))
}

/// Adds MuJoCo's setting that keeps fixed links after the opening `<robot ...>`.
fn keep_fixed_links(urdf: &str) -> String {
    let opening = urdf.find("<robot").and_then(|at| urdf[at..].find('>').map(|end| at + end + 1));
    match opening {
        Some(at) if !urdf.contains("<mujoco") => {
            let (head, rest) = urdf.split_at(at);
            format!("{head}<mujoco><compiler fusestatic=\"false\"/></mujoco>{rest}")
        }
        _ => urdf.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::{Model, ModelFormat, Options, Sim, mjtDisableBit};
    use crate::{robot, tasks};
    use rand::{RngExt, SeedableRng};
    use std::sync::Arc;

    /// Falling, limping and lying robots with and without the search for islands.
    #[test]
    fn one_tree_needs_no_islands() {
        let islands = mjtDisableBit::mjDSBL_ISLAND as i32;
        for task in ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5"] {
            let manifest = tasks::load(task, &[]).expect("task");
            let text = robot::simulation(&manifest).expect("bundled").text;
            let without = Model::from_text(&text, ModelFormat::Mjcf, Options::default()).expect("robot");
            assert_ne!(without.0.opt().disableflags & islands, 0, "{task}");
            let mut with = Model::from_text(&text, ModelFormat::Mjcf, Options::default()).expect("robot");
            Arc::get_mut(&mut with.0).expect("not shared").opt_mut().disableflags &= !islands;
            let (mut a, mut b) = (Sim::new(&without).expect("a"), Sim::new(&with).expect("b"));
            let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
            for step in 0..1000 {
                for control in 0..without.nu() {
                    let value = random.random_range(-1.0..1.0);
                    (a.ctrl_mut()[control], b.ctrl_mut()[control]) = (value, value);
                }
                a.step(5).expect("a step");
                b.step(5).expect("b step");
                let bits =
                    |sim: &Sim| sim.qpos().iter().chain(sim.qvel()).map(|x| x.to_bits()).collect::<Vec<_>>();
                assert_eq!(bits(&a), bits(&b), "{task}, step {step}");
            }
            assert!(a.qpos().iter().all(|q| q.is_finite()));
        }
    }
}
