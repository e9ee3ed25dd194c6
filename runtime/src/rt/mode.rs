//! What the loop is allowed to do: a closed set of modes and one transition function.

use serde::{Deserialize, Serialize};

use nearl_controller::codes;

codes! {
    /// Mode of the loop. Escalates at once; comes back only after good ticks in a row, and from Fault never.
    Mode, "mode" {
        Hold = "hold", "No usable state has come yet: no action is sent, the plant keeps itself still.",
            "Start the plant; if it runs, look at the reason beside it, and at the unusable states in the report.";
        Active = "active", "The controller acts.", "Nothing to do.";
        Degraded = "degraded", "The controller acts on less than it should have: a predicted state, or late.",
            "Look at the reason beside it; the loop returns to active after good ticks in a row.";
        Braking = "braking", "Brakes to zero velocity, then stands still.",
            "Look at the reason beside it; the loop returns to active after good ticks in a row, unless a stop was asked for.";
        Fault = "fault", "Latched: brakes until the process is started again.",
            "Look at the reason beside it, remove the cause, and start the runtime again.";
    }
}

impl Mode {
    /// The mode of a message; a number this build does not know is a fault.
    pub fn from_code(code: u32) -> Mode {
        Mode::ALL.get(code as usize).copied().unwrap_or(Mode::Fault)
    }

    /// True when the controller's action goes to the plant.
    pub fn acts(self) -> bool {
        matches!(self, Mode::Active | Mode::Degraded)
    }
}

codes! {
    /// Why the loop is not Active.
    Reason, "reason" {
        None = "none", "Nothing is wrong.", "Nothing to do.";
        StaleState = "stale-state", "No state came within the age limit, or its time stamp is older than that.",
            "Check that the plant runs and is not starved of processor time; raise --age-limit if it pauses on purpose.";
        FrozenState = "frozen-state", "The plant goes on sending, but its clock stands still or runs backwards, or its moving joints stand still.",
            "Check the sensor or driver behind the plant: it repeats an old sample.";
        LostStates = "lost-states", "More states in a row were lost between plant and loop than may be bridged.",
            "Free processor time for plant and runtime, or lower the rate; a driver's `time` is in seconds and goes on by `dt` with each state. \
             `hold_states` is the number that is bridged.";
        BadState = "bad-state", "The state holds NaN or infinity.",
            "Check the plant's sensors; the first few are bridged by prediction, then the plant brakes.";
        BadStates = "bad-states", "More states in a row held NaN or infinity than allowed; latched.",
            "Repair the plant's sensors, then start the runtime again.";
        ImplausibleState = "implausible-state", "A joint jumped further than its speed allows, or begins outside of its range by more than its width.",
            "Check encoder, wiring, unit (degrees for radians?) and joint order of the plant; the sample was not used.";
        ImplausibleStates = "implausible-states", "More implausible states in a row than allowed; latched.",
            "Check encoders, units and joint order of the plant, then start the runtime again.";
        SilentProposer = "silent-proposer", "The process that proposes has said nothing usable for longer than the age limit.",
            "Look at that process; --proposal-age and --proposal-hold are how long its last proposal counts.";
        Controller = "controller", "The controller refused the state: it gave no checked target.",
            "See the status of the tick in the flight log, then `nearl explain STATUS`.";
        NonFiniteProposal = "braked-non-finite-proposal", "The policy proposed NaN or infinity several ticks in a row.",
            "Go back to an earlier snapshot: the training diverged.";
        NoVerifiedBrake = "braked-no-verified-brake", "Several ticks in a row no way to stop could be verified; the stored brake ran.",
            "Lower acceleration or the proposals' size; if it lasts, a joint cannot be held: see `holding` of `nearl doctor SNAPSHOT`.";
        NoCertifiedAnswer = "braked-no-certified-answer", "Several ticks in a row no target passed the checker.",
            "The limits leave nothing to do there: run `nearl doctor SNAPSHOT` and loosen what it names.";
        NonFiniteDynamics = "braked-non-finite-dynamics", "Several ticks in a row the dynamics gave NaN or infinity.",
            "Check the robot file's masses and the plant's velocities.";
        Panic = "panic", "The controller panicked; it is discarded and the robot model alone brakes; latched.",
            "Report it with the flight log, and go back to an earlier snapshot.";
        Overruns = "overruns", "Several ticks in a row ended after the next one was due.",
            "Free a core for the runtime (--cpu, --priority), or lower the rate.";
        Starved = "starved", "Overruns did not end although the loop was braking; latched.",
            "Stop what takes the processor, then start the runtime again.";
        Stop = "stop", "A stop was asked for, by a signal or because the time was over.", "Nothing to do.";
        PlantGone = "plant-gone", "No state came for so long that the plant counts as gone; the run ended by itself.",
            "Start the plant again, then the runtime. States of another robot than at the start are none (`refused_states`). --plant-patience is how \
             long the loop waits for one that comes back.";
        MemoryTorn = "memory-torn", "A file of shared memory was made shorter while it was in use; the robot was braked and the process ended by itself.",
            "Find the program that truncates files under /dev/shm, then start plant and runtime again.";
        LoopGone = "loop-gone", "No action came for so long that the runtime counts as gone; the plant braked and ended by itself.",
            "Start the plant again, then the runtime; without --loop-patience a plant brakes and waits for the next runtime.";
        WrongPeriod = "wrong-period", "Sixteen times in a row the plant's own clock showed a period that is a fifth or more off the one it announced.",
            "Let the driver's loop run once in each period of `dt`, or announce, and train with, the period that it has; its `time` is in seconds.";
        WrongVelocity = "wrong-velocity", "A joint moved another way than its velocities say, by a quarter of what its fastest speed leads it; latched.",
            "Check unit, sign, filter and order of the plant's velocities, and that `dt` is the period it has; then start the runtime again.";
    }
}

