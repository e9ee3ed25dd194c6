//! Goes through a log tick by tick: what the loop acted upon, what it was asked for, and which of its claims are confirmed.

use std::collections::{BTreeMap, HashMap};

use serde_json::Value;

use crate::facts;
use crate::limit_check::{self, Breach, Fault, are_near, broken};
use crate::limits::{Consistency, Limits, Way};
use crate::moved::Moving;
use crate::optimum;
use crate::promise::{Entry, Projects, Promise, Sent, SetPoints};
use crate::report::{IN_WORDS, Report, Violation};
use crate::robot::Payload;
use crate::rows::{Passage, Row};
use crate::stop;
use crate::tick::{CLAMPED, Ledger, Numbered, ROOM, State, Status, Tick, UNCHANGED};

/// Version of the tick messages that are read.
const SCHEMA: &str = "7";
/// A target's position is where its velocity leads, up to this share [rad or m].
const CONSISTENT: f64 = 1e-9;
/// A proposal's position and velocity belong together up to this [rad or m].
const BELONGS: f64 = 1e-11;
/// Velocities of proposals count up to this [rad/s or m/s].
const HUGE: f64 = 1e12;
/// A proposal that is passed on is moved by no more than this [rad/s or m/s]: it is computed anew from the one of its period.
const CHANGED: f64 = 1e-6;
/// Share of its size by which an action may differ from the one that leads to the target.
const ACTION: f64 = 1e-7;

/// An acceleration [rad/s² or m/s²] and motor forces [N m or N], of each dof.
type Told = (Vec<f64>, Vec<f64>);

/// What the tick before left.
struct Past {
    /// Number of its state: the plant's start and the count since.
    epoch: u64,
    seq: u64,
    episode: u64,
    /// What it was measured to be, and the robot's clock then [s].
    measured: (Vec<f64>, Vec<f64>),
    time: f64,
    target: (Vec<f64>, Vec<f64>),
    /// How often the plant had had no answer in time by then.
    late: u64,
    /// What was sent in its period, and in the one before it, of joints that follow by themselves what they are sent.
    sent: SetPoints,
    before: Option<SetPoints>,
    /// So many ticks of those two came after a gap of the log, from what was sent in ticks that it does not have.
    cut_off: u8,
    /// The brake that it stored; empty where it stored none.
    brake: Vec<f64>,
    /// What it asked of the robot, and what the tick before it did.
    asked: Asked,
    asked_before: Asked,
}

/// What a tick asked of the robot.
#[derive(Clone, Default)]
struct Asked {
    /// Acceleration, where it is known what it began from.
    a: Option<Vec<f64>>,
    /// Acceleration and motor forces, where they are what the next tick was told.
    told: Option<Told>,
}

impl Past {
    /// States between it and `next` that did not come.
    fn lost(&self, next: &State) -> u64 {
        next.seq.saturating_sub(self.seq.saturating_add(1))
    }

    /// The plant braked by itself up to `next`, a state that came after it.
    fn is_braked_since(&self, next: &State) -> bool {
        next.bits & BRAKED != 0 && self.is_before(next)
    }

    /// `next` is another state than its own.
    fn is_before(&self, next: &State) -> bool {
        (next.epoch, next.seq) != (self.epoch, self.seq)
    }

    /// What it answered is not what the robot did up to `tick`: it came too late, or the driver asked once more in its period.
    fn is_recalled(&self, tick: &Tick) -> bool {
        let (next, (q, v)) = (&tick.state, &self.measured);
        let stands = next.time > 0.0 && next.time == self.time && next.q == *q && next.v == *v;
        // A loop that takes a state that stands for a frozen one does not act on it.
        let is_doubled = stands && tick.sensed == "measured" && self.is_before(next);
        is_doubled || self.alone(next) > self.lost(next)
    }

    /// Periods up to `next` in which the plant had no answer in time.
    fn alone(&self, next: &State) -> u64 {
        next.late.saturating_sub(self.late)
    }
}

/// What a tick goes on from (nq, nv), and the dofs whose set points wait for their joints.
struct Start {
    from: (Vec<f64>, Vec<f64>),
    /// What stood as sent, of joints that follow by themselves.
    sent: Option<SetPoints>,
    waiting: Vec<usize>,
}

/// The state in which a policy period began, and what was proposed then.
struct Begun {
    start: (Vec<f64>, Vec<f64>),
    goal: (Vec<f64>, Vec<f64>),
}

/// Of the bits of a state: the plant braked by itself last.
const BRAKED: u32 = 8;

