//! Goes through a log tick by tick: what the loop acted upon, what it was asked for, and which of its claims are confirmed.

use std::collections::{BTreeMap, HashMap};

use serde_json::Value;

use crate::before::{Asked, Before, Start, Told};
use crate::claims::{Case, Claims, agrees};
use crate::facts;
use crate::limit_check::{Breach, Fault, broken};
use crate::limits::Consistency;
use crate::promise::{Projects, Promise};
use crate::proposed::{Begun, Moment, projected};
use crate::report::{A_NUMBER, IN_WORDS, Report, Violation};
use crate::robot::Payload;
use crate::tick::{Numbered, Status, Tick};

/// Version of the tick messages that are read.
const SCHEMA: &str = "7";

/// What has been read of a log.
#[derive(Default)]
pub(crate) struct Session {
    facts: BTreeMap<String, String>,
    /// Bytes of attachments by their name.
    attachments: HashMap<String, Vec<u8>>,
    snapshots: HashMap<u64, Numbered>,
    /// Promises by snapshot: its own, then what the loop pinned beside it.
    promises: HashMap<u64, (Promise, Option<Promise>)>,
    before: Before,
    begun: Option<Begun>,
    /// What the robot carries as far as the brake in force was verified with it.
    carried: Option<Payload>,
    at: u64,
    pub(crate) report: Report,
}

impl Session {
    pub(crate) fn fact(&mut self, facts: BTreeMap<String, String>) {
        self.facts.extend(facts);
    }

    /// Keeps a snapshot's bytes, if they are what their name says.
    pub(crate) fn attach(&mut self, name: &str, bytes: Vec<u8>) -> Result<(), String> {
        let digest = blake3::hash(&bytes).to_hex().to_string();
        if name != format!("{digest}.safetensors") {
            return Err(format!("the attached snapshot '{name}' is damaged: its digest is {digest}"));
        }
        self.attachments.insert(digest, bytes);
        Ok(())
    }

    pub(crate) fn number(&mut self, snapshot: Numbered) {
        self.snapshots.insert(snapshot.id, snapshot);
    }

    /// Notes that the log has message `tick`.
    fn arrive(&mut self, tick: u64) -> Result<(), String> {
        if self.at == 0 {
            let schema = self.facts.get("schema").ok_or("its metadata has no `schema`")?;
            if schema != SCHEMA {
                return Err(format!(
                    "its schema is {schema}, this build reads {SCHEMA}; use the build that wrote it"
                ));
            }
            let settings =
                self.facts.get("settings").and_then(|text| serde_json::from_str::<Value>(text).ok());
            self.before.keeps_time = settings.is_some_and(|settings| settings["sync"] == "clock");
            self.compare_facts()?;
        }
        if tick <= self.at {
            return Err(format!("tick {tick} comes after tick {}: ticks only rise", self.at));
        }
        let lost = tick - self.at - 1;
        if lost > 0 {
            self.skip("the log does not have them", lost);
            self.lose();
        }
        self.at = tick;
        self.report.ticks += 1;
        Ok(())
    }

    /// Names what the metadata says otherwise than the first snapshot.
    fn compare_facts(&mut self) -> Result<(), String> {
        let Some(first) = self.snapshots.get(&0) else { return Ok(()) }; // named where a tick needs it
        let Some(bytes) = self.attachments.get(&first.digest) else { return Ok(()) };
        let differ =
            facts::differ(&self.facts, first, bytes).map_err(|e| format!("snapshot number 0: {e}"))?;
        for what in differ {
            self.name(0, what);
        }
        Ok(())
    }

    fn skip(&mut self, why: &str, ticks: u64) {
        *self.report.not_verified.entry(why.to_owned()).or_default() += ticks;
    }

    /// Forgets what the log does not go on from.
    fn lose(&mut self) {
        (self.before.past, self.before.has_gap, self.begun) = (None, true, None);
    }

