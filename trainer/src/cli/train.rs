//! `nearl train`: begins a training, or goes on with one.

use super::python::Python;
use super::{Failure, at_least_one, cores, of_file, say, unstable};
use crate::checkpoint::{self, Checkpoint};
use crate::learn::Algorithm;
use crate::online::PATIENCE as LOOP_PATIENCE;
use crate::preset::Preset;
use crate::train::{Experience, Progress, Request, SERVER_PATIENCE, Training, resume_on, train_in, train_on};
use crate::{run_folder, tasks};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use nearl_runtime::link::RobotName;
use nearl_runtime::{Manifest, Task};
use std::collections::BTreeSet;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

#[derive(Args)]
pub(super) struct Train {
    /// Task name (see `nearl tasks`) or TOML file.
    task: String,
    #[arg(long, default_value = "pid2-ib", conflicts_with = "resume", help = one_of())]
    algo: String,
    /// Environment steps, one a decision of the policy; 1_000_000, 1e6, 200k and 1M are read. 1e6 when absent, with --resume what the run was started with.
    #[arg(long, value_parser = steps)]
    steps: Option<u64>,
    /// Seed of everything random; the same seed gives the same weights.
    #[arg(long, default_value_t = 0, conflicts_with = "resume")]
    seed: u64,
    /// Run folder; `runs/<task>/<algo>_<seed>` when absent.
    #[arg(long, conflicts_with = "resume")]
    out: Option<PathBuf>,
    /// Go on with the run in this folder, with the settings it was started with: the result is the same, bit for bit, as
    /// if it had never stopped.
    #[arg(long, value_name = "DIR")]
    resume: Option<PathBuf>,
    /// Start from the networks of the run in this folder, of the same or another algorithm, task or limits: what they read and put out, and
    /// their sizes, must be the same. Optimisers and schedules begin anew.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["resume", "demos"])]
    start_from: Option<PathBuf>,
    /// Learn from the running loop of this robot instead of environments of one's own, and push snapshots back while it runs:
    /// `nearl plant TASK --name NAME`, then `nearl run SNAPSHOT --plant NAME --explore SEED`.
    #[arg(long, value_name = "NAME")]
    from: Option<String>,
    /// Collect in the rollout server of this name (`nearl serve SNAPSHOT --name NAME`), which must serve the same task; a seed gives
    /// the same weights as without.
    #[arg(long, value_name = "NAME", conflicts_with = "from")]
    collect: Option<String>,
    /// Threads; all cores when absent. The result does not depend on it.
    #[arg(long, value_parser = at_least_one)]
    threads: Option<usize>,
    #[arg(long, value_name = "FILE", conflicts_with = "resume", help = demonstrations())]
    demos: Option<PathBuf>,
    #[arg(long, conflicts_with = "resume", help = one_preset())]
    preset: Option<Preset>,
    /// Overrides of the task file, e.g. `constraints.velocity.limit=12`.
    #[arg(long = "set", value_name = "KEY=VALUE", conflicts_with = "resume")]
    set: Vec<String>,
    /// Print one JSON object an iteration instead of a progress bar.
    #[arg(long)]
    json: bool,
    /// At the end, write ten seconds of the policy without exploration as `video.mp4` of the run folder. The Python package does it:
    /// pip install 'nearl[video]'.
    #[arg(long)]
    video: bool,
}

/// Simulated time of a video [s].
const VIDEO: &str = "10";

/// What `--preset` may be.
pub(super) fn one_preset() -> String {
    format!("Settings by name, before those of --set: {}", Preset::names())
}

/// What `--demos` is for.
pub(super) fn demonstrations() -> String {
    format!("Demonstrations (.npz) for {}; 'nearl demos record RUN' writes some", Algorithm::imitating())
}

/// `--demos` and `--set` as overrides of the task file.
///
/// # Errors
/// A path that is no text.
pub(super) fn overrides(demos: Option<&Path>, set: &[String]) -> Result<Vec<String>, Failure> {
    let mut all = set.to_vec();
    if let Some(file) = demos {
        let path = std::path::absolute(file)?;
        let path = path.to_str().ok_or_else(|| format!("--demos: '{}' is no text", path.display()))?;
        all.push(format!("train.demos.file={}", toml::Value::String(path.to_string())));
    }
    Ok(all)
}

