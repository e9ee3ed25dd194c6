//! What one environment collected: rows for the learner, counts for the metrics.

use crate::stats::RunningStats;
use nearl_rollout_protocol::LEDGER;
use nearl_runtime::Output;
use nearl_runtime::constraints::Ledger;
use nearl_runtime::task::Task;

/// What one environment collected: `n_steps` policy steps, row by row.
#[derive(Clone, Debug, Default)]
pub struct Segment {
    /// Network inputs (n_steps x n_obs).
    pub x: Vec<f32>,
    /// Sampled proposal, normalised change (n_steps x n_state).
    pub change: Vec<f32>,
    /// Projected change (n_steps x n_state).
    pub target_change: Vec<f32>,
    /// Bounds of the projection (n_steps x n_state): `clamp(change, lower, upper)` is the target. Where more than bounds moved an entry
    /// both are the target.
    pub lower: Vec<f32>,
    /// See `lower`.
    pub upper: Vec<f32>,
    /// Reached change (n_steps x n_state).
    pub reached: Vec<f32>,
    /// Sampled action (n_steps x n_act).
    pub sampled: Vec<f32>,
    /// Executed action (n_steps x n_act).
    pub action: Vec<f32>,
    /// Log probability of what was sampled (n_steps).
    pub log_prob: Vec<f32>,
    /// Reward less the penalty for distance moved (n_steps).
    pub reward: Vec<f64>,
    /// Cost (n_steps).
    pub cost: Vec<f64>,
    /// The episode ended in a terminal state (n_steps).
    pub terminated: Vec<bool>,
    /// The episode was cut, by time or by the end of the segment (n_steps).
    pub truncated: Vec<bool>,
    /// What the value alone sees at the begin of each step (n_steps x n_privileged), as the simulator has it.
    pub privileged: Vec<f64>,
    /// The same at the end of each cut step (cuts x n_privileged).
    pub final_privileged: Vec<f64>,
    /// Network input of the true final observation of each cut step: step and (n_obs).
    pub final_x: Vec<(usize, Vec<f32>)>,
}

impl Segment {
    /// Adds what the controller put out in a policy step, and the change of state it led to in units of `scale` (n_state each).
    pub(super) fn push(&mut self, out: &Output, change: &[f64], scale: &[f64]) {
        self.x.extend_from_slice(&out.x);
        self.change.extend_from_slice(&out.change);
        self.target_change.extend_from_slice(&out.target_change);
        for (k, (&u, &target)) in out.change.iter().zip(&out.target_change).enumerate() {
            let (lower, upper) = held(u, target, (out.lower[k], out.upper[k]));
            self.lower.push(lower);
            self.upper.push(upper);
        }
        self.sampled.extend_from_slice(&out.sampled);
        self.action.extend(out.action.iter().map(|&a| a as f32));
        self.log_prob.push((out.log_prob_proposal + out.log_prob_action) as f32);
        self.reached.extend(change.iter().zip(scale).map(|(c, scale)| (c / scale).clamp(-10.0, 10.0) as f32));
    }

    /// Forgets every row; keeps the memory.
    pub(super) fn clear(&mut self) {
        let wide = [&mut self.x, &mut self.change, &mut self.target_change, &mut self.lower, &mut self.upper];
        wide.into_iter().for_each(Vec::clear);
        [&mut self.reached, &mut self.sampled, &mut self.action, &mut self.log_prob]
            .into_iter()
            .for_each(Vec::clear);
        self.reward.clear();
        self.cost.clear();
        self.terminated.clear();
        self.truncated.clear();
        self.final_x.clear();
        self.privileged.clear();
        self.final_privileged.clear();
    }
}

/// The bounds that take `u` to `target`: those of its own entry, or the target alone where rows, cones or the other half of its joint
/// moved it too.
fn held(u: f32, target: f32, (lower, upper): (f32, f32)) -> (f32, f32) {
    let alone = u.max(lower).min(upper);
    if (alone - target).abs() > 1e-5 * (1.0 + target.abs()) { (target, target) } else { (lower, upper) }
}

