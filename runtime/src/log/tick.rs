//! One record as JSON and back, and the schema that describes it.
//!
//! Numbers are written so that reading them gives the same bits. JSON has no NaN and no infinity: they are `null`.

use std::borrow::Cow;

use nearl_constraints::Kind;
use serde::{Deserialize, Deserializer, Serialize};

use crate::link::{Message, ProposalMessage, StateMessage};
use crate::rt::{Counters, Mode, Reason, Record, Row, Sensed};

/// Version of the tick messages; replay reads this one only.
pub const SCHEMA_VERSION: u32 = 7;

/// JSON schema of the `tick` topic.
pub(crate) const SCHEMA: &str = r#"{
  "title": "nearl.Tick", "type": "object",
  "properties": {
    "tick": {"type": "integer"}, "due_ns": {"type": "integer"}, "begin_ns": {"type": "integer"}, "end_ns": {"type": "integer"},
    "mode": {"type": "string"}, "reason": {"type": "string"}, "policy_version": {"type": "integer"}, "snapshot": {"type": "integer"},
    "fresh": {"type": "boolean"}, "ignored": {"type": "boolean"}, "swapped": {"type": "boolean"}, "stop": {"type": "boolean"},
    "sensed": {"type": "string"}, "ramp": {"type": "number"}, "noise": {"type": ["number", "null"]},
    "proposed": {"type": ["object", "null"]}, "proposal_age_ns": {"type": ["integer", "null"]},
    "state": {"type": "object", "properties": {
      "epoch": {"type": "integer"}, "seq": {"type": "integer"}, "stamp_ns": {"type": "integer"}, "tick": {"type": "integer"}, "time": {"type": "number"},
      "episode": {"type": "integer"}, "episode_tick": {"type": "integer"}, "bits": {"type": "integer"}, "saturated": {"type": "integer"},
      "late": {"type": "integer"}, "watchdog": {"type": "integer"},
      "q": {"type": "array", "items": {"type": "number"}}, "v": {"type": "array", "items": {"type": "number"}},
      "obs": {"type": "array", "items": {"type": "number"}}, "applied": {"type": "array", "items": {"type": "number"}}}},
    "proposal_q": {"type": "array", "items": {"type": "number"}}, "proposal_v": {"type": "array", "items": {"type": "number"}},
    "target_q": {"type": "array", "items": {"type": "number"}}, "target_v": {"type": "array", "items": {"type": "number"}},
    "action": {"type": "array", "items": {"type": "number"}},
    "log_prob_proposal": {"type": "number"}, "log_prob_action": {"type": "number"}, "period_tick": {"type": "integer"},
    "brake": {"type": "array", "items": {"type": "number"}},
    "ledger": {"type": "object", "properties": {
      "status": {"type": "integer"}, "rung": {"type": "integer"}, "active": {"type": "integer"}, "iterations": {"type": "integer"},
      "raw_violations": {"type": "integer"}, "target_violations": {"type": "integer"}, "outside": {"type": "integer"},
      "moved": {"type": "number"}, "slack": {"type": "number"}, "residual": {"type": "number"}, "duration_ns": {"type": "integer"},
      "active_rows": {"type": "array", "items": {"type": "object", "properties": {
        "kind": {"type": "string"}, "row": {"type": "integer"}, "side": {"type": "string"}, "multiplier": {"type": "number"},
        "slack": {"type": "number"}}}}}},
    "counters": {"type": "object"},
    "overruns": {"type": "integer"}, "stale": {"type": "integer"}, "lost_states": {"type": "integer"}
  }
}"#;

/// A list of numbers, `null` for those JSON does not have.
#[derive(Default, Serialize)]
#[serde(transparent)]
pub(super) struct Numbers<'a>(pub(super) Cow<'a, [f64]>);

impl<'de> Deserialize<'de> for Numbers<'_> {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        let numbers = Vec::<Option<f64>>::deserialize(from)?;
        Ok(Numbers(numbers.into_iter().map(|x| x.unwrap_or(f64::NAN)).collect()))
    }
}