/// What has been read of a log.
#[derive(Default)]
pub(crate) struct Session {
    facts: BTreeMap<String, String>,
    /// Bytes of attachments by their name.
    attachments: HashMap<String, Vec<u8>>,
    snapshots: HashMap<u64, Numbered>,
    /// Promises by snapshot: its own, then what the loop pinned beside it.
    promises: HashMap<u64, (Promise, Option<Promise>)>,
    past: Option<Past>,
    /// The log does not have the tick before.
    has_gap: bool,
    /// The loop had a clock of its own, and answered in every slot; else it answered a state when one came.
    keeps_time: bool,
    begun: Option<Begun>,
    /// What the robot carries as far as the brake in force was verified with it.
    carried: Option<Payload>,
    at: u64,
    pub(crate) report: Report,
}

/// A tick with what it acted upon.
struct Case<'a> {
    tick: &'a Tick,
    /// What the snapshot's own limits, or those that the loop pinned.
    is_own: bool,
    q: &'a [f64],
    v: &'a [f64],
    status: Status,
    by_policy: bool,
    /// Acceleration of the tick before.
    last: Option<Vec<f64>>,
    /// What was projected, or why it is not known.
    proposal: Result<(Vec<f64>, Vec<f64>), String>,
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
            self.keeps_time = settings.is_some_and(|settings| settings["sync"] == "clock");
            self.compare_facts()?;
        }
        if tick <= self.at {
            return Err(format!("tick {tick} comes after tick {}: ticks only rise", self.at));
        }
        let lost = tick - self.at - 1;
        if lost > 0 {
            self.skip("the log does not have them", lost);
            (self.past, self.begun, self.has_gap) = (None, None, true);
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
            let unit = IN_WORDS.to_owned();
            self.report.add(Violation { tick: 0, what, value: f64::NAN, limit: f64::NAN, unit });
        }
        Ok(())
    }

    fn skip(&mut self, why: &str, ticks: u64) {
        *self.report.not_verified.entry(why.to_owned()).or_default() += ticks;
    }

    /// A tick of which only its inputs are there.
    pub(crate) fn brief(&mut self, tick: u64) -> Result<(), String> {
        self.arrive(tick)?;
        self.skip("the disk was too slow for more than their inputs", 1);
        (self.past, self.begun, self.has_gap) = (None, None, true);
        Ok(())
    }

    /// A tick in full.
    pub(crate) fn tick(&mut self, tick: &Tick) -> Result<(), String> {
        self.arrive(tick.tick)?;
        if tick.swapped {
            self.begun = None;
            self.past.iter_mut().for_each(|past| (past.asked.told, past.asked_before.told) = (None, None));
        }
        if tick.action.is_empty() {
            let asks = [&tick.target_q, &tick.target_v, &tick.brake].into_iter().any(|x| !x.is_empty());
            if asks {
                let what = format!("tick {}: its action is missing, and its target is not", tick.tick);
                let (value, limit, unit) = (f64::NAN, f64::NAN, IN_WORDS.to_owned());
                self.report.add(Violation { tick: tick.tick, what, value, limit, unit });
            }
            self.report.idle += u64::from(!asks);
            // Where no state came, nothing was asked for, and what was answered last goes on.
            let is_asked = |past: &mut Past| self.keeps_time || past.is_before(&tick.state);
            _ = self.past.take_if(is_asked);
            self.has_gap = false;
            return Ok(());
        }
        let mut promises = match self.promises.remove(&tick.snapshot) {
            Some(promises) => promises,
            None => self.promise(tick.snapshot)?,
        };
        if self.past.as_ref().is_some_and(|past| past.episode != tick.state.episode) {
            self.past = None;
        }
        promises.0.machine.grant();
        promises.1.iter().for_each(|pinned| pinned.machine.grant());
        if self.past.is_none() || promises.0.payload == self.carried {
            self.carried.clone_from(&promises.0.payload);
        }
        // Another payload than the brake in force was verified with: it is executed until one with this payload is found.
        let carries = promises.0.payload == self.carried;
        let brakes = tick.ledger.status() == Some(Status::Braked);
        if !brakes {
            self.carried.clone_from(&promises.0.payload);
        }
        let told = match self.examine(&mut promises, tick) {
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
        let (dt, nq, nv) = (promises.0.period.dt, promises.0.machine.nq(), promises.0.machine.nv());
        let asked_before = self.asked(&promises.0, tick);
        // Of joints that go on from what they were sent, or of a predicted state, not known after a gap.
        let is_cut_off = self.is_cut_off(&promises.0, tick);
        let (begun, before) = match self.start(&promises.0, tick).filter(|_| !is_cut_off) {
            Some(Start { from, sent, .. }) => (Some(from), sent),
            None => (None, None),
        };
        let sent = promises.0.sends(tick, begun.as_ref());
        let v = begun.as_ref().map_or(&tick.state.v, |(_, v)| v).clone();
        self.promises.insert(tick.snapshot, promises);
        let cut_off = self.past.as_ref().map_or(0, |past| past.cut_off);
        (self.past, self.has_gap) = (None, false);
        if [tick.target_q.len(), tick.target_v.len(), v.len()] != [nq, nv, nv] {
            return Ok(()); // it was named, and leaves nothing that the next tick could be confirmed by
        }
        let a = begun.map(|(_, v)| tick.target_v.iter().zip(&v).map(|(to, from)| (to - from) / dt).collect());
        let target = (tick.target_q.clone(), tick.target_v.clone());
        let state = &tick.state;
        let (epoch, seq, episode, brake) = (state.epoch, state.seq, state.episode, tick.brake.clone());
        let cut_off = if is_cut_off { 2 } else { cut_off.saturating_sub(1) };
        let (late, asked) = (state.late, Asked { a, told });
        let measured = (state.q.clone(), state.v.clone());
        self.past = Some(Past {
            epoch,
            seq,
            episode,
            measured,
            time: state.time,
            target,
            late,
            sent,
            before,
            cut_off,
            brake,
            asked,
            asked_before,
        });
        Ok(())
    }

    /// The state that a tick goes on from (nq, nv): as measured or predicted, and of joints that follow by themselves what they were sent. None
    /// where the log does not have what it was predicted from, or has a state of another robot.
    fn begins(&self, own: &Promise, tick: &Tick) -> Option<(Vec<f64>, Vec<f64>)> {
        self.start(own, tick).map(|start| start.from)
    }

    /// The same, with the dofs whose set points wait for their joints.
    fn start(&self, own: &Promise, tick: &Tick) -> Option<Start> {
        let (mut q, mut v) = match (&tick.sensed[..], &self.past) {
            ("predicted", past) => past.as_ref()?.target.clone(),
            _ => (tick.state.q.clone(), tick.state.v.clone()),
        };
        if [q.len(), v.len()] != [own.machine.nq(), own.machine.nv()] {
            return None;
        }
        let (state, mut waiting, mut sent) = (&tick.state, Vec::new(), None);
        if let Some(past) = self.past.as_ref().filter(|past| own.follows() && past.epoch == state.epoch)
            && [past.target.0.len(), past.target.1.len()] == [q.len(), v.len()]
        {
            sent = self.standing(own, past, tick);
            waiting = sent.as_ref().map_or(Vec::new(), |sent| own.depart(sent, &mut q, &mut v));
        }
        Some(Start { from: (q, v), sent, waiting })
    }

    /// The tick goes on from what was sent in one that the log does not have.
    fn is_cut_off(&self, own: &Promise, tick: &Tick) -> bool {
        let goes_back = |past: &Past| {
            let is_left = past.alone(&tick.state).max(past.lost(&tick.state)) > 0;
            past.cut_off > 0 && !self.keeps_time && (is_left || past.is_recalled(tick))
        };
        let is_back = self.past.as_ref().is_some_and(goes_back);
        is_back && own.goes_on() || self.has_gap && own.follows()
    }

    /// What was asked of the robot for what it does up to `tick`: by the tick before, or by the one before that where its answer came too late, and
    /// from there on what the driver made of it without an answer. Nothing is known where the plant braked by itself.
    fn asked(&self, own: &Promise, tick: &Tick) -> Asked {
        let state = &tick.state;
        let is_known = |past: &&Past| {
            let fits = [past.target.0.len(), past.target.1.len()] == [own.machine.nq(), own.machine.nv()];
            past.epoch == state.epoch && fits && !past.is_braked_since(state)
        };
        let Some(past) = self.past.as_ref().filter(is_known) else { return Asked::default() };
        let (lost, alone) = (past.lost(state), past.alone(state));
        let periods = lost.max(alone);
        let is_recalled = past.is_recalled(tick);
        if self.keeps_time || periods == 0 && !is_recalled {
            return past.asked.clone();
        }
        let (sent, mut asked) = match is_recalled {
            true => (past.before.as_ref(), past.asked_before.clone()),
            false => (Some(&past.sent), past.asked.clone()),
        };
        if own.follows() {
            let Some(sent) = sent else { return Asked::default() };
            let told = asked.told.as_mut().map(|(a, _)| a);
            asked.a.iter_mut().chain(told).for_each(|a| own.hold_asked(sent, periods, a));
        }
        asked
    }

    /// What stands as sent where `state` was measured: the last answer, or the one before it where that came too late, and from there on what the
    /// driver made of it without an answer. None where the plant braked by itself.
    fn standing(&self, own: &Promise, past: &Past, tick: &Tick) -> Option<SetPoints> {
        let state = &tick.state;
        if past.is_braked_since(state) {
            return None;
        }
        if self.keeps_time {
            return Some(past.sent.clone()); // it answered in every slot
        }
        let (lost, alone) = (past.lost(state), past.alone(state));
        let applied = if past.is_recalled(tick) { past.before.as_ref() } else { Some(&past.sent) };
        let mut sent = applied?.clone();
        own.hold(&mut sent, lost.max(alone));
        Some(sent)
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
            Some(k) => broken(format!("{what}[{k}]"), x[k], 0.0, crate::report::A_NUMBER),
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
        if self.is_cut_off(own, tick) {
            return unknown("they go on from what was sent in a tick that the log does not have");
        }
        let Some((q, v)) = self.begins(own, tick) else {
            return unknown("they acted on a state predicted from a tick that the log does not have");
        };
        finite("state.q", &q)?;
        finite("state.v", &v)?;
        let begins = by_policy && tick.period_tick == 0;
        if begins {
            self.begun = Some(Begun { goal: goal(own, tick, &q, &v), start: (q.clone(), v.clone()) });
        }
        let proposal = self.proposal(own, tick, by_policy, (&q, &v));
        let last = self.asked(own, tick).a;
        let mut case = Case { tick, is_own: true, q: &q, v: &v, status, by_policy, last, proposal };
        let told = self.confirm(own, &case)?;
        if let Some(pinned) = pinned {
            case.is_own = false;
            self.confirm(pinned, &case)?;
        }
        self.report.verified += 1;
        self.report.recovering += u64::from(status == Status::Recovering);
        // What a first motion's softening or a brake asks for is projected by itself, and the next tick is told of the target before.
        Ok(told.filter(|_| by_policy && tick.ramp >= 1.0))
    }

    /// What was projected in this tick, where it is known: what was proposed, or rest for joints whose set points wait.
    fn proposal(
        &self,
        own: &Promise,
        tick: &Tick,
        by_policy: bool,
        (q, v): (&[f64], &[f64]),
    ) -> Result<(Vec<f64>, Vec<f64>), String> {
        let (mut pq, mut pv) = self.proposed(own, tick, by_policy, (q, v))?;
        for i in self.start(own, tick).map_or(Vec::new(), |start| start.waiting) {
            self.rest((own, tick), i, (q, v), (&mut pq, &mut pv))?;
        }
        Ok((pq, pv))
    }

    /// Proposes rest for dof `i` at `q`, `v`, of hard jerk what leads there.
    fn rest(
        &self,
        (own, tick): (&Promise, &Tick),
        i: usize,
        (q, v): (&[f64], &[f64]),
        (pq, pv): (&mut [f64], &mut [f64]),
    ) -> Result<(), String> {
        let p = &own.period;
        pv[i] = match (own.built().joints[i].smooth(p), self.asked(own, tick).a) {
            (None, _) => 0.0,
            (Some(smooth), Some(a)) => v[i] + p.dt * smooth.next(v[i], a[i]),
            (Some(_), None) => {
                return Err("the tick before their brake is not known, of which jerk speaks".to_owned());
            }
        };
        if let Some(at) = own.machine.single(i) {
            pq[at] = q[at] + p.way(v[i], pv[i]);
        }
        Ok(())
    }

    /// What was proposed in this tick, where it is known.
    fn proposed(
        &self,
        own: &Promise,
        tick: &Tick,
        by_policy: bool,
        (q, v): (&[f64], &[f64]),
    ) -> Result<(Vec<f64>, Vec<f64>), String> {
        let no = |why: &str| Err(why.to_owned());
        let p = &own.period;
        let (mut pq, mut pv) = (q.to_vec(), v.to_vec());
        if !by_policy {
            for &i in &own.controllable {
                self.rest((own, tick), i, (q, v), (&mut pq, &mut pv))?; // the loop's own brake
            }
            return Ok((pq, pv));
        }
        if tick.ramp < 1.0 {
            return no("the first motion was let in, by a share of a target that is not in the log");
        }
        if own.projects == Projects::Unlogged {
            return no("where a learned inverse model's action leads is not in the log");
        }
        if own.projects == Projects::Actions {
            let all = own.controllable.iter().all(|&i| own.halves(i) == (true, true));
            return if all {
                Ok((tick.proposal_q.clone(), tick.proposal_v.clone()))
            } else {
                no("not every joint's position and velocity is proposed")
            };
        }
        let Some(Begun { start, goal }) = &self.begun else {
            return no("the tick in which their policy ran is not in the log");
        };
        let is_held = tick.proposal_age_ns.is_some() && tick.proposed.is_none();
        if is_held && own.controllable.iter().any(|&i| own.halves(i) != (true, true)) {
            return no("a proposal of another process was held, of which the log has one half");
        }
        let (j, k) = (tick.period_tick.saturating_add(1), own.policy_every);
        if j >= k {
            return Ok(goal.clone());
        }
        let (s, length) = (f64::from(j) / f64::from(k), f64::from(k) * p.dt);
        for &i in &own.controllable {
            let Some(at) = own.machine.single(i) else { return no("a continuous joint follows no cubic") };
            (pq[at], pv[i]) = cubic(s, length, (start.0[at], start.1[i]), (goal.0[at], goal.1[i]));
        }
        Ok((pq, pv))
    }

    /// Limits, action, optimum and way to stop of one promise. A plant that moves in several steps is off by the second order of its period,
    /// which margins are for: the brake that was verified a tick before is executed from where it ended, and keeps the limits without them.
    fn confirm(&mut self, promise: &mut Promise, case: &Case<'_>) -> Result<Option<Told>, Fault> {
        let of_brake = case.status == Status::Braked;
        if of_brake {
            promise.leave_out_margins();
        }
        let found = self.confirm_within(promise, case);
        if of_brake {
            promise.leave_out_margins();
        }
        found
    }

    /// The same with the promise's limits as they are.
    fn confirm_within(&mut self, promise: &mut Promise, case: &Case<'_>) -> Result<Option<Told>, Fault> {
        let (tick, p, nv) = (case.tick, promise.period, case.v.len());
        let a: Vec<f64> = (0..nv).map(|i| (tick.target_v[i] - case.v[i]) / p.dt).collect();
        let mut tau = vec![0.0; nv];
        promise.machine.motors(&p, case.q, case.v, &a, &mut tau);
        let told = self.asked(promise, tick).told;
        let before = told.as_ref().map(|(a, tau)| (&a[..], &tau[..]));
        let passage = Passage {
            q: case.q,
            v: case.v,
            q1: &tick.target_q,
            v1: &tick.target_v,
            a: &a,
            tau: &tau,
            before,
            last: case.last.as_deref(),
            is_free: promise.consistency == Consistency::Free,
        };
        let is_stored = !tick.brake.is_empty();
        let excused = case.status == Status::Recovering;
        if promise.consistency == Consistency::Kinematic {
            follows(promise, &passage)?;
        }
        if let Some(mut moving) = promise.moving.take() {
            // What was built holds on any way, then what is in force on this one.
            promise.limits.clone_from(&moving.built);
            let held = holds(promise, &passage, is_stored, excused);
            let in_force = self.in_force(promise, &mut moving, case);
            promise.moving = Some(moving);
            held?;
            promise.limits = in_force?;
        }
        if promise.moving.is_none() || !excused {
            holds(promise, &passage, is_stored, excused)?;
        }
        if !case.is_own {
            return Ok(None);
        }
        if excused && !is_outside(promise, case, is_stored) {
            return broken(
                "joints, frames, bodies and rows outside at the start of a tick that says it is recovering",
                0.0,
                1.0,
                "or more",
            );
        }
        if tick.ledger.target_violations > 0 && !excused && case.status != Status::Braked {
            return broken(
                "ledger.target_violations of a target within all limits",
                f64::from(tick.ledger.target_violations),
                0.0,
                "",
            );
        }
        actions(promise, &passage, &tick.action)?;
        self.optimum(promise, case, &passage, is_stored)?;
        self.stop(promise, case, &a, is_stored)?;
        Ok(Some((a, tau)))
    }

    /// The limits in force at a tick whose limits were moved: those asked for where the tick says that they are reached.
    fn in_force(&self, promise: &mut Promise, moving: &mut Moving, case: &Case<'_>) -> Result<Limits, Fault> {
        if case.status == Status::Nearest {
            return Ok(moving.wanted.clone());
        }
        let is_stored = promise.way == Way::Stored || !case.tick.brake.is_empty();
        let brake = match &self.past {
            None if is_stored => {
                let why =
                    "their limits were moved, and the brake in force is of a tick that the log does not have";
                return Err(Fault::Unknown(why.into()));
            }
            past => past.as_ref().map(|past| &past.brake[..]).filter(|brake| brake.len() == case.v.len()),
        };
        let Promise { machine, period, controllable, .. } = promise;
        let last = case.last.clone();
        let jerk = controllable.iter().any(|i| moving.built.joints[*i].jerk.is_finite());
        if jerk && last.is_none() && case.v.iter().any(|v| *v != 0.0) {
            let why = "their limits were moved, and the tick before, of which jerk speaks, is not known";
            return Err(Fault::Unknown(why.into()));
        }
        let last = last.unwrap_or_else(|| vec![0.0; case.v.len()]);
        Ok(moving.in_force(machine, (period, controllable), (case.q, case.v), (brake, &last)))
    }

    fn optimum(
        &mut self,
        promise: &mut Promise,
        case: &Case<'_>,
        passage: &Passage<'_>,
        is_stored: bool,
    ) -> Result<(), Fault> {
        let mut without = |why: &str| {
            *self.report.not_compared.entry(why.to_owned()).or_default() += 1;
            Ok(())
        };
        match case.status {
            Status::Recovering => return without("the robot was outside its limits"),
            Status::Tightening => {
                return without("the robot was on its way to limits that an operator moved");
            }
            Status::Slowed => {
                return without(
                    "no way to stop was found from the nearest allowed state, or its physics steps do not lead there (slowed)",
                );
            }
            Status::Braked | Status::Refused => return without("the proposal was not used: braked"),
            _ => {}
        }
        let proposal = match &case.proposal {
            Ok(proposal) => proposal,
            Err(why) => return without(why),
        };
        if passage.is_free {
            match optimum::apart(promise, passage, proposal, &case.tick.ledger, is_stored) {
                Ok(()) => self.report.optimal += 1,
                Err(Fault::Unknown(why)) => return without(&why),
                Err(fault) => return Err(fault),
            }
            return Ok(());
        }
        let (one, other) = unconstrained(promise, passage, proposal);
        if !case.by_policy && promise.limits.rows.iter().any(Row::needs_before) {
            return without("a brake is not told of the tick before, of which jerk and torque rate speak");
        }
        // Half a period more where a stored brake stops in whole ones.
        let whole = is_stored;
        match optimum::confirm(promise, passage, [&one, &other], &case.tick.ledger, whole) {
            Ok(worst) => {
                self.report.optimal += 1;
                self.report.unbalanced = self.report.unbalanced.max(worst);
            }
            Err(Fault::Unknown(why)) => return without(&why),
            Err(fault) => return Err(fault),
        }
        let said = case.tick.ledger.moved;
        let found = distance(promise, passage, proposal, &other);
        if case.tick.ledger.status == UNCHANGED && found > CHANGED && !promise.limits_actions {
            return broken(
                "distance to the target of a proposal that is said to be unchanged",
                found,
                0.0,
                "rad/s or m/s",
            );
        }
        if !promise.limits_actions && !are_near(said, found, 1e-6 * (1e-3 + found)) {
            return broken("ledger.moved", said, found, "rad/s or m/s");
        }
        Ok(())
    }

    fn stop(
        &mut self,
        promise: &mut Promise,
        case: &Case<'_>,
        a: &[f64],
        is_stored: bool,
    ) -> Result<(), Fault> {
        let (q, v) = (&case.tick.target_q, &case.tick.target_v);
        let mut without = |why: &str| {
            *self.report.not_stopped.entry(why.to_owned()).or_default() += 1;
            Ok(())
        };
        if case.status == Status::Recovering {
            return without("the robot was outside its limits");
        }
        if promise.consistency == Consistency::Free {
            return without("consistency = \"free\" promises none");
        }
        let found = if is_stored {
            stop::stored(promise, q, v, a, &case.tick.brake)
        } else if promise.way == Way::Stored {
            return broken("number of stored decelerations", 0.0, v.len() as f64, "");
        } else {
            stop::certified(promise, q, v, a)
        };
        match found {
            Ok(()) => self.report.stoppable += 1,
            Err(Fault::Unknown(why)) => return without(&why),
            Err(fault) => return Err(fault),
        }
        Ok(())
    }
}