/// What was counted while collecting.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tally {
    /// Return and length in policy steps of each finished episode.
    pub episodes: Vec<(f64, usize)>,
    /// Cost of each finished episode.
    pub costs: Vec<f64>,
    /// What the environment told of the finished episodes, summed ([`Env::notes`](crate::env::Env::notes)).
    pub notes: Vec<f64>,
    /// Control ticks.
    pub ticks: u64,
    /// Ticks whose raw proposal broke a limit.
    pub raw_violations: u64,
    /// Ticks that began outside a limit: their targets can only come nearer.
    pub recovering: u64,
    /// Ticks that began within the limits and whose target broke one, by the independent checker.
    pub target_violations: u64,
    /// Ticks in which the projection moved the proposal.
    pub moved: u64,
    /// Sum of the weighted distances moved [weight rad/s].
    pub distance: f64,
    /// Ticks whose raw proposal broke a limit and whose target breaks none.
    pub avoided: u64,
    /// Sum over ticks of the rows that held the target back.
    pub active_rows: u64,
    /// Ticks after which the simulator's own state was outside a position or velocity limit.
    pub reached_violations: u64,
    /// Sum over ticks of the mean |reached - target| of the controllable entries, in units of the scale of change.
    pub residual: f64,
    /// Periods the physics could not be believed.
    pub faults: u64,
}

impl Tally {
    /// Counts a control tick by what the projection says of it; what only a simulator knows is the caller's.
    pub(crate) fn count(&mut self, ledger: &Ledger) {
        let (raw, left) = (ledger.raw_violations.total() > 0, ledger.target_violations.total() > 0);
        self.ticks += 1;
        self.raw_violations += u64::from(raw);
        self.recovering += u64::from(!ledger.outside.is_empty());
        self.target_violations += u64::from(ledger.target_breaks());
        self.moved += u64::from(ledger.moved > 0.0);
        self.distance += ledger.moved;
        self.avoided += u64::from(raw && !left);
        self.active_rows += ledger.active.len() as u64;
    }

    /// Counts and sums over ticks, in the order of [`LEDGER`].
    pub(crate) fn ledger(&self) -> [f64; LEDGER.len()] {
        let Self { ticks, raw_violations, recovering, target_violations, moved, distance, .. } = *self;
        let Self { avoided, active_rows, reached_violations, residual, faults, .. } = *self;
        let [ticks, raw, recovering, left, moved] =
            [ticks, raw_violations, recovering, target_violations, moved].map(|n| n as f64);
        let [avoided, rows, reached, faults] =
            [avoided, active_rows, reached_violations, faults].map(|n| n as f64);
        [ticks, raw, recovering, left, moved, distance, avoided, rows, reached, residual, faults]
    }

    /// The inverse of [`Tally::ledger`], without episodes.
    pub(crate) fn of_ledger(ledger: [f64; LEDGER.len()]) -> Self {
        let [ticks, raw, recovering, left, moved, distance, avoided, rows, reached, residual, faults] =
            ledger;
        let [ticks, raw_violations, recovering, target_violations, moved] =
            [ticks, raw, recovering, left, moved].map(|n| n as u64);
        let [avoided, active_rows, reached_violations, faults] =
            [avoided, rows, reached, faults].map(|n| n as u64);
        Self {
            episodes: Vec::new(),
            costs: Vec::new(),
            notes: Vec::new(),
            ticks,
            raw_violations,
            recovering,
            target_violations,
            moved,
            distance,
            avoided,
            active_rows,
            reached_violations,
            residual,
            faults,
        }
    }

    /// Adds what the environment tells of an episode that ended.
    pub(crate) fn note(&mut self, notes: &[f64]) {
        self.notes.resize(self.notes.len().max(notes.len()), 0.0);
        self.notes.iter_mut().zip(notes).for_each(|(sum, note)| *sum += note);
    }

