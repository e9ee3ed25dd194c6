//! What is kept of a tick where the disk is too slow for all of it, and what replay goes on from after a gap.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use super::tick::{Numbers, StateJson, state_json};
use crate::rt::{Record, Resume, Way};

/// JSON schema of the `brief` topic.
pub(super) const BRIEF_SCHEMA: &str = r#"{
  "title": "nearl.Brief", "type": "object",
  "properties": {
    "tick": {"type": "integer"}, "due_ns": {"type": "integer"}, "begin_ns": {"type": "integer"}, "end_ns": {"type": "integer"},
    "snapshot": {"type": "integer"}, "fresh": {"type": "boolean"}, "ignored": {"type": "boolean"}, "swapped": {"type": "boolean"},
    "stop": {"type": "boolean"}, "duration_ns": {"type": "integer"}, "dropped_actions": {"type": "integer"},
    "dropped_records": {"type": "integer"}, "state": {"type": "object"}, "digest": {"type": "string"}
  }
}"#;

/// JSON schema of the `memory` topic.
pub(super) const MEMORY_SCHEMA: &str = r#"{
  "title": "nearl.Memory", "type": "object",
  "properties": {
    "tick": {"type": "integer"}, "modes": {"type": "array", "items": {"type": "integer"}},
    "grid": {"type": "array", "items": {"type": "integer"}}, "braked": {"type": "integer"}, "ramped": {"type": "integer"},
    "overran": {"type": "boolean"}, "brake_broken": {"type": "boolean"},
    "way": {"type": "array", "items": {"type": "number"}}, "memory": {"type": "array", "items": {"type": "number"}}
  }
}"#;

/// A tick without what replay computes: its inputs, and a digest over the whole message that the `tick` topic would have had.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BriefJson<'a> {
    pub(super) tick: u64,
    pub(super) due_ns: u64,
    pub(super) begin_ns: u64,
    pub(super) end_ns: u64,
    pub(super) snapshot: u64,
    pub(super) fresh: bool,
    pub(super) ignored: bool,
    pub(super) swapped: bool,
    pub(super) stop: bool,
    pub(super) duration_ns: u64,
    pub(super) dropped_actions: u64,
    pub(super) dropped_records: u64,
    pub(super) state: StateJson<'a>,
    pub(super) digest: Cow<'a, str>,
}

/// The first 128 bits of the blake3 hash of a tick's message, in hex.
pub(super) fn digest(message: &[u8]) -> String {
    let mut hex = blake3::hash(message).to_hex().to_string();
    hex.truncate(32);
    hex
}

/// Writes `record`, whose whole message is `whole`, in brief into `out` (cleared first).
pub(super) fn encode_brief(record: &Record, whole: &[u8], out: &mut Vec<u8>) -> serde_json::Result<()> {
    let acted = record.output.nu > 0;
    out.clear();
    let brief = BriefJson {
        tick: record.tick,
        due_ns: record.due,
        begin_ns: record.begin,
        end_ns: record.end,
        snapshot: record.snapshot,
        fresh: record.fresh,
        ignored: record.ignored,
        swapped: record.swapped,
        stop: record.stop,
        duration_ns: if acted { record.output.ledger.duration } else { 0 },
        dropped_actions: record.counters.dropped_actions,
        dropped_records: record.counters.dropped_records,
        state: state_json(&record.state),
        digest: digest(whole).into(),
    };
    serde_json::to_writer(out, &brief)
}

/// What the loop remembered after a tick: with that tick's message, replay goes on from there.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MemoryJson<'a> {
    pub(super) tick: u64,
    modes: [u32; 3],
    grid: [u64; 4],
    braked: u32,
    ramped: u32,
    overran: bool,
    brake_broken: bool,
    /// None in logs of builds that did not compare ways with velocities.
    #[serde(default)]
    way: Numbers<'a>,
    memory: Numbers<'a>,
}

/// Writes what a replay can go on from after `record` into `out` (cleared first).
pub(super) fn encode_memory(record: &Record, out: &mut Vec<u8>) -> serde_json::Result<()> {
    let Resume { modes, grid, braked, ramped, overran, brake_broken, .. } = record.resume;
    out.clear();
    let (way, memory) = (record.resume.way.numbers().into(), record.resume.memory().into());
    let tick = record.tick;
    serde_json::to_writer(
        out,
        &MemoryJson { tick, modes, grid, braked, ramped, overran, brake_broken, way, memory },
    )
}

impl MemoryJson<'_> {
    /// The same for a loop to go on from; `None` if it remembers more than a loop can.
    pub(super) fn resume(&self) -> Option<Resume> {
        let mut resume = Resume {
            is_set: true,
            modes: self.modes,
            grid: self.grid,
            braked: self.braked,
            ramped: self.ramped,
            overran: self.overran,
            brake_broken: self.brake_broken,
            way: Way::of(&self.way.0)?,
            ..Resume::none()
        };
        resume.set_memory(&self.memory.0).then_some(resume)
    }
}