/// What a ledger says of one thing in several of its numbers.
fn agrees(ledger: &Ledger, status: Status, nv: usize) -> Result<(), Fault> {
    let rows = ledger.active_rows.len();
    let is_full = rows == ROOM && ledger.active > ROOM;
    if !(ledger.is_whole() || is_full) {
        return broken("ledger.active", ledger.active as f64, rows as f64, "active rows in its list");
    }
    if ledger.status == UNCHANGED && ledger.active > 0 {
        return broken(
            "number of active rows of a proposal that is said to be unchanged",
            ledger.active as f64,
            0.0,
            "",
        );
    }
    if ledger.status == CLAMPED
        && let Some(row) = ledger.active_rows.iter().map(|active| active.row).find(|row| *row >= nv)
    {
        return broken(
            "number of an active row of a proposal that is said to be clamped joint by joint",
            row as f64,
            nv as f64,
            "at most, less one",
        );
    }
    let must_be = match status {
        Status::Recovering | Status::Tightening => Some(true),
        Status::Nearest | Status::Slowed => Some(false),
        _ => None,
    };
    if must_be.is_some_and(|must_be| must_be != (ledger.outside > 0)) {
        let limit = f64::from(u8::from(ledger.outside == 0));
        let unit = if ledger.outside == 0 { "or more" } else { "" };
        let says = match status {
            Status::Recovering => "recovering",
            Status::Tightening => "tightening",
            Status::Slowed => "slowed",
            _ => "the nearest allowed state",
        };
        let what = format!("ledger.outside of a tick that says it is {says}");
        return broken(what, ledger.outside as f64, limit, unit);
    }
    // Of a target that was looked for otherwise, it is what that exceeds, and no row holds it.
    let slack = ledger.active_rows.iter().fold(0.0, |most: f64, row| most.max(row.slack));
    if ledger.slack < slack {
        return broken("ledger.slack", ledger.slack, slack, "of a limit's size, at least");
    }
    Ok(())
}

