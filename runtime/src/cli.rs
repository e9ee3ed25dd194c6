//! Subcommands of a robot's program: `nearl-runtime` has them, and `nearl` has the same.

mod limits;
mod moved;
mod verify;

use std::path::PathBuf;

use clap::{Args, Subcommand};

use crate::clock::nanoseconds;
use crate::codes::{self, Explanation};
use crate::link::{RobotName, bench_round_trip};
use crate::log::{Gap, replay};
use crate::rt::{
    FaultPlan, Mode, PRIORITY, Percentiles, ProposerSettings, Reason, RunSettings, Stop, ThreadSettings,
    bench_wake, run,
};
pub use limits::LimitOptions;
pub use moved::LimitsCommand;
pub use verify::{UNVERIFIED, Unverified, VerifyCommand};

/// Run a snapshot on a plant in real time.
#[derive(Args, Debug)]
pub struct RunCommand {
    /// Run folder or snapshot file.
    pub snapshot: PathBuf,
    /// Name of the plant.
    #[arg(long)]
    pub plant: String,
    /// Keep own time at this rate instead of following the plant [Hz]; must be the plant's.
    #[arg(long, value_parser = hertz)]
    pub rate: Option<f64>,
    /// Stop after so many seconds: of ticks, and at most one more of the wall's where the plant keeps real time.
    #[arg(long, value_parser = seconds)]
    pub seconds: Option<f64>,
    /// Flight log (MCAP).
    #[arg(long)]
    pub log: Option<PathBuf>,
    /// Age at which a state is stale [s]; 5 periods, but at least 20 ms, if not given.
    #[arg(long, value_parser = seconds)]
    pub age_limit: Option<f64>,
    /// So long without a state, and the plant is gone: the run ends with exit code 3 [s].
    #[arg(long, value_parser = seconds, default_value_t = RunSettings::default().plant_patience)]
    pub plant_patience: f64,
    /// So long without a new snapshot, and health and report say that the trainer is silent [s]; the loop goes on. Never if not given.
    #[arg(long, value_parser = seconds)]
    pub snapshot_age: Option<f64>,
    /// Time over which the first motion is let in [s]; 0 begins at once.
    #[arg(long, default_value_t = RunSettings::default().ramp)]
    pub ramp: f64,
    /// A joint may move so many times further than its speed allows before its sample is rejected; 0 checks nothing.
    #[arg(long, default_value_t = RunSettings::default().jump)]
    pub jump: f64,
    /// Explore: act with the policy's own noise, drawn from this seed, for a trainer that learns from the loop. Every limit still holds.
    #[arg(long, value_name = "SEED")]
    pub explore: Option<u64>,
    /// States or actions come from another process (`nearl.Proposer`), in place of the snapshot's policy.
    #[arg(long, conflicts_with = "explore")]
    pub proposer: bool,
    /// Age at which a proposal of that process is only held, counted from the state it answers [s].
    #[arg(long, value_parser = seconds, default_value_t = ProposerSettings::default().age_limit as f64 / 1e9)]
    pub proposal_age: f64,
    /// So long is its last proposal held before the loop brakes [s].
    #[arg(long, value_parser = seconds, default_value_t = ProposerSettings::default().hold as f64 / 1e9)]
    pub proposal_hold: f64,
    /// The limits of this loop, in place of its first snapshot's: a task file, or any TOML file with a section [constraints]. No
    /// snapshot may loosen them, the first included.
    #[arg(long = "limits", value_name = "FILE", conflicts_with = "allow_looser")]
    pub limits_file: Option<PathBuf>,
    /// Take snapshots that loosen the limits of the loop, too.
    #[arg(long)]
    pub allow_looser: bool,
    /// Rehearse the faults in this JSON file.
    #[arg(long)]
    pub faults: Option<PathBuf>,
    /// SCHED_FIFO priority; 0 keeps the normal scheduler.
    #[arg(long, default_value_t = PRIORITY)]
    pub priority: i32,
    /// Core to stay on.
    #[arg(long)]
    pub cpu: Option<usize>,
    /// A priority, core or memory lock that is refused is an error.
    #[arg(long)]
    pub strict: bool,
    /// Print the report as JSON.
    #[arg(long)]
    pub json: bool,
    /// When the loop changes its mode.
    #[command(flatten)]
    pub limits: LimitOptions,
}

