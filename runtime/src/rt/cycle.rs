//! The real-time thread. It waits, computes, and moves plain numbers through rings; it neither allocates, locks, logs
//! nor calls iceoryx2, and it drops no controller.
//!
//! Two ways to keep time:
//! - [`Sync::Plant`] (default): a tick begins when a state arrives. The plant owns the time grid; the action is
//!   computed for the state of the same tick, so analytic inverse dynamics meets the state it was solved for.
//! - [`Sync::Clock`]: a tick begins on this thread's own absolute grid, with the newest state. For plants that
//!   stream states at another rate; the action then meets a state up to one period older.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use hdrhistogram::Histogram;
use rtrb::{Consumer, Producer};

use crate::link::{ActionMessage, Message, StateMessage};
use crate::rt::clock::{self, Bell};
use crate::rt::mode::{Event, Mode, ModeLimits, Modes};
use crate::rt::swap::Slot;
use crate::rt::tick::{Outcome, Record, Step, Tick};
use crate::rt::{Grid, Stop};

/// Who keeps time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Sync {
    /// The arrival of a state begins a tick.
    Plant,
    /// The loop's own grid begins a tick.
    Clock,
}

/// Settings of the loop; times in [ns].
#[derive(Clone, Copy, Debug)]
pub(crate) struct CycleSettings {
    pub(crate) period: u64,
    pub(crate) sync: Sync,
    /// A state older than this is stale.
    pub(crate) age_limit: u64,
    /// So long before and after the moment a state is due, the thread polls instead of sleeping.
    pub(crate) spin: u64,
    /// The plant keeps real time: a tick longer than the period is an overrun.
    pub(crate) real_time: bool,
    /// Ticks until the loop stops by itself.
    pub(crate) ticks: Option<u64>,
    /// Largest speed entry that counts as standing still when stopping [1/s].
    pub(crate) stop_speed: f64,
    /// Ticks of braking after which the loop ends anyway.
    pub(crate) stop_ticks: u64,
    pub(crate) modes: ModeLimits,
}

/// The ends of the rings that belong to this thread.
pub(crate) struct Ends<T: Tick> {
    pub(crate) states: Consumer<StateMessage>,
    pub(crate) actions: Producer<ActionMessage>,
    pub(crate) records: Producer<Record>,
    pub(crate) slot: Slot<T>,
    pub(crate) bell: Arc<Bell>,
}

/// The loop with everything it ever needs.
pub(crate) struct Cycle<T: Tick> {
    settings: CycleSettings,
    ends: Ends<T>,
    stop: Stop,
    controller: Box<T>,
    modes: Modes,
    grid: Grid,
    record: Record,
    action: ActionMessage,
    overran: bool,
    usable: bool,
    /// `brake` panicked: it is not called again on this controller. A panic of `tick` latches Fault.
    brake_broken: bool,
    stopping: u64,
    pub(crate) wake: Histogram<u64>,
    pub(crate) compute: Histogram<u64>,
}

/// What is left when the loop has ended; dropped by another thread.
pub(crate) struct CycleEnd<T: Tick> {
    pub(crate) last: Record,
    pub(crate) wake: Histogram<u64>,
    pub(crate) compute: Histogram<u64>,
    /// Only carried, so that another thread drops it.
    _rest: (Box<T>, Ends<T>),
}

impl<T: Tick> Cycle<T> {
    pub(crate) fn new(settings: CycleSettings, controller: Box<T>, ends: Ends<T>, stop: Stop) -> Cycle<T> {
        Cycle {
            modes: Modes::new(settings.modes),
            grid: Grid::new(0, settings.period),
            record: Record::new(),
            action: ActionMessage::zeroed(),
            overran: false,
            usable: false,
            brake_broken: false,
            stopping: 0,
            wake: histogram(),
            compute: histogram(),
            settings,
            ends,
            stop,
            controller,
        }
    }