/// The proposed state at a policy tick; of a joint with one half proposed the other follows at constant acceleration.
fn goal(own: &Promise, tick: &Tick, q: &[f64], v: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut gq, mut gv) = (q.to_vec(), v.to_vec());
    for entry in &own.proposed {
        match *entry {
            Entry::Position { at, .. } => gq[at] = tick.proposal_q[at],
            Entry::Velocity { dof } => gv[dof] = tick.proposal_v[dof],
        }
    }
    let length = f64::from(own.policy_every) * own.period.dt;
    for &i in &own.controllable {
        let Some(at) = own.machine.single(i) else { continue };
        match own.halves(i) {
            (false, true) => gq[at] = q[at] + 0.5 * length * (v[i] + gv[i]),
            (true, false) => gv[i] = 2.0 * (gq[at] - q[at]) / length - v[i],
            _ => {}
        }
    }
    (gq, gv)
}

/// Position and velocity at share `s` of the cubic from one state to another that takes `length` [s].
fn cubic(s: f64, length: f64, (q0, v0): (f64, f64), (q1, v1): (f64, f64)) -> (f64, f64) {
    let (stay, go) = (1.0 - s, s);
    let q = stay * stay * ((1.0 + 2.0 * s) * q0 + s * length * v0)
        + go * go * ((3.0 - 2.0 * s) * q1 - stay * length * v1);
    let v = 6.0 * s * stay * (q1 - q0) / length + stay * (1.0 - 3.0 * s) * v0 + go * (3.0 * s - 2.0) * v1;
    (q, v)
}

