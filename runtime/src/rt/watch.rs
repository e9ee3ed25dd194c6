//! What the report of a run says of its ticks beside counts: how those ended that are out of the way, and which joints were found outside their
//! limits. On the I/O thread: the real-time thread only counts.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::mpsc::SyncSender;

use serde::Serialize;

use crate::codes::LedgerStatus;
use crate::rt::tick::{Record, Sensed};
use crate::rt::way::Apart;
use crate::rt::{Mode, Reason};

/// Findings that are told one by one.
const TOLD: usize = 32;
/// Beyond a limit by more than rounding, as a share of it (of 1 where it is smaller).
const ROUNDING: f64 = 1e-9;

/// What names what a tick was found outside of.
#[derive(Clone, Debug, Default)]
pub struct Watched {
    /// Joints with limits.
    pub joints: Vec<WatchedJoint>,
    /// Every row of the projection by its number, in words.
    pub rows: Vec<String>,
}

/// A joint with its limits as the projection keeps them.
#[derive(Clone, Debug)]
pub struct WatchedJoint {
    /// Name.
    pub joint: String,
    /// Degree of freedom.
    pub dof: usize,
    /// Place in the configuration.
    pub idx_q: usize,
    /// Unit of its position.
    pub length: &'static str,
    /// Lowest position [rad or m].
    pub lower: f64,
    /// Highest position [rad or m].
    pub upper: f64,
    /// Largest speed [rad/s or m/s].
    pub velocity: f64,
}

/// A joint that was outside a limit where a tick began, or whose velocity was not that of its motion.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Found {
    /// The first tick.
    pub tick: u64,
    /// Joint; empty where no single joint is beyond its position or speed.
    pub joint: String,
    /// What it is that was left where that is no position or speed of a joint, in words; empty otherwise.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub row: String,
    /// Limit.
    pub what: &'static str,
    /// What was measured.
    pub value: f64,
    /// What is allowed, or its own motion has.
    pub limit: f64,
    /// Unit of both.
    pub unit: String,
}

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Found { tick, joint, row, what, value, limit, unit } = self;
        if joint.is_empty() {
            return write!(f, "{row} ({what}), first at tick {tick}");
        }
        write!(f, "joint '{joint}' at {value} {unit}, and its {what} is {limit} {unit}, first at tick {tick}")
    }
}

/// No single joint is where it may not be, and the projection could only return all the same.
const ELSEWHERE: &str = "no joint is beyond its position or speed";

/// Ticks in a row for which a loop that never acted holds for one reason before it says so: at first, states and proposals come and go.
const LONG: u32 = 100;

/// What is gathered from the records.
pub(crate) struct Watch {
    watched: Watched,
    counts: BTreeMap<u32, u64>,
    pub(crate) outside: Vec<Found>,
    mode: Mode,
    /// Why the loop holds since it began, and for how many ticks in a row.
    hold: (Reason, u32),
    /// Where a mode is told that does not act, and that a driver keeps another period.
    pub(crate) tell: Option<SyncSender<(u64, Mode, Reason)>>,
}

/// Adds what is found for the first time of its joint and limit.
fn add(outside: &mut Vec<Found>, found: Found) {
    let same = |f: &Found| f.joint == found.joint && f.row == found.row && f.what == found.what;
    let is_known = outside.iter().any(same);
    if !is_known && outside.len() < TOLD {
        outside.push(found);
    }
}

impl Watch {
    pub(crate) fn of(watched: Watched) -> Watch {
        Watch {
            watched,
            counts: BTreeMap::new(),
            outside: Vec::new(),
            mode: Mode::Hold,
            hold: (Reason::None, 0),
            tell: None,
        }
    }

    /// The limits are these from now on.
    pub(crate) fn set(&mut self, watched: Watched) {
        self.watched = watched;
    }

    pub(crate) fn take(&mut self, record: &Record) {
        let is_told = record.mode == Mode::Fault || record.reason == Reason::WrongPeriod;
        let is_new = std::mem::replace(&mut self.mode, record.mode) != record.mode;
        let holds = record.mode == Mode::Hold && record.reason != Reason::None;
        let still = holds && self.hold.0 == record.reason;
        self.hold = (record.reason, if still { self.hold.1.saturating_add(1) } else { 0 });
        if (self.hold.1 == LONG || is_new && is_told)
            && let Some(tell) = &self.tell
        {
            // Where nobody reads, the mode still stands in the report.
            let _ = tell.try_send((record.tick, record.mode, record.reason));
        }
        let is_elsewhere = matches!(record.reason, Reason::ImplausibleState | Reason::ImplausibleStates);
        // One that was bridged was not acted upon: the robot has not been there.
        if is_elsewhere && record.fresh && record.sensed != Sensed::Predicted {
            self.name(record);
        }
        if let Some(apart) = record.apart {
            self.name_apart(record.tick, apart);
        }
        if record.output.nu == 0 {
            return;
        }
        *self.counts.entry(record.output.ledger.status).or_default() += 1;
        if record.output.ledger.outside > 0 && record.sensed == Sensed::Measured && !self.name(record) {
            self.name_row(record);
        }
    }