/// What one tick brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// A fresh, plausible state.
    Good,
    /// A predicted state stands in for the one that is missing or unusable.
    Held(Reason),
    /// There is no state to act upon.
    Lost(Reason),
    /// The controller refused the tick, or braked too often in a row.
    Refused(Reason),
    /// The controller panicked.
    Panicked,
}

/// When to change the mode \[ticks\].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "cli", derive(clap::Args))]
#[serde(deny_unknown_fields)]
pub struct ModeLimits {
    /// Good ticks in a row before Degraded or Braking ends.
    #[cfg_attr(feature = "cli", arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().recover_after))]
    pub recover_after: u32,
    /// Missing or unusable states in a row that are bridged by prediction.
    #[cfg_attr(feature = "cli", arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().hold_states))]
    pub hold_states: u32,
    /// Unusable states in a row before Fault is latched; more than those of `hold_states`.
    #[cfg_attr(feature = "cli", arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().bad_states))]
    pub bad_states: u32,
    /// Ticks in a row in which the projector braked before the loop brakes.
    #[cfg_attr(feature = "cli", arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().braked_ticks))]
    pub braked_ticks: u32,
    /// Overruns in a row before Degraded.
    #[cfg_attr(feature = "cli", arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().degrade_overruns))]
    pub degrade_overruns: u32,
    /// Overruns in a row before Braking; at least those of Degraded.
    #[cfg_attr(feature = "cli", arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().overruns))]
    pub overruns: u32,
    /// Overruns in a row before Fault is latched, more than those of Braking; if not given a hundred, and no fewer than fit a tenth of a second.
    #[cfg_attr(feature = "cli", arg(long, value_name = "TICKS"))]
    pub starved: Option<u32>,
}

impl Default for ModeLimits {
    fn default() -> Self {
        ModeLimits {
            recover_after: 10,
            hold_states: 3,
            bad_states: 8,
            braked_ticks: 5,
            degrade_overruns: 3,
            overruns: 10,
            starved: None,
        }
    }
}

impl ModeLimits {
    /// Overruns in a row before the fault is latched, at a period of `period` [ns]: more of them at a high rate, where a short pause of
    /// the machine costs many ticks.
    fn starved_at(&self, period: u64) -> u32 {
        let tenth = u32::try_from(100_000_000_u64.div_ceil(period.max(1))).unwrap_or(u32::MAX);
        self.starved.unwrap_or_else(|| tenth.max(100).max(self.overruns.saturating_add(1)))
    }
}

/// The mode with its counters. Escalates at once, comes back only after good ticks.
#[derive(Clone, Copy, Debug)]
pub struct Modes {
    limits: ModeLimits,
    starved: u32,
    mode: Mode,
    reason: Reason,
    good: u32,
    bad: u32,
    late: u32,
}

impl Modes {
    /// Begins in Hold; `period` \[ns\].
    pub fn new(limits: ModeLimits, period: u64) -> Modes {
        Modes {
            limits,
            starved: limits.starved_at(period),
            mode: Mode::Hold,
            reason: Reason::None,
            good: 0,
            bad: 0,
            late: 0,
        }
    }

    /// The mode.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Why it is not Active; `None` in Active, and in Hold where no state came at all.
    pub fn reason(&self) -> Reason {
        self.reason
    }

    /// Good, unusable and late ticks in a row, for [`Modes::resume`].
    pub fn counts(&self) -> [u32; 3] {
        [self.good, self.bad, self.late]
    }

    /// Goes on in `mode` for `reason`, after so many good, unusable and late ticks in a row.
    pub fn resume(&mut self, mode: Mode, reason: Reason, counts: [u32; 3]) {
        (self.mode, self.reason) = (mode, reason);
        [self.good, self.bad, self.late] = counts;
    }

