//! The problem of a tick with coupled rows, over the controllable dofs:
//!
//! ```text
//!     min 1/2 sum_i h_i (y_i - goal_i)^2   s.t.   lower <= y <= upper,   row_lower <= G y <= row_upper
//! ```
//!
//! Torque rows are `G = M / T`, `row_upper = tau_max - nle + passive - G_u y_u` with the dofs u that are not
//! controllable as constants, at the velocity change their proposal asks for.

use super::Dofs;
use crate::{Dynamics, LimitSet, Model};

/// The numbers of a tick; n dofs and m rows.
#[derive(Debug, Clone)]
pub(crate) struct Coupled {
    pub(crate) n: usize,
    pub(crate) m: usize,
    /// Diagonal of the Hessian (n).
    pub(crate) hessian: Vec<f64>,
    /// Unconstrained optimum (n).
    pub(crate) goal: Vec<f64>,
    /// Box (n).
    pub(crate) lower: Vec<f64>,
    /// Box (n).
    pub(crate) upper: Vec<f64>,
    /// Rows (m x n, row-major).
    pub(crate) rows: Vec<f64>,
    /// Lower bounds of the rows (m).
    pub(crate) row_lower: Vec<f64>,
    /// Upper bounds of the rows (m).
    pub(crate) row_upper: Vec<f64>,
    /// Size of each row's limit (m), for tolerances and scaling.
    pub(crate) row_size: Vec<f64>,
    /// Dof of each row (m).
    pub(crate) row_dof: Vec<usize>,
    mass: Vec<f64>,
    nle: Vec<f64>,
    passive: Vec<f64>,
}

impl Coupled {
    pub(crate) fn new(model: &Model, limits: &LimitSet, dofs: &Dofs, hessian: Vec<f64>) -> Coupled {
        let nv = model.nv();
        let row_dof: Vec<usize> =
            dofs.controllable.iter().copied().filter(|i| limits.effort[*i].is_finite()).collect();
        let (n, m) = (dofs.controllable.len(), row_dof.len());
        Coupled {
            n,
            m,
            hessian,
            goal: vec![0.0; n],
            lower: vec![0.0; n],
            upper: vec![0.0; n],
            rows: vec![0.0; n * m],
            row_lower: vec![0.0; m],
            row_upper: vec![0.0; m],
            row_size: row_dof.iter().map(|i| limits.effort[*i]).collect(),
            row_dof,
            mass: vec![0.0; nv * nv],
            nle: vec![0.0; nv],
            passive: vec![0.0; nv],
        }
    }

    /// Fills the rows at the state; `y` (nv) holds the velocity change of the dofs that are not controllable.
    pub(crate) fn linearise(
        &mut self,
        dynamics: &mut Dynamics,
        q: &[f64],
        v: &[f64],
        dofs: &Dofs,
        y: &[f64],
        dt: f64,
    ) {
        let nv = v.len();
        dynamics.mass(q, &mut self.mass);
        dynamics.nle(q, v, &mut self.nle);
        dynamics.passive(q, v, &mut self.passive);
        for r in 0..self.m {
            let i = self.row_dof[r];
            let mut offset = self.nle[i] - self.passive[i];
            for &j in &dofs.fixed {
                offset += self.mass[j * nv + i] * y[j] / dt;
            }
            for (k, &j) in dofs.controllable.iter().enumerate() {
                self.rows[r * self.n + k] = self.mass[j * nv + i] / dt;
            }
            self.row_lower[r] = -self.row_size[r] - offset;
            self.row_upper[r] = self.row_size[r] - offset;
        }
    }

    /// `G y` of row `r`.
    pub(crate) fn row(&self, r: usize, y: &[f64]) -> f64 {
        let g = &self.rows[r * self.n..(r + 1) * self.n];
        g.iter().zip(y).map(|(g, y)| g * y).sum()
    }

    /// Largest violation of a row by `y`, as a share of its limit.
    pub(crate) fn violation(&self, y: &[f64]) -> f64 {
        (0..self.m).fold(0.0, |worst: f64, r| {
            let value = self.row(r, y);
            let excess = (value - self.row_upper[r]).max(self.row_lower[r] - value);
            worst.max(excess / self.row_size[r])
        })
    }

    /// Largest violation of the stationarity condition `H (y - goal) + G' lambda + mu = 0`.
    pub(crate) fn residual(&self, y: &[f64], mu: &[f64], lambda: &[f64]) -> f64 {
        (0..self.n).fold(0.0, |worst: f64, k| {
            let pull: f64 = (0..self.m).map(|r| lambda[r] * self.rows[r * self.n + k]).sum();
            worst.max((self.hessian[k] * (y[k] - self.goal[k]) + pull + mu[k]).abs())
        })
    }

    /// False when anything is NaN or infinite that a solver would choke on.
    pub(crate) fn is_finite(&self) -> bool {
        let finite = |x: &[f64]| x.iter().all(|x| x.is_finite());
        finite(&self.rows) && finite(&self.row_lower) && finite(&self.row_upper) && finite(&self.goal)
    }

    /// Keeps goals far outside the box from spoiling a solver's scaling.
    pub(crate) fn tame_goal(&mut self) {
        for k in 0..self.n {
            let width = (self.upper[k] - self.lower[k]).clamp(1e-6, FAR);
            self.goal[k] = self.goal[k].clamp(self.lower[k] - FAR * width, self.upper[k] + FAR * width);
            self.goal[k] = self.goal[k].clamp(-FAR * FAR * FAR, FAR * FAR * FAR);
        }
    }
}

/// Goals are kept within this many box widths.
const FAR: f64 = 100.0;

/// The problem of a tick in textbook form: `min 1/2 y'H y + c'y` s.t. `G y <= h`, for other solvers to check ours.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// Dofs of the variables.
    pub dofs: Vec<usize>,
    /// `H` (n x n, row-major).
    pub hessian: Vec<f64>,
    /// `c` (n).
    pub c: Vec<f64>,
    /// `G` (rows x n, row-major): upper box, lower box, upper torque, lower torque; infinite bounds left out.
    pub g: Vec<f64>,
    /// `h` (rows).
    pub h: Vec<f64>,
}

impl Problem {
    pub(crate) fn of(p: &Coupled, dofs: &[usize]) -> Problem {
        let n = p.n;
        let mut problem =
            Problem { dofs: dofs.to_vec(), hessian: vec![0.0; n * n], c: vec![], g: vec![], h: vec![] };
        let mut push = |row: &mut dyn Iterator<Item = f64>, bound: f64| {
            if bound.is_finite() {
                problem.g.extend(row);
                problem.h.push(bound);
            }
        };
        let unit = |k: usize, sign: f64| (0..n).map(move |j| if j == k { sign } else { 0.0 });
        (0..n).for_each(|k| push(&mut unit(k, 1.0), p.upper[k]));
        (0..n).for_each(|k| push(&mut unit(k, -1.0), -p.lower[k]));
        let row = |r: usize, sign: f64| p.rows[r * n..(r + 1) * n].iter().map(move |x| sign * x);
        (0..p.m).for_each(|r| push(&mut row(r, 1.0), p.row_upper[r]));
        (0..p.m).for_each(|r| push(&mut row(r, -1.0), -p.row_lower[r]));
        for k in 0..n {
            problem.hessian[k * n + k] = p.hessian[k];
            problem.c.push(-p.hessian[k] * p.goal[k]);
        }
        problem
    }
}