    /// A joint that goes elsewhere than its velocity says.
    fn name_apart(&mut self, tick: u64, apart: Apart) {
        const WHAT: &str = "mean speed by its positions";
        let Some(joint) = self.watched.joints.iter().find(|joint| joint.dof == apart.dof) else { return };
        let (joint, unit) = (joint.joint.clone(), format!("{}/s", joint.length));
        let (value, limit, row) = (apart.told, apart.moved, String::new());
        add(&mut self.outside, Found { tick, joint, row, what: WHAT, value, limit, unit });
    }

    /// Joints beyond their positions or speeds; false where there are none.
    fn name(&mut self, record: &Record) -> bool {
        let (mut is_one, state) = (false, &record.state);
        for joint in &self.watched.joints {
            let (q, v) = (state.q[joint.idx_q], state.v[joint.dof]);
            let speed = format!("{}/s", joint.length);
            let kinds = [
                ("lowest position", -q, -joint.lower, q, joint.lower, joint.length),
                ("highest position", q, joint.upper, q, joint.upper, joint.length),
                ("largest speed", v.abs(), joint.velocity, v, joint.velocity.copysign(v), speed.as_str()),
            ];
            for (what, is, most, value, limit, unit) in kinds {
                if is <= most + ROUNDING * most.abs().max(1.0) || most.is_nan() {
                    continue;
                }
                is_one = true;
                let (tick, joint, unit) = (record.tick, joint.joint.clone(), unit.to_owned());
                let row = String::new();
                add(&mut self.outside, Found { tick, joint, row, what, value, limit, unit });
            }
        }
        is_one
    }

    /// A limit of several joints, or a joint that cannot stop in front of its own.
    fn name_row(&mut self, record: &Record) {
        let row =
            usize::from(record.output.outside).checked_sub(1).and_then(|row| self.watched.rows.get(row));
        let Some(row) = row.cloned() else { return };
        let (tick, joint, unit) = (record.tick, String::new(), String::new());
        let (what, value, limit) = (ELSEWHERE, 0.0, 0.0);
        add(&mut self.outside, Found { tick, joint, row, what, value, limit, unit });
    }

    /// Ticks by a status that is out of the way.
    pub(crate) fn statuses(&self) -> BTreeMap<&'static str, u64> {
        let of = |status: &LedgerStatus| Some((status.name(), *self.counts.get(&status.number())?));
        let usual = [
            LedgerStatus::Unchanged,
            LedgerStatus::Clamped,
            LedgerStatus::Solved,
            LedgerStatus::NotProjected,
            LedgerStatus::ActionsBounded,
        ];
        LedgerStatus::ALL.iter().filter(|status| !usual.contains(status)).filter_map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::sync_channel;

    /// What is told of ticks with these reasons.
    fn told(ticks: impl Iterator<Item = (Mode, Reason)>) -> Vec<(u64, Mode, Reason)> {
        let (tell, told) = sync_channel(64);
        let mut watch = Watch::of(Watched::default());
        watch.tell = Some(tell);
        for (tick, (mode, reason)) in (1..).zip(ticks) {
            let mut record = Record::new();
            (record.tick, record.mode, record.reason) = (tick, mode, reason);
            watch.take(&record);
        }
        drop(watch);
        told.iter().collect()
    }

    #[test]
    fn a_loop_that_holds_for_one_reason_says_it_once() {
        let hold = |reason, n| std::iter::repeat_n((Mode::Hold, reason), n);
        let begin = hold(Reason::None, 500)
            .chain(hold(Reason::SilentProposer, 90))
            .chain(hold(Reason::LostStates, 500));
        assert_eq!(told(begin), [(691, Mode::Hold, Reason::LostStates)]);
        let comes =
            hold(Reason::LostStates, 90).chain(std::iter::repeat_n((Mode::Active, Reason::None), 500));
        assert_eq!(told(comes), []);
        let fault = std::iter::repeat_n((Mode::Fault, Reason::BadStates), 500);
        assert_eq!(told(fault), [(1, Mode::Fault, Reason::BadStates)]);
    }
}
