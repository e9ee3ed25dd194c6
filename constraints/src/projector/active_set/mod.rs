//! Exact stage: the dual active-set method of Goldfarb and Idnani ("A numerically stable dual method for solving
//! strictly convex quadratic programs", 1983), written for a diagonal Hessian and a box.
//!
//! With rows R and bounds B held and F the free dofs, the answer follows from the active set alone (`equations.rs`):
//!
//! ```text
//!     S lambda = G_R y0 - row_bound,   S = G_RF H_F^-1 G_RF',   y0 = goal on F, bound on B
//!     y_F = goal_F - H_F^-1 G_RF' lambda,   mu_B = H_B (goal_B - y_B) - G_RB' lambda
//! ```
//!
//! A soft row r with slack `s_r` is rigid (`s_r = 0`) up to the multiplier `linear_r` and elastic beyond it, with
//! `|lambda_r| = linear_r + quadratic_r s_r`: `1 / quadratic_r` joins the diagonal of S, and `sign_r linear_r / quadratic_r`
//! the right-hand side.
//!
//! From a set whose multipliers have the right signs, the most violated bound or row is added, one at a time (`dual.rs`), and
//! the answer is computed again from the set alone. Every optimality condition is checked; without an answer, Clarabel is asked.
//!
//! The first try starts at the active set of the last answer. It counts only if it is strict: each held multiplier and
//! each slack is well away from zero and the held rows are well independent, so that no other set is optimal and any
//! path ends at this one. Else the problem is solved again from the optimum of its box. So the same input gives the
//! same bits, whatever came before.

mod certificate;
mod dual;
mod equations;
mod factor;

use super::coupled::Coupled;
use factor::Factor;

/// Memory of the stage.
#[derive(Debug)]
pub(crate) struct ActiveSet {
    /// Answer (n).
    pub(crate) y: Vec<f64>,
    /// Signed multipliers of the box (n): positive at an upper bound.
    pub(crate) mu: Vec<f64>,
    /// Signed multipliers of the rows (m).
    pub(crate) lambda: Vec<f64>,
    /// Steps of the last call.
    pub(crate) iterations: u32,
    /// The last call showed that nothing obeys all hard rows and the box, by a wide margin.
    pub(crate) empty: bool,
    /// Held bound of each dof (n): 1 upper, -1 lower, 0 none.
    box_side: Vec<f64>,
    /// Held bound of each row (m): 1 upper, -1 lower, 0 none.
    row_side: Vec<f64>,
    /// Soft rows that give way (m).
    elastic: Vec<bool>,
    /// Rows held, in the order of the factor.
    held: Vec<usize>,
    /// Dofs not held, while the factor is built.
    free: Vec<usize>,
    /// `S` of the held rows.
    factor: Factor,
    /// `1 / H` (n).
    inverse: Vec<f64>,
    /// `1 / H` of free dofs, 0 of held ones (n).
    weight: Vec<f64>,
    /// `G_RF`, row after row, while the factor is built (m x n).
    compact: Vec<f64>,
    /// `G y` (m).
    value: Vec<f64>,
    /// `r` of the direction (m).
    r: Vec<f64>,
    /// `r` before its back substitution (m).
    forward: Vec<f64>,
    /// `H_F^-1 g_F` (n).
    scaled: Vec<f64>,
    /// `g - G_R' r` (n).
    rest: Vec<f64>,
    /// `y`, `value` and the multipliers follow from the active set alone.
    fresh: bool,
    /// The active set is that of the last answer.
    warm: bool,
}

/// A bound of a dof or of a row, and its side: 1 upper, -1 lower.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Constraint {
    Box(usize, f64),
    Row(usize, f64),
}

/// Rows and bounds may be exceeded by this share of their size.
const EXACT: f64 = 1e-12;

/// Rounds in which the last active set may shed what no longer pulls.
const ROUNDS: u32 = 4;

impl ActiveSet {
    pub(crate) fn new(n: usize, m: usize) -> ActiveSet {
        ActiveSet {
            y: vec![0.0; n],
            mu: vec![0.0; n],
            lambda: vec![0.0; m],
            iterations: 0,
            empty: false,
            box_side: vec![0.0; n],
            row_side: vec![0.0; m],
            elastic: vec![false; m],
            held: Vec::with_capacity(m),
            free: Vec::with_capacity(n),
            factor: Factor::new(m),
            inverse: vec![0.0; n],
            weight: vec![0.0; n],
            compact: vec![0.0; m * n],
            value: vec![0.0; m],
            r: vec![0.0; m],
            forward: vec![0.0; m],
            scaled: vec![0.0; n],
            rest: vec![0.0; n],
            fresh: false,
            warm: false,
        }
    }

