//! The projector: the nearest next state that every limit allows.
//!
//! [`Projector::project`] is the page to read; the stages it calls are in the files beside it.

mod active_set;
mod build;
mod conic;
mod coupled;
mod ladder;

pub use coupled::Problem;

use crate::checker::Checker;
use crate::ledger::{ActiveRow, BrakeReason, RefuseReason, Rung, Side, Status};
use crate::target::{Bounds, Consistency, Proposal, Settings, Target};
use crate::viability::{Dof, Interval, Kind, Period, interval};
use crate::{Dynamics, LimitSet, Model};
use active_set::ActiveSet;
use conic::Conic;
use coupled::Coupled;
use std::time::Instant;

/// Projects proposals for one robot at one control period.
///
/// With `T` the period, `y = v' - v` and `kappa` from [`Period`], the kinematic mode solves
///
/// ```text
///     min_y 1/2 |W (q (+) (T v + kappa T y) (-) q_hat) / (kappa T)|^2 + 1/2 |W (v + y - v_hat)|^2
///     s.t.  viability box of each dof,   |(M/T) y + nle - passive| <= effort
/// ```
///
/// and the free mode clamps `v'` to the box and `q'` to `q (+) [T v + kappa T lb, T v + kappa T ub]` cut with the
/// position limits. Dofs that are not controllable pass through; in torque rows they are constants at the
/// velocity change they propose.
///
/// Nothing allocates after [`Projector::new`] but one small buffer inside each Clarabel solve. Given the same input, the
/// output has the same bits, whatever was projected before.
pub struct Projector {
    model: Model,
    dynamics: Dynamics,
    limits: LimitSet,
    dofs: Dofs,
    settings: Settings,
    period: Period,
    /// `w_i^2` for each dof (nv).
    weight: Vec<f64>,
    /// Deceleration each dof brakes with (nv).
    braking: Vec<f64>,
    bounds: Bounds,
    intervals: Vec<Interval>,
    checker: Checker,
    coupled: Option<Stages>,
    /// `q_hat (-) q` (nv).
    displacement: Vec<f64>,
    /// Unconstrained optimum of v' (nv).
    goal: Vec<f64>,
    /// Next velocity under construction (nv).
    v_next: Vec<f64>,
    /// The proposal's position and velocity belong together (nv).
    consistent: Vec<bool>,
    tangent: Vec<f64>,
    integrated: Vec<f64>,
}

/// The dofs by role.
pub(crate) struct Dofs {
    /// Dofs the projector may move, ascending.
    pub(crate) controllable: Vec<usize>,
    /// The others.
    pub(crate) fixed: Vec<usize>,
    /// For each dof, the configuration entry of its joint when that has exactly one of each.
    pub(crate) single: Vec<Option<usize>>,
    /// Some joint has several dofs or a configuration on a circle: Pinocchio integrates.
    pub(crate) curved: bool,
}

/// The stages for coupled rows.
struct Stages {
    problem: Coupled,
    active_set: ActiveSet,
    conic: Conic,
    y: Vec<f64>,
}

/// Position and velocity of a proposal belong together up to this [rad or m, relative above 1].
const CONSISTENT: f64 = 1e-11;

/// Velocities are kept below this, so that nothing overflows [rad/s or m/s].
const HUGE: f64 = 1e12;

impl Projector {
    /// Projects `proposal` for the measured configuration `q` (nq) and velocity `v` (nv) into `target`.
    ///
    /// Every field of `target` is finite afterwards, whatever the input; only [`RefuseReason::WrongLength`] leaves it
    /// as it was.
    pub fn project(&mut self, q: &[f64], v: &[f64], proposal: &Proposal, target: &mut Target) -> Status {
        let start = Instant::now();
        target.ledger.reset();
        let status = self.ladder(q, v, proposal, target);
        target.ledger.status = status;
        target.ledger.duration_ns = start.elapsed().as_nanos() as u64;
        status
    }

