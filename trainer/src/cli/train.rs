//! `nearl train`.

use super::{Failure, cores, say};
use crate::train::{Progress, Request, train};
use crate::{run_folder, tasks};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

#[derive(Args)]
pub(super) struct Train {
    /// Task name (see `nearl tasks`) or TOML file.
    task: String,
    /// Algorithm: ppo, pid2-gan or pid2-ib.
    #[arg(long, default_value = "pid2-ib")]
    algo: String,
    /// Environment steps; 1_000_000 and 1e6 are both read.
    #[arg(long, default_value = "1000000", value_parser = steps)]
    steps: u64,
    /// Seed of everything random; the same seed gives the same weights.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Run folder; `runs/<task>/<algo>_<seed>` when absent.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Threads; all cores when absent. The result does not depend on it.
    #[arg(long)]
    threads: Option<usize>,
    /// Overrides of the task file, e.g. `constraints.velocity.scale=0.8`.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print one JSON object an iteration instead of a progress bar.
    #[arg(long)]
    json: bool,
}

pub(super) fn steps(text: &str) -> Result<u64, String> {
    let clean = text.replace('_', "");
    match clean.parse::<f64>() {
        Ok(n) if n >= 1.0 && n.fract() == 0.0 && n < 1e15 => Ok(n as u64),
        _ => Err(format!("'{text}' is not a number of steps; write 1000000 or 1e6")),
    }
}

impl Train {
    pub(super) fn run(self) -> Result<(), Failure> {
        let mut manifest = tasks::load(&self.task, &self.set)?;
        crate::train::complete(&mut manifest)?;
        let name = manifest.task.name.clone();
        let out =
            self.out.unwrap_or_else(|| PathBuf::from(format!("runs/{name}/{}_{}", self.algo, self.seed)));
        let request = Request {
            manifest,
            algo: self.algo,
            steps: self.steps,
            seed: self.seed,
            threads: self.threads.unwrap_or_else(cores),
        };
        let stop = Arc::new(AtomicBool::new(false));
        for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
            // the second signal ends the program at once
            signal_hook::flag::register_conditional_shutdown(signal, 1, Arc::clone(&stop))?;
            signal_hook::flag::register(signal, Arc::clone(&stop))?;
        }
        let bar = bar(self.json, request.steps);
        let mut last = None;
        let saved = train(&request, &out, |p, _| {
            show(&bar, self.json, p);
            last = Some((p.steps, p.seconds, p.return_mean));
            !stop.load(Ordering::Relaxed)
        })?;
        bar.finish_and_clear();
        let (steps, seconds, mean) = last.unwrap_or((0, 0.0, f64::NAN));
        if self.json {
            say(
                serde_json::json!({ "run": out, "snapshot": saved, "steps": steps, "seconds": seconds, "return": mean }),
            );
        } else {
            say(format!(
                "{name} {}: return {mean:.0} (mean of the last 100 episodes) after {steps} steps in {seconds:.0} s, {:.0} steps/s",
                request.algo,
                steps as f64 / seconds
            ));
            say(format!(
                "run folder {}, snapshot {}",
                out.display(),
                run_folder::snapshot_of(&out)?.display()
            ));
        }
        if stop.load(Ordering::Relaxed) && steps < request.steps {
            say(format!(
                "stopped by a signal after {steps} of {} steps; what was learned is saved",
                request.steps
            ));
        }
        Ok(())
    }
}

/// A bar on a terminal; nothing into a pipe.
fn bar(json: bool, steps: u64) -> ProgressBar {
    let bar = if json { ProgressBar::hidden() } else { ProgressBar::new(steps) };
    let style = ProgressStyle::with_template(
        "{bar:30} {percent:>3}% {human_pos}/{human_len} steps  {msg}  {eta} left",
    );
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}

fn show(bar: &ProgressBar, json: bool, p: &Progress) {
    if json {
        let t = &p.tally;
        let numbers: serde_json::Map<_, _> =
            p.metrics.iter().map(|(k, v)| ((*k).to_string(), serde_json::json!(v))).collect();
        say(serde_json::json!({ "steps": p.steps, "seconds": p.seconds, "return": p.return_mean,
            "raw_violations": t.raw_violations, "target_violations": t.projected_violations, "ticks": t.ticks, "metrics": numbers }));
        return;
    }
    bar.set_position(p.steps.min(bar.length().unwrap_or(0)));
    bar.set_message(format!("return {:.0}  {:.0} steps/s", p.return_mean, p.steps as f64 / p.seconds));
}
