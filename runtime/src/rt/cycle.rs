//! The real-time thread. It waits, computes, and moves plain numbers through rings; it neither allocates, locks, logs
//! nor calls iceoryx2, and it drops no controller.
//!
//! Two ways to keep time:
//! - [`Sync::Plant`] (default): a tick begins when a state arrives. The plant owns the time grid; the action is
//!   computed for the state of the same tick, so analytic inverse dynamics meets the state it was solved for.
//! - [`Sync::Clock`]: a tick begins on this thread's own absolute grid, with the newest state. For plants that
//!   stream states at another rate; the action then meets a state up to one period older.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use hdrhistogram::Histogram;
use rtrb::{Consumer, Producer};

use crate::clock::{self, Bell};
use crate::link::{ActionMessage, Message, ProposalMessage, StateMessage};
use crate::rt::core::{Core, CoreSettings, Inputs, Loaded};
use crate::rt::faults::FaultPlan;
use crate::rt::mode::Mode;
use crate::rt::swap::Slot;
use crate::rt::tick::{LoopController, Record, Sensed};
use crate::stop::Stop;
use crate::thread::{CountAllocations, Usage};

/// Ticks after which page faults and context switches of the thread are counted.
const WARM: u64 = 300;

/// Who keeps time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sync {
    /// The arrival of a state begins a tick.
    Plant,
    /// The loop's own grid begins a tick.
    Clock,
}

/// Settings of the loop beside those of its ticks; times in [ns].
#[derive(Clone, Copy, Debug)]
pub(crate) struct CycleSettings {
    pub(crate) core: CoreSettings,
    /// So long before a state is due, the thread wakes up to poll for it; 0 sleeps until it comes.
    pub(crate) spin: u64,
    /// Ticks until the loop stops by itself.
    pub(crate) ticks: Option<u64>,
    /// Time after which the loop stops, however many ticks it has made.
    pub(crate) longest: Option<u64>,
    /// Ticks of braking after which the loop ends anyway.
    pub(crate) stop_ticks: u64,
    pub(crate) allocations: Option<CountAllocations>,
}

/// The ends of the rings that belong to this thread.
pub(crate) struct Ends<T: LoopController> {
    pub(crate) states: Consumer<StateMessage>,
    pub(crate) proposals: Consumer<ProposalMessage>,
    pub(crate) actions: Producer<ActionMessage>,
    pub(crate) records: Producer<Record>,
    pub(crate) slot: Slot<Loaded<T>>,
    pub(crate) bell: Arc<Bell>,
    /// The plant counts as gone.
    pub(crate) gone: Arc<AtomicBool>,
}

/// The loop with everything it ever needs.
pub(crate) struct Cycle<T: LoopController> {
    settings: CycleSettings,
    ends: Ends<T>,
    stop: Stop,
    core: Core<T>,
    fresh: Option<StateMessage>,
    proposal: Option<ProposalMessage>,
    action: ActionMessage,
    stopping: u64,
    /// When the loop stops, however many ticks it has made.
    deadline: u64,
    /// Sleeps for a state that was late.
    late_waits: u64,
    dropped: (u64, u64),
    pub(crate) wake: Histogram<u64>,
    pub(crate) compute: Histogram<u64>,
    answers: Answers,
}

/// How quickly another process answers.
pub(crate) struct Answers {
    /// From the state to the tick that first acts on the proposal [ns].
    pub(crate) answer: Histogram<u64>,
    /// From the sending of a proposal to that tick [ns].
    pub(crate) link: Histogram<u64>,
}

impl Answers {
    fn new() -> Answers {
        Answers { answer: histogram(), link: histogram() }
    }

    fn take(&mut self, record: &Record) {
        let proposal = &record.proposal;
        self.answer.saturating_record(record.begin.saturating_sub(proposal.state_stamp));
        self.link.saturating_record(record.begin.saturating_sub(proposal.header.stamp));
    }
}

/// What is left when the loop has ended; dropped by another thread.
pub(crate) struct CycleEnd<T: LoopController> {
    pub(crate) last: Record,
    pub(crate) wake: Histogram<u64>,
    pub(crate) compute: Histogram<u64>,
    pub(crate) answers: Answers,
    pub(crate) usage: Usage,
    /// Only carried, so that another thread drops it.
    _rest: (Core<T>, Ends<T>),
}

impl<T: LoopController> Cycle<T> {
    pub(crate) fn new(
        settings: CycleSettings,
        first: Box<Loaded<T>>,
        faults: FaultPlan,
        ends: Ends<T>,
        stop: Stop,
    ) -> Cycle<T> {
        Cycle {
            core: Core::new(settings.core, first, 0, faults),
            fresh: None,
            proposal: None,
            action: ActionMessage::zeroed(),
            stopping: 0,
            deadline: u64::MAX,
            late_waits: 0,
            dropped: (0, 0),
            wake: histogram(),
            compute: histogram(),
            answers: Answers::new(),
            settings,
            ends,
            stop,
        }
    }

