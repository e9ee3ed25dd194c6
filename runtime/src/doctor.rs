//! `nearl doctor`: checks whether a snapshot, the machine and the plant are ready to run, and prints one line for each check.

mod doubts;

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use nearl_constraints::{Drive, certify_braking};
use rustix::time::{ClockId, clock_getres};
use serde::Serialize;

use crate::cli::{Failure, say};
use crate::codes::CheckCode;
use crate::controller::{Controller, Margin, Parts};
use crate::gains;
use crate::holding;
use crate::link::{
    RobotMessage, RobotName, SHARED_MEMORY, TrainerLink, check_memory, free_memory, home_of_user, remains,
};
use crate::rt::{PRIORITY, Pilot, Stop, ThreadSettings, bench_wake, prepare};
use crate::snapshot::{Manifest, Snapshot, SnapshotError, in_run};

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

/// Can the motors hold the robot everywhere within its position limits?
fn holding(m: &Manifest, parts: &Parts) -> Check {
    let Parts { model, layout, projector } = parts;
    let controllable = layout.controllable();
    let limits = &holding::standing(projector.limits(), &m.task.constraints, model);
    if controllable.iter().all(|&i| limits.effort[i].is_infinite()) {
        return ok(CheckCode::Holding, "the task has no torque limit to compare gravity with".into());
    }
    let period = m.task.period();
    if let Some(text) = holding::refusal(model, limits, controllable, &period) {
        return if m.bounds_drives() {
            warn(CheckCode::Holding, text)
        } else {
            fail(CheckCode::Holding, text)
        };
    }
    let loads = holding::heaviest(model, limits, controllable, &period);
    if let Some(text) = out_of_reach(m, parts, &loads) {
        return warn(CheckCode::Holding, text);
    }
    let share = |l: &holding::Load| l.needed / l.effort;
    let floats = model.joints().iter().any(|j| j.nv > 1 && !controllable.contains(&j.idx_v));
    let held = if floats { ", with its base held: what legs carry comes on top" } else { "" };
    match loads.iter().max_by(|a, b| share(a).total_cmp(&share(b))) {
        None => ok(CheckCode::Holding, "no joint has a torque limit".into()),
        Some(l) => ok(
            CheckCode::Holding,
            format!(
                "standing still takes at most {:.1} of {:.1} N m or N, at joint '{}'{held}",
                l.needed, l.effort, l.joint
            ),
        ),
    }
}

/// Share of the range of a drive's targets at either end that friction and weight may take.
const TAKEN: f64 = 0.05;

/// Joints that their drives hold in a part of their limits alone, because friction and weight take the rest of the way to the end of their targets.
fn out_of_reach(m: &Manifest, parts: &Parts, loads: &[holding::Load]) -> Option<String> {
    let Parts { model, layout, projector } = parts;
    let drives =
        Parts::drives(m, model, layout.controllable()).ok().filter(|_| m.proposes() && !m.bounds_drives())?;
    let held = |&i: &usize| {
        let ([low, high], rubs) = doubts::rubbing(m, parts, &drives, i)?;
        let Drive::Pd { stiffness, .. } = drives[i] else { return None };
        let weight = loads.iter().find(|load| load.dof == i)?.needed;
        let way = rubs + weight / stiffness;
        let (iq, limits) = (model.joint_of_dof(i).idx_q, projector.limits());
        // Without a position limit the robot file's own ends, if it has any.
        let end = |limit: f64, of_file: f64| if limit.is_finite() { limit } else { of_file };
        let lower = end(limits.q_lower[i], model.lower_position_limit()[iq]);
        let upper = end(limits.q_upper[i], model.upper_position_limit()[iq]);
        let [from, to] = [low + way, high - way];
        let margin = (from - lower).max(upper - to);
        let is_far = margin.is_finite() && margin > TAKEN * (high - low);
        is_far.then(|| {
            let held = match from < to {
                true => format!(
                    "from {from:.4} to {to:.4} rad or m, {margin:.4} short of a limit on its position"
                ),
                false => "nowhere".into(),
            };
            format!(
                "'{}' {held} (friction {:.3}, weight and springs at most {weight:.3} N m or N, stiffness {stiffness})",
                model.dof_name(i),
                model.friction()[i],
            )
        })
    };
    let joints: Vec<String> = layout.controllable().iter().filter_map(held).collect();
    (!joints.is_empty()).then(|| {
        format!(
            "within the range of their targets drives are sure to hold {}: a joint that begins beyond is led back, and where no brake is found the whole robot \
             stands (braked-no-verified-brake); give position so much margin, the actuators more ctrlrange or stiffness, or begin inside",
            joints.join("; ")
        )
    })
}

