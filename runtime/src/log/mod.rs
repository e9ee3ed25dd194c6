//! Flight log: one message a tick in an MCAP file, written by a thread of its own with bounded memory.
//!
//! Messages are JSON with a JSON schema in compressed chunks, so any MCAP reader shows them, at the time of day they were made. Numbers are
//! written so that reading them gives the same bits. The names of rows, joints, statuses and units are written once, in the metadata
//! and with each snapshot. Snapshots are attachments, and topic `snapshot` says which number is which.
//!
//! If the disk is slow, what replay can compute is left out of the ticks first (topic `brief`). If that is not enough, or the disk is full,
//! whole records are dropped and counted; the loop never notices. [`replay()`] computes a log again, and after a gap goes on from the next
//! memory (topic `memory`).

mod brief;
mod facts;
mod queue;
mod replay;
#[cfg(test)]
mod slow;
mod tick;
mod writer;

pub use facts::facts;
pub use queue::{LogError, LogQueue, LogSummary};
pub use replay::{Difference, Gap, Replay, ReplayError, replay, replay_with};
pub use tick::SCHEMA_VERSION;
