//! Derivative of the target with respect to the proposal, as a vector-Jacobian product.
//!
//! With F the dofs off their bounds, A the active rows and cone normals, and D the give of elastic rows, the optimality conditions
//! of the last tick change with the goal as
//!
//! ```text
//!     [ H + C   A' ] [ dy ]   [ H dgoal ]
//!     [   A    -D  ] [ dl ] = [    0    ]      C = nu G_c' (I - u u') G_c / |G_c y + c|,   u = (G_c y + c) / |G_c y + c|
//! ```
//!
//! so for a cotangent w of y the cotangent of the goal is `H z` with `z = (K^-1)(w, 0)`: the weighted projector onto the null space
//! of the active rows. `goal = v + (y_q + y_v) / 2` then hands half of it to the velocity and `1 / (2 kappa T)` to the position
//! proposed. Where the active set changes there is no derivative; this is then one of its one-sided ones.

use super::coupled::Coupled;
use super::{Projector, Stages};
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
                let (dgoal, dfixed) = Kkt::of(stages).pull_back(&stages.problem, &w);
                for (&j, d) in self.dofs.fixed.iter().zip(dfixed) {
                    dv_proposal[j] += d;
                }
                dgoal
            }
        };
        for (&i, d) in controllable.iter().zip(dgoal) {
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
struct Kkt<'a> {
    y: &'a [f64],
    /// Dofs off their bounds.
    free: Vec<usize>,
    rows: Vec<usize>,
    /// Cones with their multipliers.
    cones: Vec<(usize, f64)>,
}

impl Kkt<'_> {
    fn of(stages: &Stages) -> Kkt<'_> {
        let (s, c, p) = (&stages.active_set, &stages.conic, &stages.problem);
        let (y, mu, lambda) = if stages.exact { (&s.y, &s.mu, &s.lambda) } else { (&c.y, &c.mu, &c.lambda) };
        let nu: &[f64] = if stages.exact { &[] } else { &c.nu };
        let all = mu.iter().chain(lambda).chain(nu);
        let largest = all.fold(0.0, |most: f64, x| most.max(x.abs()));
        let floor = if stages.exact { 0.0 } else { ROUNDING * largest };
        let held = |x: f64| x.abs() > floor;
        Kkt {
            y,
            free: (0..p.n).filter(|k| !held(mu[*k])).collect(),
            rows: (0..p.m).filter(|r| held(lambda[*r])).collect(),
            cones: nu.iter().copied().enumerate().filter(|(_, nu)| held(*nu)).collect(),
        }
    }

    /// Cotangents of the goal (n) and of the velocity changes of the dofs that are not controllable.
    fn pull_back(&self, p: &Coupled, w: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let (f, size) = (self.free.len(), self.free.len() + self.rows.len() + self.cones.len());
        let mut k = vec![0.0; size * size];
        let mut z = vec![0.0; size];
        for (a, &i) in self.free.iter().enumerate() {
            k[a * size + a] = p.hessian[i];
            z[a] = w[i];
        }
        let mut border = |a: usize, gradient: &dyn Fn(usize) -> f64, give: f64| {
            for (b, &i) in self.free.iter().enumerate() {
                (k[a * size + b], k[b * size + a]) = (gradient(i), gradient(i));
            }
            k[a * size + a] = -give;
        };
        for (a, &r) in self.rows.iter().enumerate() {
            let elastic = p.soft[r].filter(|_| p.excess(r, self.y) > 1e-9);
            border(f + a, &|i| p.rows[r * p.n + i], elastic.map_or(0.0, |s| 1.0 / s.quadratic));
        }
        for (a, &(c, _)) in self.cones.iter().enumerate() {
            border(f + self.rows.len() + a, &|i| p.cones[c].slope(self.y, i), 0.0);
        }
        for &(c, nu) in &self.cones {
            for (a, &i) in self.free.iter().enumerate() {
                for (b, &j) in self.free.iter().enumerate() {
                    k[a * size + b] += nu
                        * p.cones[c].curvature(
                            self.y,
                            |d| p.cones[c].g[d * p.n + i],
                            |d| p.cones[c].g[d * p.n + j],
                        );
                }
            }
        }
        if !solve(&mut k, &mut z, size) {
            z.fill(0.0); // dependent rows: no unique derivative
        }
        let mut dgoal = vec![0.0; p.n];
        for (a, &i) in self.free.iter().enumerate() {
            dgoal[i] = p.hessian[i] * z[a];
        }
        (dgoal, self.fixed(p, &z))
    }

    /// Constants of rows and cones: `-G_u' z_row`, and for cones the turn of their normals as well.
    fn fixed(&self, p: &Coupled, z: &[f64]) -> Vec<f64> {
        let f = self.free.len();
        let column = |u: usize| {
            let mut sum = 0.0;
            for (a, &r) in self.rows.iter().enumerate() {
                sum -= p.rows_fixed[r * p.fixed + u] * z[f + a];
            }
            for (a, &(c, nu)) in self.cones.iter().enumerate() {
                let cone = &p.cones[c];
                let own = |d: usize| cone.g_fixed[d * p.fixed + u];
                sum -= cone.slope_along(self.y, own) * z[f + self.rows.len() + a];
                for (b, &i) in self.free.iter().enumerate() {
                    sum -= nu * z[b] * cone.curvature(self.y, |d| cone.g[d * p.n + i], own);
                }
            }
            sum
        };
        (0..p.fixed).map(column).collect()
    }
}

/// Solves `K x = b` in place by elimination with pivots; false when K is singular.
pub(super) fn solve(k: &mut [f64], b: &mut [f64], n: usize) -> bool {
    let largest = k.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
    for col in 0..n {
        let pivot =
            (col..n).max_by(|a, c| k[a * n + col].abs().total_cmp(&k[c * n + col].abs())).unwrap_or(col);
        if k[pivot * n + col].abs() <= 1e-14 * largest {
            return false;
        }
        if pivot != col {
            (0..n).for_each(|j| k.swap(col * n + j, pivot * n + j));
            b.swap(col, pivot);
        }
        for row in col + 1..n {
            let factor = k[row * n + col] / k[col * n + col];
            if factor != 0.0 {
                (col..n).for_each(|j| k[row * n + j] -= factor * k[col * n + j]);
                b[row] -= factor * b[col];
            }
        }
    }
    for row in (0..n).rev() {
        let sum: f64 = (row + 1..n).map(|j| k[row * n + j] * b[j]).sum();
        b[row] = (b[row] - sum) / k[row * n + row];
    }
    true
}
