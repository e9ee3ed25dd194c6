//! Coupled rows: the closed form if it obeys them, else the active-set stage, else Clarabel, else no answer.

use super::{Projector, Stages};
use crate::ledger::{ActiveRow, BrakeReason, Rung, Side};
use crate::target::{Solver, Target};
use crate::viability::Kind;

/// Share of its limit by which the closed form and Clarabel's answer may exceed a row; the checker allows ten times this.
const ROW_TOLERANCE: f64 = 1e-10;

impl Projector {
    /// True when coupled rows changed `v_next`.
    pub(super) fn coupled_rows(
        &mut self,
        q: &[f64],
        v: &[f64],
        target: &mut Target,
    ) -> Result<bool, BrakeReason> {
        let Some(stages) = &mut self.coupled else { return Ok(false) };
        let p = &mut stages.problem;
        for (k, &i) in self.dofs.controllable.iter().enumerate() {
            p.goal[k] = self.goal[i] - v[i];
            p.lower[k] = self.bounds.v_lower[i] - v[i];
            p.upper[k] = self.bounds.v_upper[i] - v[i];
            stages.y[k] = self.v_next[i] - v[i];
        }
        for &j in &self.dofs.fixed {
            self.tangent[j] = self.v_next[j] - v[j];
        }
        p.linearise(&mut self.dynamics, q, v, &self.dofs, &self.tangent, self.period.dt);
        if !p.is_finite() {
            return Err(BrakeReason::NonFiniteDynamics);
        }
        p.tame_goal();
        let clamped = self.dofs.controllable.iter().any(|i| self.goal[*i] != self.v_next[*i]);
        let obeyed = p.violation(&stages.y) <= ROW_TOLERANCE;
        let by_clarabel = self.settings.solver == Solver::Clarabel;
        if obeyed && !(by_clarabel && clamped) {
            return Ok(false);
        }
        let rung = stages.solve(by_clarabel, &mut target.ledger.iterations)?;
        target.ledger.rung = rung;
        self.take(v, rung, target);
        Ok(true)
    }

    /// Takes over the answer of a stage with its multipliers.
    fn take(&mut self, v: &[f64], rung: Rung, target: &mut Target) {
        let Some(stages) = &self.coupled else { return };
        let exact = rung == Rung::ActiveSet;
        let (s, c, p) = (&stages.active_set, &stages.conic, &stages.problem);
        let (y, mu, lambda) = if exact { (&s.y, &s.mu, &s.lambda) } else { (&c.y, &c.mu, &c.lambda) };
        let rounding = if exact { 0.0 } else { 1e-6 };
        target.ledger.residual = p.residual(y, mu, lambda);
        for (k, &i) in self.dofs.controllable.iter().enumerate() {
            let (low, high) = (self.bounds.v_lower[i], self.bounds.v_upper[i]);
            // A dof at its bound or at its goal gets those bits, not a sum's.
            self.v_next[i] = match y[k] {
                y if y <= p.lower[k] => low,
                y if y >= p.upper[k] => high,
                y if y == p.goal[k] => self.goal[i].clamp(low, high),
                y => (v[i] + y).clamp(low, high),
            };
        }
        let floor = rounding * p.hessian.iter().fold(0.0, |m: f64, h| m.max(*h));
        for (k, &i) in self.dofs.controllable.iter().enumerate().filter(|(k, _)| mu[*k].abs() > floor) {
            self.push_box(i, mu[k], target);
        }
        for r in (0..p.m).filter(|r| lambda[*r].abs() * p.row_size[*r] > floor) {
            let side = if lambda[r] > 0.0 { Side::Upper } else { Side::Lower };
            let multiplier = lambda[r].abs();
            target.ledger.active.push(ActiveRow { kind: Kind::Torque, dof: p.row_dof[r], side, multiplier });
        }
    }
}

impl Stages {
    fn solve(&mut self, by_clarabel: bool, iterations: &mut u32) -> Result<Rung, BrakeReason> {
        if !by_clarabel {
            let settled = self.active_set.solve(&self.problem);
            *iterations += self.active_set.iterations;
            if settled {
                return Ok(Rung::ActiveSet);
            }
        }
        let answered = self.conic.solve(&self.problem);
        *iterations += self.conic.iterations;
        if answered && self.problem.violation(&self.conic.y) <= ROW_TOLERANCE {
            return Ok(Rung::Clarabel);
        }
        Err(BrakeReason::NoCertifiedAnswer)
    }
}
