//! A tick without threads, links and clocks: what the real-time thread and replay both call.
//!
//! ```text
//! swap -> sense -> decide -> act -> close
//! ```
//!
//! The same controllers and the same [`Inputs`] give the same bits.

use std::panic::{AssertUnwindSafe, catch_unwind};

use serde::{Deserialize, Serialize};

use crate::codes::LedgerStatus;
use crate::grid::Grid;
use crate::link::{Message, ProposalMessage, STATE_BRAKED, StateMessage};
use crate::rt::Sync;
use crate::rt::faults::FaultPlan;
use crate::rt::heard::Heard;
use crate::rt::mode::{Event, Mode, ModeLimits, Modes, Reason};
use crate::rt::pace::Pace;
use crate::rt::tick::{LoopController, Outcome, Record, Sensed, TickOutput};
use crate::rt::way::Way;

/// Settings of a tick; times in \[ns\].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CoreSettings {
    /// Control period.
    pub period: u64,
    /// Who keeps time.
    pub sync: Sync,
    /// A state older than this is stale.
    pub age_limit: u64,
    /// The plant keeps real time: a tick longer than the period is an overrun, and states in between are lost.
    pub real_time: bool,
    /// Largest speed entry that counts as standing still [rad/s or m/s].
    pub stop_speed: f64,
    /// A joint may move so many times further than its speed allows before its sample is implausible; 0 is no check.
    pub jump: f64,
    /// Ticks over which the first motion is let in.
    pub ramp: u32,
    /// When to change the mode.
    pub modes: ModeLimits,
    /// Seed of the exploration noise; without one there is none.
    #[serde(default)]
    pub explore: Option<u64>,
    /// What counts as a proposal of another process, in place of the policy's; without it the policy proposes.
    #[serde(default)]
    pub proposer: Option<ProposerSettings>,
}

/// How long a proposal of another process counts \[ns\].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProposerSettings {
    /// A proposal whose state is older than this is held.
    pub age_limit: u64,
    /// So long is it held, in Degraded, before the loop brakes.
    pub hold: u64,
}

impl Default for ProposerSettings {
    fn default() -> Self {
        ProposerSettings { age_limit: 100_000_000, hold: 100_000_000 }
    }
}

/// What the world brought to a tick: with the history, everything it depends on.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a> {
    /// When it was due by the loop's own clock \[ns\]; not used if the plant keeps time.
    pub due: u64,
    /// When it began \[ns\].
    pub begin: u64,
    /// A stop had been asked for.
    pub stop: bool,
    /// The newest state, if one came.
    pub fresh: Option<&'a StateMessage>,
    /// The newest proposal of another process, if one came.
    pub proposal: Option<&'a ProposalMessage>,
}

/// A controller and the number of its snapshot.
pub struct Loaded<T> {
    /// In the order the snapshots were received; 0 for the first.
    pub id: u64,
    /// The controller.
    pub controller: T,
}

/// The loop's memory from tick to tick.
pub struct Core<T: LoopController> {
    settings: CoreSettings,
    /// The controller in use.
    pub controller: Box<Loaded<T>>,
    /// The tick.
    pub record: Record,
    modes: Modes,
    grid: Grid,
    faults: FaultPlan,
    /// The state acted upon: the measured one, or a prediction.
    estimate: StateMessage,
    /// What another process proposed.
    heard: Heard,
    /// What the controller saved in the tick before, for the one swapped in after it.
    memory: Vec<f64>,
    /// What was answered last is not what the robot does.
    is_lost: bool,
    /// States predicted in a row; none can be before the first was measured.
    held: Option<u32>,
    braked: u32,
    ramped: u32,
    overran: bool,
    pace: Pace,
    way: Way,
    /// When the first state of those that tell the same came [ns].
    since: u64,
    /// Time by the plant's clock \[s\] and number of the last state by which that clock went on: one wrong time is bridged with its state.
    clock: (f64, u64),
    /// `brake` panicked: it is not called again on this controller. A panic of `tick` latches Fault.
    brake_broken: bool,
}