    /// Runs until a stop was asked for and the plant stands still.
    pub(crate) fn run(mut self) -> CycleEnd<T> {
        self.grid = Grid::new(clock::now(), self.settings.period);
        while !self.is_over() {
            self.wait();
            self.swap();
            let event = self.sense();
            self.decide(event);
            self.act();
            self.send();
            self.account();
        }
        let Cycle { record, wake, compute, controller, ends, .. } = self;
        CycleEnd { last: record, wake, compute, _rest: (controller, ends) }
    }

    fn is_stopping(&self) -> bool {
        self.stop.is_requested() || self.settings.ticks.is_some_and(|n| self.record.tick >= n)
    }

    fn is_over(&self) -> bool {
        let still = self.record.state.v().iter().all(|v| v.abs() <= self.settings.stop_speed);
        let blind = self.record.mode == Mode::Hold || !self.usable;
        // At least one braking action must have gone out, whatever the speed.
        self.is_stopping()
            && self.stopping > 0
            && (still || blind || self.stopping >= self.settings.stop_ticks)
    }

    /// Waits for the next state or the next slot, by [`Sync`].
    fn wait(&mut self) {
        match self.settings.sync {
            Sync::Clock => {
                clock::sleep_until(self.grid.due());
                self.record.due = self.grid.due();
            }
            Sync::Plant => self.wait_for_state(),
        }
        self.record.begin = clock::now();
    }

    /// Sleeps on the bell, but is awake around the moment the state is due: waking an idle core costs more than the
    /// whole exchange.
    fn wait_for_state(&mut self) {
        let last = clock::now() + self.settings.age_limit;
        let expected = self.record.state.header.stamp + self.settings.period;
        let awake = expected.saturating_sub(self.settings.spin)..expected + self.settings.spin;
        loop {
            let seen = self.ends.bell.seen();
            let now = clock::now();
            if !self.ends.states.is_empty() || now >= last {
                return;
            }
            if awake.contains(&now) {
                std::thread::yield_now();
            } else if now < awake.start {
                self.ends.bell.wait(seen, awake.start.min(last));
            } else {
                self.ends.bell.wait(seen, last);
            }
        }
    }

    /// Takes a new controller if one waits: always between two ticks.
    fn swap(&mut self) {
        self.record.swapped = self.ends.slot.swap(&mut self.controller);
        if self.record.swapped {
            self.controller.reset();
            self.brake_broken = false;
            self.record.counters.swaps += 1;
        }
        self.record.policy_version = self.controller.version();
    }

    /// Takes the newest state and says what it is worth.
    fn sense(&mut self) -> Event {
        let (known, episode) = (self.record.state.header, self.record.state.episode);
        self.record.fresh = false;
        while let Ok(state) = self.ends.states.pop() {
            self.record.state = state;
            self.record.fresh = true;
        }
        let state = &self.record.state;
        let is_late = self.record.begin.saturating_sub(state.header.stamp) > self.settings.age_limit;
        if self.record.fresh {
            let is_next = state.header.epoch == known.epoch && state.header.seq > known.seq;
            let lost = if is_next { state.header.seq - known.seq - 1 } else { 0 };
            self.record.counters.lost_states += lost;
            // By its number: the state that began the episode may be among the lost ones.
            if !is_next || state.episode != episode {
                self.controller.reset();
            }
            if self.settings.sync == Sync::Plant {
                self.record.due = state.header.stamp;
            }
            if !state.is_finite() {
                self.record.counters.bad_states += 1;
                return Event::Bad;
            }
        } else if self.settings.sync == Sync::Clock && !is_late && known.seq > 0 {
            self.record.counters.repeated += 1;
            return Event::Good;
        }
        if is_late || !self.record.fresh {
            return Event::Stale;
        }
        Event::Good
    }