    /// Takes in what a tick brought; `overran` if the tick before ended late, `stop` once a stop was asked for.
    pub fn update(&mut self, event: Event, overran: bool, stop: bool) -> Mode {
        self.count(event, overran);
        let latched = self.latched(event);
        match event {
            _ if self.mode == Mode::Fault => {}
            _ if latched != Reason::None => self.enter(Mode::Fault, latched),
            _ if stop => self.enter(Mode::Braking, Reason::Stop),
            Event::Lost(reason) | Event::Refused(reason) => self.brake(reason),
            _ if self.late >= self.limits.overruns => self.brake(Reason::Overruns),
            Event::Held(reason) => self.degrade(reason),
            _ if self.late >= self.limits.degrade_overruns => self.degrade(Reason::Overruns),
            _ => self.good_tick(),
        }
        self.mode
    }

    /// The controller's own outcome within a tick that was counted already.
    pub fn escalate(&mut self, event: Event, stop: bool) -> Mode {
        match event {
            _ if self.mode == Mode::Fault => {}
            Event::Panicked => self.enter(Mode::Fault, Reason::Panic),
            _ if stop => self.enter(Mode::Braking, Reason::Stop),
            Event::Refused(reason) | Event::Lost(reason) => self.brake(reason),
            Event::Held(reason) => self.degrade(reason),
            Event::Good => {}
        }
        self.good = 0;
        self.mode
    }

    fn count(&mut self, event: Event, overran: bool) {
        let unusable =
            |reason| matches!(reason, Reason::BadState | Reason::ImplausibleState | Reason::WrongVelocity);
        let is_bad = matches!(event, Event::Held(r) | Event::Lost(r) if unusable(r));
        self.good = if event == Event::Good && !overran { self.good.saturating_add(1) } else { 0 };
        self.bad = if is_bad { self.bad.saturating_add(1) } else { 0 };
        self.late = if overran { self.late.saturating_add(1) } else { 0 };
    }

    fn latched(&self, event: Event) -> Reason {
        let is_over = self.bad >= self.limits.bad_states;
        match event {
            Event::Panicked => Reason::Panic,
            Event::Lost(Reason::BadState) if is_over => Reason::BadStates,
            Event::Lost(Reason::ImplausibleState) if is_over => Reason::ImplausibleStates,
            Event::Lost(Reason::WrongVelocity) if is_over => Reason::WrongVelocity,
            _ if self.late >= self.starved => Reason::Starved,
            _ => Reason::None,
        }
    }

    fn brake(&mut self, reason: Reason) {
        // Whatever it brakes for: while no state comes, that is what keeps it there.
        let is_alone = self.mode == Mode::Braking && reason == Reason::StaleState;
        if self.mode.acts() || is_alone {
            self.enter(Mode::Braking, reason);
        } else {
            self.stay(reason);
        }
    }

    fn degrade(&mut self, reason: Reason) {
        if self.mode.acts() {
            self.enter(Mode::Degraded, reason);
        } else {
            self.stay(reason);
        }
    }

    /// Of a loop that never acted: what is wrong with the states that came.
    fn stay(&mut self, reason: Reason) {
        if self.mode == Mode::Hold && reason != Reason::StaleState {
            self.reason = reason;
        }
    }

    fn good_tick(&mut self) {
        match self.mode {
            Mode::Hold => self.enter(Mode::Active, Reason::None),
            Mode::Degraded | Mode::Braking if self.good >= self.limits.recover_after => {
                self.enter(Mode::Active, Reason::None);
            }
            _ => {}
        }
    }

