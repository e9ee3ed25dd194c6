//! `nearl demos`: records demonstrations, and checks files of them.

use super::eval::{SIMULATED, changed};
use super::{Failure, at_least_one, say};
use crate::demos::{Demonstrations, record};
use crate::{env, run_folder, tasks, train};
use clap::{Args, Subcommand};
use nearl_runtime::Snapshot;
use std::path::PathBuf;

#[derive(Subcommand)]
pub(super) enum Demos {
    /// Write episodes of a run's policy, without noise, as demonstrations.
    Record(Record),
    /// Say what a file of demonstrations holds, and whether it is of a task.
    Check(Check),
}

#[derive(Args)]
pub(super) struct Record {
    /// Run folder or snapshot file.
    run: PathBuf,
    /// File to write; one that is there is never replaced.
    #[arg(long, default_value = "demos.npz")]
    out: PathBuf,
    /// Episodes.
    #[arg(long, default_value = "10", value_parser = at_least_one)]
    episodes: usize,
    /// Seed of the resets.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Other limits than those of the run, or another robot: `constraints.guard="simulator"`, `random.mass=1.2`.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Keep only episodes of at least this return.
    #[arg(long, value_name = "RETURN", allow_negative_numbers = true)]
    at_least: Option<f64>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
pub(super) struct Check {
    /// Demonstrations (.npz).
    file: PathBuf,
    /// Task whose states they should be.
    #[arg(long)]
    task: Option<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Demos {
    pub(super) fn run(self) -> Result<(), Failure> {
        match self {
            Self::Record(c) => c.run(),
            Self::Check(c) => c.run(),
        }
    }
}

impl Record {
    fn run(self) -> Result<(), Failure> {
        if self.out.exists() {
            let out = self.out.display();
            return Err(format!("'{out}' is there already, and may be the only one of its demonstrations; give another file with --out, or remove it").into());
        }
        let file = run_folder::snapshot_of(&self.run)?;
        let mut snapshot = Snapshot::load(&file).map_err(|e| format!("{}: {e}", file.display()))?;
        let sections = [&SIMULATED[..], &["constraints"]].concat();
        changed(&mut snapshot, &self.set, &sections, "recording changes limits and what is simulated")?;
        let (mut demos, mut returns) = record(&snapshot, self.episodes, self.seed)?;
        if let Some(least) = self.at_least {
            let best = returns.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let mut kept = returns.iter().map(|total| *total >= least);
            demos.episodes.retain(|_| kept.next().unwrap_or_default());
            returns.retain(|total| *total >= least);
            if returns.is_empty() {
                let (out, n) = (self.out.display(), self.episodes);
                return Err(format!("--at-least {least}: the best of {n} episodes has {best:.1}, and '{out}' was not written; ask for less").into());
            }
        }
        demos.save(&self.out)?;
        let task = &snapshot.manifest.task;
        let drawn = [("random", &task.random), ("pushes", &task.pushes), ("delay", &task.delay)];
        for (section, _) in drawn.into_iter().filter(|(_, table)| !table.is_empty()) {
            nearl_runtime::tell!(
                "nearl: warning: [{section}] draws something of its own in each episode, and '{}' does not say what: only with that do the \
                 actions lead from one recorded state to the next; to learn from the actions, record with --set '{section}={{}}'",
                self.out.display()
            );
        }
        let mean = returns.iter().sum::<f64>() / returns.len() as f64;
        let (out, lengths) =
            (self.out.display(), demos.episodes.iter().map(|e| e.length).collect::<Vec<_>>());
        if self.json {
            say(serde_json::json!({ "file": self.out, "returns": returns, "lengths": lengths }));
        } else {
            let steps: usize = lengths.iter().sum();
            say(format!("{out}: {} episodes, {steps} steps, return {mean:.1}", lengths.len()));
        }
        Ok(())
    }
}

impl Check {
    fn run(self) -> Result<(), Failure> {
        let demos = Demonstrations::load(&self.file)?;
        if let Some(task) = &self.task {
            let mut manifest = tasks::load(task, &[])?;
            let mut env = env::of_task(&manifest, task)?;
            let period = manifest.task.time.dt * manifest.task.time.policy_every as f64;
            demos
                .check(&mut *env, period)
                .map_err(|e| format!("demonstrations '{}': {e}", self.file.display()))?;
            train::complete(&mut manifest)?;
            for line in train::demonstrated(&demos, &manifest)? {
                nearl_runtime::tell!("nearl: warning: {line}");
            }
        }
        let lengths: Vec<usize> = demos.episodes.iter().map(|e| e.length).collect();
        let actions = demos.episodes.iter().all(|e| !e.actions.is_empty());
        if self.json {
            say(
                serde_json::json!({ "file": self.file, "names": demos.names, "dt": demos.dt, "lengths": lengths, "actions": actions }),
            );
        } else {
            let (n, steps, with) =
                (lengths.len(), lengths.iter().sum::<usize>(), if actions { "with" } else { "without" });
            say(format!(
                "{}: {n} episodes, {steps} steps of {} s, {with} actions",
                self.file.display(),
                demos.dt
            ));
            say(demos.names.join(" "));
        }
        Ok(())
    }
}
