//! Runs episodes without noise, raw and projected, and reports their returns and violations.

use crate::env::Worst as MeterWorst;
use crate::rollout::{RolloutError, Scorer, Worker, make_env, stream};
use crate::watch::Watch;
use nearl_runtime::constraints::{ConstraintSettings, LimitSet, Model, PerJoint, build_limits};
use nearl_runtime::controller::Margin;
use nearl_runtime::{Manifest, Snapshot, SnapshotError};
use serde::Serialize;

/// How far a joint came beyond a limit that the projection keeps: the robot's own, less the task's margin or share of it.
#[derive(Clone, Debug, Serialize)]
pub struct Worst {
    /// `position` or `velocity`.
    pub limit: &'static str,
    /// The joint.
    pub joint: String,
    /// Distance [rad or m, per s for a velocity].
    pub by: f64,
    /// Furthest that any joint came beyond its limit without margins; 0 when none did.
    pub beyond_margin: f64,
}

/// Something that the environment tells of its episodes.
#[derive(Clone, Debug, Serialize)]
pub struct Told {
    /// Its column: `reward/...`, `metrics/...`, `random/...`.
    pub name: String,
    /// Mean over the episodes.
    pub mean: f64,
    /// Largest of the episodes.
    pub largest: f64,
}

/// How the simulator kept a kind of limit, margins included. A torque is that of the last physics step of a tick, held against the task's limit and the
/// robot file's.
#[derive(Debug, Clone, Serialize)]
pub struct Measured {
    /// `acceleration` or `torque`.
    pub limit: &'static str,
    /// Ticks beyond it.
    pub outside: u64,
    /// Joint that came furthest beyond; empty where none did.
    pub joint: String,
    /// How far [rad/s² or m/s²; N m or N].
    pub by: f64,
}

/// A row of `[constraints] reached`: one side of the range of a joint.
#[derive(Clone, Debug, Serialize)]
pub struct ReachedRow {
    /// The joint.
    pub joint: String,
    /// `below` or `above` its range.
    pub side: &'static str,
    /// Ticks that ended there.
    pub outside: u64,
    /// Its margin at the end, 0 to 1 ([`Margin`]).
    pub margin: f64,
    /// Its margin is at its end, and more ticks ended outside than were asked for.
    pub unattainable: bool,
}

/// What became of `[constraints] reached`.
#[derive(Clone, Debug, Serialize)]
pub struct Reached {
    /// The share of ticks outside a position limit that was asked for.
    pub asked: f64,
    /// The share that ended there.
    pub share: f64,
    /// The same of each episode: margins that begin at 0 need some thousand ticks.
    pub by_episode: Vec<f64>,
    /// Every row that has a limit.
    pub rows: Vec<ReachedRow>,
}

/// Mean results of some episodes.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    /// `projected` or `raw`.
    pub mode: &'static str,
    /// Return of each episode.
    pub returns: Vec<f64>,
    /// Cost of each episode; zeros where the task has none.
    pub costs: Vec<f64>,
    /// Length of each episode in policy steps.
    pub lengths: Vec<usize>,
    /// Control ticks.
    pub ticks: u64,
    /// Ticks whose raw proposal broke a constraint.
    pub raw_violations: u64,
    /// Ticks that began with a joint already outside its limits.
    pub recovering: u64,
    /// Ticks that began inside and whose target broke a constraint.
    pub target_violations: u64,
    /// Ticks whose state, as the simulator has it afterwards, broke a position or velocity limit.
    pub reached_violations: u64,
    /// What became of the share that the task asks for, if it does.
    pub reached: Option<Reached>,
    /// Ticks whose action the simulator's guard replaced by one that stays inside.
    pub replaced: u64,
    /// Ticks for which it found none.
    pub unavoided: u64,
    /// Furthest that the simulator came beyond a position and a velocity limit; only what was broken.
    pub worst: Vec<Worst>,
    /// Accelerations and torques of the simulator, where they have limits.
    pub measured: Vec<Measured>,
    /// Control periods that could not be simulated: each ended its episode with the reward 0.
    pub faults: u64,
    /// What a task of one's own tells of its episodes.
    pub told: Vec<Told>,
    /// Mean over ticks and controllable entries of |reached - target|, in standard deviations of change.
    pub residual: f64,
}

