//! A second projection, for ticks in which no brake leads from the nearest allowed state. Each limit that the target or its brake breaks
//! becomes one more row: linear in the velocity change `y`, with a slope found by differences. Cones become their tangents:
//!
//! ```text
//!     min 1/2 sum_i h_i (y_i - goal_i)^2   s.t.   the box, the rows of the tick,   breach + slope (y - y_refused) <= 0
//! ```
//!
//! Some rows demand more than their limit needs ([`Rows::asks_more`](crate::Rows::asks_more)); where they leave no answer, they are left out.

use super::active_set::ActiveSet;
use super::coupled::Coupled;

/// Rows that a tick may add.
const CUTS: usize = 8;

/// A cut goes this share of its breach, and this much, further than the row itself.
const FURTHER: (f64, f64) = (0.02, 1e-9);

/// The problem of a tick with cones as rows and room for [`CUTS`] rows.
pub(super) struct Nearer {
    problem: Coupled,
    active_set: ActiveSet,
    /// Rows that ask for more than they keep (m).
    asks_more: Vec<bool>,
    /// Rows of the tick's problem and its number of cones.
    rows: usize,
    cones: usize,
    cuts: usize,
}

impl Nearer {
    /// For problems like `p`; `asks_more` (m).
    pub(super) fn new(p: &Coupled, asks_more: Vec<bool>) -> Nearer {
        let mut soft = p.soft.clone();
        soft.extend(p.cones.iter().map(|cone| cone.soft));
        soft.extend([None; CUTS]);
        let mut equality = p.equality.clone();
        equality.resize(soft.len(), false);
        let problem = Coupled::new(p.hessian.clone(), soft, equality, &[], 0);
        let active_set = ActiveSet::new(problem.n, problem.m);
        Nearer { problem, active_set, asks_more, rows: p.m, cones: p.cones.len(), cuts: 0 }
    }

    /// Starts from the problem of the tick at `y` (n), the target that was refused.
    pub(super) fn begin(&mut self, p: &Coupled, y: &[f64]) {
        let (n, m, to) = (p.n, p.m, &mut self.problem);
        to.goal.copy_from_slice(&p.goal);
        to.lower.copy_from_slice(&p.lower);
        to.upper.copy_from_slice(&p.upper);
        to.rows[..m * n].copy_from_slice(&p.rows);
        to.rows[m * n..].fill(0.0);
        to.row_lower.fill(f64::NEG_INFINITY);
        to.row_upper.fill(f64::INFINITY);
        to.equality[..m].copy_from_slice(&p.equality);
        to.row_lower[..m].copy_from_slice(&p.row_lower);
        to.row_upper[..m].copy_from_slice(&p.row_upper);
        for (c, cone) in p.cones.iter().enumerate().filter(|(_, cone)| cone.radius.is_finite()) {
            let mut reached = -cone.excess(y);
            for k in 0..n {
                let slope = cone.slope(y, k);
                to.rows[(m + c) * n + k] = slope;
                reached += slope * y[k];
            }
            to.row_upper[m + c] = reached;
        }
        self.cuts = 0;
    }

    /// Leaves out every row and cone of the tick but those with `kept` (m).
    pub(super) fn keep_only(&mut self, kept: impl Fn(usize) -> bool) {
        for r in (0..self.rows + self.cones).filter(|r| *r >= self.rows || !kept(*r)) {
            (self.problem.row_lower[r], self.problem.row_upper[r]) = (f64::NEG_INFINITY, f64::INFINITY);
        }
    }

    /// Box of the velocity change of controllable dof `k`.
    pub(super) fn bound(&mut self, k: usize, lower: f64, upper: f64) {
        (self.problem.lower[k], self.problem.upper[k]) = (lower, upper);
    }

    /// Looks for the answer next to `y` (n) in place of the tick's goal.
    pub(super) fn aim(&mut self, y: &[f64]) {
        self.problem.goal.copy_from_slice(y);
    }

    /// `breach + slope (y - at) <= 0`, a little further inside; true when there was room for it and it says anything.
    pub(super) fn cut(&mut self, breach: f64, slope: &[f64], at: &[f64]) -> bool {
        let size = slope.iter().fold(0.0, |most: f64, s| most.max(s.abs()));
        if self.cuts == CUTS || !(size > 0.0 && size.is_finite() && breach.is_finite()) {
            return false;
        }
        let (n, r) = (self.problem.n, self.rows + self.cones + self.cuts);
        let row = &mut self.problem.rows[r * n..(r + 1) * n];
        row.iter_mut().zip(slope).for_each(|(to, slope)| *to = slope / size);
        let here: f64 = row.iter().zip(at).map(|(g, y)| g * y).sum();
        self.problem.row_upper[r] = here - breach * (1.0 + FURTHER.0) / size - FURTHER.1;
        self.cuts += 1;
        true
    }

    /// The answer (n), with what asks for more than it keeps or else without.
    pub(super) fn solve(&mut self) -> Option<&[f64]> {
        self.active_set.forget();
        if !self.active_set.solve(&self.problem) {
            for r in (0..self.rows).filter(|r| self.asks_more[*r] && self.problem.soft[*r].is_none()) {
                (self.problem.row_lower[r], self.problem.row_upper[r]) = (f64::NEG_INFINITY, f64::INFINITY);
            }
            self.active_set.forget();
            if !self.active_set.solve(&self.problem) {
                return None;
            }
        }
        Some(&self.active_set.y)
    }
}
