//! `nearl-runtime`: what a robot needs, without MuJoCo and Python.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use nearl_runtime::link::{RobotName, bench_round_trip};
use nearl_runtime::rt::{Percentiles, RunSettings, Stop, ThreadSettings, bench_wake, run};

#[derive(Parser)]
#[command(name = "nearl-runtime", version, about = "NEARL's real-time loop")]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Run a snapshot on a plant in real time.
    Run {
        /// Snapshot file.
        snapshot: PathBuf,
        /// Name of the plant.
        #[arg(long)]
        plant: String,
        /// Keep own time at this rate instead of following the plant [Hz]; must be the plant's.
        #[arg(long)]
        rate: Option<f64>,
        /// Stop after so many seconds of ticks.
        #[arg(long)]
        seconds: Option<f64>,
        /// Flight log (MCAP).
        #[arg(long)]
        log: Option<PathBuf>,
        /// SCHED_FIFO priority; 0 keeps the normal scheduler.
        #[arg(long, default_value_t = 40)]
        priority: i32,
        /// Core to stay on.
        #[arg(long)]
        cpu: Option<usize>,
        /// A priority, core or memory lock that is refused is an error.
        #[arg(long)]
        strict: bool,
        /// Print the report as JSON.
        #[arg(long)]
        json: bool,
    },
    /// Measure this machine: shared-memory round trip, or wake-up of an empty loop.
    Bench {
        #[command(subcommand)]
        what: Bench,
    },
}

#[derive(Subcommand)]
enum Bench {
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

fn main() -> ExitCode {
    let result = match Arguments::parse().command {
        Command::Run { snapshot, plant, rate, seconds, log, priority, cpu, strict, json } => {
            let thread =
                ThreadSettings { priority: (priority > 0).then_some(priority), cpu, lock_memory: true };
            let settings = RunSettings { rate, seconds, log, thread, strict, ..RunSettings::default() };
            execute(&settings, &snapshot, &plant, json)
        }
        Command::Bench { what: Bench::Link { count, json } } => link(count, json),
        Command::Bench { what: Bench::Loop { rate, seconds, priority, cpu, json } } => {
            wake(rate, seconds, priority, cpu, json)
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

type Failure = Box<dyn std::error::Error>;

fn execute(settings: &RunSettings, snapshot: &Path, plant: &str, json: bool) -> Result<(), Failure> {
    let stop = Stop::on_signals()?;
    let report = run(settings, snapshot, &RobotName::new(plant)?, &stop)?;
    if json {
        println!("{}", serde_json::to_string(&report)?);
        return Ok(());
    }
    print!("{report}");
    Ok(())
}

fn link(count: u64, json: bool) -> Result<(), Failure> {
    let name = RobotName::new(&format!("bench{}", std::process::id()))?;
    let result = bench_round_trip(&name, count)?;
    if json {
        println!("{}", serde_json::to_string(&result)?);
        return Ok(());
    }
    println!("state {} B, action {} B, round trip in us:", result.state_bytes, result.action_bytes);
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
        println!("{}", serde_json::json!({ "rate_hz": rate, "wake_ns": late, "warnings": warnings }));
        return Ok(());
    }
    println!("empty loop at {rate} Hz, wake-up after the slot in us:");
    line("wake-up", &late);
    Ok(())
}

fn line(name: &str, percentiles: &Percentiles) {
    println!("  {name:<16} {percentiles}");
}