impl<'a> From<&'a [f64]> for Numbers<'a> {
    fn from(numbers: &'a [f64]) -> Self {
        Numbers(Cow::Borrowed(numbers))
    }
}

fn number<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f64::NAN))
}

fn single<'de, D: Deserializer<'de>>(from: D) -> Result<f32, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f32::NAN))
}

/// What replay reads of a tick.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TickJson<'a> {
    pub(crate) tick: u64,
    pub(crate) due_ns: u64,
    pub(crate) begin_ns: u64,
    pub(crate) end_ns: u64,
    mode: Mode,
    reason: Reason,
    policy_version: u64,
    pub(crate) snapshot: u64,
    pub(crate) fresh: bool,
    pub(crate) ignored: bool,
    pub(crate) swapped: bool,
    pub(crate) stop: bool,
    sensed: Sensed,
    #[serde(deserialize_with = "number")]
    ramp: f64,
    #[serde(deserialize_with = "single")]
    noise: f32,
    /// What another process proposed, in the tick in which it came.
    #[serde(default)]
    proposed: Option<ProposedJson<'a>>,
    /// Age of the proposal acted upon.
    #[serde(default)]
    proposal_age_ns: Option<u64>,
    pub(super) state: StateJson<'a>,
    proposal_q: Numbers<'a>,
    proposal_v: Numbers<'a>,
    target_q: Numbers<'a>,
    target_v: Numbers<'a>,
    action: Numbers<'a>,
    #[serde(deserialize_with = "number")]
    log_prob_proposal: f64,
    #[serde(deserialize_with = "number")]
    log_prob_action: f64,
    period_tick: u32,
    brake: Numbers<'a>,
    ledger: LedgerJson,
    pub(crate) counters: Counters,
    overruns: u64,
    stale: u64,
    lost_states: u64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ProposedJson<'a> {
    epoch: u64,
    seq: u64,
    stamp_ns: u64,
    state_epoch: u64,
    state_seq: u64,
    state_stamp_ns: u64,
    kind: u32,
    names: u64,
    values: Numbers<'a>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StateJson<'a> {
    epoch: u64,
    seq: u64,
    stamp_ns: u64,
    tick: u64,
    #[serde(deserialize_with = "number")]
    time: f64,
    episode: u64,
    episode_tick: u64,
    bits: u32,
    saturated: u32,
    late: u64,
    watchdog: u64,
    q: Numbers<'a>,
    v: Numbers<'a>,
    obs: Numbers<'a>,
    applied: Numbers<'a>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LedgerJson {
    status: u32,
    rung: u32,
    active: u32,
    iterations: u32,
    raw_violations: u32,
    target_violations: u32,
    outside: u64,
    #[serde(deserialize_with = "number")]
    moved: f64,
    #[serde(deserialize_with = "number")]
    slack: f64,
    #[serde(deserialize_with = "number")]
    residual: f64,
    duration_ns: u64,
    active_rows: Vec<RowJson>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RowJson {
    kind: Cow<'static, str>,
    row: u16,
    side: Cow<'static, str>,
    #[serde(deserialize_with = "number")]
    multiplier: f64,
    #[serde(deserialize_with = "number")]
    slack: f64,
}

/// Writes `record` as one JSON object into `out` (cleared first). Vectors of a tick without an action are empty.
pub(crate) fn encode(record: &Record, out: &mut Vec<u8>) -> serde_json::Result<()> {
    out.clear();
    serde_json::to_writer(out, &tick(record))
}

fn tick(record: &Record) -> TickJson<'_> {
    let (output, state, counters) = (&record.output, &record.state, &record.counters);
    let acted = output.nu > 0;
    let (nq, nv) = if acted { (state.q().len(), state.v().len()) } else { (0, 0) };
    TickJson {
        tick: record.tick,
        due_ns: record.due,
        begin_ns: record.begin,
        end_ns: record.end,
        mode: record.mode,
        reason: record.reason,
        policy_version: record.policy_version,
        snapshot: record.snapshot,
        fresh: record.fresh,
        ignored: record.ignored,
        swapped: record.swapped,
        stop: record.stop,
        sensed: record.sensed,
        ramp: record.ramp,
        noise: record.noise,
        proposed: record.heard.then(|| proposed_json(&record.proposal)),
        proposal_age_ns: Some(record.proposal_age).filter(|age| *age != u64::MAX),
        state: state_json(state),
        proposal_q: output.proposal_q[..nq].into(),
        proposal_v: output.proposal_v[..nv].into(),
        target_q: output.target_q[..nq].into(),
        target_v: output.target_v[..nv].into(),
        action: output.action[..(output.nu as usize).min(output.action.len())].into(),
        log_prob_proposal: if acted { output.log_prob_proposal } else { 0.0 },
        log_prob_action: if acted { output.log_prob_action } else { 0.0 },
        period_tick: output.period_tick,
        brake: if acted { output.brake().into() } else { [].as_slice().into() },
        ledger: if acted { ledger_json(record) } else { ledger_json(&Record::new()) },
        counters: *counters,
        overruns: counters.overruns,
        stale: counters.stale,
        lost_states: counters.lost_states,
    }
}