impl<T: LoopController> Core<T> {
    /// Begins in Hold; `start` is the first slot of the loop's own clock \[ns\].
    pub fn new(settings: CoreSettings, controller: Box<Loaded<T>>, start: u64, faults: FaultPlan) -> Core<T> {
        let mut memory = Vec::new();
        controller.controller.save_memory(&mut memory);
        Core {
            memory,
            is_lost: true,
            modes: Modes::new(settings.modes, settings.period),
            grid: Grid::new(start, settings.period),
            record: Record::new(),
            estimate: StateMessage::zeroed(),
            heard: Heard::new(),
            held: None,
            braked: 0,
            ramped: 0,
            overran: false,
            pace: Pace::default(),
            way: Way::new(),
            since: 0,
            clock: (0.0, 0),
            brake_broken: false,
            settings,
            controller,
            faults,
        }
    }

    /// Moves the first slot of the loop's own clock \[ns\].
    pub fn start(&mut self, start: u64) {
        self.grid = Grid::new(start, self.settings.period);
    }

    /// Settings.
    pub fn settings(&self) -> &CoreSettings {
        &self.settings
    }

    /// When the next slot of the loop's own clock is due \[ns\].
    pub fn due(&self) -> u64 {
        self.grid.due()
    }

    /// The state acted upon.
    pub fn estimate(&self) -> &StateMessage {
        &self.estimate
    }

    /// Periods that a rehearsed fault makes this tick take at least.
    pub fn rehearsed_periods(&self) -> f64 {
        self.faults.periods(self.record.tick)
    }

    /// Begins a tick; `swapped` if [`Core::controller`] is another one since the last.
    pub fn swap(&mut self, swapped: bool) {
        self.record.swapped = swapped;
        if swapped {
            self.controller.controller.reset();
            self.controller.controller.load_memory(&self.memory);
            if self.is_lost {
                self.controller.controller.lose();
            }
            self.heard.repeat(&mut self.controller.controller);
            self.brake_broken = false;
            self.record.counters.swaps += 1;
        }
        self.record.tick += 1;
        self.record.snapshot = self.controller.id;
        self.record.policy_version = self.controller.controller.version();
    }

    /// From the state to the action in [`Core::record`]; [`Core::close`] ends the tick.
    pub fn update(&mut self, inputs: &Inputs<'_>) {
        let record = &mut self.record;
        (record.begin, record.stop) = (inputs.begin, inputs.stop);
        if self.settings.sync == Sync::Clock {
            record.due = inputs.due;
        }
        let event = self.sense(inputs.fresh);
        let told = self.listen(event, inputs);
        self.record.mode = self.modes.update(told, self.overran, inputs.stop);
        self.record.sensed = match event {
            Event::Good if self.held == Some(0) => Sensed::Measured,
            Event::Good => Sensed::Predicted,
            Event::Held(_) if self.record.mode != Mode::Hold => Sensed::Predicted,
            Event::Lost(Reason::LostStates | Reason::WrongPeriod) if self.record.fresh => Sensed::Measured,
            _ => Sensed::Missing,
        };
        self.count(event);
        self.act();
    }

    /// Ends the tick at `end` \[ns\] on its grid.
    pub fn close(&mut self, end: u64) {
        let record = &mut self.record;
        record.end = end;
        if self.settings.sync == Sync::Clock {
            self.overran = self.grid.finish(end) > 0;
            (record.counters.overruns, record.counters.skipped) = (self.grid.overruns(), self.grid.skipped());
        } else {
            let spent = end.saturating_sub(record.state.header.stamp);
            self.overran = self.settings.real_time && record.fresh && spent > self.settings.period;
            if self.overran {
                record.counters.overruns += 1;
                record.counters.skipped += (spent - 1) / self.settings.period;
            }
        }
        if record.mode.acts() {
            let ledger = record.output.ledger;
            let is = |status: LedgerStatus| u64::from(ledger.status == status.number());
            record.counters.raw_violations += u64::from(ledger.raw_violations > 0);
            record.counters.target_violations += u64::from(ledger.target_breaks());
            record.counters.recovering += u64::from(ledger.outside > 0);
            let bounded = is(LedgerStatus::ActionsBounded);
            record.counters.unprojected += is(LedgerStatus::NotProjected) + bounded;
            record.counters.bounded_actions += bounded;
        }
        record.counters.mode_ticks[record.mode.code() as usize] += 1;
        self.note_resume();
    }