    fn enter(&mut self, mode: Mode, reason: Reason) {
        (self.mode, self.reason) = (mode, reason);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(modes: &mut Modes, event: Event, times: usize) -> Mode {
        (0..times).map(|_| modes.update(event, false, false)).last().unwrap()
    }

    fn limits() -> ModeLimits {
        ModeLimits {
            recover_after: 3,
            bad_states: 2,
            degrade_overruns: 1,
            overruns: 2,
            starved: Some(4),
            ..ModeLimits::default()
        }
    }

    #[test]
    fn escalates_at_once_and_returns_slowly() {
        let mut modes = Modes::new(limits(), 1_000_000);
        let stale = Event::Lost(Reason::StaleState);
        assert_eq!(run(&mut modes, stale, 5), Mode::Hold);
        assert_eq!(run(&mut modes, Event::Good, 1), Mode::Active);
        assert_eq!(run(&mut modes, stale, 1), Mode::Braking);
        assert_eq!(modes.reason(), Reason::StaleState);
        assert_eq!(run(&mut modes, Event::Good, 2), Mode::Braking);
        assert_eq!(run(&mut modes, Event::Good, 1), Mode::Active);
    }

    #[test]
    fn a_loop_that_never_acted_says_what_is_wrong_with_the_states_that_come() {
        let mut modes = Modes::new(limits(), 1_000_000);
        for (event, reason) in [
            (Event::Lost(Reason::StaleState), Reason::None),
            (Event::Lost(Reason::LostStates), Reason::LostStates),
            (Event::Held(Reason::FrozenState), Reason::FrozenState),
            (Event::Lost(Reason::WrongPeriod), Reason::WrongPeriod),
            (Event::Lost(Reason::StaleState), Reason::WrongPeriod),
        ] {
            assert_eq!((run(&mut modes, event, 1), modes.reason()), (Mode::Hold, reason), "{event:?}");
        }
        assert_eq!((run(&mut modes, Event::Good, 1), modes.reason()), (Mode::Active, Reason::None));
    }

    #[test]
    fn overruns_degrade_then_brake_then_latch() {
        let mut modes = Modes::new(limits(), 1_000_000);
        run(&mut modes, Event::Good, 1);
        let late = |modes: &mut Modes| (modes.update(Event::Good, true, false), modes.reason());
        assert_eq!(late(&mut modes), (Mode::Degraded, Reason::Overruns));
        assert_eq!(run(&mut modes, Event::Good, 2), Mode::Degraded);
        assert_eq!(run(&mut modes, Event::Good, 1), Mode::Active);
        assert_eq!(late(&mut modes), (Mode::Degraded, Reason::Overruns));
        assert_eq!(late(&mut modes), (Mode::Braking, Reason::Overruns));
        assert_eq!(late(&mut modes), (Mode::Braking, Reason::Overruns));
        assert_eq!(late(&mut modes), (Mode::Fault, Reason::Starved));
    }

    #[test]
    fn a_plant_that_falls_silent_while_the_loop_brakes_is_named() {
        let mut modes = Modes::new(limits(), 1_000_000);
        run(&mut modes, Event::Good, 1);
        modes.update(Event::Good, true, false);
        assert_eq!(modes.update(Event::Good, true, false), Mode::Braking);
        assert_eq!(modes.reason(), Reason::Overruns);
        modes.update(Event::Lost(Reason::LostStates), true, false);
        assert_eq!(modes.reason(), Reason::Overruns, "a slot without a state says less");
        run(&mut modes, Event::Lost(Reason::StaleState), 1);
        assert_eq!((modes.mode(), modes.reason()), (Mode::Braking, Reason::StaleState));
        modes.update(Event::Lost(Reason::StaleState), false, true);
        modes.update(Event::Lost(Reason::StaleState), false, true);
        assert_eq!(modes.reason(), Reason::Stop);
    }

    #[test]
    fn a_held_state_degrades_and_does_not_soften_braking() {
        let mut modes = Modes::new(limits(), 1_000_000);
        let held = Event::Held(Reason::BadState);
        assert_eq!(run(&mut modes, held, 1), Mode::Hold);
        run(&mut modes, Event::Good, 1);
        assert_eq!(run(&mut modes, held, 5), Mode::Degraded);
        run(&mut modes, Event::Refused(Reason::Controller), 1);
        assert_eq!(run(&mut modes, held, 1), Mode::Braking);
        assert_eq!(modes.reason(), Reason::Controller);
    }

    #[test]
    fn a_fault_stays() {
        let mut modes = Modes::new(ModeLimits { recover_after: 1, ..limits() }, 1_000_000);
        run(&mut modes, Event::Good, 1);
        assert_eq!(run(&mut modes, Event::Lost(Reason::BadState), 1), Mode::Braking);
        assert_eq!(run(&mut modes, Event::Lost(Reason::BadState), 1), Mode::Fault);
        assert_eq!(run(&mut modes, Event::Good, 100), Mode::Fault);
        assert_eq!(modes.update(Event::Good, false, true), Mode::Fault);
        assert_eq!(modes.reason(), Reason::BadStates);
    }

    #[test]
    fn a_tenth_of_a_second_of_overruns_latches_at_high_rates() {
        let at = |period| ModeLimits::default().starved_at(period);
        assert_eq!((at(20_000_000), at(1_000_000), at(200_000)), (100, 100, 500));
        let patient = ModeLimits { overruns: 300, ..ModeLimits::default() };
        assert_eq!(patient.starved_at(1_000_000), 301, "braking comes first");
        assert_eq!(limits().starved_at(200_000), 4, "what is given counts");
    }

    #[test]
    fn a_stop_cannot_be_recovered_from() {
        let mut modes = Modes::new(ModeLimits::default(), 1_000_000);
        run(&mut modes, Event::Good, 1);
        for _ in 0..100 {
            assert_eq!(modes.update(Event::Good, false, true), Mode::Braking);
        }
        assert_eq!(modes.reason(), Reason::Stop);
    }
}
