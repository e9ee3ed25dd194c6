//! `nearl bench soak`: plant and loop in real time under load and hot swaps, with everything the loop promises counted.

mod stretch;

use super::process::{Process, last_json};
use super::{Failure, cores, say};
use crate::allocations::allocations;
use crate::run_folder::write_task;
use clap::Args;
use nearl_runtime::Snapshot;
use nearl_runtime::link::{RobotName, TrainerLink, Verdict, remove_files};
use nearl_runtime::log::replay;
use nearl_runtime::rt::{RunSettings, Stop, ThreadSettings, bench_wake, run};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::thread::{Scope, ScopedJoinHandle, scope, sleep};
use std::time::Duration;
use stretch::{Stretch, Swaps, at_rate, ballast, opposite};

/// The bundled snapshot.
const PANDA: &[u8] = include_bytes!("../../../examples/snapshots/panda-reach.safetensors");

#[derive(Args)]
pub(super) struct Soak {
    /// Snapshot; the bundled Panda if none is given.
    snapshot: Option<PathBuf>,
    /// Duration [s].
    #[arg(long, default_value = "600", value_parser = nearl_runtime::cli::seconds)]
    seconds: f64,
    /// Ticks per second [Hz]; another than the snapshot's changes the plant's and the loop's period.
    #[arg(long)]
    rate: Option<f64>,
    /// Threads that do nothing but take the processor; one a core if not given.
    #[arg(long)]
    hogs: Option<usize>,
    /// Time between two hot swaps [s].
    #[arg(long, default_value = "0.1", value_parser = nearl_runtime::cli::seconds)]
    swap_every: f64,
    /// Weights that travel with each swapped snapshot beside its own [MB].
    #[arg(long, default_value_t = 0)]
    megabytes: usize,
    /// First looks for the highest rate that holds, doubling and halving from the snapshot's, in trials of so many seconds.
    #[arg(long, value_parser = nearl_runtime::cli::seconds)]
    highest: Option<f64>,
    /// Share of ticks that may overrun at a rate that still holds.
    #[arg(long, default_value_t = 1e-3)]
    tolerate: f64,
    /// Another program that measures itself under the same load afterwards and prints JSON, for example a loop in Python.
    #[arg(long)]
    beside: Option<String>,
    /// SCHED_FIFO priority of loop, plant and empty loop; 0 keeps the normal scheduler.
    #[arg(long, default_value_t = 40)]
    priority: i32,
    /// Core of the loop.
    #[arg(long)]
    cpu: Option<usize>,
    /// Folder for snapshot, flight log and report.
    #[arg(long, default_value = "soak")]
    out: PathBuf,
    /// Do not write and replay a flight log (3.2 kB a tick).
    #[arg(long)]
    no_log: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Soak {
    pub(super) fn run(self) -> Result<(), Failure> {
        std::fs::create_dir_all(&self.out)?;
        let snapshot = match &self.snapshot {
            Some(file) => Snapshot::load(file)?,
            None => Snapshot::from_bytes(PANDA)?,
        };
        let own = 1.0 / snapshot.manifest.task.time.dt;
        let (mut rate, mut trials) = (self.rate.unwrap_or(own), Vec::new());
        if let Some(seconds) = self.highest {
            rate = self.search(&snapshot, own, seconds, &mut trials)?;
        }
        let stop = Stop::on_signals()?;
        let stretch = self.stretch(&snapshot, rate, self.seconds, !self.no_log, &stop)?;
        let beside = self.beside.as_deref().map(|command| self.under_load(command)).transpose()?;
        let report = json!({
            "hogs": self.hogs(), "cores": cores(), "trials": trials, "soak": stretch.json(), "beside": beside,
            "kept": stretch.kept(),
        });
        std::fs::write(self.out.join("soak.json"), serde_json::to_string_pretty(&report)?)?;
        if self.json {
            say(serde_json::to_string_pretty(&report)?);
        } else {
            stretch.print();
            if let Some(beside) = &beside {
                say(format!("  beside           {beside}"));
            }
            trials.iter().for_each(|t| say(format!("  trial            {t}")));
        }
        let broken = stretch.broken();
        if broken.is_empty() { Ok(()) } else { Err(broken.join("; ").into()) }
    }

    fn hogs(&self) -> usize {
        self.hogs.unwrap_or(cores())
    }

    /// Doubles the rate while it holds, halves it while it does not, then closes in to a tenth.
    fn search(
        &self,
        snapshot: &Snapshot,
        own: f64,
        seconds: f64,
        trials: &mut Vec<Value>,
    ) -> Result<f64, Failure> {
        let mut holds = |rate: f64| -> Result<bool, Failure> {
            let s = self.stretch(snapshot, rate, seconds, false, &Stop::new())?;
            let share = s.late_share();
            let holds = share <= self.tolerate && s.broken().is_empty();
            trials.push(json!({ "rate_hz": rate, "late_share": share, "holds": holds }));
            Ok(holds)
        };
        let (mut low, mut high) = (own, own);
        if holds(own)? {
            loop {
                high *= 2.0;
                if high > 50_000.0 || !holds(high)? {
                    break;
                }
                low = high;
            }
        } else {
            loop {
                low *= 0.5;
                if low < 10.0 {
                    return Err("not even 10 Hz hold: free the processor, or raise --tolerate".into());
                }
                if holds(low)? {
                    break;
                }
                high = low;
            }
        }
        while high > 1.1 * low {
            let middle = (0.5 * (low + high) / 50.0).round() * 50.0;
            if middle <= low || middle >= high {
                break;
            }
            *(if holds(middle)? { &mut low } else { &mut high }) = middle;
        }
        Ok(low)
    }

    fn stretch(
        &self,
        snapshot: &Snapshot,
        rate: f64,
        seconds: f64,
        logs: bool,
        stop: &Stop,
    ) -> Result<Stretch, Failure> {
        let snapshot = at_rate(snapshot, rate)?;
        let name = RobotName::new(&format!("soak-{}", std::process::id()))?;
        let file = self.out.join("soak.safetensors");
        snapshot.save(&file)?;
        let task = write_task(&self.out, "soak", &snapshot.manifest)?;
        let log = self.out.join("soak.mcap");
        let _ = std::fs::remove_file(&log);
        let (task, priority) = (task.display().to_string(), self.priority.to_string());
        let mut plant = vec!["plant", &task, "--name", name.as_str(), "--endless", "--json"];
        if self.priority > 0 {
            plant.extend(["--priority", &priority]);
        }
        let plant = Process::nearl(&plant)?;
        let over = Stop::new();
        let thread = ThreadSettings {
            priority: (self.priority > 0).then_some(self.priority),
            cpu: self.cpu,
            lock_memory: true,
        };
        let settings = RunSettings {
            seconds: Some(seconds),
            patience: 30.0,
            thread,
            log: logs.then(|| log.clone()),
            allocations: Some(allocations),
            ..RunSettings::default()
        };
        let (run, swaps, empty) = scope(|scope| {
            hogs(scope, self.hogs(), &over);
            let swaps = self.swapper(scope, &name, &snapshot, &over);
            let empty = scope.spawn(|| bench_wake(1.0 / rate, (rate * seconds) as u64, thread, &over));
            let run = run(&settings, &file, &name, stop);
            over.request();
            (run, swaps.join(), empty.join())
        });
        let (plant, run) = (plant.stop().json()?, run?);
        remove_files(&name);
        let panicked = |what: &str| -> Failure { format!("the thread of the {what} panicked").into() };
        let swaps = swaps.map_err(|_| panicked("swaps"))??;
        let (empty, _) = empty.map_err(|_| panicked("empty loop"))??;
        let replay = match logs {
            true => serde_json::to_value(replay(&log)?)?,
            false => Value::Null,
        };
        Ok(Stretch { rate, run, plant, empty: serde_json::to_value(empty)?, swaps, replay })
    }

    /// Pushes two policies in turns.
    fn swapper<'scope, 'env>(
        &'env self,
        scope: &'scope Scope<'scope, 'env>,
        name: &RobotName,
        snapshot: &Snapshot,
        over: &Stop,
    ) -> ScopedJoinHandle<'scope, Result<Swaps, Failure>> {
        let (name, over, mut snapshot) = (name.clone(), over.clone(), snapshot.clone());
        scope.spawn(move || {
            let mut link = TrainerLink::open(&name)?;
            link.wait_for_runtime(Duration::from_secs(30))?;
            snapshot.networks.idm = (self.megabytes > 0).then(|| ballast(self.megabytes));
            let bytes = [snapshot.to_bytes(), opposite(&snapshot).to_bytes()];
            let mut swaps = Swaps::default();
            let mut version = snapshot.manifest.version;
            while !over.is_requested() {
                version += 1;
                link.push(version, &bytes[version as usize % 2])?;
                swaps.pushed += 1;
                sleep(Duration::from_secs_f64(self.swap_every));
                for receipt in std::iter::from_fn(|| link.receipt()) {
                    match receipt.verdict() {
                        Verdict::Accepted => swaps.accepted += 1,
                        Verdict::Superseded => swaps.superseded += 1,
                        _ => swaps.others.push(receipt.text()),
                    }
                }
            }
            Ok(swaps)
        })
    }

    /// Runs `command` with the same load and reads the JSON object it prints last.
    fn under_load(&self, command: &str) -> Result<Value, Failure> {
        let over = Stop::new();
        let output = scope(|scope| {
            hogs(scope, self.hogs(), &over);
            let output = Command::new("sh").args(["-c", command]).stderr(Stdio::inherit()).output();
            over.request();
            output
        })?;
        last_json(&output.stdout).ok_or_else(|| {
            format!("'{command}' printed no JSON object ({}): see --beside", output.status).into()
        })
    }
}

/// Threads that count until it is over.
fn hogs<'scope>(scope: &'scope Scope<'scope, '_>, count: usize, over: &Stop) {
    for _ in 0..count {
        let over = over.clone();
        scope.spawn(move || {
            let mut n = 0_u64;
            while !over.is_requested() {
                n = std::hint::black_box(n + 1);
            }
        });
    }
}