    /// Goes on after the tick of `record`, which said so in [`Record::resume`].
    pub fn resume(&mut self, record: &Record) {
        let Record { resume, .. } = record;
        self.record = *record;
        self.estimate = record.state;
        self.modes.resume(record.mode, record.reason, resume.modes);
        self.grid.resume(resume.grid);
        self.held = Some(0);
        (self.braked, self.ramped) = (resume.braked, resume.ramped);
        (self.overran, self.brake_broken) = (resume.overran, resume.brake_broken);
        self.pace = Pace::default();
        self.way = resume.way;
        self.since = record.state.header.stamp;
        self.clock = (record.state.time, record.state.header.seq);
        self.memory.clear();
        self.memory.extend_from_slice(resume.memory());
        self.is_lost = false;
        self.controller.controller.reset();
        self.controller.controller.load_memory(&self.memory);
    }

    /// Notes what a replay can go on from.
    fn note_resume(&mut self) {
        let resume = &mut self.record.resume;
        let is_plain =
            self.record.sensed == Sensed::Measured && self.held == Some(0) && !self.memory.is_empty();
        resume.is_set = is_plain
            && self.pace == Pace::default()
            && self.since == self.record.state.header.stamp
            && self.settings.proposer.is_none()
            && self.record.output.nu > 0
            && self.controller.controller.is_memory_whole()
            && resume.set_memory(&self.memory);
        if resume.is_set {
            (resume.modes, resume.grid) = (self.modes.counts(), self.grid.place());
            (resume.braked, resume.ramped) = (self.braked, self.ramped);
            (resume.overran, resume.brake_broken) = (self.overran, self.brake_broken);
            resume.way = self.way;
        }
    }

    /// What a tick is worth whose state was worth `event`, with the proposal it has to act on.
    fn listen(&mut self, event: Event, inputs: &Inputs<'_>) -> Event {
        let Some(settings) = self.settings.proposer else { return event };
        self.record.heard = inputs.proposal.is_some();
        if let Some(proposal) = inputs.proposal {
            self.record.proposal = *proposal;
            self.heard.take(proposal, &mut self.record, &mut self.controller.controller);
        }
        let age = self.heard.age(self.record.begin);
        self.record.proposal_age = age.unwrap_or(u64::MAX);
        let is_held = age.is_some_and(|age| age > settings.age_limit);
        let is_silent = age.is_none_or(|age| age > settings.age_limit.saturating_add(settings.hold));
        self.record.counters.silent_proposer += u64::from(is_silent);
        self.record.counters.held_proposals += u64::from(is_held && !is_silent);
        match event {
            Event::Good | Event::Held(_) if is_silent => Event::Refused(Reason::SilentProposer),
            Event::Good if is_held => Event::Held(Reason::SilentProposer),
            event => event,
        }
    }

    fn count(&mut self, event: Event) {
        let (counters, mode) = (&mut self.record.counters, self.record.mode);
        counters.held += u64::from(self.record.sensed == Sensed::Predicted);
        let is_stale = matches!(event, Event::Lost(Reason::StaleState | Reason::FrozenState));
        counters.stale += u64::from(is_stale && mode != Mode::Hold);
    }

    /// Lets the controller act or brake; without an answer `nu` is 0 and the plant brakes by itself.
    fn act(&mut self) {
        self.record.output.nu = 0;
        self.record.ramp = 1.0;
        self.record.noise = self.faults.noise(self.record.tick);
        let stop = self.record.stop;
        if self.record.mode.acts() {
            let event = self.tick();
            if event != Event::Good {
                self.record.mode = self.modes.escalate(event, stop);
            }
        } else {
            (self.ramped, self.braked) = (0, 0);
        }
        let is_usable = self.record.sensed != Sensed::Missing;
        let brakes = matches!(self.record.mode, Mode::Braking | Mode::Fault) && is_usable;
        if brakes && !self.brake_broken && self.call(T::brake).is_none() {
            self.brake_broken = true;
            self.record.mode = self.modes.escalate(Event::Panicked, stop);
        }
        self.record.reason = self.modes.reason();
        if self.record.output.nu > 0 {
            self.controller.controller.save_memory(&mut self.memory);
            self.is_lost = false;
        } else if self.record.fresh || self.settings.sync == Sync::Clock {
            self.controller.controller.lose();
            self.is_lost = true;
        } // else nothing was asked for, and the next state says whether something else held the robot
    }

