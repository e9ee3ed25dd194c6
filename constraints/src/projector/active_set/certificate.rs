//! The optimality conditions that an answer of the active-set stage must meet before it is used: bounds, rows, and the signs of the
//! multipliers. And whether another active set could be optimal too.

use super::{ActiveSet, pinned};
use crate::projector::coupled::Coupled;

/// Conditions of the final answer hold to this share.
const FINAL: f64 = 1e-11;

/// Held multipliers and slacks beyond this share leave no other set; a few times the square root of [`FINAL`], by which
/// two answers that meet their conditions to [`FINAL`] may lie apart.
const STRICT: f64 = 1e-5;

/// The least pivot of well independent rows, as share of its diagonal.
const INDEPENDENT: f64 = 1e-6;

impl ActiveSet {
    /// Primal and dual feasibility of the final answer; stationarity holds by construction.
    pub(super) fn is_optimal(&mut self, p: &Coupled) -> bool {
        let mut good = true;
        for k in 0..p.n {
            let size = FINAL * (1.0 + self.y[k].abs());
            good &= self.y[k] >= p.lower[k] - size && self.y[k] <= p.upper[k] + size && self.y[k].is_finite();
            self.y[k] = self.y[k].clamp(p.lower[k], p.upper[k]);
            let scale = p.hessian[k] * (1.0 + p.goal[k].abs() + self.y[k].abs());
            good &= self.box_side[k] * self.mu[k] >= -FINAL * scale;
        }
        let largest = self.held.iter().fold(0.0, |m: f64, r| m.max(self.lambda[*r].abs()));
        for r in 0..p.m {
            let (above, below) = (self.value[r] - p.row_upper[r], p.row_lower[r] - self.value[r]);
            let bound = if above > below { p.row_upper[r] } else { p.row_lower[r] };
            good &= above.max(below) - self.slack(p, r) <= FINAL * (1.0 + bound.abs());
            let multiplier = self.row_side[r] * self.lambda[r]; // 0 if not held
            good &= pinned(p, r) || multiplier >= -FINAL * largest;
            if let Some(soft) = p.soft[r].filter(|_| self.row_side[r] != 0.0) {
                let beyond = multiplier - soft.linear;
                good &= if self.elastic[r] { beyond >= -FINAL * largest } else { beyond <= FINAL * largest };
            }
        }
        good
    }

    /// No other active set is optimal. Multipliers count by how far they move what they act on.
    pub(super) fn is_strict(&self, p: &Coupled) -> bool {
        let mut strict = self.factor.conditioning() > INDEPENDENT;
        for k in 0..p.n {
            let least = STRICT * (p.upper[k] - p.lower[k]).clamp(1e-3, 1.0);
            strict &= if self.box_side[k] == 0.0 {
                self.y[k] - p.lower[k] > least && p.upper[k] - self.y[k] > least
            } else {
                self.box_side[k] * self.mu[k] * self.inverse[k] > least
            };
        }
        for r in (0..p.m).filter(|r| self.row_side[*r] == 0.0) {
            let value = self.value[r];
            strict &= value - p.row_lower[r] > STRICT && p.row_upper[r] - value > STRICT;
        }
        for (a, &r) in self.held.iter().enumerate() {
            let least = STRICT / self.factor.diagonal(a);
            strict &= self.lambda[r].abs() > least;
            if let Some(soft) = p.soft[r] {
                strict &= (self.lambda[r].abs() - soft.linear).abs() > least;
            }
        }
        strict
    }

    /// Slack of row `r`, at least 0.
    pub(crate) fn slack(&self, p: &Coupled, r: usize) -> f64 {
        match p.soft[r] {
            Some(soft) if self.elastic[r] => ((self.lambda[r].abs() - soft.linear) / soft.quadratic).max(0.0),
            _ => 0.0,
        }
    }
}
