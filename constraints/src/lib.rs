//! Robot model, dynamics, limits, and the projector: from the next state a policy proposes to the nearest one that
//! every limit allows.
//!
//! ```no_run
//! use nearl_constraints::*;
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let model = Model::from_urdf("examples/robots/panda/panda.urdf".as_ref())?;
//! let limits: Vec<Box<dyn Limit>> = vec![
//!     Box::new(PositionLimit::with_margin(0.01)),
//!     Box::new(VelocityLimit::scaled(0.6)),
//!     Box::new(AccelerationLimit::uniform(2.0)),
//!     Box::new(TorqueLimit::default()),
//! ];
//! let mut projector = Projector::new(&model, &limits, &[0, 1, 2, 3, 4, 5, 6], Settings::new(1e-3, 1))?;
//! let (q, v) = (model.neutral(), vec![0.0; model.nv()]); // measured
//! let (proposal, mut target) = (Proposal::new(&model), Target::new(&model));
//! let status = projector.project(&q, &v, &proposal, &mut target);
//! println!("{status:?} {:?} {:?}", target.acceleration, target.ledger.active);
//! # Ok(()) }
//! ```
//!
//! # What to read, in this order
//!
//! 1. [`viability`]: why position, velocity and acceleration limits never contradict each other;
//! 2. [`limit`]: what a limit is and how to add one;
//! 3. [`Projector`] (`projector/mod.rs`): the tick; then `projector/coupled.rs` (the rows), `active_set/`, `conic.rs`;
//! 4. [`checker`]: checks a target once more and shares no code with the above; [`certify_braking`]: whether the motors can brake;
//! 5. [`Model`], [`Dynamics`], [`Kinematics`], [`convention`]: the robot, and how it meets MuJoCo; [`geometry`]: distances between solids.
//!
//! # What is promised
//!
//! With analytic inverse dynamics, a fully actuated robot and a model that is right, the reached state obeys position,
//! velocity, acceleration and torque limits for any proposal, as long as the braking holds by [`certify_braking`]. With
//! one physics step in a period that is exact, with several right to second order in it. Contact forces are not modelled. Of a
//! floating base, the rows hold the proposed motion constant.
//!
//! # Linking
//!
//! The build script looks for Pinocchio by `NEARL_SITE_PACKAGES`, `PINOCCHIO_PREFIX`, pkg-config, conda, ROS and the packages of
//! `python3`, in this order. A crate that links a binary, a test or an extension with this one needs the library in its run path: one
//! line in a `build.rs` of its own, with this crate as a dependency.
//!
//! ```text
//! fn main() { println!("cargo:rustc-link-arg=-Wl,-rpath,{}", std::env::var("DEP_NEARL_PINOCCHIO_LIB").unwrap()); }
//! ```

mod assemble;
mod certify;
pub mod checker;
pub mod convention;
pub mod description;
pub mod drive;
mod dynamics;
mod error;
mod file;
mod friction;
pub mod geometry;
pub mod jerk;
mod kinematics;
mod layout;
pub mod ledger;
pub mod limit;
mod model;
mod period_dynamics;
mod physics_steps;
mod pinocchio;
mod projector;
mod random;
mod recent;
pub mod row;
mod target;
mod urdf;
pub mod viability;
mod within_period;

pub use certify::{Certificate, certify_braking};
pub use description::RobotDescription;
pub use drive::Drive;
pub use dynamics::Dynamics;
pub use error::{LimitError, ModelError};
pub use file::{MAX_TASK_BYTES, MAX_TEXT_BYTES, open_regular, read_bounded, read_task_text, read_text};
pub use friction::MADE_UP_FOR;
pub use kinematics::{FrameMotion, Kinematics, PointMotion};
pub use layout::{Entry, LayoutError, StateLayout, parts_of};
pub use ledger::{ActiveRow, BrakeReason, Counts, Ledger, RefuseReason, Rung, Side, Status};
pub use limit::*;
pub use model::{FrameId, Joint, Model};
pub use period_dynamics::PeriodDynamics;
pub use physics_steps::PhysicsSteps;
#[doc(hidden)]
pub use projector::{CoupledStages, Numbers};
pub use projector::{Problem, ProblemCone, Projector};
pub use recent::Recent;
pub use row::{Cone, Rows, Soft};
pub use target::{Bounds, Braking, Consistency, Guard, Proposal, Settings, Solver, Target};
pub use viability::Period;