impl Evaluation {
    /// Mean return.
    pub fn mean_return(&self) -> f64 {
        self.returns.iter().sum::<f64>() / self.returns.len().max(1) as f64
    }

    /// Standard deviation of the returns, with n - 1; 0 of a single episode.
    pub fn std_return(&self) -> f64 {
        let mean = self.mean_return();
        let squares: f64 = self.returns.iter().map(|r| (r - mean).powi(2)).sum();
        (squares / self.returns.len().saturating_sub(1).max(1) as f64).sqrt()
    }

    /// Mean cost of an episode.
    pub fn mean_cost(&self) -> f64 {
        self.costs.iter().sum::<f64>() / self.costs.len().max(1) as f64
    }
}

/// Runs `episodes` without noise; `projection` off makes the raw proposal the target.
///
/// # Errors
/// [`RolloutError`].
pub fn evaluate(
    snapshot: &Snapshot,
    episodes: usize,
    seed: u64,
    projection: bool,
) -> Result<Evaluation, RolloutError> {
    let mut worker = worker(None, snapshot, seed, projection)?;
    worker.set_watch()?;
    episodes_of(worker, snapshot, episodes, projection)
}

/// The same with rewards and ends of somebody else's, where there is a scorer.
pub(crate) fn evaluate_by(
    scorer: Option<Scorer>,
    snapshot: &Snapshot,
    episodes: usize,
    seed: u64,
    projection: bool,
) -> Result<Evaluation, RolloutError> {
    episodes_of(worker(scorer, snapshot, seed, projection)?, snapshot, episodes, projection)
}

/// The environment and its controller.
fn worker(
    scorer: Option<Scorer>,
    snapshot: &Snapshot,
    seed: u64,
    projection: bool,
) -> Result<Worker, RolloutError> {
    let mut worker = Worker::new(make_env(snapshot)?, snapshot, 1.0, stream(seed, 0))?;
    if let Some(scorer) = scorer {
        worker.set_scorer(scorer);
    }
    worker.set_projection(projection);
    Ok(worker)
}

/// Runs the episodes; what the simulator does is measured where the worker has a [`Watch`].
fn episodes_of(
    mut worker: Worker,
    snapshot: &Snapshot,
    episodes: usize,
    projection: bool,
) -> Result<Evaluation, RolloutError> {
    let (model, layout) = (worker.controller.model(), worker.controller.layout());
    let own = without_margins(&snapshot.manifest, model, layout.controllable());
    worker.beyond = Some((own.map_err(RolloutError::from)?, [None; 2]));
    let mode = if projection { "projected" } else { "raw" };
    let mut e = Evaluation {
        mode,
        returns: Vec::new(),
        costs: Vec::new(),
        lengths: Vec::new(),
        ticks: 0,
        raw_violations: 0,
        recovering: 0,
        target_violations: 0,
        reached_violations: 0,
        reached: None,
        replaced: 0,
        unavoided: 0,
        worst: Vec::new(),
        measured: Vec::new(),
        faults: 0,
        told: Vec::new(),
        residual: 0.0,
    };
    let names = worker.notes().to_vec();
    let (mut told, mut by_episode) = (Vec::new(), Vec::new());
    for _ in 0..episodes {
        let before = worker.outside.0;
        let (ret, length) = worker.evaluate().map_err(RolloutError::from)?;
        if let Some((what, value)) = worker.rows.collected.odd_observation(&snapshot.manifest.task) {
            return Err(RolloutError::Odd { task: snapshot.manifest.task.name.clone(), what, value });
        }
        let t = &worker.rows.collected.tally;
        told.push(t.notes.clone());
        by_episode.push((worker.outside.0 - before) as f64 / t.ticks.max(1) as f64);
        e.returns.push(ret);
        e.costs.extend_from_slice(&t.costs);
        e.lengths.push(length);
        e.ticks += t.ticks;
        e.raw_violations += t.raw_violations;
        e.recovering += t.recovering;
        e.target_violations += t.target_violations;
        e.reached_violations += t.reached_violations;
        e.faults += t.faults;
        e.residual += t.residual;
    }
    [e.replaced, e.unavoided] = worker.foreseen;
    e.reached = reached(&worker, e.ticks, by_episode);
    e.told = names
        .into_iter()
        .enumerate()
        .map(|(i, name)| tell(name, told.iter().map(|notes| notes[i])))
        .collect();
    e.residual /= e.ticks.max(1) as f64;
    let beyond = worker.beyond.as_ref().map_or([None; 2], |(_, most)| *most);
    for ((limit, excess), own) in ["position", "velocity"].into_iter().zip(worker.excess).zip(beyond) {
        let joint = |dof| worker.controller.model().dof_name(dof);
        let beyond_margin = own.map_or(0.0, |x| x.by);
        e.worst.extend(excess.map(|x| Worst { limit, joint: joint(x.dof), by: x.by, beyond_margin }));
    }
    e.measured = measured(&worker);
    Ok(e)
}

