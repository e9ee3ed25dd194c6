//! Real-time loop, links, flight log and doctor: with the controller of `nearl-controller`, all a robot needs.
//!
//! Read [`controller`] first: the one data path is on that page. The feature `cli`, on by default, holds the command line: `cli`, `doctor` and
//! `tunnel`.

#[cfg(feature = "cli")]
// Help texts name units in brackets, which are no links.
#[allow(rustdoc::broken_intra_doc_links)]
pub mod cli;
pub mod clock;
pub mod codes;
#[cfg(feature = "cli")]
pub mod doctor;
pub mod gains;
mod grid;
pub mod holding;
pub mod link;
pub mod log;
mod percentiles;
pub mod rt;
pub mod stop;
mod thread;
#[cfg(feature = "cli")]
pub mod tunnel;
pub mod unreachable;

pub use nearl_controller::constraints;
pub use nearl_controller::{
    Controller, Excess, Manifest, Networks, Noise, Output, PolicyKind, Snapshot, SnapshotError, State, Task,
};
pub use nearl_controller::{
    command, controller, file_kind, idm, motors, multiversion, net, normaliser, recipe, snapshot, task,
};