    fn ladder(&mut self, q: &[f64], v: &[f64], proposal: &Proposal, target: &mut Target) -> Status {
        if !self.lengths_fit(q, v, proposal, target) {
            return Status::Refused(RefuseReason::WrongLength);
        }
        if !(finite(q) && finite(v)) {
            return self.refuse(q, target);
        }
        self.update_bounds(q, v, target);
        if !(finite(&proposal.q) && finite(&proposal.v)) {
            return self.brake(q, v, None, target, BrakeReason::NonFiniteProposal);
        }
        target.ledger.raw_violations = self.checker.check(q, v, &proposal.q, &proposal.v).counts;
        let outcome = match self.settings.consistency {
            Consistency::Kinematic => self.kinematic(q, v, proposal, target),
            Consistency::Free => self.free(v, proposal, target),
        };
        match outcome {
            Ok(status) => self.judge(q, v, proposal, target, status),
            Err(reason) => self.brake(q, v, Some(proposal), target, reason),
        }
    }

    /// The box of the last tick, per dof.
    pub fn bounds(&self) -> &Bounds {
        &self.bounds
    }

    /// The problem with coupled rows that the last tick solved or checked, for other solvers to compare with; `None`
    /// without coupled rows. Allocates.
    pub fn problem(&self) -> Option<Problem> {
        self.coupled.as_ref().map(|stages| Problem::of(&stages.problem, &self.dofs.controllable))
    }

    /// The limits of the model and the task together.
    pub fn limits(&self) -> &LimitSet {
        &self.limits
    }

    /// The dofs the projector may move, ascending.
    pub fn controllable(&self) -> &[usize] {
        &self.dofs.controllable
    }

    /// The settings it was built with.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The model it was built for.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// `[v_lower, v_upper]` and `[q_lower, q_upper]` of each controllable dof from the viability box.
    fn update_bounds(&mut self, q: &[f64], v: &[f64], target: &mut Target) {
        let (t, kappa) = (self.period.dt, self.period.kappa);
        let free = self.settings.consistency == Consistency::Free;
        for &i in &self.dofs.controllable {
            let mut dof = Dof::of(&self.limits, i);
            if dof.acceleration.is_infinite() {
                // Free mode without braking: the cut below is all there is.
                (dof.lower, dof.upper) = (f64::NEG_INFINITY, f64::INFINITY);
            }
            let x = interval(&dof, self.dofs.single[i].map_or(0.0, |iq| q[iq]), v[i], &self.period);
            let exact =
                |kind: Kind, bound: f64, v_max: f64| match kind == Kind::Velocity && x.outside.is_none() {
                    true => v_max,
                    false => v[i] + t * bound,
                };
            let v_lower = exact(x.lower_kind, x.lower, -dof.velocity);
            let v_upper = exact(x.upper_kind, x.upper, dof.velocity).max(v_lower);
            (self.bounds.v_lower[i], self.bounds.v_upper[i]) = (v_lower, v_upper);
            if let Some(iq) = self.dofs.single[i] {
                let reach = |v_next: f64| q[iq] + (t * v[i] + kappa * t * (v_next - v[i]));
                let (mut lower, mut upper) = (reach(v_lower), reach(v_upper));
                if free {
                    // Cut with the limits; beyond them, the reachable position nearest to them.
                    lower = lower.max(self.limits.q_lower[i]).min(upper);
                    upper = upper.min(self.limits.q_upper[i]).max(lower);
                }
                (self.bounds.q_lower[i], self.bounds.q_upper[i]) = (lower, upper);
            }
            target.ledger.outside += u32::from(x.outside.is_some());
            self.intervals[i] = x;
        }
    }

