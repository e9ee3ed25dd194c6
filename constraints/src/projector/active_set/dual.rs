//! Adding one violated constraint. With g its gradient in `g'y <= h`, the direction that gives in to it while the held ones
//! stay held is
//!
//! ```text
//!     S r = G_RF H_F^-1 g_F,   z_F = -H_F^-1 (g_F - G_RF' r),   z_B = 0
//! ```
//!
//! and multipliers move by `-r` for rows and `-s_k (g_k - (G_R' r)_k)` for bounds of sign `s_k`; one that would become
//! negative is released first.

use super::{ActiveSet, Constraint, EXACT, dot, sign};
use crate::ledger::Side;
use crate::projector::coupled::Coupled;

/// What a step ends with.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Event {
    /// A multiplier of a bound reaches zero.
    Free(usize),
    /// A multiplier of a row, at this place among the held, reaches zero.
    Release(usize),
    /// A soft row begins to give way, or stops.
    Bend(usize),
}

impl ActiveSet {
    pub(super) fn most_violated(&mut self, p: &Coupled) -> Option<Constraint> {
        if !self.fresh {
            self.products(p);
        }
        let (mut worst, mut found) = (EXACT, None);
        let mut see = |excess: f64, constraint: Constraint| {
            if excess > worst {
                (worst, found) = (excess, Some(constraint));
            }
        };
        for r in 0..p.m {
            if self.row_side[r].is_none() {
                see(self.value[r] - p.row_upper[r], Constraint::Row(r, Side::Upper));
                see(p.row_lower[r] - self.value[r], Constraint::Row(r, Side::Lower));
            }
        }
        for k in 0..p.n {
            let (low, y, high) = (p.lower[k], self.y[k], p.upper[k]);
            if self.box_side[k].is_none() && !(low <= y && y <= high) {
                let size = (high - low).clamp(1e-3, 1e3);
                see((y - high) / size, Constraint::Box(k, Side::Upper));
                see((low - y) / size, Constraint::Box(k, Side::Lower));
            }
        }
        found
    }

    /// Gives in to `violated`, releasing what has to be released; false when the constraints leave nothing.
    pub(super) fn add(&mut self, p: &Coupled, violated: Constraint, most: u32) -> bool {
        self.fresh = false;
        let size = self.size(p, violated);
        let mut own = 0.0; // multiplier of the violated constraint
        while self.iterations < most {
            self.iterations += 1;
            let product = self.direction(p, violated);
            let (give, slack, bend) = own_softness(p, violated, own);
            let slope = self.slope(violated) + give;
            let (blocked, blocking) = self.first_event(p);
            let full = match slope > 1e-13 * size {
                true => (self.excess(p, violated) - slack) / slope,
                false => f64::INFINITY,
            };
            let step = blocked.min(full).min(bend);
            if step.is_infinite() {
                return false;
            }
            self.advance(p, step, full.is_finite());
            own += step;
            match blocking.filter(|_| blocked < full.min(bend)) {
                Some(event) => {
                    if !self.happen(p, event) {
                        return false;
                    }
                }
                None if bend < full => {} // the row itself begins to give way
                None => return self.hold(p, violated, own, product + give),
            }
        }
        false
    }

    /// `g'H^-1 g`.
    fn size(&self, p: &Coupled, constraint: Constraint) -> f64 {
        match constraint {
            Constraint::Box(k, _) => self.inverse[k],
            Constraint::Row(r, _) => {
                let g = &p.rows[r * p.n..(r + 1) * p.n];
                g.iter().zip(&self.inverse).map(|(g, inverse)| g * g * inverse).sum()
            }
        }
    }

    /// `r` and `g - G_R' r` for the gradient g of `violated`; returns `g_F' H_F^-1 g_F`.
    fn direction(&mut self, p: &Coupled, violated: Constraint) -> f64 {
        let (n, count) = (p.n, self.held.len());
        let product = match violated {
            Constraint::Box(k, side) => {
                let own = sign(side) * self.inverse[k];
                for (forward, row) in self.forward.iter_mut().zip(&self.held) {
                    *forward = p.rows[row * n + k] * own;
                }
                self.rest.fill(0.0);
                self.rest[k] = sign(side);
                self.inverse[k]
            }
            Constraint::Row(r, side) => {
                let (g, sign) = (&p.rows[r * n..(r + 1) * n], sign(side));
                for k in 0..n {
                    self.rest[k] = sign * g[k];
                    self.scaled[k] = self.rest[k] * self.weight[k];
                }
                for (forward, row) in self.forward.iter_mut().zip(&self.held) {
                    *forward = dot(&p.rows[row * n..(row + 1) * n], &self.scaled);
                }
                dot(&self.rest, &self.scaled)
            }
        };
        self.factor.forward(&mut self.forward);
        self.r[..count].copy_from_slice(&self.forward[..count]);
        self.factor.backward(&mut self.r);
        for (&row, &r) in self.held.iter().zip(&self.r) {
            for (rest, g) in self.rest.iter_mut().zip(&p.rows[row * n..(row + 1) * n]) {
                *rest -= r * g;
            }
        }
        product
    }

