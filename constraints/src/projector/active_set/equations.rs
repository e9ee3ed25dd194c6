//! The answer that follows from an active set alone.

use super::{ActiveSet, EXACT, bound, dot};
use crate::projector::coupled::Coupled;

impl ActiveSet {
    /// `y`, the multipliers and `G y` from the active set, in an order of its own; false when held rows depend on each other.
    pub(super) fn solve_equations(&mut self, p: &Coupled) -> bool {
        self.held.sort_unstable();
        for k in 0..p.n {
            let side = self.box_side[k];
            let bound = if side > 0.0 { p.upper[k] } else { p.lower[k] };
            (self.y[k], self.weight[k]) =
                if side == 0.0 { (p.goal[k], self.inverse[k]) } else { (bound, 0.0) };
        }
        if !self.build_factor(p) {
            return false;
        }
        for (a, &row) in self.held.iter().enumerate() {
            let side = self.row_side[row];
            self.r[a] = dot(p.gradient(row), &self.y) - bound(p, row, side);
            if let Some(soft) = p.soft[row].filter(|_| self.elastic[row]) {
                self.r[a] += side * soft.linear / soft.quadratic;
            }
        }
        self.factor.forward(&mut self.r);
        self.factor.backward(&mut self.r);
        self.spread(p);
        self.products(p);
        if self.left_over(p) > EXACT {
            self.refine(p);
        }
        self.fresh = true;
        true
    }

    /// How far the held rows are from their equations, into `r`; returns the most. With a goal far outside, `y_F` is a small difference
    /// of large numbers.
    fn left_over(&mut self, p: &Coupled) -> f64 {
        let mut most: f64 = 0.0;
        for (a, &row) in self.held.iter().enumerate() {
            let side = self.row_side[row];
            self.r[a] = self.value[row] - bound(p, row, side);
            if let Some(soft) = p.soft[row].filter(|_| self.elastic[row]) {
                self.r[a] += (side * soft.linear - self.lambda[row]) / soft.quadratic;
            }
            most = most.max(self.r[a].abs());
        }
        most
    }

    /// Takes what is left over in `r` out of `y_F` and the multipliers.
    fn refine(&mut self, p: &Coupled) {
        self.factor.forward(&mut self.r);
        self.factor.backward(&mut self.r);
        for (&row, &r) in self.held.iter().zip(&self.r) {
            self.lambda[row] += r;
            for (k, g) in p.gradient(row).iter().enumerate() {
                self.y[k] -= r * g * self.weight[k];
                self.mu[k] -= r * g * self.box_side[k].abs();
            }
        }
        self.products(p);
    }

    /// `y`, `mu` and `lambda` from the multipliers in `r`.
    fn spread(&mut self, p: &Coupled) {
        self.lambda.fill(0.0);
        let pull = &mut self.rest;
        pull.fill(0.0);
        for (&row, &r) in self.held.iter().zip(&self.r) {
            self.lambda[row] = r;
            for (pull, g) in pull.iter_mut().zip(p.gradient(row)) {
                *pull += r * g;
            }
        }
        for k in 0..p.n {
            if self.box_side[k] != 0.0 {
                self.mu[k] = p.hessian[k] * (p.goal[k] - self.y[k]) - pull[k];
            } else {
                (self.y[k], self.mu[k]) = (p.goal[k] - pull[k] * self.inverse[k], 0.0);
            }
        }
    }

    /// `G y`.
    pub(super) fn products(&mut self, p: &Coupled) {
        for (value, g) in self.value.iter_mut().zip(p.rows.chunks_exact(p.n)) {
            *value = dot(g, &self.y);
        }
    }

    /// `S` of the held rows in their order, from nothing.
    pub(super) fn build_factor(&mut self, p: &Coupled) -> bool {
        self.factor.clear();
        if self.held.is_empty() {
            return true;
        }
        self.free.clear();
        self.free.extend((0..p.n).filter(|k| self.box_side[*k] == 0.0));
        let width = self.free.len();
        for (a, &row) in self.held.iter().enumerate() {
            let g = p.gradient(row);
            for (i, &k) in self.free.iter().enumerate() {
                self.compact[a * width + i] = g[k];
                self.scaled[i] = g[k] * self.inverse[k];
            }
            for b in 0..=a {
                let other = &self.compact[b * width..(b + 1) * width];
                self.forward[b] = dot(&self.scaled[..width], other);
            }
            let give = p.soft[row].filter(|_| self.elastic[row]).map_or(0.0, |soft| 1.0 / soft.quadratic);
            let own = self.forward[a] + give;
            self.factor.forward(&mut self.forward);
            if !self.factor.append(&self.forward, own) {
                return false;
            }
        }
        true
    }
}