/// What `--algo` may be.
pub(super) fn one_of() -> String {
    format!("Algorithm: {}", Algorithm::names())
}

pub(super) fn steps(text: &str) -> Result<u64, String> {
    let clean = text.replace('_', "");
    let units = [("k", 1e3), ("K", 1e3), ("M", 1e6)];
    let with_unit = |(unit, factor): &(&str, f64)| Some((clean.strip_suffix(unit)?, *factor));
    let (digits, factor) = units.iter().find_map(with_unit).unwrap_or((&clean, 1.0));
    match digits.parse::<f64>().map(|n| n * factor) {
        Ok(n) if n >= 1.0 && n.fract() == 0.0 && n < 1e15 => Ok(n as u64),
        _ => Err(format!("'{text}' is not a number of steps; write 1000000, 1e6, 200k or 1M")),
    }
}

/// Steps of a training that does not say.
const STEPS: u64 = 1_000_000;

/// What is told about a run.
struct Run {
    name: String,
    algo: Algorithm,
    steps: u64,
    done: u64,
    /// It has no warm-up.
    starts_warm: bool,
}

impl Run {
    /// What the checkpoint in `folder` says, and what it goes on with; it must be of the task of `own`, which was read of `file`.
    fn resumed(
        folder: &Path,
        own: &Manifest,
        file: &str,
        steps: Option<u64>,
    ) -> Result<(Self, Manifest), Failure> {
        let (header, task) = (Checkpoint::load(&checkpoint::path_in(folder))?.header, &own.task);
        let name = header.manifest.task.name.clone();
        if name != task.name {
            let folder = folder.display();
            return Err(format!(
                "run '{folder}' trains '{name}', not '{}'; write 'nearl train {folder}/task.toml --resume {folder}'",
                task.name
            )
            .into());
        }
        // a bundled name says nothing of what --preset and --set were
        let others = others(&header.manifest.task, task);
        if !others.is_empty() && Path::new(file).is_file() {
            let keys = others.join(", ");
            nearl_runtime::tell!(
                "nearl: warning: the run goes on with the settings it was started with; '{file}' by itself has others under {keys}: if the \
                 file was changed since, and none of --set, --preset and --demos set these, start a new run with --out"
            );
        }
        if !run_folder::is_same_robot(&header.manifest, own) {
            nearl_runtime::tell!(
                "nearl: warning: the run goes on with the robot it was started with, and the robot file of '{file}' is another, or was changed \
                 since; start a new run with --out for that"
            );
        }
        let (algo, done) = (header.manifest.algo.parse()?, header.manifest.steps);
        let (steps, starts_warm) = (steps.unwrap_or(header.total), header.starts_warm);
        Ok((Self { name, algo, steps, done, starts_warm }, header.manifest))
    }
}

/// The keys under which two tasks differ; not the robot file, which a run folder has under its own name.
fn others(a: &Task, b: &Task) -> Vec<String> {
    fn walk(a: &toml::Table, b: &toml::Table, at: &str, found: &mut Vec<String>) {
        let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
        for key in keys {
            let path = format!("{at}{key}");
            match (a.get(key), b.get(key)) {
                (Some(toml::Value::Table(a)), Some(toml::Value::Table(b))) => {
                    walk(a, b, &format!("{path}."), found)
                }
                (a, b) if a != b => found.push(path),
                _ => {}
            }
        }
    }
    let [a, b] = [a, b].map(|task| {
        let mut table =
            toml::Table::try_from(task).unwrap_or_else(|e| unreachable!("it was read from TOML: {e}"));
        table.remove("model");
        table
    });
    let mut found = Vec::new();
    walk(&a, &b, "", &mut found);
    found
}