    /// True when the optimum was found; then `y` and the multipliers hold it.
    pub(crate) fn solve(&mut self, p: &Coupled) -> bool {
        (self.iterations, self.empty) = (0, false);
        for (inverse, h) in self.inverse.iter_mut().zip(&p.hessian) {
            *inverse = 1.0 / h;
        }
        let most = (p.n + p.m) as u32;
        let warm = self.warm
            && !self.held.is_empty()
            && self.resume(p)
            && self.improve(p, most)
            && self.is_strict(p);
        self.warm =
            warm || (!self.empty && self.start(p) && self.improve(p, self.iterations + 10 * most + 10));
        self.warm
    }

    /// Forgets the last active set.
    pub(crate) fn forget(&mut self) {
        self.warm = false;
    }

    /// Adds what is violated, most first, until nothing is.
    fn improve(&mut self, p: &Coupled, most: u32) -> bool {
        loop {
            let Some(violated) = self.most_violated(p) else {
                return (self.fresh || self.solve_equations(p)) && self.is_optimal(p);
            };
            if self.iterations >= most || !self.add(p, violated, most) {
                return false;
            }
        }
    }

    /// The optimum of the box alone.
    fn start(&mut self, p: &Coupled) -> bool {
        self.held.clear();
        self.row_side.fill(0.0);
        self.elastic.fill(false);
        for k in 0..p.n {
            let (above, below) = (p.goal[k] > p.upper[k], p.goal[k] < p.lower[k]);
            self.box_side[k] = f64::from(u8::from(above)) - f64::from(u8::from(below && !above));
        }
        self.solve_equations(p)
    }

    /// The last active set, less what has the wrong sign; false when that does not settle.
    fn resume(&mut self, p: &Coupled) -> bool {
        for r in 0..p.m {
            if self.row_side[r] != 0.0 && bound(p, r, self.row_side[r]).is_infinite() {
                self.drop_row(r);
            }
        }
        for _ in 0..ROUNDS {
            self.iterations += 1;
            if !self.solve_equations(p) {
                return false;
            }
            if !self.shed(p) {
                return true;
            }
        }
        false
    }

    /// Takes out of the set what has the wrong sign; false when nothing has.
    fn shed(&mut self, p: &Coupled) -> bool {
        let mut changed = false;
        for k in 0..p.n {
            if self.box_side[k] * self.mu[k] < 0.0 {
                self.box_side[k] = 0.0;
                changed = true;
            }
        }
        for r in 0..p.m {
            let multiplier = self.row_side[r] * self.lambda[r];
            if self.row_side[r] == 0.0 {
                continue;
            }
            if multiplier < 0.0 && !pinned(p, r) {
                self.drop_row(r);
                changed = true;
            } else if let Some(soft) = p.soft[r] {
                let elastic = multiplier >= soft.linear;
                changed |= elastic != self.elastic[r];
                self.elastic[r] = elastic;
            }
        }
        changed
    }

    fn drop_row(&mut self, row: usize) {
        (self.row_side[row], self.elastic[row]) = (0.0, false);
        self.held.retain(|r| *r != row);
    }
}

/// A row without softness whose bounds are equal stays held whatever its multiplier.
fn pinned(p: &Coupled, r: usize) -> bool {
    p.equality[r] && p.soft[r].is_none()
}

/// The bound of row `r` on a side.
fn bound(p: &Coupled, r: usize, side: f64) -> f64 {
    if side > 0.0 { p.row_upper[r] } else { p.row_lower[r] }
}

/// `a'c` in four sums, which processors add at once.
fn dot(a: &[f64], c: &[f64]) -> f64 {
    let (a4, c4) = (a.chunks_exact(4), c.chunks_exact(4));
    let rest: f64 = a4.remainder().iter().zip(c4.remainder()).map(|(a, c)| a * c).sum();
    let mut sums = [0.0; 4];
    for (a, c) in a4.zip(c4) {
        for k in 0..4 {
            sums[k] += a[k] * c[k];
        }
    }
    (sums[0] + sums[2]) + (sums[1] + sums[3]) + rest
}
