//! One record as JSON, and the schema that describes it.

use std::borrow::Cow;

use serde::Serialize;

use crate::rt::{Mode, Reason, Record};

/// JSON schema of the `tick` topic.
pub(crate) const SCHEMA: &str = r#"{
  "title": "nearl.Tick", "type": "object",
  "properties": {
    "tick": {"type": "integer"}, "due_ns": {"type": "integer"}, "begin_ns": {"type": "integer"}, "end_ns": {"type": "integer"},
    "mode": {"type": "string"}, "reason": {"type": "string"}, "policy_version": {"type": "integer"},
    "fresh": {"type": "boolean"}, "swapped": {"type": "boolean"},
    "state": {"type": "object", "properties": {
      "epoch": {"type": "integer"}, "seq": {"type": "integer"}, "stamp_ns": {"type": "integer"}, "tick": {"type": "integer"}, "time": {"type": "number"},
      "episode": {"type": "integer"}, "episode_tick": {"type": "integer"}, "bits": {"type": "integer"}, "saturated": {"type": "integer"},
      "reward": {"type": "number"}, "episode_return": {"type": "number"}, "late": {"type": "integer"}, "watchdog": {"type": "integer"},
      "violations": {"type": "array", "items": {"type": "integer"}}, "worst": {"type": "array", "items": {"type": "number"}},
      "q": {"type": "array", "items": {"type": "number"}}, "v": {"type": "array", "items": {"type": "number"}},
      "obs": {"type": "array", "items": {"type": "number"}}, "applied": {"type": "array", "items": {"type": "number"}}}},
    "proposal_q": {"type": "array", "items": {"type": "number"}}, "proposal_v": {"type": "array", "items": {"type": "number"}},
    "target_q": {"type": "array", "items": {"type": "number"}}, "target_v": {"type": "array", "items": {"type": "number"}},
    "action": {"type": "array", "items": {"type": "number"}},
    "log_prob_proposal": {"type": "number"}, "log_prob_action": {"type": "number"},
    "ledger": {"type": "object", "properties": {
      "status": {"type": "integer"}, "rung": {"type": "integer"}, "active": {"type": "integer"}, "iterations": {"type": "integer"},
      "raw_violations": {"type": "integer"}, "projected_violations": {"type": "integer"}, "moved": {"type": "number"},
      "slack": {"type": "number"}, "residual": {"type": "number"}, "duration_ns": {"type": "integer"}}},
    "overruns": {"type": "integer"}, "stale": {"type": "integer"}, "lost_states": {"type": "integer"}
  }
}"#;

#[derive(Serialize)]
struct TickJson<'a> {
    tick: u64,
    due_ns: u64,
    begin_ns: u64,
    end_ns: u64,
    mode: Mode,
    reason: Reason,
    policy_version: u64,
    fresh: bool,
    swapped: bool,
    state: StateJson<'a>,
    proposal_q: &'a [f64],
    proposal_v: &'a [f64],
    target_q: &'a [f64],
    target_v: &'a [f64],
    action: &'a [f64],
    log_prob_proposal: f64,
    log_prob_action: f64,
    ledger: LedgerJson,
    overruns: u64,
    stale: u64,
    lost_states: u64,
}

#[derive(Serialize)]
struct StateJson<'a> {
    epoch: u64,
    seq: u64,
    stamp_ns: u64,
    tick: u64,
    time: f64,
    episode: u64,
    episode_tick: u64,
    bits: u32,
    saturated: u32,
    reward: f64,
    episode_return: f64,
    late: u64,
    watchdog: u64,
    violations: Cow<'a, [u64]>,
    worst: Cow<'a, [f64]>,
    q: &'a [f64],
    v: &'a [f64],
    obs: &'a [f64],
    applied: &'a [f64],
}

#[derive(Serialize)]
struct LedgerJson {
    status: u32,
    rung: u32,
    active: u32,
    iterations: u32,
    raw_violations: u32,
    projected_violations: u32,
    moved: f64,
    slack: f64,
    residual: f64,
    duration_ns: u64,
}

