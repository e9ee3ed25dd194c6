//! A proposal gives each joint a position and a velocity, but within one period a joint has a single freedom, its acceleration. Here are
//! the two ways to deal with that: `free` clamps position and velocity apart, `kinematic` looks for one velocity change that serves
//! both, and the position follows from it. Then the target is written.

use super::Projector;
use crate::ledger::{ActiveRow, BrakeReason, Side, Status};
use crate::target::{Proposal, Target};
use crate::viability::{Dof, Kind, coming_back};

/// Position and velocity of a proposal belong together up to this [rad or m, relative above 1].
const CONSISTENT: f64 = 1e-11;

/// Velocities are kept below this, so that nothing overflows [rad/s or m/s].
const HUGE: f64 = 1e12;

impl Projector {
    /// Free mode: velocity and position of each dof are clamped apart.
    pub(super) fn free(
        &mut self,
        v: &[f64],
        proposal: &Proposal,
        target: &mut Target,
    ) -> Result<Status, BrakeReason> {
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
                    let row = ActiveRow { kind, row: i, side, multiplier, slack: 0.0 };
                    target.ledger.active.push(row);
                    moved += weight * (value - clamped).powi(2);
                    unchanged = false;
                }
                clamped
            };
            let kinds = (x.lower_kind, x.upper_kind);
            target.v[i] = clamp(proposal.v[i], b.v_lower[i], b.v_upper[i], self.weight[i], kinds);
            let v_clamped = target.v[i] != proposal.v[i];
            let mut q_clamped = false;
            if let Some(iq) = self.dofs.single[i] {
                let cut =
                    |bound: f64, limit: f64, kind: Kind| if bound == limit { Kind::Position } else { kind };
                let kinds = (
                    cut(b.q_lower[i], self.limits.q_lower[i], x.lower_kind),
                    cut(b.q_upper[i], self.limits.q_upper[i], x.upper_kind),
                );
                let weight = self.weight[i] * position_weight;
                target.q[iq] = clamp(proposal.q[iq], b.q_lower[i], b.q_upper[i], weight, kinds);
                q_clamped = target.q[iq] != proposal.q[iq];
            }
            self.clamped[i] = [q_clamped, v_clamped];
        }
        for i in 0..v.len() {
            target.acceleration[i] = (target.v[i] - v[i]) / self.period.dt;
        }
        target.ledger.moved = f64::sqrt(moved);
        Ok(if unchanged { Status::Unchanged } else { Status::Clamped })
    }

    /// Kinematic mode: one velocity change per dof.
    pub(super) fn kinematic(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: &Proposal,
        target: &mut Target,
    ) -> Result<Status, BrakeReason> {
        self.find_goal(q, v, proposal);
        self.aim(v);
        self.come_back(q);
        self.v_next.copy_from_slice(&proposal.v);
        for &i in &self.dofs.controllable {
            self.v_next[i] = self.goal[i].clamp(self.bounds.v_lower[i], self.bounds.v_upper[i]);
        }
        let solved = self.coupled_rows(q, v, target)?;
        if !solved {
            self.report_box(target);
        }
        self.report_pulls(target);
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
            self.pull[i] = 0.0;
            if let Some(iq) = self.dofs.single[i] {
                self.displacement[i] = proposal.q[iq] - q[iq];
                size = q[iq].abs().max(1.0); // not the proposal's: next to 1e300 every speed would belong
            }
            let (e, y_v) = (self.displacement[i], (proposal.v[i] - v[i]).clamp(-HUGE, HUGE));
            let y_q = ((e - t * v[i]) / (kappa * t)).clamp(-HUGE, HUGE);
            self.consistent[i] = (kappa * t * (y_q - y_v)).abs() <= CONSISTENT * size;
            self.goal[i] = if self.consistent[i] { proposal.v[i] } else { v[i] + 0.5 * (y_q + y_v) };
        }
    }

    /// Joints that are beyond a position limit aim at coming back, whatever is proposed.
    fn come_back(&mut self, q: &[f64]) {
        for &i in self.dofs.controllable.iter().filter(|i| self.outside[**i]) {
            let Some(iq) = self.dofs.single[i] else { continue };
            let (most, least) = coming_back(&Dof::of(&self.limits, i), q[iq], &self.period);
            let goal = self.goal[i].min(most).max(least);
            self.pull[i] = self.goal[i] - goal;
            self.consistent[i] &= goal == self.goal[i];
            self.goal[i] = goal;
        }
    }

    /// What is coming back is held by its position limit.
    fn report_pulls(&self, target: &mut Target) {
        for &i in self.dofs.controllable.iter().filter(|i| self.pull[**i] != 0.0) {
            let side = if self.pull[i] > 0.0 { Side::Upper } else { Side::Lower };
            let multiplier = 2.0 * self.weight[i] * self.pull[i].abs();
            target.ledger.active.push(ActiveRow {
                kind: Kind::Position,
                row: i,
                side,
                multiplier,
                slack: 0.0,
            });
        }
    }

    /// Writes the target that `v_next` leads to; true when it is the proposal, bit for bit. Without a proposal, dofs
    /// that are not controllable keep their velocity.
    pub(super) fn write(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: Option<&Proposal>,
        target: &mut Target,
    ) -> bool {
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

    pub(super) fn push_box(&self, dof: usize, signed: f64, target: &mut Target) {
        let x = &self.intervals[dof];
        let (side, kind) =
            if signed > 0.0 { (Side::Upper, x.upper_kind) } else { (Side::Lower, x.lower_kind) };
        let multiplier = signed.abs();
        target.ledger.active.push(ActiveRow { kind, row: dof, side, multiplier, slack: 0.0 });
    }
}