/// Share of a drive's gains that is hardly known better.
const KNOWN: f64 = 0.2;

/// How well must the gains of the joints' drives be known?
fn gains(m: &Manifest, parts: &Parts) -> Check {
    let Parts { model, layout, projector } = parts;
    let controllable = layout.controllable();
    let drives = match Parts::drives(m, model, controllable) {
        Ok(drives) => drives,
        Err(e) => return fail(CheckCode::Gains, e.to_string()),
    };
    if !m.proposes() || m.bounds_drives() {
        return ok(CheckCode::Gains, "no limit of the motion counts on the gains of a drive".into());
    }
    let all = gains::tolerances(model, projector.limits(), controllable, &drives);
    let Some(least) = all.iter().min_by(|a, b| a.share.total_cmp(&b.share)) else {
        return ok(CheckCode::Gains, "no limit of the motion counts on the gains of a drive".into());
    };
    let percent = |share: f64| format!("{:.0} %", 100.0 * share);
    if least.share >= KNOWN {
        let text = format!(
            "the gains of the drives may be off by {}, at joint '{}'",
            percent(least.share),
            least.joint
        );
        return ok(CheckCode::Gains, text);
    }
    let close: Vec<String> = all
        .iter()
        .filter(|t| t.share < KNOWN)
        .map(|t| {
            let gains::Tolerance { joint, share, damping, velocity, deceleration, inertia } = t;
            format!(
                "joint '{joint}' to {} (damping {damping} N m s/rad or N s/m, {velocity:.3} rad/s or m/s, {deceleration} rad/s² or m/s², \
                 inertia {inertia:.3} kg m² or kg)",
                percent(*share)
            )
        })
        .collect();
    warn(
        CheckCode::Gains,
        format!(
            "the limits count on the gains of the drives: {}; where damping is less than stated by that much, or stiffness more, a joint at its \
             speed limit cannot be braked",
            close.join("; ")
        ),
    )
}

/// Can the motors give the decelerations that the position limits count on?
fn braking(m: &Manifest, parts: Parts) -> Check {
    let left_alone = doubts::left_alone(&parts, &[]);
    let Parts { model, layout, projector } = parts;
    let (limits, controllable) = (projector.limits(), layout.controllable());
    if controllable.iter().all(|&i| limits.effort[i].is_infinite()) {
        return ok(CheckCode::Braking, "the task has no torque limit, so there is nothing to certify".into());
    }
    if m.bounds_drives() {
        return ok(
            CheckCode::Braking,
            "nothing is promised of the motion (guard = \"drive\"), so there is no brake to certify".into(),
        );
    }
    if !m.proposes() {
        return ok(CheckCode::Braking, "no limit of the motion counts on the motors' brake".into());
    }
    let period = m.task.period();
    let (samples, seed) = SAMPLES;
    match certify_braking(&model, limits, controllable, &period, samples, seed) {
        Err(e) => fail(CheckCode::Braking, e.to_string()),
        Ok(c) => {
            let joint = model.dof_name(c.dof);
            // The search leaves what nothing commands at rest.
            let at_rest = match &left_alone[..] {
                [] => String::new(),
                joints => format!(" while {}, which nothing commands, stand still", joints.join(", ")),
            };
            let found = format!(
                "in the hardest of {} states '{joint}' might need {:.1} of its {:.1} N m or N to brake{at_rest}",
                c.samples, c.needed, c.effort
            );
            if c.holds() {
                return ok(CheckCode::Braking, found);
            }
            if projector.stores_a_brake() {
                let kept = "each tick verifies a way to stop before it takes a state (constraints.braking = \"stored\")";
                return ok(CheckCode::Braking, format!("{found}: too little, so {kept}"));
            }
            // Rounded down: what is advised must do.
            let scale = (100.0 * c.scale).floor() / 100.0;
            let smaller = match scale > 0.0 {
                true => format!(", or multiply constraints.acceleration.limit by {scale:.2} or less"),
                false => String::new(),
            };
            warn(
                CheckCode::Braking,
                format!("{found}, which is too little: set constraints.braking = \"stored\"{smaller}"),
            )
        }
    }
}

/// Room for the links.
fn memory() -> Check {
    let megabytes = |bytes: u64| bytes >> 20;
    let needed = megabytes(SHARED_MEMORY);
    let result = RobotName::new(&format!("doctor{}", std::process::id()))
        .and_then(|name| check_memory(&name, SHARED_MEMORY));
    match result {
        Err(e) => fail(CheckCode::Memory, e.to_string()),
        Ok(()) => ok(
            CheckCode::Memory,
            format!("/dev/shm has {} MB free, a robot needs {needed}", megabytes(free_memory())),
        ),
    }
}