    pub(crate) fn add(&mut self, other: &Self) {
        self.episodes.extend_from_slice(&other.episodes);
        self.costs.extend_from_slice(&other.costs);
        self.note(&other.notes);
        self.ticks += other.ticks;
        self.raw_violations += other.raw_violations;
        self.recovering += other.recovering;
        self.target_violations += other.target_violations;
        self.moved += other.moved;
        self.distance += other.distance;
        self.avoided += other.avoided;
        self.active_rows += other.active_rows;
        self.reached_violations += other.reached_violations;
        self.residual += other.residual;
        self.faults += other.faults;
    }
}

/// One stretch of experience with its counts and statistics.
#[derive(Clone, Debug)]
pub struct Collected {
    /// The collected rows.
    pub segment: Segment,
    /// What was counted.
    pub tally: Tally,
    /// Raw observations.
    pub obs_stats: RunningStats,
    /// Place and value of the first entry of an observation that was no finite number; empty where there was none.
    pub odd: Vec<f64>,
    /// Changes of the proposed state.
    pub change_stats: RunningStats,
    /// Discounted returns, for scaling the reward.
    pub return_stats: RunningStats,
    /// Discounted costs, for scaling the cost.
    pub cost_stats: RunningStats,
    /// The margins of `[constraints] reached` at its end ([`Controller::learned_margins`](nearl_runtime::Controller::learned_margins)).
    pub margins: Vec<f64>,
}

impl Collected {
    /// Nothing yet.
    pub(super) fn new(n_obs: usize, n_state: usize) -> Self {
        Self {
            segment: Segment::default(),
            tally: Tally::default(),
            obs_stats: RunningStats::new(n_obs),
            odd: Vec::new(),
            change_stats: RunningStats::new(n_state),
            return_stats: RunningStats::new(1),
            cost_stats: RunningStats::new(1),
            margins: Vec::new(),
        }
    }

    /// Adds a policy step that led to what the policy sees as `after` by the change of state `change`. Reward and cost come each with
    /// their discounted sums so far; `truncated` says that nothing follows in this stretch.
    pub(super) fn push(
        &mut self,
        out: &Output,
        (change, scale): (&[f64], &[f64]),
        after: &[f64],
        [(reward, discounted), (cost, discounted_cost)]: [(f64, f64); 2],
        (terminated, truncated): (bool, bool),
    ) {
        self.segment.push(out, change, scale);
        self.segment.reward.push(reward);
        self.segment.cost.push(cost);
        self.segment.terminated.push(terminated);
        self.segment.truncated.push(truncated);
        self.change_stats.push(change);
        self.see(after);
        self.return_stats.push(&[discounted]);
        self.cost_stats.push(&[discounted_cost]);
    }

    /// Counts what the policy sees (n_seen).
    pub(super) fn see(&mut self, seen: &[f64]) {
        if !self.obs_stats.push(seen) && self.odd.is_empty() {
            let place = seen.iter().position(|x| !x.is_finite());
            self.odd.extend(place.into_iter().flat_map(|k| [k as f64, seen[k]]));
        }
    }

    /// The first observation that was no finite number, and that.
    pub(crate) fn odd_observation(&self, task: &Task) -> Option<(String, f64)> {
        let [k, value] = self.odd[..] else { return None };
        Some((format!("observation '{}'", nth(&task.state.observation, k as usize)), value))
    }

    /// Forgets everything; keeps the rows' memory.
    pub(super) fn clear(&mut self) {
        self.segment.clear();
        self.odd.clear();
        self.tally = Tally::default();
        self.margins.clear();
        for stats in
            [&mut self.obs_stats, &mut self.change_stats, &mut self.return_stats, &mut self.cost_stats]
        {
            stats.clear();
        }
    }
}

/// The name of the k-th entry of a row, as far as they have names.
pub(crate) fn nth(names: &[String], k: usize) -> String {
    names.get(k).cloned().unwrap_or_else(|| format!("number {k}"))
}
