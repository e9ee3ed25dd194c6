//! `nearl serve`: constrained rollouts for other processes.

use super::{Failure, at_least_one, cores, say};
use crate::run_folder;
use crate::serve::{Settings, serve};
use clap::Args;
use nearl_runtime::Snapshot;
use nearl_runtime::link::RobotName;
use nearl_runtime::rt::Stop;
use std::io::Write;
use std::path::PathBuf;
use std::time::Duration;

#[derive(Args)]
pub(super) struct Serve {
    /// Snapshot file or run folder.
    snapshot: PathBuf,
    /// Name of the server; clients say the same.
    #[arg(long)]
    name: String,
    /// Threads that simulate; all cores if not given.
    #[arg(long, value_parser = at_least_one)]
    threads: Option<usize>,
    /// Requests under way at once; further ones are answered busy.
    #[arg(long, default_value_t = 16)]
    requests: usize,
    /// Policy steps of one request at most, and of all trainings together.
    #[arg(long, default_value_t = 1_000_000)]
    max_steps: u64,
    /// Environments at most that are kept for all clients that learn (`nearl train TASK --collect NAME`).
    #[arg(long, default_value_t = 256)]
    max_envs: u64,
    /// A client that takes nothing for so long loses its place [s].
    #[arg(long, default_value_t = 60.0, value_parser = nearl_runtime::cli::seconds)]
    patience: f64,
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

impl Serve {
    pub(super) fn run(self) -> Result<(), Failure> {
        let file = run_folder::snapshot_of(&self.snapshot)?;
        let snapshot = Snapshot::load(&file).map_err(|e| format!("{}: {e}", file.display()))?;
        let name = RobotName::new(&self.name)?;
        let settings = Settings {
            threads: self.threads.unwrap_or_else(cores),
            requests: self.requests,
            max_steps: self.max_steps,
            max_envs: self.max_envs,
            patience: Duration::from_secs_f64(self.patience),
        };
        let stop = Stop::on_signals()?;
        let begin = || {
            if !self.json {
                // A closed output is no reason not to serve.
                let task = &snapshot.manifest.task.name;
                let _ = writeln!(
                    std::io::stdout(),
                    "{task} as '{name}', policy version {}; Ctrl-C ends it",
                    snapshot.manifest.version
                );
            }
        };
        let report = serve(&snapshot, &name, &settings, &stop, begin)?;
        if self.json {
            say(serde_json::to_string(&report)?);
        } else {
            say(format!(
                "{} requests, {} steps; {} done, {} cancelled, {} busy, {} over a limit, {} malformed, {} clients gone, {} failed",
                report.requests,
                report.steps,
                report.done,
                report.cancelled,
                report.busy,
                report.limit,
                report.malformed,
                report.gone,
                report.failed
            ));
        }
        Ok(())
    }
}
