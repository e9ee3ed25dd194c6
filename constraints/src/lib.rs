//! Robot model, dynamics, limits and the projector.

pub mod checker;
pub mod convention;
mod dynamics;
mod error;
mod layout;
pub mod ledger;
pub mod limit;
mod mjcf;
mod model;
mod pinocchio;
mod projector;
mod target;
mod urdf;
pub mod viability;

pub use dynamics::Dynamics;
pub use error::{LimitError, ModelError};
pub use layout::{Entry, LayoutError, StateLayout};
pub use ledger::{ActiveRow, BrakeReason, Counts, Ledger, RefuseReason, Rung, Side, Status};
pub use limit::{
    AccelerationLimit, ConstraintSettings, Limit, LimitSet, PerJoint, PositionLimit, TorqueLimit,
    VelocityLimit, build_limits,
};
pub use model::{Joint, Model};
pub use projector::{Problem, Projector};
pub use target::{Bounds, Consistency, Proposal, Settings, Solver, Target};
pub use viability::{Kind, Period};
