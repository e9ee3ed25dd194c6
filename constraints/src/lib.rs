//! Robot model, dynamics, limits and the projector.
#![allow(dead_code)]
pub mod convention;
mod dynamics;
mod error;
mod mjcf;
mod model;
mod pinocchio;
mod urdf;
pub use dynamics::Dynamics;
pub use error::{LimitError, ModelError};
pub use model::{Joint, Model};
