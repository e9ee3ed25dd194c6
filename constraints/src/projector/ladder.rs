//! Coupled rows and cones: the closed form if it obeys them, else the active-set stage, else Clarabel, else both without the soft
//! rows, else no answer.

use super::sources::Measured;
use super::{Projector, Stages};
use crate::ledger::{ActiveRow, BrakeReason, Rung, Side};
use crate::target::{Solver, Target};

/// Share of its limit by which the closed form and Clarabel's answer may exceed a row or a cone; the checker allows ten times this.
pub(super) const ROW_TOLERANCE: f64 = 1e-10;

/// The same for equal rows, which Clarabel cannot be kept a little inside of.
const EQUALITY_TOLERANCE: f64 = 5e-10;

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
        if !self.fill_rows(q, v) {
            return Err(BrakeReason::NonFiniteDynamics);
        }
        let Some(stages) = &mut self.coupled else { return Ok(false) };
        let p = &mut stages.problem;
        let named = &mut target.ledger.outside; // a brake asks a second time
        for row in stages.sources.outside().map(|r| v.len() + r) {
            if !named.contains(&row) {
                named.push(row);
            }
        }
        p.tame_goal();
        let clamped = self.dofs.controllable.iter().any(|i| self.goal[*i] != self.v_next[*i]);
        let obeyed =
            stages.obeys(&stages.y, ROW_TOLERANCE) && stages.problem.obeys_soft(&stages.y, ROW_TOLERANCE);
        let by_clarabel = self.settings.solver == Solver::Clarabel;
        if obeyed && !(by_clarabel && clamped) {
            return Ok(false);
        }
        let rung = stages.solve(by_clarabel, &mut target.ledger.iterations)?;
        target.ledger.rung = rung;
        self.take(v, target);
        Ok(true)
    }

    /// Writes the rows and cones at `q`, `v`, with what `v_next` asks of dofs that are not controllable; false where there are none, or where they are
    /// no numbers.
    pub(super) fn fill_rows(&mut self, q: &[f64], v: &[f64]) -> bool {
        let Some(stages) = &mut self.coupled else { return false };
        let p = &mut stages.problem;
        for &j in &self.dofs.fixed {
            self.tangent[j] = self.v_next[j] - v[j];
        }
        let measured = Measured { q, v, external: &self.external, previous: self.previous.get() };
        stages.sources.fill(p, &mut self.dynamics, &measured, &self.dofs, &self.tangent, &self.period);
        if !p.is_finite() {
            // Nothing of a tick changes the Hessian: whatever did does not reach the next one.
            p.hessian.copy_from_slice(stages.conic.hessian());
            return false;
        }
        true
    }

    /// Takes over the answer of a stage with its multipliers.
    fn take(&mut self, v: &[f64], target: &mut Target) {
        let Some(stages) = &self.coupled else { return };
        let (s, c, p) = (&stages.active_set, &stages.conic, &stages.problem);
        let (y, mu, lambda) = if stages.exact { (&s.y, &s.mu, &s.lambda) } else { (&c.y, &c.mu, &c.lambda) };
        let nu: &[f64] = if stages.exact { &[] } else { &c.nu };
        target.ledger.residual = p.residual(y, mu, lambda, nu);
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
        // Clarabel leaves every row a multiplier. A row that holds a joint back a little must be named all the same, where it is known which ones do.
        let floor = match (stages.exact, stages.polished) {
            (true, _) => 0.0,
            (false, true) => stages.polish.rounding(),
            (false, false) => 1e-6 * p.hessian.iter().fold(0.0, |m: f64, h| m.max(*h)),
        };
        for (k, &i) in self.dofs.controllable.iter().enumerate().filter(|(k, _)| mu[*k].abs() > floor) {
            self.push_box(i, mu[k], target);
        }
        let nv = v.len();
        for r in 0..p.m {
            let excess = if p.soft[r].is_some() { p.excess(r, y).max(0.0) } else { 0.0 };
            let slack = if excess > ROW_TOLERANCE { excess } else { 0.0 };
            if lambda[r].abs() > floor || slack > 0.0 {
                let upper = lambda[r] > 0.0 || (lambda[r] == 0.0 && p.row(r, y) > p.row_upper[r]);
                let side = if upper { Side::Upper } else { Side::Lower };
                let (kind, multiplier) = (stages.labels[r].kind, lambda[r].abs() / p.row_size[r]);
                target.ledger.active.push(ActiveRow { kind, row: nv + r, side, multiplier, slack });
            }
        }
        for (c, cone) in p.cones.iter().enumerate() {
            let (nu, excess) = (nu.get(c).copied().unwrap_or(0.0), cone.excess(y));
            let slack = if cone.soft.is_some() && excess > ROW_TOLERANCE { excess } else { 0.0 };
            if nu > floor || slack > 0.0 {
                let (kind, multiplier) = (stages.labels[p.m + c].kind, nu / cone.size);
                let (row, side) = (nv + p.m + c, Side::Upper);
                target.ledger.active.push(ActiveRow { kind, row, side, multiplier, slack });
            }
        }
    }
}

