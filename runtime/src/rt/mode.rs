//! What the loop is allowed to do: a closed set of modes and one transition function.

use serde::Serialize;

/// Mode of the loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// No state has come yet: no action is sent, the plant keeps itself still.
    Hold,
    /// The controller acts.
    Active,
    /// Brakes to zero velocity; back to Active after enough good ticks, unless a stop was asked for.
    Braking,
    /// Latched: brakes until the process is restarted.
    Fault,
}

impl Mode {
    /// All modes, in the order of their codes.
    pub const ALL: [Mode; 4] = [Mode::Hold, Mode::Active, Mode::Braking, Mode::Fault];

    /// The number in a message.
    pub fn code(self) -> u32 {
        self as u32
    }

    /// The mode of a message; a number this build does not know is a fault.
    pub fn from_code(code: u32) -> Mode {
        Mode::ALL.get(code as usize).copied().unwrap_or(Mode::Fault)
    }

    /// Lower-case name.
    pub fn name(self) -> &'static str {
        ["hold", "active", "braking", "fault"][self as usize]
    }
}

/// Why the loop left Active.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// Nothing is wrong.
    None,
    /// No state within the age limit.
    StaleState,
    /// The state holds numbers that are not finite, or the wrong sizes.
    BadState,
    /// More bad states in a row than allowed.
    BadStates,
    /// The controller could not give a checked target.
    Controller,
    /// The controller panicked; it is not called again.
    Panic,
    /// More overruns in a row than allowed.
    Overruns,
    /// A stop was asked for.
    Stop,
}

/// What one tick brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// A fresh, finite state of the right sizes.
    Good,
    /// No state within the age limit.
    Stale,
    /// A state that cannot be used.
    Bad,
    /// The controller refused the tick.
    Refused,
    /// The controller panicked.
    Panicked,
}

/// Limits of the transitions [ticks].
#[derive(Clone, Copy, Debug)]
pub struct ModeLimits {
    /// Good ticks in a row before Braking ends.
    pub recover_after: u32,
    /// Bad states in a row before the fault is latched.
    pub bad_states: u32,
    /// Overruns in a row before braking.
    pub overruns: u32,
}

impl Default for ModeLimits {
    fn default() -> Self {
        ModeLimits { recover_after: 10, bad_states: 5, overruns: 10 }
    }
}

/// The mode with its counters. Escalates at once, comes back only after good ticks.
#[derive(Clone, Copy, Debug)]
pub struct Modes {
    limits: ModeLimits,
    mode: Mode,
    reason: Reason,
    good: u32,
    bad: u32,
    late: u32,
}

impl Modes {
    /// Begins in Hold.
    pub fn new(limits: ModeLimits) -> Modes {
        Modes { limits, mode: Mode::Hold, reason: Reason::None, good: 0, bad: 0, late: 0 }
    }

    /// The mode.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Why it is not Active; `None` in Hold and Active.
    pub fn reason(&self) -> Reason {
        self.reason
    }

    /// Takes in what a tick brought; `overran` if the tick before ended late, `stop` once a stop was asked for.
    pub fn update(&mut self, event: Event, overran: bool, stop: bool) -> Mode {
        self.count(event, overran);
        match event {
            _ if self.mode == Mode::Fault => {}
            Event::Panicked => self.enter(Mode::Fault, Reason::Panic),
            Event::Bad if self.bad >= self.limits.bad_states => self.enter(Mode::Fault, Reason::BadStates),
            _ if stop => self.enter(Mode::Braking, Reason::Stop),
            Event::Bad => self.brake(Reason::BadState),
            Event::Stale => self.brake(Reason::StaleState),
            Event::Refused => self.brake(Reason::Controller),
            Event::Good if self.late >= self.limits.overruns => self.brake(Reason::Overruns),
            Event::Good => self.good_tick(),
        }
        self.mode
    }

    fn count(&mut self, event: Event, overran: bool) {
        self.good = if event == Event::Good && !overran { self.good.saturating_add(1) } else { 0 };
        self.bad = if event == Event::Bad { self.bad.saturating_add(1) } else { 0 };
        self.late = if overran { self.late.saturating_add(1) } else { 0 };
    }

    fn brake(&mut self, reason: Reason) {
        if self.mode == Mode::Active {
            self.enter(Mode::Braking, reason);
        }
    }

    fn good_tick(&mut self) {
        match self.mode {
            Mode::Hold => self.enter(Mode::Active, Reason::None),
            Mode::Braking if self.good >= self.limits.recover_after => self.enter(Mode::Active, Reason::None),
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

    #[test]
    fn escalates_at_once_and_returns_slowly() {
        let mut modes = Modes::new(ModeLimits { recover_after: 3, bad_states: 2, overruns: 2 });
        assert_eq!(run(&mut modes, Event::Stale, 5), Mode::Hold);
        assert_eq!(run(&mut modes, Event::Good, 1), Mode::Active);
        assert_eq!(run(&mut modes, Event::Stale, 1), Mode::Braking);
        assert_eq!(modes.reason(), Reason::StaleState);
        assert_eq!(run(&mut modes, Event::Good, 2), Mode::Braking);
        assert_eq!(run(&mut modes, Event::Good, 1), Mode::Active);
        assert_eq!(modes.update(Event::Good, true, false), Mode::Active);
        assert_eq!(modes.update(Event::Good, true, false), Mode::Braking);
        assert_eq!(modes.reason(), Reason::Overruns);
    }

    #[test]
    fn a_fault_stays() {
        let mut modes = Modes::new(ModeLimits { recover_after: 1, bad_states: 2, overruns: 2 });
        run(&mut modes, Event::Good, 1);
        assert_eq!(run(&mut modes, Event::Bad, 1), Mode::Braking);
        assert_eq!(run(&mut modes, Event::Bad, 1), Mode::Fault);
        assert_eq!(run(&mut modes, Event::Good, 100), Mode::Fault);
        assert_eq!(modes.update(Event::Good, false, true), Mode::Fault);
        assert_eq!(modes.reason(), Reason::BadStates);
    }

    #[test]
    fn a_stop_cannot_be_recovered_from() {
        let mut modes = Modes::new(ModeLimits::default());
        run(&mut modes, Event::Good, 1);
        for _ in 0..100 {
            assert_eq!(modes.update(Event::Good, false, true), Mode::Braking);
        }
        assert_eq!(modes.reason(), Reason::Stop);
    }
}