fn proposed_json(proposal: &ProposalMessage) -> ProposedJson<'_> {
    ProposedJson {
        epoch: proposal.header.epoch,
        seq: proposal.header.seq,
        stamp_ns: proposal.header.stamp,
        state_epoch: proposal.state_epoch,
        state_seq: proposal.state_seq,
        state_stamp_ns: proposal.state_stamp,
        kind: proposal.kind,
        names: proposal.names,
        values: proposal.values().into(),
    }
}

pub(super) fn state_json(state: &StateMessage) -> StateJson<'_> {
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
        late: state.late,
        watchdog: state.watchdog,
        q: state.q().into(),
        v: state.v().into(),
        obs: state.obs().into(),
        applied: state.applied().into(),
    }
}

fn ledger_json(record: &Record) -> LedgerJson {
    let ledger = record.output.ledger;
    let row = |row: &Row| RowJson {
        kind: Kind::ALL[usize::from(row.kind)].name().into(),
        row: row.row,
        side: Row::SIDES[usize::from(row.side)].into(),
        multiplier: row.multiplier,
        slack: row.slack,
    };
    LedgerJson {
        status: ledger.status,
        rung: ledger.rung,
        active: ledger.active,
        iterations: ledger.iterations,
        raw_violations: ledger.raw_violations,
        target_violations: ledger.target_violations,
        outside: ledger.outside,
        moved: ledger.moved,
        slack: ledger.slack,
        residual: ledger.residual,
        duration_ns: ledger.duration,
        active_rows: record.output.rows().iter().map(row).collect(),
    }
}

impl TickJson<'_> {
    /// Time of the projection [ns]: measured, so replay takes it over.
    pub(super) fn duration(&self) -> u64 {
        self.ledger.duration_ns
    }

    /// The proposal that came in the tick, if one did; `None` if it is longer than a message holds.
    pub(super) fn proposal(&self) -> Option<Option<ProposalMessage>> {
        let Some(json) = &self.proposed else { return Some(None) };
        let mut proposal = ProposalMessage::zeroed();
        let header = &mut proposal.header;
        (header.epoch, header.seq, header.stamp) = (json.epoch, json.seq, json.stamp_ns);
        (proposal.state_epoch, proposal.state_seq) = (json.state_epoch, json.state_seq);
        proposal.state_stamp = json.state_stamp_ns;
        (proposal.kind, proposal.names) = (json.kind, json.names);
        let values = &json.values.0;
        proposal.values.get_mut(..values.len())?.copy_from_slice(values);
        proposal.n = u32::try_from(values.len()).ok()?;
        Some(Some(proposal))
    }

    /// The record as far as the next tick depends on it; `None` if a vector is longer than a message holds.
    pub(super) fn record(&self) -> Option<Record> {
        let mut record = Record::new();
        (record.tick, record.mode, record.reason) = (self.tick, self.mode, self.reason);
        (record.fresh, record.sensed) = (self.fresh, self.sensed);
        (record.state, record.counters) = (self.state.message()?, self.counters);
        let output = &mut record.output;
        output.nu = u32::try_from(self.action.0.len()).ok()?;
        output.period_tick = self.period_tick;
        output.target_q.get_mut(..self.target_q.0.len())?.copy_from_slice(&self.target_q.0);
        output.target_v.get_mut(..self.target_v.0.len())?.copy_from_slice(&self.target_v.0);
        Some(record)
    }
}

