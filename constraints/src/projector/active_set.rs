//! Exact stage: the dual active-set method of Goldfarb and Idnani ("A numerically stable dual method for solving
//! strictly convex quadratic programs", 1983), written for a diagonal Hessian and a box.
//!
//! It starts at the optimum of the box alone and adds the most violated bound or row, one at a time. With rows R and
//! bounds B held, F the free dofs and g the gradient of the violated constraint `g'y <= h`, the direction that gives in to
//! it while the held ones stay held is
//!
//! ```text
//!     S r = G_RF H_F^-1 g_F,   S = G_RF H_F^-1 G_RF',   z_F = -H_F^-1 (g_F - G_RF' r),   z_B = 0
//! ```
//!
//! and multipliers move by `-r` for rows and `-s_k (g_k - (G_R' r)_k)` for bounds of sign `s_k`; one that would become
//! negative is released first. At the end the answer is computed again from the active set alone,
//!
//! ```text
//!     S lambda = G_R y0 - row_bound,   y0 = goal on F, bound on B
//!     y_F = goal_F - H_F^-1 G_RF' lambda,   mu_B = H_B (goal_B - y_B) - G_RB' lambda
//! ```
//!
//! A soft row r with slack `s_r` is rigid (`s_r = 0`) up to the multiplier `linear_r` and elastic beyond it, with
//! `|lambda_r| = linear_r + quadratic_r s_r`: `1 / quadratic_r` joins the diagonal of S, and `sign_r linear_r / quadratic_r`
//! the right-hand side.
//!
//! Every optimality condition is checked. It starts from the problem alone, so the same input gives the same
//! bits; without an answer, Clarabel is asked.

use super::coupled::Coupled;
use crate::ledger::Side;

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
    /// Held bound of each dof (n).
    box_side: Vec<Option<Side>>,
    /// Held bound of each row (m).
    row_side: Vec<Option<Side>>,
    /// Soft rows that give way (m).
    elastic: Vec<bool>,
    /// Rows held, ascending.
    held: Vec<usize>,
    schur: Vec<f64>,
    r: Vec<f64>,
    /// `g - G_R' r` (n).
    rest: Vec<f64>,
}

/// What a step ends with.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Event {
    /// A multiplier reaches zero.
    Release(Constraint),
    /// A soft row begins to give way, or stops.
    Bend(usize),
}

/// A bound of a dof or of a row.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Constraint {
    Box(usize, Side),
    Row(usize, Side),
}

/// Rows and bounds may be exceeded by this share of their size.
const EXACT: f64 = 1e-12;

/// Conditions of the final answer hold to this share.
const FINAL: f64 = 1e-11;

impl ActiveSet {
    pub(crate) fn new(n: usize, m: usize) -> ActiveSet {
        ActiveSet {
            y: vec![0.0; n],
            mu: vec![0.0; n],
            lambda: vec![0.0; m],
            iterations: 0,
            box_side: vec![None; n],
            row_side: vec![None; m],
            elastic: vec![false; m],
            held: Vec::with_capacity(m),
            schur: vec![0.0; m * m],
            r: vec![0.0; m],
            rest: vec![0.0; n],
        }
    }

    /// True when the optimum was found; then `y` and the multipliers hold it.
    pub(crate) fn solve(&mut self, p: &Coupled) -> bool {
        self.start(p);
        let most = 10 * (p.n + p.m) as u32 + 10;
        while self.iterations < most {
            let Some(violated) = self.most_violated(p) else {
                return self.solve_equations(p) && self.is_optimal(p);
            };
            if !self.add(p, violated, most) {
                return false;
            }
        }
        false
    }

    /// The optimum of the box alone.
    fn start(&mut self, p: &Coupled) {
        self.iterations = 0;
        self.held.clear();
        self.row_side.fill(None);
        self.elastic.fill(false);
        self.lambda.fill(0.0);
        for k in 0..p.n {
            self.y[k] = p.goal[k].clamp(p.lower[k], p.upper[k]);
            self.mu[k] = p.hessian[k] * (p.goal[k] - self.y[k]);
            self.box_side[k] = match self.mu[k] {
                mu if mu > 0.0 => Some(Side::Upper),
                mu if mu < 0.0 => Some(Side::Lower),
                _ => None,
            };
        }
    }

