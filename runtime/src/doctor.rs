//! `nearl doctor`: checks whether a snapshot, the machine and the plant are ready to run, and prints one line for each check.

mod braking;
mod doubts;
mod machine;

use crate::cli::{Failure, say};
use crate::codes::CheckCode;
use crate::controller::{Controller, Margin, Parts};
use crate::link::{RobotMessage, RobotName, TrainerLink};
use crate::rt::Pilot;
use crate::snapshot::{Manifest, Snapshot, SnapshotError, in_run};
use braking::{braking, gains, holding};
use clap::Args;
use machine::{clock, lock, memory, priority, stale_links, wake};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Check that a snapshot, this machine and a plant are ready.
#[derive(Args, Debug)]
pub struct DoctorCommand {
    /// Run folder or snapshot file.
    pub snapshot: PathBuf,
    /// Name of a plant the snapshot is to drive.
    #[arg(long)]
    pub plant: Option<String>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Outcome of one check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Finding {
    /// As it should be.
    Ok,
    /// It runs, but worse than it could.
    Warn,
    /// It does not run.
    Fail,
}

/// One check with a sentence that says what was found and, if it is not ok, what to do.
#[derive(Clone, Debug, Serialize)]
pub struct Check {
    /// What was looked at.
    pub check: &'static str,
    /// Its code; `nearl explain` knows it.
    pub code: CheckCode,
    /// Outcome.
    pub finding: Finding,
    /// One sentence.
    pub text: String,
    /// The next step; none where all is well.
    pub remedy: Option<&'static str>,
}

/// States looked at for the braking certificate, and their seed.
const SAMPLES: (usize, u64) = (5000, 1);
/// Longest wait for the plant's announcement.
const PATIENCE: Duration = Duration::from_secs(3);

impl DoctorCommand {
    /// Runs every check and prints a line for each.
    ///
    /// # Errors
    /// One sentence naming the checks that failed.
    pub fn run(self) -> Result<(), Failure> {
        let checks = examine(&in_run(&self.snapshot), self.plant.as_deref());
        let failed: Vec<&str> =
            checks.iter().filter(|c| c.finding == Finding::Fail).map(|c| c.check).collect();
        if self.json {
            say(serde_json::json!({ "ok": failed.is_empty(), "checks": checks }));
        } else {
            for Check { check, code, finding, text, .. } in &checks {
                let more = if *finding == Finding::Ok { String::new() } else { format!(" [{code}]") };
                say(format!("{:<5} {check:<10} {text}{more}", format!("{finding:?}").to_lowercase()));
            }
        }
        if failed.is_empty() {
            return Ok(());
        }
        Err(format!("failed: {}; do what the lines say, then run doctor again", failed.join(", ")).into())
    }
}

/// Every check, in order.
pub fn examine(file: &Path, plant: Option<&str>) -> Vec<Check> {
    let (snapshot, mut checks) = examine_snapshot(file);
    let dt = snapshot.as_ref().map_or(1e-3, |s| s.manifest.task.time.dt);
    checks.extend([memory(), stale_links(), priority(), lock(), clock(), wake(dt)]);
    match (plant, &snapshot) {
        (Some(name), Some(snapshot)) => checks.push(examine_plant(name, snapshot)),
        (Some(_), None) => {
            checks.push(fail(CheckCode::Plant, "not asked, because the snapshot failed".into()))
        }
        (None, _) => {}
    }
    checks
}

/// What whoever steps a simulated robot behind its limits is told, one sentence each: what [`told`] says, and joints that the motors cannot hold still
/// everywhere; where the forces of drives alone are bounded, those whose targets end too early for that.
///
/// # Errors
/// As [`Parts::new`].
pub fn told_of_simulated(m: &Manifest) -> Result<Vec<String>, SnapshotError> {
    let parts = Parts::new(m)?;
    if m.bounds_drives() {
        let drives = Parts::drives(m, &parts.model, parts.layout.controllable())?;
        return Ok(doubts::cut_targets(m, &parts, &drives).into_iter().collect());
    }
    let mut notes = doubts::of(m, &parts);
    let holds = holding(m, &parts);
    if holds.finding != Finding::Ok {
        notes.push(holds.text);
    }
    Ok(notes)
}

/// What the checks of a task say before it is trained: one line for each that is not as it should be, with what to change.
///
/// # Errors
/// As [`Parts::new`].
pub fn advice(manifest: &Manifest) -> Result<Vec<String>, SnapshotError> {
    let parts = Parts::new(manifest)?;
    let notes = notes(manifest, &parts);
    let checks = [notes, holding(manifest, &parts), gains(manifest, &parts), braking(manifest, parts)];
    let odd = checks.into_iter().filter(|check| check.finding != Finding::Ok);
    Ok(odd.map(|check| format!("{} [{}]", check.text, check.code)).collect())
}

fn ok(code: CheckCode, text: String) -> Check {
    Check { check: name(code), code, finding: Finding::Ok, text, remedy: None }
}
fn warn(code: CheckCode, text: String) -> Check {
    Check { check: name(code), code, finding: Finding::Warn, text, remedy: Some(code.explanation().remedy) }
}
fn fail(code: CheckCode, text: String) -> Check {
    Check { check: name(code), code, finding: Finding::Fail, text, remedy: Some(code.explanation().remedy) }
}
/// The code without the group in front.
fn name(code: CheckCode) -> &'static str {
    code.name().trim_start_matches("doctor-")
}

