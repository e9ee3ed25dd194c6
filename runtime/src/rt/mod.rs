//! The real-time loop: one thread that computes, one that talks, one that receives snapshots, one that builds, one that logs.
//!
//! ```text
//! plant ──state──> I/O thread ──ring, bell──> real-time thread: wait, swap, sense, decide, act, send, account
//!       <─action──            <──ring────────
//! trainer ──snapshot──> receiver ──> I/O ──> builder ──> I/O ──slot──> real-time thread ──old controller──> I/O ──> builder (dropped there)
//! ```
//!
//! The pages to read are `core.rs`, a tick without threads and clocks, and `cycle.rs`, the thread around it. A run is [`run`]: a snapshot file on a plant by
//! name.

mod bench;
mod brake;
mod build;
pub mod core;
mod cycle;
pub mod faults;
mod heard;
mod inbox;
mod io;
mod meaning;
mod mode;
mod pace;
mod pilot;
mod pinned;
mod receive;
mod report;
mod residual;
mod resume;
mod run;
pub mod swap;
mod tick;
mod watch;
mod way;

pub use crate::clock;
pub use crate::grid::Grid;
pub use crate::percentiles::Percentiles;
pub use crate::stop::Stop;
pub use crate::thread::{CountAllocations, PRIORITY, ThreadSettings, Usage, prepare};
pub use bench::bench_wake;
pub use brake::Brake;
pub use core::{Core, CoreSettings, Inputs, Loaded, ProposerSettings};
pub use cycle::Sync;
pub use faults::{Fault, FaultKind, FaultPlan, FaultyPlant, Odd};
pub use meaning::Meaning;
pub use mode::{Event, Mode, ModeLimits, Modes, Reason};
pub use pilot::{Asked, Pilot, PilotBuilder, describe, numbers};
pub use pinned::Pinned;
pub use report::{PlantSummary, ProposerSummary, RunReport};
pub use residual::RollbackSettings;
pub use resume::{MAX_MEMORY, Resume};
pub use run::{OnMode, RunError, RunSettings, connect, run, run_loop};
pub use tick::{
    Build, Counters, LoopController, MAX_ROWS, Outcome, Question, Record, Refusal, Row, Sensed, TickOutput,
};
pub use watch::{Found, Watched, WatchedJoint};
pub use way::{Apart, Way};