impl StateJson<'_> {
    /// The state; `None` if a vector is longer than a message holds.
    pub(super) fn message(&self) -> Option<StateMessage> {
        let json = self;
        let mut state = StateMessage::zeroed();
        (state.header.epoch, state.header.seq, state.header.stamp) = (json.epoch, json.seq, json.stamp_ns);
        (state.tick, state.time) = (json.tick, json.time);
        (state.episode, state.episode_tick) = (json.episode, json.episode_tick);
        (state.bits, state.saturated) = (json.bits, json.saturated);
        (state.late, state.watchdog) = (json.late, json.watchdog);
        let fill = |to: &mut [f64], from: &Numbers<'_>| -> Option<u32> {
            to.get_mut(..from.0.len())?.copy_from_slice(&from.0);
            u32::try_from(from.0.len()).ok()
        };
        state.nq = fill(&mut state.q, &json.q)?;
        state.nv = fill(&mut state.v, &json.v)?;
        state.n_obs = fill(&mut state.obs, &json.obs)?;
        state.nu = fill(&mut state.applied, &json.applied)?;
        Some(state)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schema_names_exactly_the_fields_that_are_written() {
        let schema: serde_json::Value = serde_json::from_str(SCHEMA).unwrap();
        let mut record = Record::new();
        record.output.nu = 1;
        record.output.ledger.active = 1;
        let mut out = Vec::new();
        encode(&record, &mut out).unwrap();
        let tick: serde_json::Value = serde_json::from_slice(&out).unwrap();
        let keys = |v: &serde_json::Value| v.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        let properties = &schema["properties"];
        assert_eq!(keys(properties), keys(&tick));
        for part in ["state", "ledger"] {
            assert_eq!(keys(&properties[part]["properties"]), keys(&tick[part]), "{part}");
        }
        let row = &properties["ledger"]["properties"]["active_rows"]["items"]["properties"];
        assert_eq!(keys(row), keys(&tick["ledger"]["active_rows"][0]));
    }

    #[test]
    fn numbers_come_back_bit_for_bit() {
        let mut record = Record::new();
        record.state.nv = 6;
        let odd = [0.1 + 0.2, 1e-310, -0.0, f64::MAX, 9_007_199_254_740_993.5, 5.0e-324];
        record.state.v_mut().copy_from_slice(&odd);
        let mut out = Vec::new();
        encode(&record, &mut out).unwrap();
        let read: TickJson<'_> = serde_json::from_slice(&out).unwrap();
        let bits = |v: &[f64]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(read.state.message().unwrap().v()), bits(&odd));
    }

    #[test]
    fn what_is_not_finite_stays_so() {
        let mut record = Record::new();
        record.state.nq = 2;
        record.state.q_mut().copy_from_slice(&[f64::NAN, f64::NEG_INFINITY]);
        let mut out = Vec::new();
        encode(&record, &mut out).unwrap();
        let read: TickJson<'_> = serde_json::from_slice(&out).unwrap();
        assert!(read.state.message().unwrap().q().iter().all(|x| !x.is_finite()));
    }
}