impl Train {
    pub(super) fn run(self) -> Result<(), Failure> {
        let set = overrides(self.demos.as_deref(), &self.set)?;
        let mut manifest = tasks::load_with(&self.task, self.preset, &set)?;
        crate::train::complete(&mut manifest).map_err(|e| of_file(&self.task, &e))?;
        let (run, manifest) = match &self.resume {
            Some(folder) => Run::resumed(folder, &manifest, &self.task, self.steps)?,
            None => {
                let run = Run {
                    name: manifest.task.name.clone(),
                    algo: self.algo.parse()?,
                    steps: self.steps.unwrap_or(STEPS),
                    done: 0,
                    starts_warm: self.start_from.is_some(),
                };
                (run, manifest)
            }
        };
        let out = self
            .resume
            .clone()
            .or_else(|| self.out.clone())
            .unwrap_or_else(|| PathBuf::from(format!("runs/{}/{}_{}", run.name, run.algo, self.seed)));
        let threads = self.threads.unwrap_or_else(cores);
        let stop = on_signals()?;
        let python = self.video.then(|| Python::of(None));
        if let Some(python) = &python {
            // What is missing is said before hours of training.
            python.module("nearl.video", &["--check"])?;
        }
        let experience = self.experience(&stop)?;
        // Said with the first batch: a training that is refused says why, and nothing else.
        let mut advice = crate::train::advice(run.algo, &manifest)?;
        advice.extend(crate::train::unread(&[run.algo], &set));
        if !run.starts_warm {
            advice.extend(crate::train::ends_in_warm_up(run.algo, run.steps, &manifest)?);
        }
        let bar = bar(self.json, run.steps);
        let (mut last, mut faults, mut lines) = (None, 0, Lines::new(self.json));
        let report = |p: &Progress, _| {
            for line in advice.drain(..) {
                bar.suspend(|| nearl_runtime::tell!("nearl: warning: {line}"));
            }
            show(&bar, self.json, p);
            lines.show(p, run.steps);
            faults += p.tally.faults;
            last = Some(End { steps: p.steps, seconds: p.seconds, mean: p.return_mean });
            !stop.load(Ordering::Relaxed)
        };
        match &experience {
            Experience::Loop(name, _) => {
                nearl_runtime::tell!(
                    "nearl: looking for the loop of '{name}', {} s at most",
                    LOOP_PATIENCE.as_secs()
                );
            }
            Experience::Served(name, _) => {
                let patience = SERVER_PATIENCE.as_secs();
                nearl_runtime::tell!("nearl: looking for the rollout server '{name}', {patience} s at most");
            }
            _ => {}
        }
        let saved = match &self.resume {
            Some(folder) => resume_on(folder, &experience, self.steps, threads, report)?,
            None => {
                let (algo, steps) = (run.algo, run.steps);
                let request = Request { manifest, algo, steps, seed: self.seed, threads };
                match &self.start_from {
                    Some(run) => train_in(&out, Training::start_from(&request, &experience, run)?, report)?,
                    None => train_on(&request, &experience, &out, report)?,
                }
            }
        };
        bar.finish_and_clear();
        if faults > 0 {
            nearl_runtime::tell!("nearl: {}", unstable(faults));
        }
        let stopped = stop.load(Ordering::Relaxed);
        let Some(end) = last else {
            self.tell_nothing(&run, &out, stopped);
            return Ok(());
        };
        let stopped = stopped && end.steps < run.steps;
        self.tell(&run, &out, &saved, &end, stopped)?;
        if let Some(python) = python {
            let video = out.join("video.mp4");
            python.module(
                "nearl.video",
                &[out.as_os_str(), video.as_os_str(), "--seconds".as_ref(), VIDEO.as_ref()],
            )?;
            if !self.json {
                say(format!("video {}", video.display()));
            }
        }
        if stopped && !self.json {
            let (steps, all, task, out) = (end.steps, run.steps, &self.task, out.display());
            say(format!(
                "stopped by a signal after {steps} of {all} steps; go on with 'nearl train {task} --resume {out}'"
            ));
        }
        Ok(())
    }

    fn experience(&self, stop: &Arc<AtomicBool>) -> Result<Experience, Failure> {
        Ok(match (&self.from, &self.collect) {
            (Some(name), _) => Experience::Loop(RobotName::new(name)?, Arc::clone(stop)),
            (None, Some(name)) => Experience::Served(RobotName::new(name)?, Arc::clone(stop)),
            (None, None) => Experience::Here,
        })
    }