    /// The controller's tick, softened while the first motion is let in.
    fn tick(&mut self) -> Event {
        self.controller.controller.set_noise(self.record.noise);
        // A rehearsed fault takes the place of exploration.
        if let (Some(seed), true) = (self.settings.explore, self.record.noise == 0.0) {
            self.controller.controller.explore(seed, self.record.tick);
        }
        let outcome = match self.faults.panics(self.record.tick) {
            true => self.call(|_, _, _| panic!("rehearsed panic of the controller")),
            false => self.call(T::tick),
        };
        self.braked = if outcome == Some(Outcome::Braked) { self.braked + 1 } else { 0 };
        match outcome {
            None => return Event::Panicked,
            Some(Outcome::Refused) => {
                self.record.counters.refused += 1;
                return Event::Refused(Reason::Controller);
            }
            Some(Outcome::Braked) => {
                self.record.counters.braked += 1;
                if self.braked >= self.settings.modes.braked_ticks {
                    return Event::Refused(braked_reason(self.record.output.ledger.status));
                }
            }
            Some(Outcome::Acted) => self.soften(),
        }
        Event::Good
    }

    fn soften(&mut self) {
        if self.ramped >= self.settings.ramp {
            return;
        }
        self.ramped += 1;
        self.record.ramp = f64::from(self.ramped) / f64::from(self.settings.ramp + 1);
        let (share, output) = (self.record.ramp, &mut self.record.output);
        self.controller.controller.soften(&self.estimate, share, output);
    }

    /// Calls a verb of the controller; `None` if it panicked.
    fn call(&mut self, verb: fn(&mut T, &StateMessage, &mut TickOutput) -> Outcome) -> Option<Outcome> {
        let (controller, output) = (&mut self.controller.controller, &mut self.record.output);
        let outcome = catch_unwind(AssertUnwindSafe(|| verb(controller, &self.estimate, output))).ok();
        if !matches!(outcome, Some(Outcome::Acted | Outcome::Braked)) {
            self.record.output.nu = 0;
        }
        outcome
    }

    /// Takes the newest state and says what it is worth.
    fn sense(&mut self, fresh: Option<&StateMessage>) -> Event {
        let known = self.record.state.header;
        let is_old = |s: &StateMessage| s.header.epoch == known.epoch && s.header.seq <= known.seq;
        self.record.ignored = fresh.is_some_and(is_old);
        self.record.counters.out_of_order += u64::from(self.record.ignored);
        let Some(state) = fresh.filter(|s| !is_old(s)) else {
            self.record.fresh = false;
            return self.without_state();
        };
        self.record.fresh = true;
        if self.settings.sync == Sync::Plant {
            self.record.due = state.header.stamp;
        }
        let is_next = state.header.epoch == known.epoch;
        let lost = if is_next { state.header.seq - known.seq - 1 } else { 0 };
        let counted = &mut self.record.counters.lost_states;
        *counted = counted.saturating_add(lost);
        let is_doubled = is_next && self.is_doubled(state);
        self.record.counters.out_of_order += u64::from(is_doubled);
        let mut left_out = 0;
        // By its number: the state that began the episode may be among the lost ones.
        if !is_next || state.episode != self.record.state.episode {
            self.controller.controller.reset();
            self.memory.clear();
            self.heard.begin(state.header.seq);
            self.held = None;
            self.pace = Pace::default();
            self.way.clear();
            self.record.apart = None;
            self.clock = (state.time, state.header.seq);
        } else if is_doubled {
            self.controller.controller.recall();
        } else {
            left_out = self.go_on(state, lost);
        }
        let is_frozen = is_next && !is_doubled && self.is_frozen(state);
        let passed = if is_next { self.passed(state) } else { (0.0, 0) };
        if is_doubled {
            self.clock.1 = state.header.seq;
        } else if !is_frozen && state.time.is_finite() {
            self.clock = (state.time, state.header.seq);
        }
        if !is_doubled && !is_frozen {
            self.since = state.header.stamp;
        }
        if self.held.is_some() && !is_doubled {
            self.follow(state, lost, is_frozen);
        }
        let missed = state.tick.saturating_sub(self.record.state.tick + 1);
        let gap = if is_next && self.settings.real_time { missed.min(lost) } else { 0 };
        self.record.state = *state;
        if left_out > 0 {
            self.record.state.bits |= STATE_BRAKED; // nobody knows what held it
            let counted = &mut self.record.counters.lost_states;
            *counted = counted.saturating_add(left_out);
        }
        self.event_of_state(is_frozen, gap.max(left_out), passed)
    }

