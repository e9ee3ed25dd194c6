//! What was found in a log.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

/// Violations that are told one by one; all are counted.
const TOLD: usize = 10;

/// Unit of what has to be a number and is none.
pub(crate) const A_NUMBER: &str = "a number";

/// Unit of what is said in words, with no number.
pub(crate) const IN_WORDS: &str = "in words";

/// What does not hold.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Violation {
    /// Tick.
    pub tick: u64,
    /// What it is of: a joint, a row, a field, as the subject of a sentence.
    pub what: String,
    /// The value that was found.
    pub value: f64,
    /// What is allowed.
    pub limit: f64,
    /// Unit of both.
    pub unit: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Violation { tick, what, value, limit, unit } = self;
        match unit.as_str() {
            IN_WORDS => write!(f, "{what}"),
            A_NUMBER => write!(f, "tick {tick}: {what} is {value}, which is no number"),
            "" => write!(f, "tick {tick}: {what} is {value}, and {limit} is what holds there"),
            unit => {
                write!(f, "tick {tick}: {what} is {value} {unit}, and {limit} {unit} is what holds there")
            }
        }
    }
}

/// What was found in a log.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// Ticks of which the log has a message, in full or in brief.
    pub ticks: u64,
    /// Ticks that asked the robot for a state, whose limits held and whose other claims were confirmed.
    pub verified: u64,
    /// Those of them whose target was confirmed to be the nearest allowed state.
    pub optimal: u64,
    /// Those of them for which a way to stop was confirmed.
    pub stoppable: u64,
    /// Those of them that only came back or braked, because the robot was found outside its limits.
    pub recovering: u64,
    /// Ticks without an action of the loop: nothing was claimed.
    pub idle: u64,
    /// Ticks that are not verified, by the reason.
    pub not_verified: BTreeMap<String, u64>,
    /// Ticks whose limits were verified and whose answer was not said or not known to be the nearest, by the reason.
    pub not_compared: BTreeMap<String, u64>,
    /// Ticks whose limits were verified and for which no way to stop was looked for, by the reason.
    pub not_stopped: BTreeMap<String, u64>,
    /// What does not hold: the first few.
    pub violations: Vec<Violation>,
    /// How many do not hold.
    pub found: u64,
    /// The largest pull that nothing balanced in an answer that was confirmed, as a share of what was allowed for rounding.
    pub unbalanced: f64,
    /// The log was closed by the runtime, not cut by its death.
    pub complete: bool,
    /// The file ends as it was written: nothing of what stands behind the last tick is missing, and nothing was added.
    pub intact: bool,
}

impl Report {
    pub(crate) fn add(&mut self, violation: Violation) {
        self.found += 1;
        if self.violations.len() < TOLD {
            self.violations.push(violation);
        }
    }

    /// Ticks that are neither verified, idle nor found in violation.
    pub fn unverified(&self) -> u64 {
        self.not_verified.values().fold(0, |sum, ticks| sum.saturating_add(*ticks))
    }

    /// Everything that was claimed was verified, and something was.
    pub fn is_whole(&self) -> bool {
        self.found == 0 && self.unverified() == 0 && self.complete && self.intact && self.verified > 0
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} ticks, {} of them without an action", self.ticks, self.idle)?;
        writeln!(
            f,
            "  limits held in {}; {} of these were outside at their start, and came back or braked",
            self.verified, self.recovering
        )?;
        writeln!(f, "  the target was the nearest allowed state in {}", self.optimal)?;
        for (reason, count) in &self.not_compared {
            writeln!(f, "    not compared in {count}: {reason}")?;
        }
        writeln!(f, "  a way to stop existed in {}", self.stoppable)?;
        for (reason, count) in &self.not_stopped {
            writeln!(f, "    not looked for in {count}: {reason}")?;
        }
        for (reason, count) in &self.not_verified {
            writeln!(f, "  not verified: {count} ticks, {reason}")?;
        }
        if !self.complete {
            writeln!(
                f,
                "  not verified: what came after the end of this log, which was cut short: its runtime did not close it, or a part was lost since"
            )?;
        } else if !self.intact {
            writeln!(
                f,
                "  not verified: the end of the file behind the last tick, which was cut off, damaged or added to after the runtime closed it"
            )?;
        }
        for violation in &self.violations {
            writeln!(f, "  {violation}")?;
        }
        let more = self.found - self.violations.len() as u64;
        if more > 0 {
            writeln!(f, "  and {more} more")?;
        }
        Ok(())
    }
}
