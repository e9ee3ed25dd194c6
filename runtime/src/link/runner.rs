//! The plant's side of a tick, for simulators and drivers alike.
//!
//! Real time: at each slot of its own absolute grid the plant publishes its state, waits for the action computed from
//! exactly that state until the deadline (a fraction of the period), applies it and advances one period. If the
//! action is late, the last one is held and counted; after the watchdog's time without a fresh action the plant brakes
//! by itself, whatever the runtime does.
//!
//! Lockstep: no grid; the plant waits for the action of every state. Time stands still meanwhile, so there is nothing
//! to brake. For tests and for running faster than real time.

use serde::Serialize;

use super::{ActionMessage, LinkError, Message, PlantLink, RobotName, StateMessage, TallyMessage, torn};
use crate::clock;
use crate::grid::Grid;
use crate::percentiles::{Percentiles, percentiles};
use crate::stop::Stop;

/// A robot or its simulator.
pub trait Plant {
    /// Writes the measured state; numbers of the link (header, tick, due, late, watchdog) are filled by the runner.
    fn observe(&mut self, state: &mut StateMessage);
    /// Applies `action` for one control period.
    fn apply(&mut self, action: &ActionMessage);
    /// No action came in time for this control period, and `action` is the one applied last. Where joints are sent positions it would stop them within
    /// a period: a plant of those goes on from its last two, slower (`docs/CONNECT.md`).
    fn hold(&mut self, action: &ActionMessage) {
        self.apply(action);
    }
    /// Advances one control period while bringing the velocity to zero, or keeping it there.
    fn brake(&mut self);
    /// Writes what was counted since the start; a plant that measures no limit and has no episodes leaves it as it is.
    fn tally(&self, _tally: &mut TallyMessage) {}
}

/// Who waits for whom.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Pace {
    /// The plant keeps its own time grid.
    RealTime,
    /// The plant waits for every action.
    Lockstep,
}

/// Settings of a plant process.
#[derive(Clone, Copy, Debug)]
pub struct PlantSettings {
    /// Control period \[s\].
    pub dt: f64,
    /// Who waits for whom.
    pub pace: Pace,
    /// The action must come within this fraction of the period; above 1 the plant's time may stretch.
    pub deadline: f64,
    /// Time without a fresh action after which the plant brakes \[s\].
    pub watchdog: f64,
    /// Ticks until the plant stops by itself.
    pub ticks: Option<u64>,
    /// Time without an action, from the start or the last one, after which the runtime counts as gone and the plant ends \[s\]; without it the
    /// plant brakes and waits for the next runtime.
    pub loop_patience: Option<f64>,
    /// SCHED_FIFO priority, if the system allows it; it polls without a pause in lockstep, which needs none.
    pub priority: Option<i32>,
}

impl PlantSettings {
    /// Real time with a deadline of 0.6 periods and a watchdog of 5 periods, but at least 20 ms.
    pub fn real_time(dt: f64) -> PlantSettings {
        let watchdog = (5.0 * dt).max(0.02);
        let (ticks, loop_patience, priority) = (None, None, None);
        PlantSettings { dt, pace: Pace::RealTime, deadline: 0.6, watchdog, ticks, loop_patience, priority }
    }

    /// Real time for a simulator, whose time may stretch: rather than holding an old action it waits up to 15 ms (at
    /// least 0.6 periods) for the right one and falls behind its grid, which is counted as an overrun.
    pub fn simulator(dt: f64) -> PlantSettings {
        let wait = (0.6 * dt).max(0.015);
        PlantSettings { deadline: wait / dt, watchdog: (5.0 * dt).max(0.05), ..PlantSettings::real_time(dt) }
    }

    /// Lockstep.
    pub fn lockstep(dt: f64) -> PlantSettings {
        PlantSettings { pace: Pace::Lockstep, ..PlantSettings::real_time(dt) }
    }
}

/// What the plant counted.
#[derive(Clone, Debug, Default, Serialize)]
pub struct PlantReport {
    /// Ticks.
    pub ticks: u64,
    /// Ticks that applied a fresh action.
    pub fresh: u64,
    /// Ticks that held the last action.
    pub late: u64,
    /// Ticks braked: no runtime, the watchdog, or because the runtime asked for it.
    pub braked: u64,
    /// Times the watchdog took over.
    pub watchdog: u64,
    /// Ticks that ended after the next slot was due.
    pub overruns: u64,
    /// Slots left out.
    pub skipped: u64,
    /// Looks for a runtime while there was none.
    pub looks: u64,
    /// Shared memory was taken away under the plant: it braked to rest and ended.
    pub memory_torn: bool,
    /// The runtime was gone for longer than [`PlantSettings::loop_patience`]: the plant ended by itself.
    pub loop_gone: bool,
    /// From sending the state to having its action.
    pub round_trip: Percentiles,
}