    fn most_violated(&self, p: &Coupled) -> Option<Constraint> {
        let (mut worst, mut found) = (EXACT, None);
        let mut see = |excess: f64, constraint: Constraint| {
            if excess > worst {
                (worst, found) = (excess, Some(constraint));
            }
        };
        for r in (0..p.m).filter(|r| self.row_side[*r].is_none()) {
            let value = p.row(r, &self.y);
            see(value - p.row_upper[r], Constraint::Row(r, Side::Upper));
            see(p.row_lower[r] - value, Constraint::Row(r, Side::Lower));
        }
        for k in (0..p.n).filter(|k| self.box_side[*k].is_none()) {
            let size = (p.upper[k] - p.lower[k]).clamp(1e-3, 1e3);
            see((self.y[k] - p.upper[k]) / size, Constraint::Box(k, Side::Upper));
            see((p.lower[k] - self.y[k]) / size, Constraint::Box(k, Side::Lower));
        }
        found
    }

    /// Gives in to `violated`, releasing what has to be released; false when the constraints leave nothing.
    fn add(&mut self, p: &Coupled, violated: Constraint, most: u32) -> bool {
        let mut own = 0.0; // multiplier of the violated constraint
        while self.iterations < most {
            self.iterations += 1;
            if !self.direction(p, violated) {
                return false;
            }
            let (give, slack, bend) = own_softness(p, violated, own);
            let slope: f64 =
                self.free(p).map(|k| gradient(p, violated, k) * self.rest[k] / p.hessian[k]).sum();
            let slope = slope + give;
            let size: f64 = (0..p.n).map(|k| gradient(p, violated, k).powi(2) / p.hessian[k]).sum();
            let (blocked, blocking) = self.first_event(p);
            let excess = self.excess(p, violated) - slack;
            let full = if slope > 1e-13 * size { excess / slope } else { f64::INFINITY };
            let step = blocked.min(full).min(bend);
            if step.is_infinite() {
                return false;
            }
            if full.is_finite() {
                for k in 0..p.n {
                    if self.box_side[k].is_none() {
                        self.y[k] -= step * self.rest[k] / p.hessian[k];
                    }
                }
            }
            self.move_multipliers(p, step);
            own += step;
            match blocking.filter(|_| blocked < full.min(bend)) {
                Some(Event::Release(released)) => self.release(released),
                Some(Event::Bend(row)) => self.elastic[row] = !self.elastic[row],
                None if bend < full => {} // the row itself begins to give way
                None => {
                    self.hold(violated, own);
                    if let Constraint::Row(row, _) = violated {
                        self.elastic[row] = p.soft[row].is_some_and(|s| own >= s.linear * (1.0 - EXACT));
                    }
                    return true;
                }
            }
        }
        false
    }

    /// `r` and `g - G_R' r` for the gradient g of `violated`.
    fn direction(&mut self, p: &Coupled, violated: Constraint) -> bool {
        for (a, &row) in self.held.iter().enumerate() {
            self.r[a] =
                self.free(p).map(|k| p.rows[row * p.n + k] * gradient(p, violated, k) / p.hessian[k]).sum();
        }
        if !self.solve_schur(p) {
            return false;
        }
        for k in 0..p.n {
            let pull: f64 = self.held.iter().zip(&self.r).map(|(row, r)| r * p.rows[row * p.n + k]).sum();
            self.rest[k] = gradient(p, violated, k) - pull;
        }
        true
    }

