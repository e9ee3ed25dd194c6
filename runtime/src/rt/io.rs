//! The I/O thread: moves messages between the links and the rings of the real-time thread.
//!
//! It polls. Around the moment a state or an action is due it yields instead of sleeping, so that the exchange of a
//! tick costs microseconds; the rest of the period it sleeps, so that two cores are enough for plant, loop and this.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use hdrhistogram::Histogram;
use rtrb::{Consumer, Producer};

use crate::clock::{self, Bell};
use crate::link::torn;
use crate::link::{
    ActionMessage, AskedMessage, HealthMessage, MAX_JOINTS, Message, ProposalMessage, RobotMessage,
    RuntimeLink, StateMessage, TallyMessage, TickMessage, TransitionMessage,
};
use crate::log::LogQueue;
use crate::percentiles::percentiles;
use crate::rt::inbox::{SnapshotInbox, Surroundings};
use crate::rt::pinned::above;
use crate::rt::tick::{Build, Record, Sensed};
use crate::rt::watch::Watch;

/// Before a state is due, this thread is awake so much earlier [ns].
const LEAD: u64 = 120_000;
/// Longest sleep [ns].
const NAP: u64 = 500_000;
/// After so long without a state the plant counts as silent and polling slows down [ns].
const SILENT: u64 = 5_000_000;
/// Least time between two looks at what is not part of a tick [ns].
const ATTEND: u64 = 500_000;
/// Longest wait for a plant's last count [ns].
const ANSWER: u64 = 300_000_000;
/// Period of the health message [ns].
const HEALTH: u64 = 100_000_000;

/// The I/O thread's state.
pub(crate) struct Io<B: Build> {
    pub(crate) link: RuntimeLink,
    pub(crate) robot: RobotMessage,
    /// What the last plant that came back as another robot has otherwise.
    pub(crate) foreign: Option<String>,
    pub(crate) states: Producer<StateMessage>,
    pub(crate) proposals: Producer<ProposalMessage>,
    /// What is asked of another process, where one proposes.
    pub(crate) asked: Option<Box<AskedMessage>>,
    pub(crate) actions: Consumer<ActionMessage>,
    pub(crate) records: Consumer<Record>,
    pub(crate) bell: Arc<Bell>,
    pub(crate) snapshots: SnapshotInbox<B>,
    pub(crate) log: Option<LogQueue>,
    pub(crate) explore: Option<u64>,
    /// Set once the plant counts as gone, after so long without a state [ns].
    pub(crate) gone: Arc<AtomicBool>,
    pub(crate) gone_after: u64,
    /// So long without a new snapshot is said [ns].
    pub(crate) snapshot_age: Option<u64>,
    pub(crate) period: u64,
    pub(crate) polls_always: bool,
    /// That of the real-time thread.
    pub(crate) priority: Option<i32>,
    pub(crate) health: Health,
    /// The message of the tick, filled anew for each.
    pub(crate) tick: Box<TickMessage>,
    pub(crate) traffic: Traffic,
    /// What the plant counted, as far as it said.
    pub(crate) tally: Option<TallyMessage>,
    pub(crate) watch: Watch,
}

/// What this thread counts and remembers.
#[derive(Default)]
pub(crate) struct Traffic {
    /// States of the wrong size or from a plant that is not the announced one.
    pub(crate) refused_states: u64,
    /// States that found the ring full.
    pub(crate) dropped_states: u64,
    last_state: u64,
    last_due: u64,
    waits_for_action: bool,
    next_attend: u64,
    previous: Option<Box<Record>>,
    pub(crate) tick: u64,
    /// No new snapshot came for too long, and how often that was.
    is_aged: bool,
    pub(crate) aged: u64,
}

