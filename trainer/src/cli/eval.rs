//! `nearl eval`: episodes without exploration, and the limits they broke.

use super::{Failure, say, unstable};
use crate::evaluate::evaluate;
use crate::run_folder;
use clap::Args;
use nearl_runtime::Snapshot;
use nearl_runtime::task::Task;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct Eval {
    /// Run folder or snapshot file.
    run: PathBuf,
    /// Episodes.
    #[arg(long, default_value_t = 10)]
    episodes: usize,
    /// Modes, separated by commas: `raw` takes the proposal as the target, `projected` projects it.
    #[arg(long, default_value = "projected", value_delimiter = ',', value_parser = ["raw", "projected"])]
    compare: Vec<String>,
    /// Seed of the initial states.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Another robot than the one of the training: `random.mass=1.2`, `delay.action=2`, of the sections that a task of one's own simulates by.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Eval {
    pub(super) fn run(self) -> Result<(), Failure> {
        if self.episodes == 0 {
            return Err("--episodes 0 measures nothing; give at least 1".into());
        }
        let file = run_folder::snapshot_of(&self.run)?;
        let mut snapshot = Snapshot::load(&file).map_err(|e| format!("{}: {e}", file.display()))?;
        changed(
            &mut snapshot,
            &self.set,
            &SIMULATED,
            "an evaluation changes what is simulated and no controller",
        )?;
        let results = self
            .compare
            .iter()
            .map(|mode| evaluate(&snapshot, self.episodes, self.seed, mode == "projected"))
            .collect::<Result<Vec<_>, _>>()?;
        if self.json {
            say(serde_json::to_string_pretty(&results)?);
            return Ok(());
        }
        say(format!("{}, {} episodes", snapshot.manifest.task.name, self.episodes));
        say(
            "                                         raw proposals         targets   reached states   already outside   |reached - target|",
        );
        say(
            "mode        return ± spread        cost  outside limits         outside          outside     (recovering)     [std of change]",
        );
        for e in &results {
            let percent = |n: u64| 100.0 * n as f64 / e.ticks.max(1) as f64;
            // A policy on actions without a guard proposes nothing, and may have limits on actions.
            let m = &snapshot.manifest;
            let where_so = |is: bool, text: String| if is { text } else { "-".into() };
            let of_targets = |text: String| where_so(m.proposes(), text);
            let share = |n: u64| where_so(m.proposes() || m.limits_actions(), format!("{:.2} %", percent(n)));
            // There are no targets beside the proposals then, and what begins outside would not count.
            let projected = e.mode == "projected" || !m.proposes();
            let targets = if projected { share(e.target_violations) } else { "not projected".into() };
            say(format!(
                "{:<10}{:>8.1} ± {:<8.1}{:>10.1}{:>16}{:>16}{:>15.2} %{:>17}{:>20}",
                e.mode,
                e.mean_return(),
                e.std_return(),
                e.mean_cost(),
                share(e.raw_violations),
                targets,
                percent(e.reached_violations),
                share(e.recovering),
                of_targets(format!("{:.3}", e.residual)),
            ));
        }
        for e in results.iter().filter(|e| e.replaced + e.unavoided > 0) {
            say(format!(
                "{}: the simulator's guard replaced the action of {} ticks, and found none that stays inside for {}",
                e.mode, e.replaced, e.unavoided
            ));
        }
        for (e, w) in results.iter().flat_map(|e| e.worst.iter().map(move |w| (e, w))) {
            let unit = if w.limit == "position" { "rad or m" } else { "rad/s or m/s" };
            let without = match w.beyond_margin {
                0.0 => "none came beyond its limit without margins".into(),
                by => format!("beyond its limit without margins one came by {by:.3e} {unit}"),
            };
            say(format!(
                "{}: joint '{}' came furthest beyond its {} limit as the task has it, by {:.3e} {unit}; {without}",
                e.mode, w.joint, w.limit, w.by
            ));
        }
        for e in &results {
            for told in &e.told {
                let (name, mean, largest) = (&told.name, told.mean, told.largest);
                say(format!("{}: {name} {mean:.4}, at most {largest:.4} in an episode", e.mode));
            }
        }
        for e in results.iter().filter(|e| e.faults > 0) {
            say(format!("{}: {}", e.mode, unstable(e.faults)));
        }
        Ok(())
    }
}

/// Sections that say what is simulated, and nothing of the controller.
pub(super) const SIMULATED: [&str; 10] =
    ["reset", "termination", "metrics", "scene", "commands", "pushes", "random", "noise", "delay", "reward"];

/// Changes those `sections` of the task; networks and the controller's own robot stay. Others are refused, for the reason `why`.
pub(super) fn changed(
    snapshot: &mut Snapshot,
    set: &[String],
    sections: &[&str],
    why: &str,
) -> Result<(), Failure> {
    if set.is_empty() {
        return Ok(());
    }
    let section = |set: &String| set.split(['.', '=']).next().unwrap_or_default().trim().to_string();
    if let Some(other) = set.iter().find(|set| !sections.contains(&section(set).as_str())) {
        return Err(format!("--set {other}: {why}; there are {}", sections.join(", ")).into());
    }
    let task = &snapshot.manifest.task;
    snapshot.manifest.task = Task::parse(&task.name, &run_folder::to_toml(task), set)?;
    snapshot.manifest.task.state.privileged.clear(); // of the value, which has no part here
    Ok(())
}
