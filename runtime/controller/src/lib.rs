//! Task, snapshot, networks, inverse dynamics and the controller: what a program embeds to run a trained policy within its limits.
//!
//! Read [`controller`] first: the one data path is on that page. Nothing here opens a link, starts a thread or reads a command line.

mod arrival;
pub mod codes;
pub mod command;
pub mod controller;
pub mod file_kind;
mod followers;
pub mod idm;
pub mod motors;
pub mod net;
pub mod normaliser;
pub mod recipe;
pub mod snapshot;
pub mod task;

pub use nearl_constraints as constraints;

pub use controller::{Controller, Excess, Noise, Output, State};
pub use snapshot::{Manifest, Networks, PolicyKind, Snapshot, SnapshotError};
pub use task::Task;