/// Compute every tick of a flight log again and compare it bit for bit.
#[derive(Args, Debug)]
pub struct ReplayCommand {
    /// Flight log (MCAP) of `nearl run --log`.
    pub file: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Say what a code in a report, a log or a refusal means, and what to do.
#[derive(Args, Debug)]
pub struct ExplainCommand {
    /// The code, for example `stale-state`; all of them if none is given.
    pub code: Option<String>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Measurements that need no policy.
#[derive(Subcommand, Debug)]
pub enum LoopBench {
    /// Round trip of a state and its action through shared memory.
    Link {
        /// Round trips, busy and again paced at 1 kHz.
        #[arg(long, default_value_t = 5000)]
        count: u64,
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
    /// How late an empty loop wakes up on an absolute time grid.
    Loop {
        /// Slots per second [Hz].
        #[arg(long, default_value_t = 1000.0)]
        rate: f64,
        /// Duration [s].
        #[arg(long, default_value_t = 5.0)]
        seconds: f64,
        /// SCHED_FIFO priority; 0 keeps the normal scheduler.
        #[arg(long, default_value_t = PRIORITY)]
        priority: i32,
        /// Core to stay on.
        #[arg(long)]
        cpu: Option<usize>,
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
}

/// Writes a line to standard error, as `eprintln!` does. Where nobody can read it any more, as in a terminal that was closed, it is lost and the program
/// goes on.
#[macro_export]
macro_rules! tell {
    ($($words:tt)*) => {
        drop(std::io::Write::write_fmt(&mut std::io::stderr(), format_args!("{}\n", format_args!($($words)*))))
    };
}

/// Prints a line. A closed pipe ends the program quietly, as other commands do, and what a closed terminal should show is lost; any other failure ends it with
/// code 1.
pub fn say(line: impl std::fmt::Display) {
    use std::io::{ErrorKind, Write};
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{line}").and_then(|()| out.flush()) {
        Ok(()) => {}
        Err(e) if e.kind() == ErrorKind::BrokenPipe => std::process::exit(0),
        Err(e) if e.raw_os_error() == Some(libc::EIO) => {} // the program was told by SIGHUP
        Err(e) => {
            crate::tell!("standard output cannot be written ({e}): send it to another file");
            std::process::exit(1);
        }
    }
}

/// A path as a shell takes it: in quotes where it holds more than letters, digits and what stands in plain names.
pub fn quoted(path: &std::path::Path) -> String {
    let text = path.display().to_string();
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+:,=@%".contains(c);
    match !text.is_empty() && text.chars().all(is_plain) {
        true => text,
        false => format!("'{}'", text.replace('\'', r"'\''")),
    }
}

/// A duration in seconds on the command line: positive and finite.
///
/// # Errors
/// One sentence.
pub fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s <= 1e7 => Ok(s),
        _ => Err(format!("'{text}' is not a duration; write seconds above 0, for example 2.5")),
    }
}

fn hertz(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if rate > 0.0 && rate <= 1e6 => Ok(rate),
        _ => Err(format!("'{text}' is not a rate; write Hz, for example 1000")),
    }
}

/// What the wall clock is ahead of the monotonic one [ns]: read once, before the loop starts.
fn ahead() -> u64 {
    let wall = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(wall.as_nanos()).unwrap_or(u64::MAX).saturating_sub(crate::clock::now())
}

/// Says on standard error that the loop does not act any more, and why.
fn tell_mode(tick: u64, mode: Mode, reason: Reason) {
    use std::io::Write;
    let why = match reason {
        Reason::None => String::new(),
        reason => format!(" ({reason}): {} {}", reason.explanation().meaning, reason.explanation().remedy),
    };
    // Who closed standard error does not want to know.
    let _ = writeln!(std::io::stderr(), "tick {tick}: {mode}{why}");
}