fn measured(worker: &Worker) -> Vec<Measured> {
    let Some(meter) = worker.watch.as_ref().map(Watch::meter) else { return Vec::new() };
    let limits = meter.limits();
    let kinds = [
        ("acceleration", &limits.acceleration, Some(meter.acceleration())),
        ("torque", &limits.effort, meter.effort()),
    ];
    let kept = |(limit, ends, worst): (_, &Vec<f64>, Option<MeterWorst>)| {
        let worst = worst.filter(|_| ends.iter().any(|end| end.is_finite()))?;
        let joint = if worst.states > 0 { worker.joint_of(worst.index) } else { String::new() };
        let by = if worst.states > 0 { worst.excess } else { 0.0 };
        Some(Measured { limit, outside: worst.states, joint, by })
    };
    kinds.into_iter().filter_map(kept).collect()
}

fn reached(worker: &Worker, ticks: u64, by_episode: Vec<f64>) -> Option<Reached> {
    let (controller, (any, by_row)) = (&worker.controller, &worker.outside);
    let (asked, share) = (controller.asked()?, *any as f64 / ticks.max(1) as f64);
    let limits = controller.limits();
    let of_row = |(margin, &outside): (Margin, &u64)| {
        let limit = if margin.is_upper { &limits.q_upper } else { &limits.q_lower }[margin.dof];
        limit.is_finite().then(|| ReachedRow {
            joint: controller.model().dof_name(margin.dof),
            side: if margin.is_upper { "above" } else { "below" },
            outside,
            margin: margin.share,
            unattainable: margin.at_end && outside > 0 && share > asked,
        })
    };
    let rows = controller.margins().into_iter().zip(by_row).filter_map(of_row).collect();
    Some(Reached { asked, share, by_episode, rows })
}

fn tell(name: String, values: impl ExactSizeIterator<Item = f64>) -> Told {
    let n = values.len().max(1) as f64;
    let (sum, largest) = values.fold((0.0, f64::NEG_INFINITY), |(sum, most), x| (sum + x, x.max(most)));
    Told { name, mean: sum / n, largest }
}

/// The position and velocity limits of the task with no margin and the robot's whole speed.
fn without_margins(m: &Manifest, model: &Model, controllable: &[usize]) -> Result<LimitSet, SnapshotError> {
    let ConstraintSettings { mut position, mut velocity, .. } = m.task.constraints.clone();
    position.iter_mut().for_each(|p| p.margin = PerJoint::All(0.0));
    velocity.iter_mut().for_each(|v| (v.scale, v.margin) = (v.scale.map(|_| 1.0), None));
    let settings = ConstraintSettings { position, velocity, ..ConstraintSettings::default() };
    let unusable =
        |e: nearl_runtime::constraints::LimitError| SnapshotError::Unusable { reason: e.to_string() };
    let limits = build_limits(&settings, model).map_err(unusable)?;
    LimitSet::collect(model, &limits, controllable).map_err(unusable)
}