/// The next velocities nearest to a proposal without limits: where its position would lead and where its velocity does count alike. Twice: where the
/// two are one but for rounding, the second is the velocity.
fn unconstrained(
    own: &Promise,
    passage: &Passage<'_>,
    (pq, pv): &(Vec<f64>, Vec<f64>),
) -> (Vec<f64>, Vec<f64>) {
    let (p, q, v) = (&own.period, passage.q, passage.v);
    let (mut one, mut other) = (v.to_vec(), v.to_vec());
    for &i in &own.controllable {
        let by_velocity = (pv[i] - v[i]).clamp(-HUGE, HUGE);
        let Some(at) = own.machine.single(i) else {
            (one[i], other[i]) = (pv[i], pv[i]);
            continue;
        };
        let by_position = ((pq[at] - q[at] - p.dt * v[i]) / (p.kappa * p.dt)).clamp(-HUGE, HUGE);
        one[i] = v[i] + 0.5 * (by_position + by_velocity);
        let belong =
            (p.kappa * p.dt * (by_position - by_velocity)).abs() <= 2.0 * BELONGS * q[at].abs().max(1.0);
        other[i] = if belong { pv[i] } else { one[i] };
    }
    (one, other)
}

/// The distance from proposal to target: positions divided by a period, so that both are velocities. Of a joint that has what it was asked for
/// it is rounding.
fn distance(own: &Promise, passage: &Passage<'_>, (pq, pv): &(Vec<f64>, Vec<f64>), goal: &[f64]) -> f64 {
    let p = &own.period;
    let each = own.controllable.iter().map(|&i| {
        let dv = passage.v1[i] - pv[i];
        let Some(at) = own.machine.single(i).filter(|_| !(goal[i] == pv[i] && dv == 0.0)) else { return 0.0 };
        let dq = (passage.q[at] + p.way(passage.v[i], passage.v1[i]) - pq[at]) / (p.kappa * p.dt);
        dq * dq + dv * dv
    });
    each.sum::<f64>().sqrt()
}

