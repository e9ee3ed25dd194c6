//! Flight log: one message a tick in an MCAP file, written by a thread of its own with bounded memory.
//!
//! Messages are JSON with a JSON schema, so any MCAP reader shows them; numbers are written so that reading them gives
//! the same bits. If the disk is slow or full, records are dropped and counted; the loop never notices.

mod encode;
mod queue;

pub use queue::{LogError, LogQueue, LogSummary};
