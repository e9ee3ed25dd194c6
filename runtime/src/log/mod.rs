//! Flight log: one message a tick in an MCAP file, written by a thread of its own with bounded memory.
//!
//! Messages are JSON with a JSON schema, so any MCAP reader shows them; numbers are written so that reading them gives
//! the same bits. Snapshots are attachments, and topic `snapshot` says which number is which. If the disk is slow or
//! full, records are dropped and counted; the loop never notices. [`replay()`] computes a log again.

mod facts;
mod queue;
mod replay;
mod tick;

pub(crate) use facts::facts;
pub use queue::{LogError, LogQueue, LogSummary};
pub use replay::{Difference, Replay, ReplayError, replay, replay_with};
pub use tick::SCHEMA_VERSION;
