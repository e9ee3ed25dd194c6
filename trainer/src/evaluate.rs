//! `nearl eval`: episodes without noise, raw and projected.

use crate::rollout::{RolloutError, Worker, make_env, stream};
use nearl_runtime::Snapshot;
use serde::Serialize;

/// How far a joint came beyond a limit.
#[derive(Clone, Debug, Serialize)]
pub struct Worst {
    /// `position` or `velocity`.
    pub limit: &'static str,
    /// The joint.
    pub joint: String,
    /// Distance [rad or m, per s for a velocity].
    pub by: f64,
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
    /// Ticks whose action the simulator's guard replaced by one that stays inside.
    pub replaced: u64,
    /// Ticks for which it found none.
    pub unavoided: u64,
    /// Furthest that the simulator came beyond a position and a velocity limit; only what was broken.
    pub worst: Vec<Worst>,
    /// Control periods that could not be simulated: each ended its episode with the reward 0.
    pub faults: u64,
    /// Mean over ticks and controllable entries of |reached - target|, in standard deviations of change.
    pub residual: f64,
}

impl Evaluation {
    /// Mean return.
    pub fn mean_return(&self) -> f64 {
        self.returns.iter().sum::<f64>() / self.returns.len().max(1) as f64
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
    let mut worker = Worker::new(make_env(snapshot)?, snapshot, 1.0, stream(seed, 0))?;
    worker.set_projection(projection);
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
        replaced: 0,
        unavoided: 0,
        worst: Vec::new(),
        faults: 0,
        residual: 0.0,
    };
    for _ in 0..episodes {
        let (ret, length) = worker.evaluate().map_err(RolloutError::from)?;
        let t = &worker.rows.collected.tally;
        e.returns.push(ret);
        e.costs.extend_from_slice(&t.costs);
        e.lengths.push(length);
        e.ticks += t.ticks;
        e.raw_violations += t.raw_violations;
        e.recovering += t.recovering;
        e.target_violations += t.projected_violations;
        e.reached_violations += t.reached_violations;
        e.faults += t.faults;
        e.residual += t.residual;
    }
    [e.replaced, e.unavoided] = worker.foreseen;
    e.residual /= e.ticks.max(1) as f64;
    let named = ["position", "velocity"].into_iter().zip(worker.excess);
    let joint = |dof| worker.controller.model().dof_name(dof);
    e.worst = named
        .filter_map(|(limit, excess)| excess.map(|x| Worst { limit, joint: joint(x.dof), by: x.by }))
        .collect();
    Ok(e)
}