fn examine_snapshot(file: &Path) -> (Option<Snapshot>, Vec<Check>) {
    let snapshot = match Snapshot::load(file) {
        Ok(snapshot) => snapshot,
        Err(e @ SnapshotError::Unreadable { .. }) => {
            return (None, vec![fail(CheckCode::Snapshot, e.to_string())]);
        }
        Err(e) => return (None, vec![fail(CheckCode::Snapshot, format!("{}: {e}", file.display()))]),
    };
    let m = &snapshot.manifest;
    let (task, algo) = (&m.task.name, &m.algo);
    let text =
        format!("{task} by {algo}, version {}, {} steps, digest {}", m.version, m.steps, snapshot.digest());
    let mut checks = vec![ok(CheckCode::Snapshot, text)];
    match Controller::new(&snapshot) {
        Ok(controller) => {
            checks.push(ok(CheckCode::Canary, "trial states gave finite actions".into()));
            checks.extend(reached(m, &controller));
        }
        Err(e) => {
            checks.push(fail(CheckCode::Canary, e.to_string()));
            return (None, checks);
        }
    }
    if let Some(policy) = &snapshot.manifest.task.policy {
        checks.push(ok(CheckCode::Recipe, policy.to_string()));
    }
    match Parts::new(&snapshot.manifest) {
        Ok(parts) => {
            checks.extend([
                notes(m, &parts),
                projection(m),
                holding(m, &parts),
                gains(m, &parts),
                braking(m, parts),
            ]);
        }
        Err(e) => checks.push(fail(CheckCode::Braking, e.to_string())),
    }
    (Some(snapshot), checks)
}

/// Is the share of ticks that may end outside to be had?
fn reached(m: &Manifest, controller: &Controller) -> Option<Check> {
    let asked = 100.0 * m.task.constraints.reached?;
    let margins = controller.margins();
    let name = |row: &Margin| {
        format!(
            "the {} limit of joint '{}'",
            if row.is_upper { "upper" } else { "lower" },
            controller.model().dof_name(row.dof)
        )
    };
    let ends: Vec<String> = margins.iter().filter(|row| row.at_end).map(name).collect();
    if !ends.is_empty() {
        let text = format!(
            "{asked:.3} % of ticks may end outside a position limit, but at {} the motor pushes away with all it has and it is not enough; the share \
             there may be higher",
            ends.join(", ")
        );
        return Some(warn(CheckCode::Reached, text));
    }
    let widest = margins.iter().max_by(|a, b| a.share.total_cmp(&b.share)).filter(|row| row.share > 0.0);
    let learned = match widest {
        Some(row) => format!("the largest margin that was learned is {:.2}, at {}", row.share, name(row)),
        None => "no margin was learned yet".into(),
    };
    Some(ok(CheckCode::Reached, format!("{asked:.3} % of ticks may end outside a position limit; {learned}")))
}

/// What the robot file has that projection and inverse dynamics do not reckon with, and limits that are hardly meant.
fn notes(m: &Manifest, parts: &Parts) -> Check {
    match &doubts::of(m, parts)[..] {
        [] => ok(CheckCode::Model, "the model holds what the robot file describes".into()),
        notes => warn(CheckCode::Model, notes.join("; ")),
    }
}