    /// `-g'z`.
    fn slope(&self, violated: Constraint) -> f64 {
        match violated {
            Constraint::Box(k, side) => sign(side) * self.rest[k] * self.inverse[k],
            Constraint::Row(..) => dot(&self.scaled, &self.rest),
        }
    }

    /// The first multiplier to reach zero or its row's linear weight, and the step at which it does.
    fn first_event(&self, p: &Coupled) -> (f64, Option<Event>) {
        let (mut least, mut found) = (f64::INFINITY, None);
        let mut see = |distance: f64, rate: f64, event: Event| {
            if rate > 0.0 && distance.max(0.0) < least * rate {
                (least, found) = (distance.max(0.0) / rate, Some(event));
            }
        };
        for (a, &row) in self.held.iter().enumerate() {
            let Some(side) = self.row_side[row] else { continue };
            let (multiplier, rate) = (sign(side) * self.lambda[row], sign(side) * self.r[a]);
            match p.soft[row] {
                None if p.equality[row] => {}
                None => see(multiplier, rate, Event::Release(a)),
                Some(soft) if self.elastic[row] && soft.linear > 0.0 => {
                    see(multiplier - soft.linear, rate, Event::Bend(a));
                }
                Some(_) if self.elastic[row] => see(multiplier, rate, Event::Release(a)),
                Some(soft) => {
                    see(multiplier, rate, Event::Release(a));
                    see(soft.linear - multiplier, -rate, Event::Bend(a));
                }
            }
        }
        for k in 0..p.n {
            if let Some(side) = self.box_side[k] {
                see(sign(side) * self.mu[k], sign(side) * self.rest[k], Event::Free(k));
            }
        }
        (least, found)
    }

    /// Moves the multipliers, and `y` if it can move.
    fn advance(&mut self, p: &Coupled, step: f64, moves: bool) {
        for (&row, r) in self.held.iter().zip(&self.r) {
            self.lambda[row] -= step * r;
        }
        let along = if moves { step } else { 0.0 };
        for k in 0..p.n {
            let rest = self.rest[k];
            self.y[k] -= along * rest * self.weight[k];
            if self.box_side[k].is_some() {
                self.mu[k] -= step * rest;
            }
        }
    }

    fn happen(&mut self, p: &Coupled, event: Event) -> bool {
        match event {
            Event::Free(k) => {
                (self.box_side[k], self.mu[k], self.weight[k]) = (None, 0.0, self.inverse[k]);
                self.reweigh(p, k, self.inverse[k])
            }
            Event::Release(a) => {
                let row = self.held.remove(a);
                (self.row_side[row], self.lambda[row], self.elastic[row]) = (None, 0.0, false);
                self.factor.remove(a);
                true
            }
            Event::Bend(a) => {
                let row = self.held[a];
                self.elastic[row] = !self.elastic[row];
                let Some(soft) = p.soft[row] else { return false };
                let give = if self.elastic[row] { 1.0 / soft.quadratic } else { -1.0 / soft.quadratic };
                self.factor.rank_one(give, |b| f64::from(u8::from(a == b))) || self.build_factor(p)
            }
        }
    }

    /// Dof `k` begins to count with `change` in S.
    fn reweigh(&mut self, p: &Coupled, k: usize, change: f64) -> bool {
        let held = &self.held;
        self.factor.rank_one(change, |a| p.rows[held[a] * p.n + k]) || self.build_factor(p)
    }

    /// `product`: what the constraint adds to the diagonal of S.
    fn hold(&mut self, p: &Coupled, constraint: Constraint, multiplier: f64, product: f64) -> bool {
        match constraint {
            Constraint::Box(k, side) => {
                (self.box_side[k], self.mu[k]) = (Some(side), sign(side) * multiplier);
                (self.weight[k], self.y[k]) = (0.0, if side == Side::Upper { p.upper[k] } else { p.lower[k] });
                self.reweigh(p, k, -self.inverse[k])
            }
            Constraint::Row(row, side) => {
                (self.row_side[row], self.lambda[row]) = (Some(side), sign(side) * multiplier);
                self.elastic[row] = p.soft[row].is_some_and(|s| multiplier >= s.linear * (1.0 - EXACT));
                self.held.push(row);
                if side == Side::Lower {
                    self.forward[..self.factor.size].iter_mut().for_each(|x| *x = -*x);
                }
                self.factor.append(&self.forward, product) || self.build_factor(p)
            }
        }
    }

    fn excess(&self, p: &Coupled, constraint: Constraint) -> f64 {
        match constraint {
            Constraint::Box(k, Side::Upper) => self.y[k] - p.upper[k],
            Constraint::Box(k, Side::Lower) => p.lower[k] - self.y[k],
            Constraint::Row(r, side) => {
                let value = dot(&p.rows[r * p.n..(r + 1) * p.n], &self.y);
                if side == Side::Upper { value - p.row_upper[r] } else { p.row_lower[r] - value }
            }
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