/// Writes `record` as one JSON object into `out` (cleared first). Vectors of a tick without an action are empty.
pub(crate) fn encode(record: &Record, out: &mut Vec<u8>) -> serde_json::Result<()> {
    out.clear();
    serde_json::to_writer(out, &tick(record))
}

fn tick(record: &Record) -> TickJson<'_> {
    let (step, state, counters) = (&record.step, &record.state, &record.counters);
    let acted = step.nu > 0;
    let (nq, nv) = if acted { (state.q().len(), state.v().len()) } else { (0, 0) };
    TickJson {
        tick: record.tick,
        due_ns: record.due,
        begin_ns: record.begin,
        end_ns: record.end,
        mode: record.mode,
        reason: record.reason,
        policy_version: record.policy_version,
        fresh: record.fresh,
        swapped: record.swapped,
        state: state_json(record),
        proposal_q: &step.proposal_q[..nq],
        proposal_v: &step.proposal_v[..nv],
        target_q: &step.target_q[..nq],
        target_v: &step.target_v[..nv],
        action: &step.action[..(step.nu as usize).min(step.action.len())],
        log_prob_proposal: step.log_prob_proposal,
        log_prob_action: step.log_prob_action,
        ledger: ledger_json(record),
        overruns: counters.overruns,
        stale: counters.stale,
        lost_states: counters.lost_states,
    }
}

fn state_json(record: &Record) -> StateJson<'_> {
    let state = &record.state;
    StateJson {
        epoch: state.header.epoch,
        seq: state.header.seq,
        stamp_ns: state.header.stamp,
        tick: state.tick,
        time: state.time,
        episode: state.episode,
        episode_tick: state.episode_tick,
        bits: state.bits,
        saturated: state.saturated,
        reward: state.reward,
        episode_return: state.episode_return,
        late: state.late,
        watchdog: state.watchdog,
        violations: Cow::Borrowed(&state.violations),
        worst: Cow::Borrowed(&state.worst),
        q: state.q(),
        v: state.v(),
        obs: state.obs(),
        applied: state.applied(),
    }
}

fn ledger_json(record: &Record) -> LedgerJson {
    let ledger = record.step.ledger;
    LedgerJson {
        status: ledger.status,
        rung: ledger.rung,
        active: ledger.active,
        iterations: ledger.iterations,
        raw_violations: ledger.raw_violations,
        projected_violations: ledger.projected_violations,
        moved: ledger.moved,
        slack: ledger.slack,
        residual: ledger.residual,
        duration_ns: ledger.duration,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schema_names_exactly_the_fields_that_are_written() {
        let schema: serde_json::Value = serde_json::from_str(SCHEMA).unwrap();
        let mut record = Record::new();
        record.step.nu = 1;
        let mut out = Vec::new();
        encode(&record, &mut out).unwrap();
        let tick: serde_json::Value = serde_json::from_slice(&out).unwrap();
        let keys = |v: &serde_json::Value| v.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        let properties = &schema["properties"];
        assert_eq!(keys(properties), keys(&tick));
        for part in ["state", "ledger"] {
            assert_eq!(keys(&properties[part]["properties"]), keys(&tick[part]), "{part}");
        }
    }

    #[test]
    fn numbers_come_back_bit_for_bit() {
        let mut record = Record::new();
        record.state.nv = 4;
        record.state.v_mut().copy_from_slice(&[0.1 + 0.2, 1e-310, -0.0, f64::MAX]);
        let mut out = Vec::new();
        encode(&record, &mut out).unwrap();
        let text = String::from_utf8(out).unwrap();
        let (_, after) = text.split_once("\"v\":[").unwrap();
        let (list, _) = after.split_once(']').unwrap();
        let read: Vec<u64> = list.split(',').map(|x| x.parse::<f64>().unwrap().to_bits()).collect();
        let written: Vec<u64> = record.state.v().iter().map(|v| v.to_bits()).collect();
        assert_eq!(read, written);
    }
}