/// Polls between looks at the clock while a runtime that is not attached yet is being waited for [ns].
const SLOW_POLL: u64 = 30_000;
/// The same in lockstep while nobody answers: time stands still, and nothing comes too late [ns].
pub(super) const STANDSTILL_POLL: u64 = 1_000_000;
/// Longest braking of a plant that ends by itself [s], and the speed that counts as rest [rad/s or m/s].
const LAST_BRAKE: f64 = 2.0;
const STILL: f64 = 1e-2;
/// Looks for a runtime in a tick while there is none.
const LOOKS: u64 = 3;
/// Share of the period over which they are spread.
const ALONE: f64 = 0.6;
/// The plant announces itself this often [ns].
const ANNOUNCE: u64 = 100_000_000;
/// In lockstep, a state without an answer is sent again after this time [ns]: a runtime may have come late.
const RESEND: u64 = 250_000_000;

/// Drives a [`Plant`] over a [`PlantLink`].
pub struct PlantRunner {
    link: PlantLink,
    settings: PlantSettings,
    state: StateMessage,
    last: ActionMessage,
    last_fresh: u64,
    is_attached: bool,
    /// The plant braked by itself last.
    brakes: bool,
    /// A runtime sends actions, though not yet in time for the state they are for.
    is_near: bool,
    /// When an action came last, whatever state it was for, and when the first could have.
    last_heard: u64,
    next_announce: u64,
    report: PlantReport,
    round_trip: hdrhistogram::Histogram<u64>,
}

impl PlantRunner {
    /// Takes over an open link.
    pub fn new(link: PlantLink, settings: PlantSettings) -> Result<PlantRunner, LinkError> {
        let round_trip = hdrhistogram::Histogram::new_with_bounds(1, 100_000_000_000, 3)
            .map_err(|e| link.name().transport("measure", e.to_string()))?;
        Ok(PlantRunner {
            link,
            settings,
            state: StateMessage::zeroed(),
            last: ActionMessage::zeroed(),
            last_fresh: 0,
            is_attached: false,
            brakes: true,
            is_near: false,
            last_heard: clock::now(),
            next_announce: 0,
            report: PlantReport::default(),
            round_trip,
        })
    }

    /// The robot's name.
    pub fn name(&self) -> &RobotName {
        self.link.name()
    }

    /// Runs until `stop`, or for the number of ticks of the settings.
    pub fn run(mut self, plant: &mut impl Plant, stop: &Stop) -> PlantReport {
        crate::thread::be_prompt(self.settings.priority);
        let period = clock::nanoseconds(self.settings.dt);
        let mut grid = Grid::new(clock::now() + period, period);
        self.last_heard = clock::now();
        while !stop.is_requested() && self.settings.ticks.is_none_or(|n| self.report.ticks < n) {
            self.report.loop_gone = self.is_deserted();
            self.report.memory_torn = torn::is_torn();
            if self.report.loop_gone || self.report.memory_torn {
                self.brake_alone(plant);
                break;
            }
            let due = match self.settings.pace {
                Pace::RealTime => grid.due(),
                Pace::Lockstep => clock::now(),
            };
            if self.settings.pace == Pace::RealTime {
                clock::sleep_until(due);
            }
            self.tick(plant, due, stop);
            if self.settings.pace == Pace::RealTime {
                grid.finish(clock::now());
            }
        }
        self.send_tally(plant);
        (self.report.overruns, self.report.skipped) = (grid.overruns(), grid.skipped());
        self.report.round_trip = percentiles(&self.round_trip);
        self.report
    }

    fn tick(&mut self, plant: &mut impl Plant, due: u64, stop: &Stop) {
        plant.observe(&mut self.state);
        self.state.tick = self.report.ticks;
        self.state.due = due;
        self.state.set_braked(self.brakes);
        (self.state.late, self.state.watchdog) = (self.report.late, self.report.watchdog);
        self.link.send_state(&mut self.state);
        let sent = self.state.header.stamp;
        match self.wait(plant, due, stop) {
            Some(action) => {
                if self.is_attached {
                    self.round_trip.saturating_record(clock::now() - sent);
                }
                self.last_fresh = clock::now();
                self.last_heard = self.last_fresh;
                self.is_attached = true;
                self.last = action;
                self.report.fresh += 1;
                match self.last.nu {
                    0 => self.brake(plant),
                    _ => {
                        self.brakes = false;
                        plant.apply(&self.last);
                    }
                }
            }
            // Stopped while time stood still: the state stays as it is.
            None if self.settings.pace == Pace::Lockstep => return,
            None => self.miss(plant),
        }
        self.report.ticks += 1;
        if due >= self.next_announce {
            self.link.announce();
            self.send_tally(plant);
            self.next_announce = due + ANNOUNCE;
        }
    }