    fn decide(&mut self, event: Event) {
        let stop = self.is_stopping();
        self.record.mode = self.modes.update(event, self.overran, stop);
        if event == Event::Stale && self.record.mode != Mode::Hold {
            self.record.counters.stale += 1;
        }
        // A state that is bad or old is not acted upon: the plant brakes by itself.
        self.usable = event == Event::Good;
    }

    /// Lets the controller act or brake; without an answer `nu` is 0 and the plant brakes by itself.
    fn act(&mut self) {
        self.record.step.nu = 0;
        if self.record.mode == Mode::Active {
            match self.call(T::tick) {
                Some(Outcome::Acted) => {}
                Some(Outcome::Refused) => {
                    self.record.counters.refused += 1;
                    self.record.mode = self.modes.update(Event::Refused, false, self.is_stopping());
                }
                None => self.record.mode = self.modes.update(Event::Panicked, false, false),
            }
        }
        let brakes = matches!(self.record.mode, Mode::Braking | Mode::Fault) && self.usable;
        if brakes && !self.brake_broken && self.call(T::brake).is_none() {
            self.brake_broken = true;
            self.record.mode = self.modes.update(Event::Panicked, false, false);
        }
        self.record.reason = self.modes.reason();
    }

    /// Calls a verb of the controller; `None` if it panicked.
    fn call(&mut self, verb: fn(&mut T, &StateMessage, &mut Step) -> Outcome) -> Option<Outcome> {
        let (controller, record) = (&mut self.controller, &mut self.record);
        let called = catch_unwind(AssertUnwindSafe(|| verb(controller, &record.state, &mut record.step)));
        let outcome = called.ok();
        if outcome != Some(Outcome::Acted) {
            self.record.step.nu = 0;
        }
        outcome
    }

    fn send(&mut self) {
        self.record.tick += 1;
        let record = &self.record;
        let header = record.state.header;
        self.action.tick = record.tick;
        (self.action.state_seq, self.action.state_epoch) = (header.seq, header.epoch);
        self.action.mode = record.mode.code();
        self.action.policy_version = record.policy_version;
        self.action.nu = record.step.nu;
        self.action.action = record.step.action;
        if self.ends.actions.push(self.action).is_err() {
            self.record.counters.dropped_actions += 1;
        }
        self.record.end = clock::now();
    }

    fn account(&mut self) {
        self.finish();
        let record = &mut self.record;
        if record.fresh || self.settings.sync == Sync::Clock {
            self.wake.saturating_record(record.begin.saturating_sub(record.due));
            self.compute.saturating_record(record.end - record.begin);
        }
        if record.mode == Mode::Active {
            record.counters.raw_violations += u64::from(record.step.ledger.raw_violations);
            record.counters.projected_violations += u64::from(record.step.ledger.projected_violations);
        }
        record.counters.mode_ticks[record.mode.code() as usize] += 1;
        if self.ends.records.push(*record).is_err() {
            record.counters.dropped_records += 1;
        }
        if self.is_stopping() {
            self.stopping += 1;
        }
    }

    /// Ends the tick on its grid.
    fn finish(&mut self) {
        let record = &mut self.record;
        if self.settings.sync == Sync::Clock {
            self.overran = self.grid.finish(record.end) > 0;
            (record.counters.overruns, record.counters.skipped) = (self.grid.overruns(), self.grid.skipped());
            return;
        }
        let late = record.end.saturating_sub(record.state.header.stamp) > self.settings.period;
        self.overran = self.settings.real_time && record.fresh && late;
        if self.overran {
            let spent = record.end - record.state.header.stamp;
            record.counters.overruns += 1;
            record.counters.skipped += (spent - 1) / self.settings.period;
        }
    }
}

/// 1 ns to 100 s with three digits; never grows.
fn histogram() -> Histogram<u64> {
    match Histogram::new_with_bounds(1, 100_000_000_000, 3) {
        Ok(histogram) => histogram,
        Err(_) => unreachable!("the bounds are constants that hdrhistogram accepts"),
    }
}