    /// Names something that has no number.
    fn name(&mut self, tick: u64, what: String) {
        let (value, limit, unit) = (f64::NAN, f64::NAN, IN_WORDS.to_owned());
        self.report.add(Violation { tick, what, value, limit, unit });
    }

    /// A tick of which only its inputs are there.
    pub(crate) fn brief(&mut self, tick: u64) -> Result<(), String> {
        self.arrive(tick)?;
        self.skip("the disk was too slow for more than their inputs", 1);
        self.lose();
        Ok(())
    }

    /// A tick in full.
    pub(crate) fn tick(&mut self, tick: &Tick) -> Result<(), String> {
        self.arrive(tick.tick)?;
        if tick.swapped {
            self.begun = None;
            let past = self.before.past.iter_mut();
            past.for_each(|past| (past.asked.told, past.asked_before.told) = (None, None));
        }
        if tick.action.is_empty() {
            self.idle(tick);
            return Ok(());
        }
        let mut promises = match self.promises.remove(&tick.snapshot) {
            Some(promises) => promises,
            None => self.promise(tick.snapshot)?,
        };
        _ = self.before.past.take_if(|past| past.episode != tick.state.episode);
        promises.0.machine.grant();
        promises.1.iter().for_each(|pinned| pinned.machine.grant());
        if self.before.past.is_none() || promises.0.payload == self.carried {
            self.carried.clone_from(&promises.0.payload);
        }
        // Another payload than the brake in force was verified with: it is executed until one with this payload is found.
        let carries = promises.0.payload == self.carried;
        let brakes = tick.ledger.status() == Some(Status::Braked);
        if !brakes {
            self.carried.clone_from(&promises.0.payload);
        }
        let asked = self.before.asked(&promises.0, tick);
        let start = self.before.start(&promises.0, tick);
        let told = match self.examine(&mut promises, tick, &asked, &start) {
            Ok(told) => told,
            Err(Fault::Broken(_)) if brakes && !carries => {
                self.skip("the robot braked as was verified before it carried what it carries now", 1);
                None
            }
            Err(Fault::Broken(Breach { what, value, limit, unit })) => {
                self.report.add(Violation { tick: tick.tick, what, value, limit, unit });
                None
            }
            Err(Fault::Unknown(why)) => {
                self.skip(&why, 1);
                None
            }
        };
        self.before.note(&promises.0, tick, start.ok(), (asked, told));
        self.promises.insert(tick.snapshot, promises);
        Ok(())
    }

    /// A tick that asked for nothing.
    fn idle(&mut self, tick: &Tick) {
        let asks = [&tick.target_q, &tick.target_v, &tick.brake].into_iter().any(|x| !x.is_empty());
        if asks {
            self.name(tick.tick, format!("tick {}: its action is missing, and its target is not", tick.tick));
        }
        self.report.idle += u64::from(!asks);
        // Where no state came, nothing was asked for, and what was answered last goes on.
        let keeps_time = self.before.keeps_time;
        _ = self.before.past.take_if(|past| keeps_time || past.is_before(&tick.state));
        self.before.has_gap = false;
    }

    /// What snapshot `id` promises, and what the loop pinned.
    fn promise(&self, id: u64) -> Result<(Promise, Option<Promise>), String> {
        let numbered = self.snapshots.get(&id).ok_or_else(|| format!("snapshot number {id} is not in it"))?;
        let bytes = self
            .attachments
            .get(&numbered.digest)
            .ok_or_else(|| format!("snapshot number {id} is not in it"))?;
        let of = |e: String| format!("snapshot number {id}: {e}");
        let own = Promise::read(bytes, None).map_err(of)?;
        let names: Vec<&str> = own
            .built()
            .joints
            .iter()
            .map(|j| j.name.as_str())
            .chain(own.built().rows.iter().map(|r| r.name.as_str()))
            .collect();
        if own.projects != Projects::Nothing
            && own.consistency == Consistency::Kinematic
            && names != numbered.rows
        {
            return Err(format!(
                "the rows of snapshot number {id} are {:?} in the log, and {names:?} by its limits",
                numbered.rows
            ));
        }
        let pinned = match self.facts.get("limits") {
            None => None,
            Some(text) => {
                let pinned: Value = serde_json::from_str(text)
                    .map_err(|e| format!("its metadata `limits` is damaged: {e}"))?;
                (pinned != Promise::stated(bytes)?)
                    .then(|| Promise::read(bytes, Some(&pinned)))
                    .transpose()
                    .map_err(of)?
            }
        };
        Ok((own, pinned))
    }