    /// Says how a training ended that learned something.
    fn tell(&self, run: &Run, out: &Path, saved: &Path, end: &End, stopped: bool) -> Result<(), Failure> {
        let End { steps, seconds, mean } = *end;
        if self.json {
            say(
                serde_json::json!({ "run": out, "snapshot": saved, "steps": steps, "seconds": seconds, "return": mean,
                "stopped": stopped }),
            );
            return Ok(());
        }
        let (name, algo, speed) = (&run.name, run.algo, steps as f64 / seconds);
        let returned = returned(mean, " (mean of the last 100 episodes)");
        say(format!("{name} {algo}: {returned} after {steps} steps in {seconds:.0} s, {speed:.0} steps/s"));
        say(format!("run folder {}, snapshot {}", out.display(), run_folder::snapshot_of(out)?.display()));
        Ok(())
    }

    /// Says why nothing was learned: a signal came first, or the run had all its steps.
    fn tell_nothing(&self, run: &Run, out: &Path, stopped: bool) {
        let Run { steps, done, .. } = run;
        if self.json {
            say(
                serde_json::json!({ "run": out, "snapshot": null, "steps": done, "seconds": 0.0, "return": null,
                "stopped": stopped }),
            );
        } else if stopped {
            say(format!("stopped by a signal before the first batch; run folder {}", out.display()));
        } else {
            say(format!("{} has {done} of {steps} steps already; give more with --steps", out.display()));
        }
    }
}

/// Becomes true with the first signal to end; the second one ends the program at once.
fn on_signals() -> Result<Arc<AtomicBool>, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in nearl_runtime::stop::ending() {
        signal_hook::flag::register_conditional_shutdown(signal, 1, Arc::clone(&stop))?;
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

/// How far a training came.
struct End {
    steps: u64,
    seconds: f64,
    /// Mean return of the last episodes.
    mean: f64,
}

/// Time between two lines of a training that no bar shows.
const BETWEEN_LINES: Duration = Duration::from_secs(30);

/// A line now and then where there is no terminal, so that a log shows how far the training is.
struct Lines {
    /// When the next is due; `None` where a bar or JSON shows it.
    due: Option<Instant>,
}

impl Lines {
    fn new(json: bool) -> Lines {
        let silent = json || std::io::stderr().is_terminal();
        Lines { due: (!silent).then(|| Instant::now() + BETWEEN_LINES) }
    }

    fn show(&mut self, p: &Progress, steps: u64) {
        let now = Instant::now();
        if self.due.is_some_and(|due| now >= due) {
            self.due = Some(now + BETWEEN_LINES);
            let speed = p.steps as f64 / p.seconds;
            nearl_runtime::tell!(
                "{} of {steps} steps, {}, {speed:.0} steps/s",
                p.steps,
                returned(p.return_mean, "")
            );
        }
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
            "raw_violations": t.raw_violations, "target_violations": t.target_violations, "ticks": t.ticks, "metrics": numbers }));
        return;
    }
    bar.set_position(p.steps.min(bar.length().unwrap_or(0)));
    bar.set_message(format!("{}  {:.0} steps/s", returned(p.return_mean, ""), p.steps as f64 / p.seconds));
}

/// The mean return and `of` what; in words while no episode has ended.
fn returned(mean: f64, of: &str) -> String {
    if mean.is_nan() { "no episode ended".to_owned() } else { format!("return {mean:.0}{of}") }
}

#[cfg(test)]
mod tests {
    use super::{others, steps};
    use crate::tasks;

    #[test]
    fn what_another_task_file_says_is_found_by_its_keys() {
        let of = |set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| (*s).to_string()).collect();
            tasks::load("Hopper-v5", &set).expect("task").task
        };
        assert!(others(&of(&[]), &of(&[])).is_empty());
        let changed = of(&["train.n_envs=3", "constraints.velocity.scale=0.5"]);
        assert_eq!(others(&of(&[]), &changed), ["constraints.velocity.scale", "train.n_envs"]);
    }

    #[test]
    fn steps_are_read_as_people_write_them() {
        let all = ["1000000", "1_000_000", "1e6", "1M", "1.5M", "200k", "2.5e3"];
        assert_eq!(
            all.map(|s| steps(s).unwrap_or(0)),
            [1_000_000, 1_000_000, 1_000_000, 1_000_000, 1_500_000, 200_000, 2_500]
        );
        for wrong in ["", "k", "0", "-1", "0.5", "1.5", "1e20", "1m", "nan"] {
            assert!(steps(wrong).is_err(), "{wrong}");
        }
    }
}
