//! `nearl sweep`: tasks times algorithms times seeds.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::Args;
use indicatif::ProgressBar;

use super::{Failure, at_least_one, cores, say};
use crate::learn::Algorithm;
use crate::preset::Preset;
use crate::sweep::{Event, Found, Row, Run, Summary, Sweep, run};
use crate::{tasks, train};

#[derive(Args)]
pub(super) struct SweepCommand {
    /// Tasks or task files, separated by commas.
    #[arg(long, value_delimiter = ',', required = true)]
    tasks: Vec<String>,
    #[arg(long, value_delimiter = ',', default_value = "ppo,pid2-ib", help = several())]
    algos: Vec<String>,
    /// Seeds: `0,1,2` or `0-2`.
    #[arg(long, default_value = "0-2", value_parser = seeds)]
    seeds: Seeds,
    /// Environment steps of each run; 1_000_000 and 1e6 are both read.
    #[arg(long, default_value = "1000000", value_parser = super::train::steps)]
    steps: u64,
    /// Folder of all runs: `<out>/<task>/<algo>_<seed>`.
    #[arg(long)]
    out: PathBuf,
    /// Runs at a time, one thread each; all cores when absent.
    #[arg(long, value_parser = at_least_one)]
    jobs: Option<usize>,
    #[arg(long, value_name = "FILE", help = super::train::demonstrations())]
    demos: Option<PathBuf>,
    #[arg(long, help = super::train::one_preset())]
    preset: Option<Preset>,
    /// Overrides of every task file, e.g. `train.n_envs=32`.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

fn several() -> String {
    format!("Algorithms, separated by commas: {}", Algorithm::names())
}

#[derive(Clone)]
struct Seeds(Vec<u64>);

fn seeds(text: &str) -> Result<Seeds, String> {
    let wrong = || format!("'{text}' are no seeds; write 0,1,2 or 0-2");
    let mut all = Vec::new();
    for part in text.split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let number = |s: &str| s.trim().parse::<u64>().map_err(|_| wrong());
        let (first, last) = (number(first)?, number(last)?);
        if last < first || last - first > 10_000 {
            return Err(wrong());
        }
        all.extend(first..=last);
    }
    Ok(Seeds(all))
}

/// What the trainings that are still to be made say before they begin, once for each task. One that cannot be made says why by itself.
fn advice(sweep: &Sweep, runs: &[Run]) -> Vec<String> {
    let mut lines = train::unread(&sweep.algos, &sweep.set);
    let mut seen = Vec::new();
    for r in runs.iter().filter(|r| r.found != Found::Finished) {
        let kind = (&r.task, r.algo.is_direct());
        if seen.contains(&kind) {
            continue;
        }
        seen.push(kind);
        let Ok(mut manifest) = tasks::load_with(&r.task, sweep.preset, &sweep.set) else { continue };
        if train::complete(&mut manifest).is_err() {
            continue;
        }
        for line in train::advice(r.algo, &manifest).unwrap_or_default() {
            let line = format!("{}: {line}", r.name);
            if !lines.contains(&line) {
                lines.push(line);
            }
        }
    }
    lines
}

impl SweepCommand {
    pub(super) fn run(self) -> Result<(), Failure> {
        let Seeds(seeds) = self.seeds;
        let sweep = Sweep {
            tasks: self.tasks,
            algos: self.algos.iter().map(|name| name.parse()).collect::<Result<_, _>>()?,
            seeds,
            steps: self.steps,
            out: self.out,
            preset: self.preset,
            set: super::train::overrides(self.demos.as_deref(), &self.set)?,
        };
        if !sweep.out.exists() {
            // A sweep that is refused leaves no folder.
            sweep.plan()?;
        }
        let _lock = sweep.lock()?;
        let runs = sweep.plan()?;
        let stop = Arc::new(AtomicBool::new(false));
        for signal in nearl_runtime::stop::ending() {
            signal_hook::flag::register(signal, Arc::clone(&stop))?;
        }
        for line in advice(&sweep, &runs) {
            nearl_runtime::tell!("nearl: warning: {line}");
        }
        let todo = runs.iter().filter(|r| r.found != Found::Finished).count() as u64;
        let bar = if self.json { ProgressBar::hidden() } else { ProgressBar::new(todo * sweep.steps) };
        let mut done = 0;
        let left = run(&sweep, &runs, self.jobs.unwrap_or_else(cores), &stop, |event| {
            let line = |r: &Run, words: &str| {
                if !self.json {
                    bar.suspend(|| say(format!("{} {} seed {}: {words}", r.name, r.algo, r.seed)));
                }
            };
            let error = |r: &Run, words: &str| match self.json {
                true => nearl_runtime::tell!("{} {} seed {}: {words}", r.name, r.algo, r.seed),
                false => line(r, words),
            };
            match event {
                Event::Skipped(r) => line(r, "finished before"),
                Event::Started(r) => match r.found {
                    Found::Resumable => line(r, "was broken off, goes on"),
                    Found::Broken => line(r, "was broken off, begins anew"),
                    _ => {}
                },
                Event::Ended(r, Ok(())) => {
                    done += sweep.steps;
                    line(r, "done");
                }
                Event::Ended(r, Err(words)) => error(r, &words),
                Event::Waiting(steps) => bar.set_position(done + steps),
            }
        });
        bar.finish_and_clear();
        let rows: Vec<Row> = runs.iter().map(Row::of).collect();
        let summary = Summary::of(&rows);
        if self.json {
            say(serde_json::to_string_pretty(
                &serde_json::json!({ "summary": summary, "runs": rows, "failed": left.failed, "stopped": left.stopped }),
            )?);
        } else {
            table(&summary);
            let is_whole = |row: &&Row| row.steps.is_some_and(|steps| steps >= sweep.steps as f64);
            let silent = rows.iter().filter(is_whole).filter(|row| row.return_mean.is_none()).count();
            if silent > 0 {
                say(format!(
                    "{silent} of {} runs have no return, as none of their episodes ended: give more --steps, or a smaller max_episode_steps",
                    rows.len()
                ));
            }
        }
        let all = runs.len();
        let mut words = Vec::new();
        if left.stopped > 0 {
            let n = left.stopped;
            words.push(format!("interrupted with {n} of {all} runs to go; the same command goes on"));
        }
        if left.failed > 0 {
            words.push(format!(
                "{} of {all} runs ended with the errors above; mend what they name, and where that is the task, move their folders away",
                left.failed
            ));
        }
        if words.is_empty() { Ok(()) } else { Err(words.join("; ").into()) }
    }
}

fn table(summary: &[Summary]) {
    let number = |x: Option<f64>, digits: usize| x.map_or("-".into(), |x| format!("{x:.digits$}"));
    say(format!(
        "{:<22}{:<10}{:>5}{:>12}{:>10}{:>20}{:>9}{:>10}{:>10}",
        "task", "algorithm", "runs", "steps", "return", "lowest .. highest", "cost", "idm loss", "steps/s"
    ));
    for s in summary {
        say(format!(
            "{:<22}{:<10}{:>5}{:>12}{:>10}{:>20}{:>9}{:>10}{:>10}",
            s.task,
            s.algo,
            s.seeds,
            number(s.steps, 0),
            number(s.return_mean, 1),
            format!("{} .. {}", number(s.lowest, 0), number(s.highest, 0)),
            number(s.cost, 1),
            number(s.idm_loss, 3),
            number(s.steps_per_s, 0)
        ));
    }
    say(
        "return, cost and idm loss: interquartile mean over the runs of each run's last ten batches, exploration on; steps/s: of one core, over the \
         whole run"
            .to_string(),
    );
}