    /// Free mode: velocity and position of each dof are clamped apart.
    fn free(&mut self, v: &[f64], proposal: &Proposal, target: &mut Target) -> Result<Status, BrakeReason> {
        target.q.copy_from_slice(&proposal.q);
        target.v.copy_from_slice(&proposal.v);
        let position_weight = (self.period.kappa * self.period.dt).powi(-2);
        let (mut moved, mut unchanged) = (0.0, true);
        for &i in &self.dofs.controllable {
            let (b, x) = (&self.bounds, &self.intervals[i]);
            let mut clamp = |value: f64, lower: f64, upper: f64, weight: f64, kinds: (Kind, Kind)| {
                let clamped = value.clamp(lower, upper);
                if clamped != value {
                    let side = if value > upper { Side::Upper } else { Side::Lower };
                    let kind = if side == Side::Upper { kinds.1 } else { kinds.0 };
                    let multiplier = weight * (value - clamped).abs();
                    target.ledger.active.push(ActiveRow { kind, dof: i, side, multiplier });
                    moved += weight * (value - clamped).powi(2);
                    unchanged = false;
                }
                clamped
            };
            let kinds = (x.lower_kind, x.upper_kind);
            target.v[i] = clamp(proposal.v[i], b.v_lower[i], b.v_upper[i], self.weight[i], kinds);
            if let Some(iq) = self.dofs.single[i] {
                let cut =
                    |bound: f64, limit: f64, kind: Kind| if bound == limit { Kind::Position } else { kind };
                let kinds = (
                    cut(b.q_lower[i], self.limits.q_lower[i], x.lower_kind),
                    cut(b.q_upper[i], self.limits.q_upper[i], x.upper_kind),
                );
                let weight = self.weight[i] * position_weight;
                target.q[iq] = clamp(proposal.q[iq], b.q_lower[i], b.q_upper[i], weight, kinds);
            }
        }
        for i in 0..v.len() {
            target.acceleration[i] = (target.v[i] - v[i]) / self.period.dt;
        }
        target.ledger.moved = f64::sqrt(moved);
        Ok(if unchanged { Status::Unchanged } else { Status::Clamped })
    }

    /// Kinematic mode: one velocity change per dof.
    fn kinematic(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: &Proposal,
        target: &mut Target,
    ) -> Result<Status, BrakeReason> {
        self.find_goal(q, v, proposal);
        self.v_next.copy_from_slice(&proposal.v);
        for &i in &self.dofs.controllable {
            self.v_next[i] = self.goal[i].clamp(self.bounds.v_lower[i], self.bounds.v_upper[i]);
        }
        let solved = self.coupled_rows(q, v, target)?;
        if !solved {
            self.report_box(target);
        }
        let unchanged = self.write(q, v, Some(proposal), target);
        Ok(match (solved, unchanged) {
            (true, _) => Status::Solved,
            (false, true) => Status::Unchanged,
            (false, false) => Status::Clamped,
        })
    }

    /// Unconstrained optimum. With `e = q_hat (-) q`, position asks for `y_q = (e - T v) / (kappa T)` and velocity for
    /// `y_v = v_hat - v`, with equal weight: `y* = (y_q + y_v) / 2`.
    fn find_goal(&mut self, q: &[f64], v: &[f64], proposal: &Proposal) {
        let (t, kappa) = (self.period.dt, self.period.kappa);
        if self.dofs.curved {
            self.dynamics.difference(q, &proposal.q, &mut self.displacement);
        }
        for &i in &self.dofs.controllable {
            let mut size = 1.0;
            if let Some(iq) = self.dofs.single[i] {
                self.displacement[i] = proposal.q[iq] - q[iq];
                size = proposal.q[iq].abs().max(q[iq].abs()).max(1.0);
            }
            let (e, y_v) = (self.displacement[i], (proposal.v[i] - v[i]).clamp(-HUGE, HUGE));
            let y_q = ((e - t * v[i]) / (kappa * t)).clamp(-HUGE, HUGE);
            self.consistent[i] = (kappa * t * (y_q - y_v)).abs() <= CONSISTENT * size;
            self.goal[i] = if self.consistent[i] { proposal.v[i] } else { v[i] + 0.5 * (y_q + y_v) };
        }
    }

    /// Writes the target that `v_next` leads to; true when it is the proposal, bit for bit. Without a proposal, dofs
    /// that are not controllable keep their velocity.
    fn write(&mut self, q: &[f64], v: &[f64], proposal: Option<&Proposal>, target: &mut Target) -> bool {
        let (t, kappa) = (self.period.dt, self.period.kappa);
        for i in 0..v.len() {
            let y = self.v_next[i] - v[i];
            target.v[i] = self.v_next[i];
            target.acceleration[i] = y / t;
            self.tangent[i] = t * v[i] + kappa * t * y;
        }
        if self.dofs.curved {
            self.dynamics.integrate(q, &self.tangent, &mut self.integrated);
        }
        let (mut unchanged, mut moved) = (true, 0.0);
        for joint in self.model.joints() {
            let dofs = joint.idx_v..joint.idx_v + joint.nv;
            let movable = self.dofs.controllable.binary_search(&joint.idx_v).is_ok();
            let kept = |p: &Proposal| {
                !movable || dofs.clone().all(|i| self.consistent[i] && self.v_next[i] == p.v[i])
            };
            let entries = joint.idx_q..joint.idx_q + joint.nq;
            match proposal {
                Some(p) if kept(p) => target.q[entries.clone()].copy_from_slice(&p.q[entries]),
                _ if self.dofs.single[joint.idx_v].is_some() => {
                    target.q[joint.idx_q] = q[joint.idx_q] + self.tangent[joint.idx_v];
                    unchanged = false;
                }
                _ => {
                    target.q[entries.clone()].copy_from_slice(&self.integrated[entries]);
                    unchanged = false;
                }
            }
            if let Some(p) = proposal.filter(|p| movable && !kept(p)) {
                for i in dofs {
                    let (dq, dv) = (self.tangent[i] - self.displacement[i], self.v_next[i] - p.v[i]);
                    moved += self.weight[i] * ((dq / (kappa * t)).powi(2) + dv * dv);
                }
            }
        }
        target.ledger.moved = f64::sqrt(moved).min(f64::MAX);
        unchanged
    }