impl Stages {
    fn solve(&mut self, by_clarabel: bool, iterations: &mut u32) -> Result<Rung, BrakeReason> {
        if let Some(rung) = self.answer(by_clarabel, iterations) {
            return Ok(rung);
        }
        let p = &mut self.problem;
        let soft = (0..p.m).filter(|r| p.soft[*r].is_some());
        let dropped = soft.fold(0, |count, r| {
            (self.dropped[r].0, self.dropped[r].1) = (p.row_lower[r], p.row_upper[r]);
            (p.row_lower[r], p.row_upper[r]) = (f64::NEG_INFINITY, f64::INFINITY);
            count + 1
        });
        let dropped =
            p.cones.iter_mut().zip(&mut self.dropped[p.m..]).fold(dropped, |count, (cone, kept)| {
                if cone.soft.is_none() {
                    return count;
                }
                kept.1 = std::mem::replace(&mut cone.radius, f64::INFINITY);
                count + 1
            });
        if dropped == 0 {
            return Err(BrakeReason::NoCertifiedAnswer);
        }
        let relaxed = self.answer(by_clarabel, iterations).map(|_| Rung::Relaxed);
        let p = &mut self.problem;
        for r in (0..p.m).filter(|r| p.soft[*r].is_some()) {
            (p.row_lower[r], p.row_upper[r]) = self.dropped[r];
        }
        let cones = p.cones.iter_mut().zip(&self.dropped[p.m..]);
        cones.filter(|(cone, _)| cone.soft.is_some()).for_each(|(cone, kept)| cone.radius = kept.1);
        relaxed.ok_or(BrakeReason::NoCertifiedAnswer)
    }

    /// The first stage whose answer obeys everything hard.
    fn answer(&mut self, by_clarabel: bool, iterations: &mut u32) -> Option<Rung> {
        if !by_clarabel {
            let settled = self.active_set.solve(&self.problem);
            *iterations += self.active_set.iterations;
            let y = &self.active_set.y; // of the rows alone
            self.exact = settled && self.problem.cones.iter().all(|cone| cone.excess(y) <= ROW_TOLERANCE);
            if self.exact {
                return Some(Rung::ActiveSet);
            }
            if self.active_set.empty {
                return None; // shown: no stage has an answer
            }
        }
        self.exact = false;
        let answered = self.conic.solve(&self.problem);
        if answered {
            let late = self.conic.clock();
            self.polished = self.polish.refine(&self.problem, &mut self.conic, late);
        }
        *iterations += self.conic.iterations;
        (answered && self.obeys(&self.conic.y, ROW_TOLERANCE)).then_some(Rung::Clarabel)
    }

    /// Hard rows and cones hold.
    fn obeys(&self, y: &[f64], tolerance: f64) -> bool {
        let p = &self.problem;
        let allowed = |r: usize| if p.equality[r] { EQUALITY_TOLERANCE } else { tolerance };
        let rows = (0..p.m).filter(|r| p.soft[*r].is_none()).all(|r| p.excess(r, y) <= allowed(r));
        rows && p.cone_violation(y) <= tolerance
    }
}

#[cfg(test)]
mod tests {
    use super::super::*;
    use crate::random::Random;
    use crate::target::Solver;
    use crate::{AccelerationLimit, Limit, PositionLimit, Rung, Side, TorqueLimit, VelocityLimit};

    const PANDA: &str = include_str!("../../../examples/robots/panda/panda.urdf");

    /// Rows that hold a joint back a little are named too: what is named balances the pull of the proposal, by the problem's own slopes.
    #[test]
    fn what_is_named_of_a_polished_answer_balances_the_pull() {
        let model = Model::from_urdf_text(PANDA).unwrap();
        let limits: Vec<Box<dyn Limit>> = vec![
            Box::new(PositionLimit::default()),
            Box::new(VelocityLimit::default()),
            Box::new(AccelerationLimit::uniform(60.0)),
            Box::new(TorqueLimit::default()),
        ];
        let dofs: Vec<usize> = (0..7).collect();
        let settings =
            Settings { solver: Solver::Clarabel, braking: Braking::Certified, ..Settings::new(0.001, 1) };
        let mut projector = Projector::new(&model, &limits, &dofs, settings).unwrap();
        let mut target = Target::new(&model);
        let (mut q, mut v) = (vec![0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8], vec![0.0; 7]);
        let (mut random, mut wish, mut polished, mut worst) = (Random(11), vec![0.0; 7], 0, 0.0f64);
        for tick in 0..3000 {
            if tick % 40 == 0 {
                wish.iter_mut().for_each(|w| *w = 4.0 * random.between(-1.0, 1.0));
            }
            let proposal = Proposal { q: q.clone(), v: wish.clone() };
            projector.project(&q, &v, &proposal, &mut target);
            // Once more, from a little beyond the rows that hold this answer.
            let mut beyond = Proposal { q: target.q.clone(), v: target.v.clone() };
            beyond.v.iter_mut().zip(&wish).for_each(|(v, wish)| *v += 1e-7 * (wish - *v));
            let status = projector.project(&q, &v, &beyond, &mut target);
            let stages = projector.coupled.as_ref().unwrap();
            if (status, target.ledger.rung) == (Status::Solved, Rung::Clarabel) && stages.polished {
                let (p, y) = (&stages.problem, &stages.conic.y);
                let pull = (0..7).map(|k| p.hessian[k] * (p.goal[k] - y[k]));
                let left = target.ledger.active.iter().fold(pull.collect::<Vec<f64>>(), |mut left, row| {
                    let push = if row.side == Side::Upper { row.multiplier } else { -row.multiplier };
                    match row.row.checked_sub(7) {
                        None => left[row.row] -= push,
                        Some(r) => left
                            .iter_mut()
                            .zip(p.gradient(r))
                            .for_each(|(left, g)| *left -= push * p.row_size[r] * g),
                    }
                    left
                });
                polished += 1;
                worst = left.into_iter().fold(worst, |worst, left| worst.max(left.abs()));
            }
            (q, v) = (target.q.clone(), target.v.clone());
        }
        println!("{polished} polished answers, {worst:.1e} left");
        assert!(polished > 100 && worst < 1e-9, "{polished} {worst:e}");
    }
}
