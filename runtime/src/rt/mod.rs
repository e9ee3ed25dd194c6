//! The real-time loop: one thread that computes, one that talks, one that receives snapshots, one that builds, one that logs.
//!
//! ```text
//! plant ──state──> I/O thread ──ring, bell──> real-time thread: wait, swap, sense, decide, act, send, account
//!       <─action──            <──ring────────
//! trainer ──snapshot──> receiver ──> I/O ──> builder ──> I/O ──slot──> real-time thread ──old controller──> I/O ──> builder (dropped there)
//! ```
//!
//! The pages to read are `core.rs`, a tick without threads and clocks, and `cycle.rs`, the thread around it. A run is [`run`]: a snapshot file on a plant by name.

mod bench;
mod brake;
mod build;
pub mod clock;
pub mod core;
mod cycle;
pub mod faults;
mod grid;
mod inbox;
mod io;
mod mode;
mod pilot;
mod receive;
mod report;
mod residual;
mod run;
mod stop;
pub mod swap;
pub(crate) mod thread;
mod tick;

pub use bench::bench_wake;
pub use brake::Brake;
pub use core::{Core, CoreSettings, Inputs, Loaded};
pub use cycle::Sync;
pub use faults::{Fault, FaultKind, FaultPlan, FaultyPlant, Odd};
pub use grid::Grid;
pub use mode::{Event, Mode, ModeLimits, Modes, Reason};
pub use pilot::{Pilot, PilotBuilder, describe, numbers};
pub(crate) use report::percentiles;
pub use report::{Percentiles, PlantSummary, RunReport};
pub use residual::RollbackSettings;
pub use run::{RunError, RunSettings, connect, run, run_loop};
pub use stop::Stop;
pub use thread::{CountAllocations, ThreadSettings, Usage, prepare};
pub use tick::{Build, Counters, MAX_ROWS, Outcome, Record, Refusal, Row, Sensed, Step, Tick};
