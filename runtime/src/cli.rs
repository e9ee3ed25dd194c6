//! Subcommands of a robot's program: `nearl-runtime` has them, and `nearl` has the same.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use crate::link::{RobotName, bench_round_trip};
use crate::rt::{Percentiles, RunSettings, Stop, ThreadSettings, bench_wake, run};

/// Run a snapshot on a plant in real time.
#[derive(Args, Debug)]
pub struct RunCommand {
    /// Snapshot file.
    pub snapshot: PathBuf,
    /// Name of the plant.
    #[arg(long)]
    pub plant: String,
    /// Keep own time at this rate instead of following the plant [Hz]; must be the plant's.
    #[arg(long, value_parser = hertz)]
    pub rate: Option<f64>,
    /// Stop after so many seconds of ticks.
    #[arg(long, value_parser = seconds)]
    pub seconds: Option<f64>,
    /// Flight log (MCAP).
    #[arg(long)]
    pub log: Option<PathBuf>,
    /// SCHED_FIFO priority; 0 keeps the normal scheduler.
    #[arg(long, default_value_t = 40)]
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
        #[arg(long, default_value_t = 40)]
        priority: i32,
        /// Core to stay on.
        #[arg(long)]
        cpu: Option<usize>,
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
}

/// Prints a line. A closed pipe ends the program quietly, as other commands do; any other failure ends it with code 1.
pub fn say(line: impl std::fmt::Display) {
    use std::io::{ErrorKind, Write};
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{line}").and_then(|()| out.flush()) {
        Ok(()) => {}
        Err(e) if e.kind() == ErrorKind::BrokenPipe => std::process::exit(0),
        Err(e) => {
            eprintln!("standard output cannot be written ({e}): send it to another file");
            std::process::exit(1);
        }
    }
}

/// A duration in seconds on the command line: positive and finite.
///
/// # Errors
/// One sentence.
pub fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s <= 1e7 => Ok(s),
        _ => Err(format!("'{text}' is not a duration; write seconds, for example 2.5")),
    }
}

fn hertz(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if rate > 0.0 && rate <= 1e6 => Ok(rate),
        _ => Err(format!("'{text}' is not a rate; write Hz, for example 1000")),
    }
}

/// Any failure, as one sentence.
pub type Failure = Box<dyn std::error::Error + Send + Sync>;

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
        let settings = RunSettings {
            rate: self.rate,
            seconds: self.seconds,
            log: self.log,
            thread,
            strict: self.strict,
            ..RunSettings::default()
        };
        let stop = Stop::on_signals()?;
        let report = run(&settings, &self.snapshot, &RobotName::new(&self.plant)?, &stop)?;
        if self.json {
            say(serde_json::to_string(&report)?);
        } else {
            say(report.to_string().trim_end());
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
    say(format!("state {} B, action {} B, round trip in us:", result.state_bytes, result.action_bytes));
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
    let (late, warnings) = bench_wake(1.0 / rate, (rate * seconds) as u64, settings)?;
    for warning in &warnings {
        eprintln!("warning: {warning}");
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
