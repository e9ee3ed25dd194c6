//! Limits: what a task file may ask for, one implementation a file.
//!
//! A new one is a file with a type implementing [`Limit`], a field in [`ConstraintSettings`] and a line in
//! [`REGISTRY`]. Limits of single joints narrow the [`LimitSet`]; limits that tie joints together hand out [`Rows`] or a [`Cone`].

mod acceleration;
mod action;
mod clearance;
mod collision;
mod drive;
mod energy;
mod frame;
mod frame_speed;
mod jerk;
mod locked;
mod margin;
mod moved;
mod position;
mod set;
mod settings;
mod torque;
mod torque_rate;
mod torque_speed;
mod user;
mod velocity;
mod velocity_profile;

pub use acceleration::{AccelerationLimit, AccelerationSettings};
pub use action::{ActionLimit, ActionReport, ActionSettings};
pub use collision::{CollisionLimit, CollisionSettings, SolidSettings};
pub use drive::DriveTorqueLimit;
pub use energy::{EnergyLimit, EnergySettings};
pub use frame::{FrameBox, FrameLimit, FrameSettings, HalfSpace};
pub use frame_speed::{FrameSpeedLimit, FrameSpeedSettings};
pub use jerk::{JerkLimit, JerkSettings};
pub use locked::LockedJoints;
pub use margin::AlwaysHard;
pub use moved::Moved;
pub use position::{PositionLimit, PositionSettings};
pub use set::LimitSet;
pub use settings::{ConstraintSettings, PerJoint};
pub use torque::{TorqueLimit, TorqueSettings};
pub use torque_rate::{TorqueRateLimit, TorqueRateSettings};
pub use torque_speed::{TorqueSpeedLimit, TorqueSpeedSettings};
pub use user::{UserRow, UserRowSettings};
pub use velocity::{VelocityLimit, VelocitySettings};
pub use velocity_profile::{
    JointProfile, KnownRobot, RobotProfile, VelocityProfileLimit, VelocityProfileSettings,
};

use crate::{Cone, LimitError, Model, Rows, Soft};

/// A limit on the motion: a part of the box of each joint, rows or a cone over several joints, or both.
pub trait Limit: Send + Sync + std::fmt::Debug {
    /// Name in the task file.
    fn name(&self) -> &'static str;

    /// Name to switch it on and off by, where several limits share [`Limit::name`].
    fn label(&self) -> &str {
        self.name()
    }

    /// Narrows `set` for the dofs in `controllable`.
    ///
    /// # Errors
    /// Unknown joints, values out of their domain, or limits the robot file does not state; every joint is listed.
    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        let _ = (model, controllable, set);
        Ok(())
    }

    /// The rows it adds, anew for each caller.
    ///
    /// # Errors
    /// As [`Limit::restrict`].
    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        let _ = (model, controllable);
        Ok(None)
    }

    /// The cone it adds, anew for each caller.
    ///
    /// # Errors
    /// As [`Limit::restrict`].
    fn cone(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Cone>>, LimitError> {
        let _ = (model, controllable);
        Ok(None)
    }

    /// How much its rows or its cone resist; `None` for hard ones. The part in the box is always hard.
    fn soft(&self) -> Option<Soft> {
        None
    }
}

/// Makes the limits of one kind from the task file's section.
type Build = fn(&ConstraintSettings, &Model) -> Result<Vec<Box<dyn Limit>>, LimitError>;

/// Whether a kind of limit forbids or resists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// Always hard: braking counts on it.
    Hard,
    /// Soft: braking comes first. `jerk` is hard with `hard = true`.
    Soft,
    /// Hard unless `soft` is given.
    Either,
}

/// One kind of limit.
pub struct LimitEntry {
    /// Name in the task file.
    pub name: &'static str,
    /// What a line of the task file looks like, with the joints of a Panda.
    pub example: &'static str,
    /// Hard, soft or either.
    pub form: Form,
    /// Makes the limits.
    pub build: Build,
}