/// The limits of joints, then what ties joints together.
fn holds(promise: &mut Promise, passage: &Passage<'_>, stored: bool, excused: bool) -> Result<(), Fault> {
    let Promise { machine, limits, controllable, period, .. } = promise;
    limit_check::joints(limits, machine, controllable, period, passage, excused)?;
    limit_check::rows(limits, machine, period, passage, stored, excused)
}

/// The target's position is where its velocity leads.
fn follows(promise: &Promise, passage: &Passage<'_>) -> Result<(), Fault> {
    let p = &promise.period;
    for &i in &promise.controllable {
        let Some(at) = promise.machine.single(i) else { continue };
        let leads = passage.q[at] + p.way(passage.v[i], passage.v1[i]);
        if !are_near(passage.q1[at], leads, CONSISTENT * leads.abs().max(1.0)) {
            let j = &promise.limits.joints[i];
            return broken(format!("target position of joint '{}'", j.name), passage.q1[at], leads, j.length);
        }
    }
    Ok(())
}

/// Something is outside its limits at the start of the tick.
fn is_outside(promise: &mut Promise, case: &Case<'_>, whole: bool) -> bool {
    let Promise { machine, limits, controllable, period, .. } = promise;
    let joint = |&i: &usize| {
        let known = case.last.as_ref().map(|last| last[i]);
        limits.joints[i].is_outside(period, machine.single(i).map(|at| case.q[at]), (case.v[i], known), whole)
    };
    if controllable.iter().any(joint) {
        return true;
    }
    let (q, v) = (case.q, case.v);
    if limits.rows.iter().any(|row| row.is_of_state() && crate::rows::is_beyond(row, machine, q, v)) {
        return true;
    }
    let Some(collision) = &limits.collision else { return false };
    machine.go(q, v);
    !matches!(collision.gap(machine, collision.margin), crate::collision::Gap::Kept)
}

