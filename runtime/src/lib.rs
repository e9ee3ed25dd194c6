//! Snapshot, networks, controller, real-time loop and links.

pub mod link;
pub mod log;
pub mod rt;
