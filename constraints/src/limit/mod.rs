//! Limits: what a task file may ask for, one implementation a file.
//!
//! A new one is a file with a type implementing [`Limit`] and what it says [`About`] itself, and its line of the
//! registry below. Limits of single joints narrow the [`LimitSet`]; limits that tie joints together hand out [`Rows`] or a [`Cone`].

mod about;
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
mod registry;
mod set;
mod settings;
mod torque;
mod torque_rate;
mod torque_speed;
mod user;
mod velocity;
mod velocity_profile;

pub use about::{About, Argument, Form, Takes};
pub use acceleration::{AccelerationLimit, AccelerationSettings};
pub use action::{ActionLimit, ActionReport, ActionSettings};
pub use collision::{CollisionLimit, CollisionSettings, SolidSettings};
pub use drive::DriveTorqueLimit;
pub use energy::{EnergyLimit, EnergySettings};
pub use frame::{FrameBox, FrameLimit, FrameSettings, HalfSpace};
pub use frame_speed::{FrameSpeedLimit, FrameSpeedSettings};
pub use jerk::{JerkLimit, JerkSettings};
pub use locked::{LockedJoints, LockedSettings};
pub use margin::AlwaysHard;
pub use moved::{Moved, Pose};
pub use position::{PositionLimit, PositionSettings, STOP_GAPS, end_of_range};
pub use registry::RegisteredLimit;
pub use set::LimitSet;
pub use settings::PerJoint;
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

    /// Where it holds for less than its name says, one sentence each: what a projector's notes tell.
    fn notes(&self, model: &Model, controllable: &[usize]) -> Vec<String> {
        let _ = (model, controllable);
        Vec::new()
    }

    /// Joints that its settings name one by one: a projector notes those that are not controllable, for which nothing holds.
    fn named_joints(&self) -> Vec<&str> {
        Vec::new()
    }

    /// How much its rows or its cone resist; `None` for hard ones. The part in the box is always hard.
    fn soft(&self) -> Option<Soft> {
        None
    }
}

// Key of the task file, settings, where the limit is, its kind with the number in logs and the name in reports.
registry::limits! {
    position: Option<PositionSettings> => position::PositionLimit, Position = 0 "position";
    velocity: Option<VelocitySettings> => velocity::VelocityLimit, Velocity = 1 "velocity";
    acceleration: Option<AccelerationSettings> => acceleration::AccelerationLimit, Acceleration = 2 "acceleration";
    torque: Option<TorqueSettings> => torque::TorqueLimit, Torque = 4 "torque";
    jerk: Option<JerkSettings> => jerk::JerkLimit, Jerk = 5 "jerk";
    torque_speed: Option<TorqueSpeedSettings> => torque_speed::TorqueSpeedLimit, TorqueSpeed = 6 "torque_speed";
    torque_rate: Option<TorqueRateSettings> => torque_rate::TorqueRateLimit, TorqueRate = 7 "torque_rate";
    velocity_profile: Option<VelocityProfileSettings> => velocity_profile::VelocityProfileLimit, VelocityProfile = 14 "velocity_profile";
    locked: Option<LockedSettings> => locked::LockedJoints, Locked = 13 "locked";
    frame: Vec<FrameSettings> => frame::FrameLimit, Frame = 8 "frame";
    frame_speed: Vec<FrameSpeedSettings> => frame_speed::FrameSpeedLimit, FrameSpeed = 9 "frame_speed";
    energy: Option<EnergySettings> => energy::EnergyLimit, Energy = 10 "energy";
    collision: Option<CollisionSettings> => collision::CollisionLimit, Collision = 11 "collision";
    rows: Vec<UserRowSettings> => user::UserRow, User = 12 "user";
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
    if settings.reached.is_some() {
        return Err(LimitError::Unusable {
            what: "reached bounds what a network gives the motors, and no action is given here".into(),
            next: "leave constraints.reached to a controller with a policy on actions or a learned inverse model",
        });
    }
    check_counts(settings)?;
    let mut limits = Vec::new();
    for entry in REGISTRY {
        limits.extend((entry.build)(settings));
    }
    for limit in &limits {
        limit.restrict(model, &[], &mut LimitSet::unlimited(model.nv()))?;
        limit.rows(model, &[])?;
        limit.cone(model, &[])?;
    }
    Ok(limits)
}

/// Entries of one list of `[constraints]`: the memory of a projector grows with their square.
const MOST: usize = 500;

/// Refuses lists that no robot needs and that would take all the memory there is.
fn check_counts(s: &ConstraintSettings) -> Result<(), LimitError> {
    let collision = s.collision.as_ref();
    let lists = [
        ("rows", s.rows.len()),
        ("frame", s.frame.len()),
        ("frame_speed", s.frame_speed.len()),
        ("collision.shapes", collision.map_or(0, |c| c.shapes.len())),
        ("collision.ignore", collision.map_or(0, |c| c.ignore.len())),
        ("collision.rows", collision.map_or(0, |c| c.rows)),
    ];
    match lists.into_iter().find(|(_, count)| *count > MOST) {
        None => Ok(()),
        Some((list, count)) => Err(LimitError::Unusable {
            what: format!("constraints.{list} has {count} entries, more than the {MOST} that are kept"),
            next: "leave out those that others imply",
        }),
    }
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