    fn send_tally(&mut self, plant: &impl Plant) {
        let mut tally = TallyMessage::zeroed();
        tally.tick = self.report.ticks;
        plant.tally(&mut tally);
        self.link.send_tally(&mut tally);
    }

    /// To rest, by the plant's own means and without the link: after this nobody drives it.
    fn brake_alone(&mut self, plant: &mut impl Plant) {
        let period = clock::nanoseconds(self.settings.dt);
        let mut grid = Grid::new(clock::now() + period, period);
        for _ in 0..(LAST_BRAKE / self.settings.dt).ceil() as u64 {
            plant.observe(&mut self.state);
            if self.state.v().iter().all(|v| v.abs() < STILL) {
                return;
            }
            self.report.ticks += 1;
            self.report.braked += 1;
            plant.brake();
            if self.settings.pace == Pace::RealTime {
                clock::sleep_until(grid.due());
                grid.finish(clock::now());
            }
        }
    }

    fn is_deserted(&self) -> bool {
        let patience = self.settings.loop_patience.map(clock::nanoseconds);
        patience.is_some_and(|patience| clock::now() > self.last_heard + patience)
    }

    fn brake(&mut self, plant: &mut impl Plant) {
        self.brakes = true;
        self.report.braked += 1;
        plant.brake();
    }

    /// No action came in time: hold the last one, or brake once the watchdog's time is over.
    fn miss(&mut self, plant: &mut impl Plant) {
        let is_alive = clock::now() < self.last_fresh + clock::nanoseconds(self.settings.watchdog);
        if self.is_attached && is_alive {
            self.report.late += 1;
            return match self.brakes {
                true => self.brake(plant),
                false => plant.hold(&self.last),
            };
        }
        if self.is_attached {
            self.is_attached = false;
            self.report.watchdog += 1;
        }
        self.brake(plant);
    }

    /// The action for the state just sent, if it comes in time.
    fn wait(&mut self, plant: &impl Plant, due: u64, stop: &Stop) -> Option<ActionMessage> {
        let period = clock::nanoseconds(self.settings.dt);
        let watchdog = clock::nanoseconds(self.settings.watchdog);
        let mut resend = clock::now() + RESEND;
        // In lockstep a runtime that was killed takes no leave.
        let mut is_silent = false;
        loop {
            let header = self.state.header;
            match self.link.newest_action() {
                Some(action) if (action.state_epoch, action.state_seq) == (header.epoch, header.seq) => {
                    return Some(*action);
                }
                // The runtime ended in order: the plant is on its own at once, without the watchdog.
                Some(action) if action.is_farewell() => {
                    (self.is_attached, self.is_near) = (false, false);
                    self.send_tally(plant);
                }
                Some(_) => (self.is_near, self.last_heard) = (true, clock::now()),
                None => {}
            }
            let now = clock::now();
            // Without a runtime there is nothing to wait for: the plant keeps its own time, and only looks whether one comes.
            self.is_near &= now < self.last_heard + watchdog;
            let is_waiting = self.is_attached || self.is_near;
            let share = if is_waiting { self.settings.deadline } else { self.settings.deadline.min(ALONE) };
            let until = due + (share * period as f64) as u64;
            match self.settings.pace {
                Pace::RealTime if now >= until => return None,
                Pace::Lockstep if stop.is_requested() || self.is_deserted() => return None,
                Pace::Lockstep if now >= resend => {
                    self.link.announce();
                    self.link.send_state(&mut self.state);
                    resend = now + RESEND;
                    is_silent = true;
                }
                _ => {}
            }
            if self.is_attached && !is_silent {
                std::thread::yield_now();
                continue;
            }
            self.link.attend();
            self.report.looks += u64::from(!is_waiting);
            let pause = match (is_waiting && !is_silent, self.settings.pace) {
                (true, _) => SLOW_POLL,
                (false, Pace::Lockstep) => STANDSTILL_POLL,
                (false, Pace::RealTime) => (until.saturating_sub(due) / LOOKS).max(SLOW_POLL),
            };
            let latest =
                if self.settings.pace == Pace::RealTime { until.max(now + SLOW_POLL) } else { u64::MAX };
            clock::sleep_until((now + pause).min(latest));
        }
    }
}