impl<B: Build> Io<B> {
    /// Runs until `over` is set and nothing is left to move; returns itself for the report.
    pub(crate) fn run(mut self, over: &AtomicBool) -> Io<B> {
        // Who polls without a pause would take a core for itself at a real-time priority.
        crate::thread::be_prompt(self.priority.filter(|_| !self.polls_always));
        self.traffic.last_state = clock::now();
        loop {
            let is_over = over.load(Ordering::Acquire);
            if torn::is_torn() {
                self.end();
            }
            self.move_proposals();
            let moved = self.move_states() | self.move_actions() | self.move_records();
            if self.has_time() {
                self.attend();
            }
            if !moved {
                if is_over {
                    self.attend();
                    self.link.send_action(&mut ActionMessage::farewell());
                    return self;
                }
                self.idle();
            }
        }
    }

    fn move_states(&mut self) -> bool {
        let Some(state) = self.link.newest_state() else { return false };
        if !fits(&self.robot, state) {
            self.traffic.refused_states += 1;
            return true;
        }
        self.traffic.last_state = clock::now();
        self.traffic.last_due = state.header.stamp;
        match self.states.push(*state) {
            Ok(()) => self.traffic.waits_for_action = true,
            Err(_) => self.traffic.dropped_states += 1,
        }
        self.bell.ring();
        true
    }

    /// A proposal that finds the ring full is overtaken by the next one.
    fn move_proposals(&mut self) {
        if self.asked.is_some()
            && let Some(proposal) = self.link.newest_proposal()
        {
            let _ = self.proposals.push(*proposal);
        }
    }

    fn move_actions(&mut self) -> bool {
        let Ok(mut action) = self.actions.pop() else { return false };
        self.traffic.waits_for_action = false;
        self.link.send_action(&mut action);
        true
    }

    fn move_records(&mut self) -> bool {
        let Ok(record) = self.records.peek() else { return false };
        self.traffic.tick = record.tick;
        self.health.take(record);
        self.watch.take(record);
        if self.link.is_watched() {
            fill_tick(&mut self.tick, record);
            self.link.send_tick(&mut self.tick);
        }
        if let Some(log) = &mut self.log {
            log.push(record);
        }
        if record.fresh {
            if let Some(previous) = self.traffic.previous.as_deref() {
                self.snapshots.observe(previous, record);
                // What was predicted or could not be used was not experienced.
                let is_measured = previous.sensed == Sensed::Measured && record.sensed == Sensed::Measured;
                if previous.output.nu > 0 && is_measured {
                    self.link.send_transition(&mut transition(previous, &record.state, self.explore));
                }
            }
            match &mut self.traffic.previous {
                Some(previous) => **previous = *record,
                none => *none = Some(Box::new(*record)),
            }
        }
        let _ = self.records.pop();
        true
    }

    /// Waits for the plant's count up to its tick `tick`, which it sends when the runtime leaves; what it said last if it does not answer.
    pub(crate) fn last_tally(&mut self, tick: u64) -> Option<TallyMessage> {
        let until = clock::now() + ANSWER;
        while self.tally.is_none_or(|t| t.tick < tick) && clock::now() < until {
            self.hear_tally();
            clock::sleep_until(clock::now() + NAP);
        }
        self.tally
    }

    fn hear_tally(&mut self) {
        let epoch = self.robot.header.epoch;
        self.tally = self.link.tally().filter(|t| t.header.epoch == epoch).or(self.tally);
    }

    /// True when nothing urgent is expected soon.
    fn has_time(&self) -> bool {
        let now = clock::now();
        if now < self.traffic.next_attend || self.traffic.waits_for_action {
            return false;
        }
        let next = self.traffic.last_due + self.period;
        let is_far = now + 2 * LEAD < next || now > next + SILENT;
        is_far || self.polls_always || self.period < 4 * LEAD
    }