/// The action is the one that leads to the target; where a joint rubs, to within its dry friction.
fn actions(promise: &mut Promise, passage: &Passage<'_>, found: &[f64]) -> Result<(), Fault> {
    let p = promise.period;
    let (lag, sag) = (0.5 * (p.dt - p.tau), (p.dt * p.dt - p.tau * p.tau) / 6.0);
    let (mut means, mut cut) = (Vec::new(), None);
    for action in &promise.actions {
        let (i, joint) = (action.dof, &promise.limits.joints[action.dof].name);
        let Some(at) = promise.machine.single(i) else { continue };
        let (v, a, tau) = (passage.v[i], passage.a[i], passage.tau[i]);
        let (sent, by_friction, unit) = match action.sent {
            Sent::Force => {
                let share = action.gear * action.gain;
                ((tau / action.gear - action.bias) / action.gain, action.friction / share.abs(), "N m or N")
            }
            Sent::Position => (passage.q1[at], 0.0, "rad or m"),
            Sent::Velocity => (passage.v1[i], 0.0, "rad/s or m/s"),
            Sent::Target { stiffness, damping } => {
                let target = passage.q[at] + lag * v + sag * a + (tau + damping * (v + lag * a)) / stiffness;
                // No force goes to where a step is no longer implicit in the drive's damping.
                let [low, high] = [-action.strength, action.strength]
                    .map(|force| passage.q[at] + (force + damping * v) / stiffness);
                (target.max(low).min(high), action.friction / stiffness, "rad or m")
            }
        };
        let leads = sent.max(action.range[0]).min(action.range[1]);
        let is = found.get(action.place).copied().unwrap_or(f64::NAN);
        let size = 1.0 + leads.abs().max(action.range[1].abs().min(1e3));
        means.push(leads);
        let moves = matches!(action.sent, Sent::Force | Sent::Target { .. });
        if p.sub_steps > 1 && moves {
            continue;
        }
        // What a motor lacks of a force is its limit's matter; a position, a speed or a target that ends before leads elsewhere.
        if !matches!(action.sent, Sent::Force) && !are_near(sent, leads, by_friction + ACTION * size) {
            cut = cut.or(Some(i));
        }
        if !are_near(is, leads, by_friction + ACTION * size) {
            return broken(format!("action for joint '{joint}'"), is, leads, unit);
        }
    }
    if let Some(cut) = cut {
        return crate::cut::lead(promise, passage, found, cut);
    }
    if p.sub_steps > 1 && !means.is_empty() {
        crate::steps::lead(promise, passage, found, &means)
    } else {
        Ok(())
    }
}
