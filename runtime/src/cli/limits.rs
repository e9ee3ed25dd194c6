//! Options of `nearl run` that say when the loop changes its mode, and when it takes a snapshot back.

use clap::Args;

use super::Failure;
use crate::rt::{ModeLimits, RollbackSettings};

/// When the loop degrades, brakes, latches, recovers and rolls back.
#[derive(Args, Clone, Copy, Debug)]
#[command(next_help_heading = "Mode limits and rollback")]
pub struct LimitOptions {
    /// Modes.
    #[command(flatten)]
    pub modes: ModeLimits,
    /// Rollback.
    #[command(flatten)]
    pub rollback: RollbackSettings,
}

impl LimitOptions {
    /// The settings of the run.
    ///
    /// # Errors
    /// One sentence naming the option whose number contradicts another or is out of range.
    pub fn settings(self) -> Result<(ModeLimits, RollbackSettings), Failure> {
        let LimitOptions { modes: m, rollback: r } = self;
        let order = [
            ("--bad-states", m.bad_states, "--hold-states", m.hold_states.saturating_add(1)),
            ("--degrade-overruns", m.degrade_overruns, "1", 1),
            ("--overruns", m.overruns, "--degrade-overruns", m.degrade_overruns),
            ("--starved", m.starved.unwrap_or(u32::MAX), "--overruns", m.overruns.saturating_add(1)),
            ("--recover-after", m.recover_after, "1", 1),
            ("--braked-ticks", m.braked_ticks, "1", 1),
        ];
        if let Some((name, ticks, than, least)) = order.into_iter().find(|(_, ticks, _, least)| ticks < least)
        {
            return Err(
                format!("{name} {ticks} ticks is below {least}, by {than}: give at least {least}").into()
            );
        }
        let (window, most) = (r.window, RollbackSettings::MOST_WINDOW);
        if window > most {
            return Err(format!("--rollback-window {window} ticks is not usable: give at most {most}").into());
        }
        let least = [("--rollback-factor", r.factor, 1.0), ("--rollback-floor", r.floor, 0.0)];
        if let Some((name, value, least)) =
            least.into_iter().find(|(_, value, least)| !(least..=&1e9).contains(&value))
        {
            return Err(format!("{name} {value} is not usable: give a number from {least} to 1e9").into());
        }
        Ok((m, r))
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