    /// The first multiplier to reach zero or its row's linear weight, and the step at which it does.
    fn first_event(&self, p: &Coupled) -> (f64, Option<Event>) {
        let (mut least, mut found) = (f64::INFINITY, None);
        let mut see = |distance: f64, rate: f64, event: Event| {
            if rate > 0.0 && distance.max(0.0) / rate < least {
                (least, found) = (distance.max(0.0) / rate, Some(event));
            }
        };
        for (a, &row) in self.held.iter().enumerate() {
            let Some(side) = self.row_side[row] else { continue };
            let (multiplier, rate) = (sign(side) * self.lambda[row], sign(side) * self.r[a]);
            let linear = p.soft[row].map_or(f64::INFINITY, |s| s.linear);
            if self.elastic[row] && linear > 0.0 {
                see(multiplier - linear, rate, Event::Bend(row));
                continue;
            }
            if !p.equality[row] {
                see(multiplier, rate, Event::Release(Constraint::Row(row, side)));
            }
            if !self.elastic[row] {
                see(linear - multiplier, -rate, Event::Bend(row));
            }
        }
        for k in 0..p.n {
            if let Some(side) = self.box_side[k] {
                let released = Event::Release(Constraint::Box(k, side));
                see(sign(side) * self.mu[k], sign(side) * self.rest[k], released);
            }
        }
        (least, found)
    }

    fn move_multipliers(&mut self, p: &Coupled, step: f64) {
        for (a, &row) in self.held.iter().enumerate() {
            self.lambda[row] -= step * self.r[a];
        }
        for k in (0..p.n).filter(|k| self.box_side[*k].is_some()) {
            self.mu[k] -= step * self.rest[k];
        }
    }

    fn hold(&mut self, constraint: Constraint, multiplier: f64) {
        match constraint {
            Constraint::Box(k, side) => {
                (self.box_side[k], self.mu[k]) = (Some(side), sign(side) * multiplier)
            }
            Constraint::Row(row, side) => {
                (self.row_side[row], self.lambda[row]) = (Some(side), sign(side) * multiplier);
                let at = self.held.partition_point(|r| *r < row);
                self.held.insert(at, row);
            }
        }
    }

    fn release(&mut self, constraint: Constraint) {
        match constraint {
            Constraint::Box(k, _) => (self.box_side[k], self.mu[k]) = (None, 0.0),
            Constraint::Row(row, _) => {
                (self.row_side[row], self.lambda[row]) = (None, 0.0);
                self.elastic[row] = false;
                self.held.retain(|r| *r != row);
            }
        }
    }

    fn excess(&self, p: &Coupled, constraint: Constraint) -> f64 {
        match constraint {
            Constraint::Box(k, Side::Upper) => self.y[k] - p.upper[k],
            Constraint::Box(k, Side::Lower) => p.lower[k] - self.y[k],
            Constraint::Row(r, Side::Upper) => p.row(r, &self.y) - p.row_upper[r],
            Constraint::Row(r, Side::Lower) => p.row_lower[r] - p.row(r, &self.y),
        }
    }

