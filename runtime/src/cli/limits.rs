//! Options of `nearl run` that say when the loop changes its mode, and when it takes a snapshot back.

use clap::Args;

use super::Failure;
use crate::rt::{ModeLimits, RollbackSettings};

/// Longest window of the residual [ticks]; its memory is taken at once.
const MOST_WINDOW: usize = 1_000_000;

/// When the loop degrades, brakes, latches, recovers and rolls back.
#[derive(Args, Clone, Copy, Debug)]
#[command(next_help_heading = "Mode limits and rollback")]
pub struct LimitOptions {
    /// Good ticks in a row before Degraded or Braking ends.
    #[arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().recover_after)]
    pub recover_after: u32,
    /// Missing or unusable states in a row that are bridged by prediction.
    #[arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().hold_states)]
    pub hold_states: u32,
    /// Unusable states in a row before Fault is latched; more than --hold-states.
    #[arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().bad_states)]
    pub bad_states: u32,
    /// Ticks in a row in which the projector braked before the loop brakes.
    #[arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().braked_ticks)]
    pub braked_ticks: u32,
    /// Overruns in a row before Degraded.
    #[arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().degrade_overruns)]
    pub degrade_overruns: u32,
    /// Overruns in a row before Braking; at least --degrade-overruns.
    #[arg(long, value_name = "TICKS", default_value_t = ModeLimits::default().overruns)]
    pub overruns: u32,
    /// Overruns in a row before Fault is latched; more than --overruns. [default: 100, but at least a tenth of a second]
    #[arg(long, value_name = "TICKS")]
    pub starved: Option<u32>,
    /// Ticks over which the distance of reached and target velocity is averaged before and after a swap; 0 never goes back.
    #[arg(long, value_name = "TICKS", default_value_t = RollbackSettings::default().window)]
    pub rollback_window: usize,
    /// The mean after a swap may be so many times the mean before.
    #[arg(long, value_name = "FACTOR", default_value_t = RollbackSettings::default().factor)]
    pub rollback_factor: f64,
    /// Means below this are no reason to go back [rad/s or m/s].
    #[arg(long, value_name = "SPEED", default_value_t = RollbackSettings::default().floor)]
    pub rollback_floor: f64,
}

impl LimitOptions {
    /// The settings of the run.
    ///
    /// # Errors
    /// One sentence naming the option whose number contradicts another or is out of range.
    pub fn settings(self) -> Result<(ModeLimits, RollbackSettings), Failure> {
        let order = [
            ("--bad-states", self.bad_states, "--hold-states", self.hold_states.saturating_add(1)),
            ("--degrade-overruns", self.degrade_overruns, "1", 1),
            ("--overruns", self.overruns, "--degrade-overruns", self.degrade_overruns),
            ("--starved", self.starved.unwrap_or(u32::MAX), "--overruns", self.overruns.saturating_add(1)),
            ("--recover-after", self.recover_after, "1", 1),
            ("--braked-ticks", self.braked_ticks, "1", 1),
        ];
        if let Some((name, ticks, than, least)) = order.into_iter().find(|(_, ticks, _, least)| ticks < least)
        {
            return Err(
                format!("{name} {ticks} ticks is below {least}, by {than}: give at least {least}").into()
            );
        }
        if self.rollback_window > MOST_WINDOW {
            let window = self.rollback_window;
            return Err(format!(
                "--rollback-window {window} ticks is not usable: give at most {MOST_WINDOW}"
            )
            .into());
        }
        let rollback = [
            ("--rollback-factor", self.rollback_factor, 1.0),
            ("--rollback-floor", self.rollback_floor, 0.0),
        ];
        if let Some((name, value, least)) =
            rollback.into_iter().find(|(_, value, least)| !(least..=&1e9).contains(&value))
        {
            return Err(format!("{name} {value} is not usable: give a number from {least} to 1e9").into());
        }
        let modes = ModeLimits {
            recover_after: self.recover_after,
            hold_states: self.hold_states,
            bad_states: self.bad_states,
            braked_ticks: self.braked_ticks,
            degrade_overruns: self.degrade_overruns,
            overruns: self.overruns,
            starved: self.starved,
        };
        let (window, factor, floor) = (self.rollback_window, self.rollback_factor, self.rollback_floor);
        Ok((modes, RollbackSettings { window, factor, floor }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        limits: LimitOptions,
    }

    fn parse(line: &str) -> Result<(ModeLimits, RollbackSettings), String> {
        let words = std::iter::once("run").chain(line.split_whitespace());
        Line::parse_from(words).limits.settings().map_err(|e| e.to_string())
    }

    #[test]
    fn what_is_not_given_is_the_default() {
        assert_eq!(parse("").unwrap(), (ModeLimits::default(), RollbackSettings::default()));
        let (modes, rollback) = parse("--hold-states 5 --bad-states 6 --rollback-window 0").unwrap();
        assert_eq!((modes.hold_states, modes.bad_states, rollback.window), (5, 6, 0));
    }

    #[test]
    fn limits_that_contradict_each_other_are_refused_by_name() {
        for (line, says) in [
            ("--hold-states 8", "--bad-states 8 ticks is below 9, by --hold-states"),
            ("--overruns 2", "--overruns 2 ticks is below 3"),
            ("--starved 10", "--starved 10 ticks is below 11"),
            ("--recover-after 0", "--recover-after 0"),
            ("--rollback-factor 0.5", "--rollback-factor 0.5"),
            ("--rollback-floor NaN", "--rollback-floor NaN"),
        ] {
            let text = parse(line).unwrap_err();
            assert!(text.contains(says), "{text}");
        }
    }
}