    /// What has passed by the plant's clock up to `state` \[s\] since the last state by which it went on, and how many were between.
    fn passed(&self, state: &StateMessage) -> (f64, u64) {
        let (time, seq) = self.clock;
        (state.time - time, state.header.seq.saturating_sub(seq + 1))
    }

    /// Tells the controller what the plant has done by itself up to `state`, before which `lost` states were: it says how often it had no answer in
    /// time, that to the last state it was given included. Gives the periods that its clock has passed over without a state, where they are more
    /// than may be bridged: the controller then goes on from where the robot is.
    fn go_on(&mut self, state: &StateMessage, lost: u64) -> u64 {
        let (passed, between) = self.passed(state);
        let (known, controller) = (&self.record.state, &mut self.controller.controller);
        if state.bits & STATE_BRAKED != 0 {
            controller.lose();
        }
        if self.settings.sync == Sync::Clock {
            return 0; // it has answered in every slot, at its own pace
        }
        let left_out = left_out(passed, between, &self.settings);
        if left_out > 0 {
            controller.lose();
        }
        let alone = state.late.saturating_sub(known.late);
        if alone > lost {
            controller.recall();
        }
        if alone.max(lost) > 0 {
            controller.miss(alone.max(lost));
        }
        self.pace.take(passed, between + 1, self.settings.period);
        left_out
    }

    /// Compares where the joints went with their velocities. Once a driver is found to tell others, nothing can be reckoned with them any more.
    fn follow(&mut self, state: &StateMessage, lost: u64, is_frozen: bool) {
        let (known, settings) = (&self.record.state, &self.settings);
        let is_again = state.tick == known.tick; // because no answer came
        if settings.jump <= 0.0 || self.record.apart.is_some() || is_again {
            return;
        }
        let is_usable =
            known.is_finite() && state.is_finite() && lost <= u64::from(settings.modes.hold_states);
        if !is_usable || is_frozen || self.pace.is_wrong() {
            self.way.clear();
            return;
        }
        let nominal = (lost + 1) as f64 * settings.period as f64 * 1e-9;
        self.record.apart = self.way.take(known, state, nominal, self.controller.controller.speeds());
    }

    /// What the state just taken is worth, `passed` [s] of the plant's clock after the last by which it went on, with so many between.
    fn event_of_state(&mut self, is_frozen: bool, gap: u64, (passed, between): (f64, u64)) -> Event {
        let (state, counters) = (&self.record.state, &mut self.record.counters);
        if !state.is_finite() {
            counters.bad_states += 1;
            return self.hold(Reason::BadState);
        }
        if self.record.begin.saturating_sub(state.header.stamp) > self.settings.age_limit {
            return Event::Lost(Reason::StaleState);
        }
        if is_frozen {
            counters.frozen_states += 1;
            return self.hold(Reason::FrozenState);
        }
        let jump = self.settings.jump;
        if jump > 0.0 && self.held.is_none() && self.controller.controller.elsewhere(state).is_some() {
            counters.implausible_states += 1;
            return Event::Lost(Reason::ImplausibleState);
        }
        if jump > 0.0 && self.held.is_some() {
            let ticks = state.tick.saturating_sub(self.estimate.tick).max(1);
            let period = self.settings.period as f64 * 1e-9;
            let age = (ticks as f64 * period).max(passed - between as f64 * period);
            if self.controller.controller.implausible(&self.estimate, state, age, jump).is_some() {
                counters.implausible_states += 1;
                return self.hold(Reason::ImplausibleState);
            }
        }
        if self.record.apart.is_some() {
            return Event::Lost(Reason::WrongVelocity);
        }
        self.estimate = *state;
        self.held = Some(0);
        match gap <= u64::from(self.settings.modes.hold_states) {
            false => Event::Lost(Reason::LostStates),
            true if self.pace.is_wrong() => Event::Lost(Reason::WrongPeriod),
            true => Event::Good,
        }
    }