    fn free<'a>(&'a self, p: &Coupled) -> impl Iterator<Item = usize> + 'a {
        (0..p.n).filter(|k| self.box_side[*k].is_none())
    }

    /// Solves `S x = r` in place of `r`; false when the held rows depend on each other.
    fn solve_schur(&mut self, p: &Coupled) -> bool {
        let size = self.held.len();
        for a in 0..size {
            for b in 0..=a {
                let (ga, gb) = (&p.rows[self.held[a] * p.n..], &p.rows[self.held[b] * p.n..]);
                let sum = self.free(p).map(|k| ga[k] * gb[k] / p.hessian[k]).sum();
                self.schur[a * size + b] = sum;
            }
            if let Some(soft) = p.soft[self.held[a]].filter(|_| self.elastic[self.held[a]]) {
                self.schur[a * size + a] += 1.0 / soft.quadratic;
            }
        }
        cholesky_solve(&mut self.schur, &mut self.r, size)
    }

    /// The answer that follows from the active set alone.
    fn solve_equations(&mut self, p: &Coupled) -> bool {
        for k in 0..p.n {
            self.y[k] = match self.box_side[k] {
                None => p.goal[k],
                Some(Side::Lower) => p.lower[k],
                Some(Side::Upper) => p.upper[k],
            };
        }
        for (a, &row) in self.held.iter().enumerate() {
            let lower = self.row_side[row] == Some(Side::Lower);
            self.r[a] = p.row(row, &self.y) - if lower { p.row_lower[row] } else { p.row_upper[row] };
            if let Some(soft) = p.soft[row].filter(|_| self.elastic[row]) {
                let sign = if lower { -1.0 } else { 1.0 };
                self.r[a] += sign * soft.linear / soft.quadratic;
            }
        }
        if !self.solve_schur(p) {
            return false;
        }
        self.lambda.fill(0.0);
        for (a, &row) in self.held.iter().enumerate() {
            self.lambda[row] = self.r[a];
        }
        for k in 0..p.n {
            let pull: f64 = self.held.iter().map(|row| self.lambda[*row] * p.rows[row * p.n + k]).sum();
            match self.box_side[k] {
                None => (self.y[k], self.mu[k]) = (p.goal[k] - pull / p.hessian[k], 0.0),
                Some(_) => self.mu[k] = p.hessian[k] * (p.goal[k] - self.y[k]) - pull,
            }
        }
        true
    }

    /// Primal and dual feasibility of the final answer; stationarity holds by construction.
    fn is_optimal(&mut self, p: &Coupled) -> bool {
        let mut good = p.violation(&self.y) <= FINAL && self.y.iter().all(|y| y.is_finite());
        good &= (0..p.m).all(|r| p.soft[r].is_none_or(|_| p.excess(r, &self.y) - self.slack(p, r) <= FINAL));
        for k in 0..p.n {
            let size = FINAL * (1.0 + self.y[k].abs());
            good &= self.y[k] >= p.lower[k] - size && self.y[k] <= p.upper[k] + size;
            self.y[k] = self.y[k].clamp(p.lower[k], p.upper[k]);
            let scale = p.hessian[k] * (1.0 + p.goal[k].abs() + self.y[k].abs());
            good &= self.box_side[k].is_none_or(|side| sign(side) * self.mu[k] >= -FINAL * scale);
        }
        let largest = self.lambda.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
        for r in 0..p.m {
            let Some(side) = self.row_side[r] else { continue };
            let multiplier = sign(side) * self.lambda[r];
            good &= p.equality[r] || multiplier >= -FINAL * largest;
            if let Some(soft) = p.soft[r] {
                let beyond = multiplier - soft.linear;
                good &= if self.elastic[r] { beyond >= -FINAL * largest } else { beyond <= FINAL * largest };
            }
        }
        good
    }

    /// Slack of row `r`, at least 0.
    pub(crate) fn slack(&self, p: &Coupled, r: usize) -> f64 {
        match p.soft[r] {
            Some(soft) if self.elastic[r] => ((self.lambda[r].abs() - soft.linear) / soft.quadratic).max(0.0),
            _ => 0.0,
        }
    }
}

/// Of the constraint being added with multiplier `own`: how much it gives per multiplier, its slack, and the step at which it
/// begins to give.
fn own_softness(p: &Coupled, constraint: Constraint, own: f64) -> (f64, f64, f64) {
    let Constraint::Row(row, _) = constraint else { return (0.0, 0.0, f64::INFINITY) };
    match p.soft[row] {
        None => (0.0, 0.0, f64::INFINITY),
        Some(soft) if own < soft.linear * (1.0 - EXACT) => (0.0, 0.0, soft.linear - own),
        Some(soft) => (1.0 / soft.quadratic, (own - soft.linear) / soft.quadratic, f64::INFINITY),
    }
}

/// Entry k of the gradient of a constraint written `g'y <= h`.
fn gradient(p: &Coupled, constraint: Constraint, k: usize) -> f64 {
    match constraint {
        Constraint::Box(j, side) => {
            if j == k {
                sign(side)
            } else {
                0.0
            }
        }
        Constraint::Row(r, side) => sign(side) * p.rows[r * p.n + k],
    }
}

fn sign(side: Side) -> f64 {
    if side == Side::Upper { 1.0 } else { -1.0 }
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
