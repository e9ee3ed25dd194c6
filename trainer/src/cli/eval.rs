//! `nearl eval`: episodes without exploration, and the limits they broke.

use super::{Failure, say, unstable};
use crate::evaluate::{Reached, ReachedRow, evaluate};
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
    /// Ask for this share of ticks outside a position limit (`constraints.reached`), of a policy that was trained without or for another.
    #[arg(long, value_name = "SHARE")]
    reached: Option<f64>,
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
        if self.reached.is_some() {
            snapshot.manifest.task.constraints.reached = self.reached;
        }
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
                "{:<10}{:>8} ± {:<8}{:>10}{:>16}{:>16}{:>15.2} %{:>17}{:>20}",
                e.mode,
                figures(e.mean_return()),
                figures(e.std_return()),
                figures(e.mean_cost()),
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
        for (e, reached) in results.iter().filter_map(|e| Some((e, e.reached.as_ref()?))) {
            for line in reached_lines(reached, e.ticks) {
                say(format!("{}: {line}", e.mode));
            }
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
        for (e, m) in results.iter().flat_map(|e| e.measured.iter().map(move |m| (e, m))) {
            let unit = if m.limit == "torque" { "N m or N" } else { "rad/s² or m/s²" };
            let furthest = match m.outside {
                0 => String::new(),
                _ => format!("; joint '{}' came furthest, by {:.3e} {unit}", m.joint, m.by),
            };
            say(format!(
                "{}: ticks beyond a limit on {} in the simulator: {} of {}{furthest}",
                e.mode, m.limit, m.outside, e.ticks
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

/// Asked and reached share, and row by row what cannot be had.
fn reached_lines(reached: &Reached, ticks: u64) -> Vec<String> {
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    let of = |row: &ReachedRow| percent(row.outside as f64 / ticks.max(1) as f64);
    let mut rows: Vec<&ReachedRow> = reached.rows.iter().filter(|row| row.outside > 0).collect();
    rows.sort_by_key(|row| std::cmp::Reverse(row.outside));
    let most: Vec<String> = (rows.iter().take(3))
        .map(|row| format!("'{}' {} its range {}, margin {:.2}", row.joint, row.side, of(row), row.margin))
        .collect();
    let most = if most.is_empty() { String::new() } else { format!("; most {}", most.join(", ")) };
    let mut lines = vec![format!(
        "constraints.reached asks for {} of the ticks outside a position limit, and {} were{most}",
        percent(reached.asked),
        percent(reached.share)
    )];
    lines.extend(rows.iter().filter(|row| row.unattainable).map(|row| {
        format!(
            "unattainable: joint '{}' is {} its range in {} of the ticks although its motor pushes away from it as hard as it can",
            row.joint,
            row.side,
            of(row)
        )
    }));
    lines
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

/// A return with a decimal, or as many as show three figures of one below 1.
fn figures(x: f64) -> String {
    match x.abs() {
        size if size >= 1.0 || size == 0.0 || !size.is_finite() => format!("{x:.1}"),
        size if size >= 1e-3 => format!("{x:.*}", (2.0 - size.log10().floor()) as usize),
        _ => format!("{x:.1e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::{Reached, ReachedRow, reached_lines};

    #[test]
    fn small_returns_are_told_apart() {
        let told = [12.04, 0.0, -0.0265, 0.31799, -1e-5, 0.001, f64::INFINITY].map(super::figures);
        assert_eq!(told, ["12.0", "0.0", "-0.0265", "0.318", "-1.0e-5", "0.00100", "inf"]);
    }

    #[test]
    fn shares_are_said_and_what_cannot_be_had_by_row() {
        let row = |joint: &str, side, outside, margin, unattainable| ReachedRow {
            joint: joint.into(),
            side,
            outside,
            margin,
            unattainable,
        };
        let rows = vec![
            row("hip", "below", 1, 0.25, false),
            row("foot", "above", 30, 1.0, true),
            row("foot", "below", 0, 0.0, false),
        ];
        let reached = Reached { asked: 0.01, share: 0.031, by_episode: vec![0.031], rows };
        assert_eq!(
            reached_lines(&reached, 1000),
            [
                "constraints.reached asks for 1.00 % of the ticks outside a position limit, and 3.10 % were; most 'foot' above its range 3.00 %, \
                 margin 1.00, 'hip' below its range 0.10 %, margin 0.25",
                "unattainable: joint 'foot' is above its range in 3.00 % of the ticks although its motor pushes away from it as hard as it can",
            ]
        );
        let none = Reached { asked: 0.5, share: 0.0, by_episode: Vec::new(), rows: Vec::new() };
        let text =
            "constraints.reached asks for 50.00 % of the ticks outside a position limit, and 0.00 % were";
        assert_eq!(reached_lines(&none, 0), [text]);
    }
}