/// What whoever writes a snapshot is told of its robot and limits, one sentence each.
///
/// # Errors
/// As [`Parts::new`].
pub fn told(m: &Manifest) -> Result<Vec<String>, SnapshotError> {
    let parts = Parts::new(m)?;
    let mut notes = doubts::of(m, &parts);
    let holds = holding(m, &parts);
    if holds.finding == Finding::Fail {
        notes.push(format!("{}; `nearl run` refuses it as it is", holds.text));
    }
    Ok(notes)
}

/// Does anything keep the limits at all?
fn projection(m: &Manifest) -> Check {
    if let Some(text) = m.without_simulator() {
        return warn(CheckCode::Projection, text.into());
    }
    if m.bounds_drives() {
        let text = "the forces of its drives and their change are kept within the motors'; nothing is promised of the motion (guard = \"drive\")";
        let steps = m.task.sub_steps();
        if steps > 1 {
            let when = format!(
                "at the first of the {steps} physics steps of a period alone; a period of one step keeps them in all"
            );
            return warn(CheckCode::Projection, format!("{text}, {when}"));
        }
        return ok(CheckCode::Projection, text.into());
    }
    if m.proposes() {
        return ok(CheckCode::Projection, "every target is projected into the limits of the task".into());
    }
    let kept = if m.limits_actions() { "none is kept but [constraints.action]" } else { "none is kept" };
    warn(
        CheckCode::Projection,
        format!(
            "its policy is direct and not guarded: nothing is projected, so of the limits of the task {kept}; set constraints.guard, or train \
             with an algorithm that proposes states, as pid2-ib"
        ),
    )
}

/// What was compared with the plant, and what it did not say.
fn plant_found(name: &str, robot: &RobotMessage) -> Check {
    let (mut same, mut unsaid) = (vec!["joints", "observation"], Vec::new());
    let file = "the robot file's limits, the actuators' range and what the joints are commanded";
    if robot.limits != 0 {
        same.push(file)
    } else {
        unsaid.push(file)
    };
    let stated = "position, velocity, acceleration and torque limits by number";
    let found =
        format!("`{name}` answers: its {} joints, period of {} s, ", robot.joint_names().len(), robot.dt);
    let found = format!("{found}{} are the snapshot's", same.join(", "));
    match robot.states_limits() {
        true => {
            let found = format!("{found}, and the snapshot allows no joint more than the plant: {stated}");
            if unsaid.is_empty() {
                return ok(CheckCode::Plant, found);
            }
            warn(
                CheckCode::Plant,
                format!("{found}; not compared, because the plant does not state them: {file}"),
            )
        }
        false => {
            unsaid.push(stated);
            let unsaid = unsaid.join(", and ");
            warn(
                CheckCode::Plant,
                format!("{found}; not compared, because the plant does not state them: {unsaid}"),
            )
        }
    }
}

/// Does the plant answer, and is it the robot of the snapshot?
fn examine_plant(name: &str, snapshot: &Snapshot) -> Check {
    let robot = RobotName::new(name).and_then(|name| {
        let mut link = TrainerLink::open(&name)?;
        link.wait_for_plant(PATIENCE)
    });
    match robot {
        Err(e) => fail(CheckCode::Plant, e.to_string()),
        Ok(robot) => match Pilot::new(snapshot, &robot) {
            Err(refusal) => fail(CheckCode::Plant, refusal.text),
            Ok(_) => plant_found(name, &robot),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::machine::left;
    use super::*;

    #[test]
    fn what_is_left_of_many_robots_is_a_count_and_the_first_few() {
        let names: Vec<String> = (0..400).map(|k| format!("arm{k}")).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let text = left(&names, 1200, Path::new("/run/x"));
        assert!(
            text.contains("1200 kB of 400 robots") && text.contains("/run/x/arm2 and those of 397 more"),
            "{text}"
        );
        assert!(text.len() < 400 && !text.contains("arm3"), "{text}");
        let text = left(&names[..2], 8, Path::new("/run/x"));
        assert!(
            text.ends_with(
                "delete /dev/shm/nearl.arm0.* and /run/x/arm0, /dev/shm/nearl.arm1.* and /run/x/arm1"
            ),
            "{text}"
        );
    }
}