/// Links that only dead processes hold.
fn stale_links() -> Check {
    let all = remains();
    let mut stale: Vec<_> = all.iter().filter(|r| r.is_stale()).collect();
    stale.sort_by_key(|r| -r.changed);
    if stale.is_empty() {
        let alive = all.iter().filter(|r| r.alive > 0).count();
        return ok(
            CheckCode::Links,
            format!("{alive} robots are running, no link of a dead process is left"),
        );
    }
    let kilobytes = stale.iter().map(|r| r.bytes).sum::<u64>() >> 10;
    let names: Vec<&str> = stale.iter().map(|r| r.name.as_str()).collect();
    warn(CheckCode::Links, left(&names, kilobytes, &home_of_user()))
}

/// Names of robots that are told one by one.
const NAMED: usize = 3;

/// What dead processes left of the links of this user's robots `names`, newest first.
fn left(names: &[&str], kilobytes: u64, folder: &Path) -> String {
    let files = |name: &&str| format!("/dev/shm/nearl.{name}.* and {}/{name}", folder.display());
    let shown: Vec<String> = names.iter().take(NAMED).map(files).collect();
    let more = match names.len().saturating_sub(NAMED) {
        0 => String::new(),
        more => format!(" and those of {more} more (names in {})", folder.display()),
    };
    format!(
        "{kilobytes} kB of {} robots are held by dead processes: start a robot again, which cleans up, or delete {}{more}",
        names.len(),
        shown.join(", ")
    )
}

/// Asks the operating system for `wish` on a thread that ends at once.
fn wish(check: CheckCode, granted: &str, wish: ThreadSettings) -> Check {
    let thread = std::thread::Builder::new().spawn(move || prepare(&wish));
    match thread.map(std::thread::JoinHandle::join) {
        Ok(Ok(warnings)) if warnings.is_empty() => ok(check, granted.into()),
        Ok(Ok(warnings)) => warn(check, warnings.join("; ")),
        Ok(Err(_)) => fail(check, "the thread that asked panicked: report it with the message above".into()),
        Err(e) => fail(check, format!("no thread could be started ({e}): raise `ulimit -u`")),
    }
}

fn priority() -> Check {
    let settings = ThreadSettings { priority: Some(PRIORITY), cpu: None, lock_memory: false };
    wish(CheckCode::Priority, &format!("SCHED_FIFO priority {PRIORITY} is granted"), settings)
}

fn lock() -> Check {
    let settings = ThreadSettings { priority: None, cpu: None, lock_memory: true };
    wish(CheckCode::Lock, "memory can be locked", settings)
}

fn clock() -> Check {
    let t = clock_getres(ClockId::Monotonic);
    let resolution = t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64;
    if resolution <= 1000 {
        return ok(CheckCode::Clock, format!("the monotonic clock counts {resolution} ns"));
    }
    let text = format!(
        "the monotonic clock counts {resolution} ns: boot with high-resolution timers (CONFIG_HIGH_RES_TIMERS)"
    );
    warn(CheckCode::Clock, text)
}

/// Shortest control period that is tried, and the shortest that is told by its number [s].
const SHORTEST: f64 = 2e-5;
const NANOSECOND: f64 = 1e-9;

/// One second of an empty loop beside the control period `dt` [s].
fn wake(dt: f64) -> Check {
    if dt < SHORTEST {
        let period = if dt < NANOSECOND { format!("less than {NANOSECOND} s") } else { format!("{dt} s") };
        let text = format!("the period is {period}, which no loop here keeps: give at least {SHORTEST} s");
        return fail(CheckCode::WakeUp, text);
    }
    let period = dt.min(1e-3);
    let settings = ThreadSettings { priority: Some(PRIORITY), cpu: None, lock_memory: false };
    let late = match bench_wake(period, (1.0 / period).round() as u64, settings, &Stop::new()) {
        Ok((late, _)) => late,
        Err(e) => {
            return fail(CheckCode::WakeUp, format!("the empty loop did not run ({e}): raise `ulimit -u`"));
        }
    };
    let us = |ns: u64| ns as f64 * 1e-3;
    let found = format!(
        "an empty loop wakes up {:.0} us late (p50), {:.0} us (p99), {:.0} us at most; the period is {:.0} us",
        us(late.p50),
        us(late.p99),
        us(late.max),
        1e6 * dt
    );
    if late.p99 as f64 * 1e-9 < 0.5 * dt {
        return ok(CheckCode::WakeUp, found);
    }
    warn(
        CheckCode::WakeUp,
        format!("{found}: stop other programs, or keep a core free and give it with --cpu"),
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
