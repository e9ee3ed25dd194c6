//! Exact stage: guesses which bounds are active, solves the equations that follow, corrects the guess.
//!
//! With bounds fixed for the dofs in B and rows R held at their bound, the optimality conditions of
//! [`Coupled`] are
//!
//! ```text
//!     S lambda = G_R y0 - row_bound,   S = G_RF H_F^-1 G_RF',   y0 = goal on F, bound on B
//!     y_F = goal_F - H_F^-1 G_RF' lambda,   mu_B = H_B (goal_B - y_B) - G_RB' lambda
//! ```
//!
//! A wrong sign of a multiplier releases its bound, a violated bound becomes active (primal-dual active set,
//! Hintermueller, Ito and Kunisch 2003). When nothing changes, all conditions hold: the answer is exact. It starts from the
//! problem alone, so the same input gives the same bits; when it does not settle, Clarabel is asked.

use super::coupled::Coupled;
use crate::ledger::Side;

/// Memory of the stage.
#[derive(Debug)]
pub(crate) struct ActiveSet {
    /// Answer (n).
    pub(crate) y: Vec<f64>,
    /// Active bound of each dof (n).
    pub(crate) box_side: Vec<Option<Side>>,
    /// Active bound of each row (m).
    pub(crate) row_side: Vec<Option<Side>>,
    /// Signed multipliers of the box (n): positive at an upper bound.
    pub(crate) mu: Vec<f64>,
    /// Signed multipliers of the rows (m).
    pub(crate) lambda: Vec<f64>,
    /// Iterations of the last call.
    pub(crate) iterations: u32,
    schur: Vec<f64>,
    held: Vec<usize>,
    rhs: Vec<f64>,
}

const MAX_ITERATIONS: u32 = 25;

/// Rows and bounds may be exceeded by this share of their size.
const EXACT: f64 = 1e-11;

impl ActiveSet {
    pub(crate) fn new(n: usize, m: usize) -> ActiveSet {
        ActiveSet {
            y: vec![0.0; n],
            box_side: vec![None; n],
            row_side: vec![None; m],
            mu: vec![0.0; n],
            lambda: vec![0.0; m],
            iterations: 0,
            schur: vec![0.0; m * m],
            held: Vec::with_capacity(m),
            rhs: vec![0.0; m],
        }
    }

    /// True when the optimum was found; then `y`, the sides and the multipliers hold it.
    pub(crate) fn solve(&mut self, p: &Coupled) -> bool {
        self.start(p);
        for iteration in 1..=MAX_ITERATIONS {
            self.iterations = iteration;
            if !self.solve_equations(p) {
                return false;
            }
            if !self.correct(p) {
                for k in 0..p.n {
                    self.y[k] = self.y[k].clamp(p.lower[k], p.upper[k]);
                }
                return true;
            }
        }
        false
    }

    /// First guess: the box alone, then the rows its answer violates.
    fn start(&mut self, p: &Coupled) {
        for k in 0..p.n {
            self.y[k] = p.goal[k].clamp(p.lower[k], p.upper[k]);
            self.box_side[k] = beyond(p.goal[k], p.lower[k], p.upper[k], 0.0);
        }
        for r in 0..p.m {
            self.row_side[r] = beyond(p.row(r, &self.y), p.row_lower[r], p.row_upper[r], 0.0);
        }
    }

    fn solve_equations(&mut self, p: &Coupled) -> bool {
        for k in 0..p.n {
            self.y[k] = match self.box_side[k] {
                None => p.goal[k],
                Some(Side::Lower) => p.lower[k],
                Some(Side::Upper) => p.upper[k],
            };
        }
        self.held.clear();
        self.lambda.fill(0.0);
        for r in 0..p.m {
            if let Some(side) = self.row_side[r] {
                let bound = if side == Side::Lower { p.row_lower[r] } else { p.row_upper[r] };
                self.rhs[self.held.len()] = p.row(r, &self.y) - bound;
                self.held.push(r);
            }
        }
        let free = |k: &usize| self.box_side[*k].is_none();
        let size = self.held.len();
        for a in 0..size {
            for b in 0..=a {
                let (ga, gb) = (&p.rows[self.held[a] * p.n..], &p.rows[self.held[b] * p.n..]);
                self.schur[a * size + b] = (0..p.n).filter(free).map(|k| ga[k] * gb[k] / p.hessian[k]).sum();
            }
        }
        if !cholesky_solve(&mut self.schur, &mut self.rhs, size) {
            return false;
        }
        for (a, &r) in self.held.iter().enumerate() {
            self.lambda[r] = self.rhs[a];
        }
        for k in 0..p.n {
            let pull: f64 = self.held.iter().map(|r| self.lambda[*r] * p.rows[r * p.n + k]).sum();
            match self.box_side[k] {
                None => (self.y[k], self.mu[k]) = (p.goal[k] - pull / p.hessian[k], 0.0),
                Some(_) => self.mu[k] = p.hessian[k] * (p.goal[k] - self.y[k]) - pull,
            }
        }
        self.y.iter().all(|y| y.is_finite())
    }

    /// Corrects the guess; true when something changed.
    fn correct(&mut self, p: &Coupled) -> bool {
        let mut changed = false;
        for k in 0..p.n {
            let new = match self.box_side[k] {
                None => beyond(self.y[k], p.lower[k], p.upper[k], EXACT * (1.0 + self.y[k].abs())),
                held => held.filter(|side| leans(*side, self.mu[k])),
            };
            changed |= new != self.box_side[k];
            self.box_side[k] = new;
        }
        for r in 0..p.m {
            let new = match self.row_side[r] {
                None => {
                    beyond(p.row(r, &self.y), p.row_lower[r], p.row_upper[r], EXACT * p.row_size[r].max(1.0))
                }
                held => held.filter(|side| leans(*side, self.lambda[r])),
            };
            changed |= new != self.row_side[r];
            self.row_side[r] = new;
        }
        changed
    }
}

fn beyond(x: f64, lower: f64, upper: f64, tolerance: f64) -> Option<Side> {
    match x {
        x if x > upper + tolerance => Some(Side::Upper),
        x if x < lower - tolerance => Some(Side::Lower),
        _ => None,
    }
}

/// True when the sign of a multiplier keeps its bound active.
fn leans(side: Side, multiplier: f64) -> bool {
    match side {
        Side::Lower => multiplier <= 0.0,
        Side::Upper => multiplier >= 0.0,
    }
}

/// Solves `S x = b` in place for the lower triangle of a symmetric S (row-major); false when S is not positive definite.
fn cholesky_solve(s: &mut [f64], b: &mut [f64], n: usize) -> bool {
    for i in 0..n {
        let original = s[i * n + i];
        for j in 0..=i {
            let mut sum = s[i * n + j];
            for k in 0..j {
                sum -= s[i * n + k] * s[j * n + k];
            }
            if i == j {
                if !(sum > 1e-12 * original && sum > 0.0) {
                    return false;
                }
                s[i * n + i] = sum.sqrt();
            } else {
                s[i * n + j] = sum / s[j * n + j];
            }
        }
    }
    for i in 0..n {
        for k in 0..i {
            b[i] -= s[i * n + k] * b[k];
        }
        b[i] /= s[i * n + i];
    }
    for i in (0..n).rev() {
        for k in i + 1..n {
            b[i] -= s[k * n + i] * b[k];
        }
        b[i] /= s[i * n + i];
    }
    true
}
