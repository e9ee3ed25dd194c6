//! `nearl demo`: plant and runtime as two processes over shared memory, a hot swap while they run, and the report.

use super::process::Process;
use super::python::Python;
use super::{Failure, say};
use crate::evaluate::evaluate;
use crate::run_folder::{self, write_task};
use clap::Args;
use nearl_runtime::Snapshot;
use nearl_runtime::link::{RobotName, TrainerLink, Verdict, remove_files};
use serde_json::{Value, json};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The bundled snapshot: Panda-reach, trained with the command in `examples/snapshots/README.md`.
const PANDA: &[u8] = include_bytes!("../../../examples/snapshots/panda-reach.safetensors");

#[derive(Args)]
pub(super) struct Demo {
    /// Run folders or snapshots to show beside the bundled Panda.
    #[arg(long = "run", value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// Folder for logs, summary and report.
    #[arg(long, default_value = "demo")]
    out: PathBuf,
    /// Seconds each robot runs.
    #[arg(long, default_value = "10", value_parser = nearl_runtime::cli::seconds)]
    seconds: f64,
    /// Python that draws the report; by default that of the package this command came with, else `.venv/bin/python`, else `python3`.
    #[arg(long)]
    python: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Demo {
    pub(super) fn run(self) -> Result<(), Failure> {
        std::fs::create_dir_all(&self.out)?;
        let bundled = self.out.join("panda-reach.safetensors");
        std::fs::write(&bundled, PANDA)?;
        let mut snapshots =
            self.runs.iter().map(|r| run_folder::snapshot_of(r)).collect::<Result<Vec<_>, _>>()?;
        snapshots.push(bundled);
        let shows = snapshots.iter().map(|s| self.show(s)).collect::<Result<Vec<_>, _>>()?;
        let summary = self.out.join("summary.json");
        std::fs::write(&summary, serde_json::to_string_pretty(&shows)?)?;
        if self.json {
            say(serde_json::to_string_pretty(&shows)?);
        } else {
            table(&shows);
        }
        let report = self.report(&summary, &shows)?;
        if !self.json {
            say(format!("report {}", report.display()));
        }
        Ok(())
    }

    /// One robot: plant, runtime, a swap in the middle, and an evaluation raw against projected.
    fn show(&self, path: &Path) -> Result<Value, Failure> {
        let snapshot = Snapshot::load(path)?;
        let task = &snapshot.manifest.task.name;
        let name = format!("demo-{}", std::process::id());
        let log = self.out.join(format!("{task}.mcap"));
        let _ = std::fs::remove_file(&log);
        let task_file = write_task(&self.out, task, &snapshot.manifest)?;
        let text = |p: &Path| p.display().to_string();
        let plant = Process::nearl(&["plant", &text(&task_file), "--name", &name, "--json"])?;
        let seconds = self.seconds.to_string();
        let run =
            ["run", &text(path), "--plant", &name, "--seconds", &seconds, "--log", &text(&log), "--json"];
        let runtime = Process::nearl(&run)?;
        let swap = self.swap(&name, &snapshot);
        let report = runtime.json()?;
        let plant = plant.stop().json()?;
        remove_files(&RobotName::new(&name)?);
        let modes = [true, false].map(|projection| evaluate(&snapshot, 3, 0, projection));
        let [projected, raw] = modes;
        let (projected, raw) = (projected?, raw?);
        Ok(
            json!({ "task": task, "algo": snapshot.manifest.algo, "snapshot": text(path), "log": text(&log), "run": report,
            "plant": plant, "swap": swap?, "evaluation": [projected, raw] }),
        )
    }

    /// Pushes the next version of the same snapshot while the loop runs, then a damaged one, which must be refused.
    fn swap(&self, name: &str, snapshot: &Snapshot) -> Result<Value, Failure> {
        let mut link = TrainerLink::open(&RobotName::new(name)?)?;
        link.wait_for_runtime(Duration::from_secs(10))?;
        std::thread::sleep(Duration::from_secs_f64(self.seconds * 0.4));
        let mut next = snapshot.clone();
        next.manifest.version += 1;
        let bytes = next.to_bytes();
        let mut damaged = bytes.clone();
        let last = damaged.len() - 1;
        damaged[last] ^= 1;
        let mut receipts = Vec::new();
        for (version, bytes) in [(next.manifest.version, &bytes), (next.manifest.version + 1, &damaged)] {
            link.push(version, bytes)?;
            let receipt = link.wait_for_receipt(version, Duration::from_secs(10))?;
            receipts.push(json!({ "version": version, "accepted": receipt.verdict() == Verdict::Accepted,
                "verdict": format!("{:?}", receipt.verdict()), "text": receipt.text() }));
        }
        Ok(json!(receipts))
    }

    fn report(&self, summary: &Path, shows: &[Value]) -> Result<PathBuf, Failure> {
        let out = self.out.join("report.html");
        let mut arguments: Vec<OsString> =
            ["--summary".into(), summary.into(), "--out".into(), out.clone().into()].into();
        for run in self.runs.iter().filter(|r| r.is_dir()) {
            arguments.extend(["--run".into(), run.into()]);
        }
        for log in shows.iter().filter_map(|s| s["log"].as_str()) {
            arguments.extend(["--log".into(), log.into()]);
        }
        Python::of(self.python.as_deref()).module("nearl.report", &arguments)?;
        Ok(out)
    }
}

fn table(shows: &[Value]) {
    say(
        "                         limits broken, share of ticks                update [us]       wake-up [us]    of all ticks",
    );
    say(
        "task             return  raw     target  robot   robot, no projection   p50     p99       p50      p99   overrun  late",
    );
    for s in shows {
        let run = &s["run"];
        let us = |v: &Value| v.as_f64().unwrap_or(f64::NAN) / 1e3;
        let count = |v: &Value| v.as_u64().unwrap_or(0);
        let share = |e: &Value, key: &str| {
            format!(
                "{:.2}%",
                100.0 * e[key].as_f64().unwrap_or(f64::NAN) / e["ticks"].as_f64().unwrap_or(f64::NAN)
            )
        };
        let (projected, raw) = (&s["evaluation"][0], &s["evaluation"][1]);
        let returns: Vec<f64> =
            projected["returns"].as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
        say(format!(
            "{:<15}{:>8.1}  {:<8}{:<8}{:<8}{:<21}{:>5.1}{:>8.1}{:>10.1}{:>9.1}{:>10}{:>6}",
            s["task"].as_str().unwrap_or(""),
            returns.iter().sum::<f64>() / returns.len().max(1) as f64,
            share(projected, "raw_violations"),
            share(projected, "target_violations"),
            share(projected, "reached_violations"),
            share(raw, "reached_violations"),
            us(&run["compute"]["p50"]),
            us(&run["compute"]["p99"]),
            us(&run["wake"]["p50"]),
            us(&run["wake"]["p99"]),
            count(&run["counters"]["overruns"]),
            count(&s["plant"]["report"]["late"]),
        ));
        for r in s["swap"].as_array().into_iter().flatten() {
            let what = if r["accepted"] == true { "swapped in" } else { "refused" };
            say(format!(
                "  version {} {what} while running: {}",
                r["version"],
                r["text"].as_str().unwrap_or("")
            ));
        }
    }
}