    /// Everything that is not part of a tick: the plant's description, snapshots, health.
    fn attend(&mut self) {
        self.traffic.next_attend = clock::now() + ATTEND;
        if let Some(robot) = self.link.robot() {
            // A plant that came back as another robot gets no action: its states are refused by their epoch.
            match another(&self.robot, &robot) {
                None => self.robot = robot,
                Some(what) => self.foreign = Some(what),
            }
        }
        self.hear_tally();
        self.look_for_the_plant();
        let Io { link, log, robot, snapshots, traffic, watch, .. } = self;
        snapshots.pump(&mut Surroundings { link, log, robot, tick: traffic.tick });
        if let Some(watched) = snapshots.watched.take() {
            watch.set(watched);
        }
        let now = clock::now();
        self.look_for_the_trainer(now);
        if now >= self.health.next {
            self.health.next = now + HEALTH;
            let mut message = self.health.message();
            message.refused_states = self.traffic.refused_states + self.link.refused_states();
            message.refused_snapshots = self.snapshots.refused();
            message.rolled_back = self.snapshots.rolled_back;
            message.aged = u32::from(self.traffic.is_aged);
            message.log_drops = self.log.as_ref().map_or(0, LogQueue::dropped);
            self.link.send_health(&mut message);
            if let Some(asked) = &mut self.asked {
                self.health.account(asked);
                self.link.send_asked(asked);
            }
            self.link.send_rows(&mut self.snapshots.rows);
        }
    }

    /// A plant that keeps real time and is silent is gone. One in lockstep may take its time, as long as its process lives and has not left.
    fn look_for_the_plant(&self) {
        let is_silent = clock::now() > self.traffic.last_state + self.gone_after;
        if is_silent && !(self.robot.is_lockstep() && is_alive(self.robot.pid) && self.link.has_plant()) {
            self.end();
        }
    }

    /// A trainer that pushes nothing for long is said to be silent; the loop goes on with what it has.
    fn look_for_the_trainer(&mut self, now: u64) {
        let is_aged = self.snapshot_age.is_some_and(|most| now > self.snapshots.came.saturating_add(most));
        if is_aged && !self.traffic.is_aged {
            self.traffic.aged += 1;
        }
        self.traffic.is_aged = is_aged;
    }

    /// Has the loop brake and end: there is nobody to drive, or nothing to drive it over.
    fn end(&self) {
        if !self.gone.swap(true, Ordering::AcqRel) {
            self.bell.ring();
        }
    }

    fn idle(&self) {
        let now = clock::now();
        let next = self.traffic.last_due + self.period;
        if now > self.traffic.last_state + self.period + SILENT {
            return clock::sleep_until(now + NAP);
        }
        if self.polls_always || self.traffic.waits_for_action || now + LEAD >= next {
            return std::thread::yield_now();
        }
        clock::sleep_until((next - LEAD).min(now + NAP));
    }
}

/// What a plant that came back has otherwise than the one that was `known`; `None` where it is the same robot.
fn another(known: &RobotMessage, robot: &RobotMessage) -> Option<String> {
    if robot.joints != known.joints {
        let theirs = robot.joint_names();
        let (at, is, was) = known.first_other_joint(&theirs);
        let name = |name: Option<&str>| name.map_or("none".into(), |name| format!("'{name}'"));
        return Some(format!("its joint {at} is {}, and was {}", name(is), name(was.as_deref())));
    }
    let mut sizes = robot.sizes().into_iter().zip(known.sizes());
    if let Some(((what, is), (_, was))) = sizes.find(|((_, is), (_, was))| is != was) {
        return Some(format!("it has {is} {what}, and had {was}"));
    }
    if robot.dt != known.dt {
        return Some(format!("its control period is {} s, and was {} s", robot.dt, known.dt));
    }
    if robot.is_lockstep() != known.is_lockstep() {
        return Some("it waits for the loop where it did not, or the other way round (lockstep)".into());
    }
    if robot.observation != known.observation {
        return Some("the entries of its observation have other names or another order".into());
    }
    if robot.limits != known.limits {
        return Some("its robot file or its actuators state other limits".into());
    }
    tighter(known, robot)
}