/// All kinds of limits by their name in the task file.
pub const REGISTRY: &[LimitEntry] = &[
    LimitEntry {
        name: "position",
        example: "position = { margin = 0.01 }",
        form: Form::Hard,
        build: |s, _| Ok(one(&s.position, PositionLimit::new)),
    },
    LimitEntry {
        name: "velocity",
        example: "velocity = { scale = 0.8 }",
        form: Form::Hard,
        build: |s, _| Ok(one(&s.velocity, VelocityLimit::new)),
    },
    LimitEntry {
        name: "acceleration",
        example: "acceleration = { limit = 10.0 }",
        form: Form::Hard,
        build: |s, _| Ok(one(&s.acceleration, AccelerationLimit::new)),
    },
    LimitEntry {
        name: "torque",
        example: "torque = { scale = 0.9 }",
        form: Form::Either,
        build: |s, _| Ok(one(&s.torque, TorqueLimit::new)),
    },
    LimitEntry {
        name: "jerk",
        example: "jerk = { limit = 500.0 }",
        form: Form::Soft,
        build: |s, _| Ok(one(&s.jerk, JerkLimit::new)),
    },
    LimitEntry {
        name: "torque_speed",
        example: "torque_speed = { stall = 80.0, no_load = 3.0 }",
        form: Form::Either,
        build: |s, _| Ok(one(&s.torque_speed, TorqueSpeedLimit::new)),
    },
    LimitEntry {
        name: "torque_rate",
        example: "torque_rate = { limit = 1000.0 }",
        form: Form::Soft,
        build: |s, _| Ok(one(&s.torque_rate, TorqueRateLimit::new)),
    },
    LimitEntry {
        name: "velocity_profile",
        example: "velocity_profile = \"fr3\"",
        form: Form::Hard,
        build: |s, _| Ok(one(&s.velocity_profile, VelocityProfileLimit::new)),
    },
    LimitEntry {
        name: "locked",
        example: "locked = [\"panda_joint7\"]",
        form: Form::Hard,
        build: |s, _| Ok(one(&(!s.locked.is_empty()).then(|| s.locked.clone()), LockedJoints::new)),
    },
    LimitEntry {
        name: "frame",
        example: "frame = [{ frame = \"panda_hand\", half_space = { normal = [0, 0, -1], through = [0, 0, 0.1] }, braking = 5.0 }]",
        form: Form::Either,
        build: |s, _| Ok(each(&s.frame, FrameLimit::new)),
    },
    LimitEntry {
        name: "frame_speed",
        example: "frame_speed = [{ frame = \"panda_hand\", limit = 0.25 }]",
        form: Form::Either,
        build: |s, _| Ok(each(&s.frame_speed, FrameSpeedLimit::new)),
    },
    LimitEntry {
        name: "energy",
        example: "energy = { limit = 2.0 }",
        form: Form::Either,
        build: |s, _| Ok(one(&s.energy, EnergyLimit::new)),
    },
    LimitEntry {
        name: "collision",
        example: "collision = { shapes = [{ frame = \"panda_hand\", shape = { sphere = { radius = 0.1 } } }, \
                  { name = \"floor\", shape = \"half_space\" }], braking = 2.0 }",
        form: Form::Either,
        build: |s, _| Ok(one(&s.collision, CollisionLimit::new)),
    },
    LimitEntry {
        name: "rows",
        example: "rows = [{ name = \"elbow up\", terms = { \"q.panda_joint4\" = 1.0 }, upper = -0.5, braking = 2.0 }]",
        form: Form::Either,
        build: |s, _| Ok(each(&s.rows, UserRow::new)),
    },
];

/// The limit a setting asks for, if any.
fn one<S: Clone, L: Limit + 'static>(settings: &Option<S>, new: fn(S) -> L) -> Vec<Box<dyn Limit>> {
    each(settings.as_slice(), new)
}

/// A limit for each setting.
fn each<S: Clone, L: Limit + 'static>(settings: &[S], new: fn(S) -> L) -> Vec<Box<dyn Limit>> {
    settings.iter().map(|s| Box::new(new(s.clone())) as Box<dyn Limit>).collect()
}

/// The limits that a task file's `[constraints]` asks for, checked against all joints of `model` they name.
///
/// # Errors
/// Unknown joints and values out of their domain; [`ActionSettings`], which are no limits of a state. Limits that the robot file lacks are found by
/// [`Projector::new`](crate::Projector::new), which knows the controllable dofs.
pub fn build_limits(settings: &ConstraintSettings, model: &Model) -> Result<Vec<Box<dyn Limit>>, LimitError> {
    if settings.action.is_some() {
        return Err(LimitError::Unusable {
            what: "action limits what a network gives the motors, and no state is proposed here".into(),
            next: "leave [constraints.action] to a controller with a policy on actions or a learned inverse model",
        });
    }
    let mut limits = Vec::new();
    for entry in REGISTRY {
        limits.extend((entry.build)(settings, model)?);
    }
    for limit in &limits {
        limit.restrict(model, &[], &mut LimitSet::unlimited(model.nv()))?;
        limit.rows(model, &[])?;
        limit.cone(model, &[])?;
    }
    Ok(limits)
}

/// "a; b; c" over dofs.
fn listed<'a>(dofs: impl Iterator<Item = &'a usize>, text: impl Fn(usize) -> String) -> String {
    dofs.map(|i| text(*i)).collect::<Vec<_>>().join("; ")
}

/// "'a', 'b'" over dofs.
fn quoted(model: &Model, dofs: &[usize]) -> String {
    dofs.iter().map(|i| format!("'{}'", model.dof_name(*i))).collect::<Vec<_>>().join(", ")
}

/// "'a', 'b'".
fn quoted_names(names: &[&str]) -> String {
    names.iter().map(|n| format!("'{n}'")).collect::<Vec<_>>().join(", ")
}