    /// Confirms a tick's claims; what the next one is told of it.
    fn examine(
        &mut self,
        (own, pinned): &mut (Promise, Option<Promise>),
        tick: &Tick,
        asked: &Asked,
        start: &Result<Start, &str>,
    ) -> Result<Option<Told>, Fault> {
        let unknown = |why: &str| Err(Fault::Unknown(why.to_owned()));
        let (nq, nv) = (own.machine.nq(), own.machine.nv());
        for (what, found, length) in [
            ("state.q", &tick.state.q, nq),
            ("state.v", &tick.state.v, nv),
            ("target_q", &tick.target_q, nq),
            ("target_v", &tick.target_v, nv),
            ("proposal_q", &tick.proposal_q, nq),
            ("proposal_v", &tick.proposal_v, nv),
        ] {
            if found.len() != length {
                return broken(format!("length of {what}"), found.len() as f64, length as f64, "numbers");
            }
        }
        let Some(status) = tick.ledger.status() else {
            return broken(
                "ledger.status",
                f64::from(tick.ledger.status),
                0.0,
                "as the list in the metadata has it",
            );
        };
        if own.projects == Projects::Nothing || status == Status::NotProjected {
            return unknown("their policy gives actions that nothing was projected for");
        }
        agrees(&tick.ledger, status, nv)?;
        if own.moving.is_none() && status == Status::Tightening {
            return broken("limits moved by an operator, of a tick on the way to such,", 0.0, 1.0, "or more");
        }
        let finite = |what: &str, x: &[f64]| match x.iter().position(|x| !x.is_finite()) {
            Some(k) => broken(format!("{what}[{k}]"), x[k], 0.0, A_NUMBER),
            None => Ok(()),
        };
        finite("target_q", &tick.target_q)?;
        finite("target_v", &tick.target_v)?;
        finite("action", &tick.action)?;
        let by_policy = matches!(tick.mode.as_str(), "active" | "degraded");
        if !matches!(tick.sensed.as_str(), "measured" | "predicted") {
            let what = format!("action, while the state is '{}',", tick.sensed);
            return broken(what, tick.action[0], 0.0, "");
        }
        let Start { from: (q, v), waiting, .. } = match start {
            Ok(start) => start,
            Err(why) => return unknown(why),
        };
        finite("state.q", q)?;
        finite("state.v", v)?;
        if by_policy && tick.period_tick == 0 {
            self.begun = Some(Begun::at(own, tick, q, v));
        }
        let moment = Moment { tick, q, v, by_policy, last: asked.a.as_deref() };
        let proposal = projected(own, &moment, self.begun.as_ref(), waiting);
        let brake = self.before.past.as_ref().map(|past| &past.brake[..]);
        let case = Case { moment, status, asked, brake, proposal };
        let mut claims = Claims { report: &mut self.report, case };
        let told = claims.confirm(own)?;
        if let Some(pinned) = pinned {
            claims.confirm_limits(pinned)?;
        }
        self.report.verified += 1;
        self.report.recovering += u64::from(status == Status::Recovering);
        // What a first motion's softening or a brake asks for is projected by itself, and the next tick is told of the target before.
        Ok((by_policy && tick.ramp >= 1.0).then_some(told))
    }
}
