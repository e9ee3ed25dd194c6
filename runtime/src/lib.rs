//! Real-time loop, links, flight log and doctor: with the controller of `nearl-controller`, all a robot needs.
//!
//! Read [`controller`] first: the one data path is on that page.

pub mod cli;
pub mod codes;
pub mod doctor;
pub mod link;
pub mod log;
pub mod rollout_protocol;
pub mod rt;
pub mod tunnel;

pub use nearl_controller::constraints;
pub use nearl_controller::{
    Controller, Excess, Manifest, Networks, Noise, Output, PolicyKind, Snapshot, SnapshotError, State, Task,
};
pub use nearl_controller::{controller, idm, multiversion, net, normaliser, snapshot, task};