/// A limit that a plant states tighter than it did: what the loop runs was compared with the one before.
fn tighter(known: &RobotMessage, robot: &RobotMessage) -> Option<String> {
    let names = robot.joint_names();
    let kinds = [
        ("velocity", 1.0, robot.velocity, known.velocity),
        ("acceleration", 1.0, robot.acceleration, known.acceleration),
        ("torque", 1.0, robot.effort, known.effort),
        ("highest position", 1.0, robot.q_upper, known.q_upper),
        ("lowest position", -1.0, robot.q_lower, known.q_lower),
    ];
    let of_joint = |(what, sign, is, was): &(&str, f64, [f64; MAX_JOINTS], [f64; MAX_JOINTS]), i: usize| {
        let was = if known.states_limits() { was[i] } else { sign * f64::INFINITY };
        above(sign * was, sign * is[i]).then(|| {
            format!(
                "it states {what} {} for joint '{}' where it stated {was}: start the loop anew within it",
                is[i], names[i]
            )
        })
    };
    robot.states_limits().then(|| {
        (0..names.len().min(MAX_JOINTS)).find_map(|i| kinds.iter().find_map(|kind| of_joint(kind, i)))
    })?
}

/// True if the state is of the size and from the plant that were announced.
fn fits(robot: &RobotMessage, state: &StateMessage) -> bool {
    state.header.epoch == robot.header.epoch
        && (state.nq, state.nv, state.n_obs) == (robot.nq, robot.nv, robot.n_obs)
}

/// True if a process with this number exists.
fn is_alive(pid: u32) -> bool {
    std::path::Path::new("/proc").join(pid.to_string()).exists()
}

/// What viewers are told of a tick.
fn fill_tick(m: &mut TickMessage, record: &Record) {
    let (state, output, counters) = (&record.state, &record.output, &record.counters);
    (m.tick, m.due, m.begin, m.end) = (record.tick, record.due, record.begin, record.end);
    (m.policy_version, m.snapshot, m.episode) = (record.policy_version, record.snapshot, state.episode);
    (m.mode, m.reason) = (record.mode.code(), record.reason.code());
    m.overruns = counters.overruns;
    (m.raw_violations, m.target_violations) = (counters.raw_violations, counters.target_violations);
    (m.nq, m.nv, m.nu) = (state.nq, state.nv, output.nu);
    m.q_mut().copy_from_slice(state.q());
    m.v_mut().copy_from_slice(state.v());
    (m.n_active, m.n_brake) = (0, 0);
    if output.nu == 0 {
        return;
    }
    m.ledger = output.ledger;
    (m.n_active, m.n_brake) = (output.rows().len() as u32, output.n_brake);
    let (nq, nv) = (state.q().len(), state.v().len());
    m.proposal_q_mut().copy_from_slice(&output.proposal_q[..nq]);
    m.proposal_v_mut().copy_from_slice(&output.proposal_v[..nv]);
    m.target_q_mut().copy_from_slice(&output.target_q[..nq]);
    m.target_v_mut().copy_from_slice(&output.target_v[..nv]);
    let nu = m.action().len();
    m.action_mut().copy_from_slice(&output.action[..nu]);
    m.brake_mut().copy_from_slice(output.brake());
    for (k, row) in output.rows().iter().enumerate() {
        (m.rows[k], m.kinds[k], m.sides[k]) = (u32::from(row.row), u32::from(row.kind), u32::from(row.side));
        (m.multipliers[k], m.slacks[k]) = (row.multiplier, row.slack);
    }
}

/// The transition from one record to the state that followed it.
fn transition(record: &Record, next: &StateMessage, explore: Option<u64>) -> TransitionMessage {
    let mut m = TransitionMessage::zeroed();
    let (state, output) = (&record.state, &record.output);
    m.tick = record.tick;
    m.state_epoch = state.header.epoch;
    m.state_seq = state.header.seq;
    m.next_state_seq = next.header.seq;
    m.policy_version = record.policy_version;
    m.episode = state.episode;
    m.next_bits = next.bits;
    m.mode = record.mode.code();
    (m.explores, m.explore) = (u32::from(explore.is_some()), explore.unwrap_or(0));
    (m.period_tick, m.time) = (output.period_tick, state.time);
    (m.nq, m.nv, m.nu, m.n_obs) = (state.nq, state.nv, output.nu, state.n_obs);
    (m.log_prob_proposal, m.log_prob_action) = (output.log_prob_proposal, output.log_prob_action);
    m.ledger = output.ledger;
    (m.q, m.v, m.obs) = (state.q, state.v, state.obs);
    (m.proposal_q, m.proposal_v) = (output.proposal_q, output.proposal_v);
    (m.target_q, m.target_v) = (output.target_q, output.target_v);
    m.action = output.action;
    m
}