    /// Active rows of the closed form: `mu = H |goal - y|` with `H = 2 w^2`.
    fn report_box(&self, target: &mut Target) {
        for &i in &self.dofs.controllable {
            let excess = self.goal[i] - self.v_next[i];
            if excess != 0.0 {
                self.push_box(i, 2.0 * self.weight[i] * excess, target);
            }
        }
    }

    fn push_box(&self, dof: usize, signed: f64, target: &mut Target) {
        let x = &self.intervals[dof];
        let (side, kind) =
            if signed > 0.0 { (Side::Upper, x.upper_kind) } else { (Side::Lower, x.lower_kind) };
        target.ledger.active.push(ActiveRow { kind, dof, side, multiplier: signed.abs() });
    }

    /// The independent checker has the last word.
    fn judge(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: &Proposal,
        target: &mut Target,
        status: Status,
    ) -> Status {
        let verdict = self.checker.check(q, v, &target.q, &target.v);
        target.ledger.violations = verdict.counts;
        target.ledger.slack = verdict.worst;
        let outside = target.ledger.outside > 0;
        if verdict.accepts() || (outside && verdict.counts.torque == 0) {
            return if outside { Status::Recovering } else { status };
        }
        self.brake(q, v, Some(proposal), target, BrakeReason::NoCertifiedAnswer)
    }

    /// Last rung: every controllable dof takes `-sgn(v) min(A_b, |v| / T)`, inside its box.
    fn brake(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: Option<&Proposal>,
        target: &mut Target,
        reason: BrakeReason,
    ) -> Status {
        self.v_next.copy_from_slice(proposal.map_or(v, |p| &p.v));
        self.consistent.fill(false);
        for &i in &self.dofs.controllable {
            let stop = v[i] - v[i].signum() * (self.braking[i] * self.period.dt).min(v[i].abs());
            self.v_next[i] = stop.clamp(self.bounds.v_lower[i], self.bounds.v_upper[i]);
        }
        target.ledger.active.clear();
        self.write(q, v, proposal, target);
        let verdict = self.checker.check(q, v, &target.q, &target.v);
        target.ledger.violations = verdict.counts;
        target.ledger.slack = if verdict.worst.is_finite() { verdict.worst } else { f64::MAX };
        target.ledger.rung = Rung::Brake;
        Status::Braked(reason)
    }

    /// A finite target that stands still, for a state nobody knows.
    fn refuse(&self, q: &[f64], target: &mut Target) -> Status {
        target.q.copy_from_slice(q);
        if !finite(q) {
            target.q.copy_from_slice(self.model.raw_neutral());
        }
        target.v.fill(0.0);
        target.acceleration.fill(0.0);
        target.ledger.rung = Rung::Brake;
        Status::Refused(RefuseReason::NonFiniteState)
    }

    fn lengths_fit(&self, q: &[f64], v: &[f64], proposal: &Proposal, target: &Target) -> bool {
        let (nq, nv) = (self.model.nq(), self.model.nv());
        [q.len(), proposal.q.len(), target.q.len()].iter().all(|n| *n == nq)
            && [v.len(), proposal.v.len(), target.v.len(), target.acceleration.len()].iter().all(|n| *n == nv)
    }
}

fn finite(x: &[f64]) -> bool {
    x.iter().all(|x| x.is_finite())
}