/// Any failure, as one sentence.
pub type Failure = Box<dyn std::error::Error + Send + Sync>;

/// Exit code of a run whose plant is gone.
pub const PLANT_GONE: u8 = 3;
/// Exit code of a plant whose runtime is gone.
pub const LOOP_GONE: u8 = 4;

/// Exit code of a run or a plant whose shared memory was taken away.
pub const MEMORY_TORN: u8 = 5;
/// Exit code of a run that ended in Fault.
pub const FAULT: u8 = 6;

/// A run or a plant that ended by itself for a reason with an exit code of its own.
#[derive(Debug, thiserror::Error)]
#[error("`{name}`: {reason}: {} {}", .reason.explanation().meaning, .reason.explanation().remedy)]
pub struct Ended {
    code: u8,
    reason: Reason,
    name: String,
}

impl Ended {
    /// As a failure.
    pub fn failure(code: u8, reason: Reason, name: &str) -> Failure {
        Box::new(Ended { code, reason, name: name.to_owned() })
    }
}

/// The exit code that a program ends with after `failure`: 1 unless it has one of its own.
pub fn exit_code(failure: &Failure) -> u8 {
    match failure.downcast_ref::<Ended>() {
        Some(ended) => ended.code,
        None if failure.is::<Unverified>() => UNVERIFIED,
        None => 1,
    }
}

impl RunCommand {
    /// Runs until the time is over or a signal comes, and prints the report.
    ///
    /// # Errors
    /// One sentence: the plant, the snapshot, or what strict mode refused.
    pub fn run(self) -> Result<(), Failure> {
        let thread = ThreadSettings {
            priority: (self.priority > 0).then_some(self.priority),
            cpu: self.cpu,
            lock_memory: true,
        };
        let faults = self.faults.as_deref().map(FaultPlan::load).transpose()?.unwrap_or_default();
        let (modes, rollback) = self.limits.settings()?;
        let settings = RunSettings {
            modes,
            rollback,
            explore: self.explore,
            proposer: self.proposer.then(|| ProposerSettings {
                age_limit: nanoseconds(self.proposal_age),
                hold: nanoseconds(self.proposal_hold),
            }),
            age_limit: self.age_limit,
            plant_patience: self.plant_patience,
            snapshot_age: self.snapshot_age,
            ramp: self.ramp,
            jump: self.jump,
            limits: self.limits_file,
            allow_looser: self.allow_looser,
            faults,
            rate: self.rate,
            seconds: self.seconds,
            log: self.log,
            wall: ahead(),
            thread,
            strict: self.strict,
            on_mode: Some(tell_mode),
            ..RunSettings::default()
        };
        let stop = Stop::on_signals()?;
        let report = run(&settings, &self.snapshot, &RobotName::new(&self.plant)?, &stop)?;
        if self.json {
            say(serde_json::to_string(&report)?);
        } else {
            say(report.to_string().trim_end());
        }
        match report.reason {
            reason if report.last_mode == Mode::Fault => Err(Ended::failure(FAULT, reason, &self.plant)),
            Reason::PlantGone => Err(Ended::failure(PLANT_GONE, report.reason, &self.plant)),
            Reason::MemoryTorn => Err(Ended::failure(MEMORY_TORN, report.reason, &self.plant)),
            _ => Ok(()),
        }
    }
}