    /// No state came: with the loop's own clock a few are bridged, with the plant's the wait was over the age limit.
    fn without_state(&mut self) -> Event {
        if self.settings.sync == Sync::Plant || self.held.is_none() {
            return Event::Lost(Reason::StaleState);
        }
        self.record.counters.repeated += 1;
        let is_first = self.held == Some(0);
        match self.hold(Reason::LostStates) {
            // Two clocks of the same rate meet a slot without a state now and then.
            Event::Held(_) if is_first => Event::Good,
            event => event,
        }
    }

    /// Puts a predicted state in place of the one that is missing, if that may be done once more.
    fn hold(&mut self, reason: Reason) -> Event {
        let has_acted = self.record.output.nu > 0 && self.modes.mode().acts();
        match self.held {
            Some(held) if held < self.settings.modes.hold_states && has_acted => {
                self.held = Some(held + 1);
                self.controller.controller.predict(&mut self.estimate, &self.record.output);
                self.estimate.tick += 1;
                Event::Held(reason)
            }
            _ => Event::Lost(reason),
        }
    }

    /// The driver has asked twice in a period: the same numbers, the clock of the robot stands, and hardly any time has passed, nor has since
    /// they came first: what stands for longer than a period and a half is frozen. The first answer is not the one that is applied.
    fn is_doubled(&self, new: &StateMessage) -> bool {
        let (old, settings) = (&self.record.state, &self.settings);
        let after = |stamp: u64| new.header.stamp.saturating_sub(stamp);
        let is_soon =
            2 * after(old.header.stamp) < settings.period && 2 * after(self.since) < 3 * settings.period;
        let is_same = new.q() == old.q() && new.v() == old.v() && new.episode == old.episode;
        let is_asked = new.bits & STATE_BRAKED == 0 && new.late == old.late && new.tick != old.tick;
        settings.real_time
            && settings.sync == Sync::Plant
            && new.time > 0.0
            && new.time == old.time
            && is_soon
            && is_same
            && is_asked
    }

    /// The plant's clock stands still or runs backwards within an episode, or no joint has moved although the state says that one moves.
    fn is_frozen(&self, new: &StateMessage) -> bool {
        let old = &self.record.state;
        if new.tick == old.tick {
            return false; // sent again because no answer came
        }
        let moves = new.v().iter().any(|v| v.abs() > self.settings.stop_speed);
        let goes_back = new.time < old.time && new.episode == old.episode;
        goes_back
            || (new.time > 0.0 && new.time == old.time)
            || (moves && new.q() == old.q() && new.v() == old.v())
    }
}

/// Periods that a clock can have passed over at once; it may say anything.
const MOST_LEFT_OUT: f64 = 1e9;

/// Periods in `passed` \[s\] of the plant's clock of which no state tells, beside the `lost` ones; 0 where they may be bridged, and of a time that is
/// none.
fn left_out(passed: f64, lost: u64, settings: &CoreSettings) -> u64 {
    let periods = passed / (settings.period as f64 * 1e-9);
    let most = (lost + 1 + u64::from(settings.modes.hold_states)) as f64 + 0.5;
    if !periods.is_finite() || periods <= most {
        return 0;
    }
    (periods.min(MOST_LEFT_OUT).round() as u64).saturating_sub(lost + 1)
}

fn braked_reason(status: u32) -> Reason {
    if status == LedgerStatus::BrakedNonFiniteProposal.number() {
        Reason::NonFiniteProposal
    } else if status == LedgerStatus::BrakedNonFiniteDynamics.number() {
        Reason::NonFiniteDynamics
    } else if status == LedgerStatus::BrakedNoVerifiedBrake.number() {
        Reason::NoVerifiedBrake
    } else {
        Reason::NoCertifiedAnswer
    }
}