/// What the health message says.
pub(crate) struct Health {
    next: u64,
    last: HealthMessage,
    /// Proposals taken, overtaken, refused; ticks that held one, and without one.
    proposals: [u64; 5],
    wake: Histogram<u64>,
    compute: Histogram<u64>,
}

impl Health {
    /// Of a loop that begins with this `version`: who asks before the first tick counts on from it.
    pub(crate) fn new(version: u64) -> Result<Health, hdrhistogram::CreationError> {
        let histogram = || Histogram::new_with_bounds(1, 100_000_000_000, 2);
        let mut last = HealthMessage::zeroed();
        (last.pid, last.policy_version) = (std::process::id(), version);
        Ok(Health { next: 0, last, proposals: [0; 5], wake: histogram()?, compute: histogram()? })
    }

    fn take(&mut self, record: &Record) {
        let (last, counters) = (&mut self.last, &record.counters);
        last.tick = record.tick;
        (last.mode, last.reason) = (record.mode.code(), record.reason.code());
        last.policy_version = record.policy_version;
        (last.overruns, last.skipped) = (counters.overruns, counters.skipped);
        (last.stale, last.swaps) = (counters.stale, counters.swaps);
        last.lost_states = counters.lost_states;
        self.proposals = [
            counters.proposals,
            counters.overtaken_proposals,
            counters.refused_proposals,
            counters.held_proposals,
            counters.silent_proposer,
        ];
        last.raw_violations = counters.raw_violations;
        last.target_violations = counters.target_violations;
        if record.fresh {
            self.wake.saturating_record(record.begin.saturating_sub(record.due));
            self.compute.saturating_record(record.end - record.begin);
        }
    }

    fn account(&self, asked: &mut AskedMessage) {
        [asked.taken, asked.overtaken, asked.refused, asked.held, asked.silent] = self.proposals;
        asked.mode = self.last.mode;
    }

    fn message(&self) -> HealthMessage {
        let four = |h| {
            let p = percentiles(h);
            [p.p50, p.p99, p.p999, p.max]
        };
        HealthMessage { wake: four(&self.wake), compute: four(&self.compute), ..self.last }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::ROBOT_LIMITS;

    #[test]
    fn a_plant_that_states_tighter_limits_than_it_did_is_another() {
        let mut known = RobotMessage::zeroed();
        known.set_joint_names(&["shoulder", "elbow"]);
        (known.nv, known.bits) = (2, ROBOT_LIMITS);
        for most in [&mut known.velocity, &mut known.acceleration, &mut known.effort, &mut known.q_upper] {
            most.fill(2.0);
        }
        known.q_lower.fill(-2.0);
        let mut robot = known;
        assert_eq!(another(&known, &robot), None);
        robot.velocity[1] = 3.0;
        assert_eq!(another(&known, &robot), None, "looser");
        robot.velocity[1] = 0.5;
        let said = another(&known, &robot).unwrap();
        assert!(said.starts_with("it states velocity 0.5 for joint 'elbow' where it stated 2"), "{said}");
        (robot.velocity[1], robot.q_lower[0]) = (2.0, -1.0);
        assert!(another(&known, &robot).unwrap().contains("lowest position -1 for joint 'shoulder'"));
        let mut silent = known;
        silent.bits = 0;
        assert_eq!(another(&known, &silent), None, "one that states none");
        assert!(another(&silent, &known).is_some());
        let mut many = known;
        many.set_joint_names(&vec!["j"; 1000]);
        assert_eq!(tighter(&known, &many), None, "more names than joints");
    }
}