impl ReplayCommand {
    /// Replays and prints what was found.
    ///
    /// # Errors
    /// One sentence: the first tick and field that differ, or why the log cannot be replayed.
    pub fn run(self) -> Result<(), Failure> {
        let found = replay(&self.file)?;
        if self.json {
            say(serde_json::to_string(&found)?);
        }
        let file = self.file.display();
        if let Some(difference) = &found.difference {
            return Err(format!("{file}: {difference}; the {} ticks before are the same", found.ticks).into());
        }
        if !self.json {
            let end = match found.complete {
                true => "",
                false => {
                    "; the log was cut short or added to: its runtime did not close it, or its end was changed since, and what came after was not looked at"
                }
            };
            let others = if found.gaps.is_empty() { "" } else { "; others could not be computed" };
            say(format!(
                "{file}: {} ticks and {} swaps, bit for bit the same{others}{end}",
                found.ticks, found.swaps
            ));
            if found.brief > 0 {
                say(format!("  {} of them by their digest: the disk was too slow for more", found.brief));
            }
            for Gap { from, to, lost } in &found.gaps {
                say(format!(
                    "  ticks {from} to {to} could not be computed: {lost} of them are not in the log"
                ));
            }
        }
        let missing: u64 = found.gaps.iter().map(|gap| gap.to - gap.from + 1).sum();
        if missing > 0 {
            return Err(Box::new(Unverified(format!(
                "{file}: what was computed is the same, but {missing} ticks could not be: {} of them are not in the log, which a slow disk explains \
                 (see dropped records in the report of the run) or somebody who took them out",
                found.gaps.iter().map(|gap| gap.lost).sum::<u64>()
            ))));
        }
        Ok(())
    }
}

impl ExplainCommand {
    /// Prints the explanation; `further` are codes of the program beside those of this crate.
    ///
    /// # Errors
    /// One sentence for a code that does not exist, with the nearest that does.
    pub fn run(self, further: Vec<Explanation>) -> Result<(), Failure> {
        let all = [codes::all(), further].concat();
        let chosen: Vec<_> = match &self.code {
            None => all,
            Some(code) => vec![codes::find(&all, code)?],
        };
        if self.json {
            say(serde_json::to_string(&chosen)?);
            return Ok(());
        }
        for Explanation { code, group, meaning, remedy } in chosen {
            say(format!("{code} ({group}): {meaning}\n  What to do: {remedy}"));
        }
        Ok(())
    }
}

impl LoopBench {
    /// Measures and prints.
    ///
    /// # Errors
    /// One sentence.
    pub fn run(self) -> Result<(), Failure> {
        match self {
            Self::Link { count, json } => link(count, json),
            Self::Loop { rate, seconds, priority, cpu, json } => wake(rate, seconds, priority, cpu, json),
        }
    }
}

fn link(count: u64, json: bool) -> Result<(), Failure> {
    let name = RobotName::new(&format!("bench{}", std::process::id()))?;
    let result = bench_round_trip(&name, count)?;
    if json {
        say(serde_json::to_string(&result)?);
        return Ok(());
    }
    say(format!("state and action of {} joints, round trip in us:", result.joints));
    line("busy", &result.busy);
    line("paced at 1 kHz", &result.paced);
    Ok(())
}

fn wake(rate: f64, seconds: f64, priority: i32, cpu: Option<usize>, json: bool) -> Result<(), Failure> {
    if !(1.0..=100_000.0).contains(&rate) || !(0.0..=3600.0).contains(&seconds) {
        return Err(format!(
            "--rate {rate} Hz and --seconds {seconds}: give 1 to 100000 Hz and at most 3600 s"
        )
        .into());
    }
    let settings = ThreadSettings { priority: (priority > 0).then_some(priority), cpu, lock_memory: true };
    let (late, warnings) = bench_wake(1.0 / rate, (rate * seconds) as u64, settings, &Stop::new())?;
    for warning in &warnings {
        crate::tell!("warning: {warning}");
    }
    if json {
        say(serde_json::json!({ "rate_hz": rate, "wake_ns": late, "warnings": warnings }));
        return Ok(());
    }
    say(format!("empty loop at {rate} Hz, wake-up after the slot in us:"));
    line("wake-up", &late);
    Ok(())
}

fn line(name: &str, percentiles: &Percentiles) {
    say(format!("  {name:<16} {percentiles}"));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_in_a_hint_can_be_pasted() {
        let quote = |text: &str| quoted(std::path::Path::new(text));
        assert_eq!(quote("runs/panda_0/policy-2.safetensors"), "runs/panda_0/policy-2.safetensors");
        assert_eq!(quote("mein Arm ü/p.safetensors"), "'mein Arm ü/p.safetensors'");
        assert_eq!(quote("it's"), r"'it'\''s'");
        assert_eq!(quote(""), "''");
    }
}