    /// Runs until a stop was asked for and the plant stands still.
    pub(crate) fn run(mut self) -> CycleEnd<T> {
        self.core.start(clock::now());
        self.deadline = self.settings.longest.map_or(u64::MAX, |longest| clock::now() + longest);
        let count = self.settings.allocations;
        let (mut usage, mut late_waits) = (Usage::of_this_thread(count), 0);
        while !self.is_over() {
            self.wait();
            self.swap();
            self.update();
            self.send();
            self.account();
            if self.core.record.tick == WARM {
                (usage, late_waits) = (Usage::of_this_thread(count), self.late_waits);
            }
        }
        let mut usage = Usage::of_this_thread(count).since(usage);
        usage.late_waits = self.late_waits - late_waits;
        let Cycle { wake, compute, answers, core, ends, .. } = self;
        CycleEnd { last: core.record, wake, compute, answers, usage, _rest: (core, ends) }
    }

    fn is_stopping(&self) -> bool {
        self.is_told_to_stop() || self.settings.ticks.is_some_and(|n| self.core.record.tick >= n)
    }

    /// By whatever does not count ticks.
    fn is_told_to_stop(&self) -> bool {
        self.stop.is_requested() || self.ends.gone.load(Ordering::Acquire) || clock::now() >= self.deadline
    }

    fn is_over(&self) -> bool {
        let (record, state) = (&self.core.record, self.core.estimate());
        let still = state.v().iter().all(|v| v.abs() <= self.settings.core.stop_speed);
        let blind = record.mode == Mode::Hold || record.sensed == Sensed::Missing;
        // At least one braking action must have gone out, whatever the speed.
        self.is_stopping()
            && self.stopping > 0
            && (still || blind || self.stopping >= self.settings.stop_ticks)
    }

    /// Waits for the next state or the next slot, by [`Sync`].
    fn wait(&mut self) {
        match self.settings.core.sync {
            Sync::Clock => clock::sleep_until(self.core.due()),
            Sync::Plant => self.wait_for_state(),
        }
    }

    /// Sleeps once, on the bell, and is awake when the state is due: waking an idle core costs more than the whole exchange. Only
    /// when the state is late by more than a quarter of a period does it sleep again.
    fn wait_for_state(&mut self) {
        let (core, spin) = (&self.settings.core, self.settings.spin);
        let last = (clock::now() + core.age_limit).min(self.deadline);
        let expected = self.core.record.state.header.stamp + core.period;
        let awake = match spin {
            0 => 0..0,
            _ => expected.saturating_sub(spin)..expected + spin.max(core.period / 4),
        };
        loop {
            let seen = self.ends.bell.seen();
            let now = clock::now();
            if !self.ends.states.is_empty() || now >= last || self.ends.gone.load(Ordering::Acquire) {
                return;
            }
            if awake.contains(&now) {
                std::thread::yield_now();
            } else if now < awake.start {
                self.ends.bell.wait(seen, awake.start.min(last));
            } else {
                self.late_waits += u64::from(spin > 0);
                self.ends.bell.wait(seen, last);
            }
        }
    }

    /// Takes a new controller if one waits: always between two ticks.
    fn swap(&mut self) {
        let swapped = self.ends.slot.swap(&mut self.core.controller);
        self.core.swap(swapped);
    }

    /// Takes the newest state and lets the controller act or brake.
    fn update(&mut self) {
        let begin = clock::now();
        // The tick that is beginning is counted already; a stop by their number comes after the last of them.
        let stop = self.is_told_to_stop() || self.settings.ticks.is_some_and(|n| self.core.record.tick > n);
        self.fresh = None;
        while let Ok(state) = self.ends.states.pop() {
            self.fresh = Some(state);
        }
        self.proposal = None;
        while let Ok(proposal) = self.ends.proposals.pop() {
            self.proposal = Some(proposal);
        }
        let (fresh, proposal) = (self.fresh.as_ref(), self.proposal.as_ref());
        let inputs = Inputs { due: self.core.due(), begin, stop, fresh, proposal };
        self.core.update(&inputs);
        let periods = self.core.rehearsed_periods();
        if periods > 0.0 {
            while clock::now() < begin + (periods * self.settings.core.period as f64) as u64 {}
        }
    }

    fn send(&mut self) {
        let record = &self.core.record;
        let header = record.state.header;
        self.action.tick = record.tick;
        (self.action.state_seq, self.action.state_epoch) = (header.seq, header.epoch);
        self.action.mode = record.mode.code();
        self.action.policy_version = record.policy_version;
        self.action.nu = record.output.nu;
        self.action.action = record.output.action;
        self.dropped.0 += u64::from(self.ends.actions.push(self.action).is_err());
    }

    fn account(&mut self) {
        self.core.close(clock::now());
        let record = &mut self.core.record;
        (record.counters.dropped_actions, record.counters.dropped_records) = self.dropped;
        if record.fresh || self.settings.core.sync == Sync::Clock {
            self.wake.saturating_record(record.begin.saturating_sub(record.due));
            self.compute.saturating_record(record.end - record.begin);
        }
        if record.heard {
            self.answers.take(record);
        }
        self.dropped.1 += u64::from(self.ends.records.push(*record).is_err());
        self.stopping += u64::from(self.core.record.stop);
    }
}

/// 1 ns to 100 s with three digits; never grows.
fn histogram() -> Histogram<u64> {
    match Histogram::new_with_bounds(1, 100_000_000_000, 3) {
        Ok(histogram) => histogram,
        Err(_) => unreachable!("the bounds are constants that hdrhistogram accepts"),
    }
}
