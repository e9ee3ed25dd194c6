//! Snapshot, networks, controller, real-time loop and links: all a robot needs.
//!
//! Read [`controller`] first: the one data path is on that page.

pub mod cli;
pub mod codes;
pub mod controller;
pub mod doctor;
pub mod idm;
pub mod link;
pub mod log;
pub mod net;
pub mod normaliser;
pub mod rollout_protocol;
pub mod rt;
pub mod snapshot;
pub mod task;
pub mod tunnel;

pub use nearl_constraints as constraints;

pub use controller::{Controller, Excess, Noise, Output, State};
pub use snapshot::{Manifest, Networks, PolicyKind, Snapshot, SnapshotError};
pub use task::Task;
