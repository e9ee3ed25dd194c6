//! Derivative of the target with respect to the proposal, as a vector-Jacobian product.
//!
//! The optimality conditions of the last tick (`kkt.rs`) change with the goal as `K (dy, dlambda) = (H dgoal, 0)`, so for a cotangent w
//! of y the cotangent of the goal is `H z` with `z = (K^-1)(w, 0)`: the weighted projector onto the null space of the active rows.
//! `goal = v + (y_q + y_v) / 2` then hands half of it to the velocity and `1 / (2 kappa T)` to the position
//! proposed. Where the active set changes there is no derivative; this is then one of its one-sided ones.

use super::coupled::Coupled;
use super::kkt::Kkt;
use super::{Projector, Stages};
use crate::Soft;
use crate::ledger::{Rung, Status};
use crate::target::Consistency;

/// A multiplier of Clarabel's below this share of the largest is rounding.
const ROUNDING: f64 = 1e-6;

impl Projector {
    /// Pulls a cotangent of the last target back to the last proposal: `dq`, `dv` (nv) are the derivatives of a scalar with respect to
    /// target configuration and velocity, `dq_proposal`, `dv_proposal` (nv) become those with respect to the proposal; configurations in
    /// tangent space, which for joints with one dof is the configuration itself. Allocates.
    ///
    /// Where the proposal was not used (braking, refusal, the stored brake) the controllable dofs get zero.
    pub fn vjp(&self, dq: &[f64], dv: &[f64], dq_proposal: &mut [f64], dv_proposal: &mut [f64]) {
        dq_proposal.copy_from_slice(dq);
        dv_proposal.copy_from_slice(dv);
        for &i in &self.dofs.controllable {
            (dq_proposal[i], dv_proposal[i]) = (0.0, 0.0);
        }
        let used =
            matches!(self.last.0, Status::Unchanged | Status::Clamped | Status::Solved | Status::Recovering);
        match self.settings.consistency {
            _ if !used => {}
            Consistency::Free => self.pull_back_free(dq, dv, dq_proposal, dv_proposal),
            Consistency::Kinematic => self.pull_back_kinematic(dq, dv, dq_proposal, dv_proposal),
        }
    }

    fn pull_back_free(&self, dq: &[f64], dv: &[f64], dq_proposal: &mut [f64], dv_proposal: &mut [f64]) {
        for &i in &self.dofs.controllable {
            let [q_clamped, v_clamped] = self.clamped[i];
            dv_proposal[i] = if v_clamped { 0.0 } else { dv[i] };
            dq_proposal[i] = if q_clamped { 0.0 } else { dq[i] };
        }
    }

    fn pull_back_kinematic(&self, dq: &[f64], dv: &[f64], dq_proposal: &mut [f64], dv_proposal: &mut [f64]) {
        let way = self.period.kappa * self.period.dt;
        let controllable = &self.dofs.controllable;
        let w: Vec<f64> = controllable.iter().map(|&i| dv[i] + way * dq[i]).collect();
        let solved = self.coupled.as_ref().filter(|_| self.last.1 != Rung::ClosedForm);
        let dgoal = match solved {
            None => self.through_the_box(&w),
            Some(stages) => {
                let (dgoal, dfixed) = Held::of(stages).pull_back(&stages.problem, &w);
                for (&j, d) in self.dofs.fixed.iter().zip(dfixed) {
                    dv_proposal[j] += d;
                }
                dgoal
            }
        };
        for (&i, d) in controllable.iter().zip(dgoal).filter(|(i, _)| self.pull[**i] == 0.0) {
            dv_proposal[i] = 0.5 * d;
            dq_proposal[i] = 0.5 * d / way;
        }
    }

    /// Zero along clamped dofs.
    fn through_the_box(&self, w: &[f64]) -> Vec<f64> {
        let each = self.dofs.controllable.iter().zip(w);
        each.map(|(&i, w)| if self.v_next[i] == self.goal[i] { *w } else { 0.0 }).collect()
    }
}

/// The conditions that hold with equality at the answer of a stage.
struct Held<'a> {
    y: &'a [f64],
    nu: &'a [f64],
    kkt: Kkt,
}

impl Held<'_> {
    fn of(stages: &Stages) -> Held<'_> {
        let (s, c, p) = (&stages.active_set, &stages.conic, &stages.problem);
        let (y, mu, lambda) = if stages.exact { (&s.y, &s.mu, &s.lambda) } else { (&c.y, &c.mu, &c.lambda) };
        let nu: &[f64] = if stages.exact { &[] } else { &c.nu };
        let all = mu.iter().chain(lambda).chain(nu);
        let largest = all.fold(0.0, |most: f64, x| most.max(x.abs()));
        let floor = if stages.exact { 0.0 } else { ROUNDING * largest };
        let held = |x: f64| x.abs() > floor;
        let give = |soft: Option<Soft>, excess: f64| {
            soft.filter(|_| excess > 1e-9).map_or(0.0, |s| 1.0 / s.quadratic)
        };
        let rows = (0..p.m).filter(|r| held(lambda[*r]));
        let cones = (0..nu.len()).filter(|c| held(nu[*c]));
        let mut kkt = Kkt::default();
        kkt.free.extend((0..p.n).filter(|k| !held(mu[*k])));
        kkt.rows.extend(rows.map(|r| (r, give(p.soft[r], p.excess(r, y)))));
        kkt.cones.extend(cones.map(|c| (c, give(p.cones[c].soft, p.cones[c].excess(y)))));
        kkt.look(p, y);
        Held { y, nu, kkt }
    }

    /// Cotangents of the goal (n) and of the velocity changes of the dofs that are not controllable.
    fn pull_back(&mut self, p: &Coupled, w: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let kkt = &mut self.kkt;
        kkt.x = kkt.free.iter().map(|i| w[*i]).collect();
        kkt.x.resize(kkt.free.len() + kkt.rows.len() + kkt.cones.len(), 0.0);
        if !kkt.solve(p, self.nu) {
            kkt.x.fill(0.0); // dependent rows: no unique derivative
        }
        let mut dgoal = vec![0.0; p.n];
        for (&i, z) in kkt.free.iter().zip(&kkt.x) {
            dgoal[i] = p.hessian[i] * z;
        }
        (dgoal, self.fixed(p))
    }

    /// Constants of rows and cones: `-G_u' z_row`, and for cones the turn of their normals as well.
    fn fixed(&self, p: &Coupled) -> Vec<f64> {
        let Kkt { free, rows, cones, x: z, .. } = &self.kkt;
        let f = free.len();
        let column = |u: usize| {
            let mut sum = 0.0;
            for (a, &(r, _)) in rows.iter().enumerate() {
                sum -= p.rows_fixed[r * p.fixed + u] * z[f + a];
            }
            for (a, &(c, _)) in cones.iter().enumerate() {
                let cone = &p.cones[c];
                let own = |d: usize| cone.g_fixed[d * p.fixed + u];
                sum -= cone.slope_along(self.y, own) * z[f + rows.len() + a];
                for (b, &i) in free.iter().enumerate() {
                    sum -= self.nu[c] * z[b] * cone.curvature(self.y, |d| cone.g[d * p.n + i], own);
                }
            }
            sum
        };
        (0..p.fixed).map(column).collect()
    }
}
