//! Adding one violated constraint. With g its gradient in `g'y <= h`, the direction that gives in to it while the held ones
//! stay held is
//!
//! ```text
//!     S r = G_RF H_F^-1 g_F,   z_F = -H_F^-1 (g_F - G_RF' r),   z_B = 0
//! ```
//!
//! and multipliers move by `-r` for rows and `-s_k (g_k - (G_R' r)_k)` for bounds of sign `s_k`; one that would become
//! negative is released first.

use super::{ActiveSet, Constraint, EXACT, bound, dot};
use crate::projector::coupled::Coupled;

/// Constraints that contradict each other by more than this share are empty to every stage: far above the shares to which Clarabel's
/// answers are taken.
const CLEAR: f64 = 1e-8;

/// Square of the share of its own size below which a direction's component is rounding.
const NOISE: f64 = 1e-24;

/// A constraint this near to depending on the held ones, as share of its own size, is looked at again with a new factor.
const NEAR: f64 = 1e-6;

/// A constraint nearer than this to depending on the held ones, which nothing blocks, may show that nothing obeys them all.
const SUSPECT: f64 = 1e-3;

/// A constraint nearer than this depends on them: the factor could not hold it.
const DEPENDENT: f64 = 1e-11;

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
        let values = self.value.iter().zip(&p.row_lower).zip(&p.row_upper).zip(&self.row_side);
        for (r, (((value, low), high), side)) in values.enumerate() {
            let (above, below) = (value - high, low - value);
            if (above > worst || below > worst) && *side == 0.0 {
                worst = above.max(below);
                found = Some(Constraint::Row(r, if above > below { 1.0 } else { -1.0 }));
            }
        }
        // Held dofs are at their bounds.
        for (k, ((y, low), high)) in self.y.iter().zip(&p.lower).zip(&p.upper).enumerate() {
            let (above, below) = (y - high, low - y);
            if !(above > 0.0 || below > 0.0) {
                continue;
            }
            let excess = above.max(below) / (high - low).clamp(1e-3, 1e3);
            if excess > worst {
                worst = excess;
                found = Some(Constraint::Box(k, if above > below { 1.0 } else { -1.0 }));
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
            let (give, slack, bend) = own_softness(p, violated, own);
            let mut product = self.direction(p, violated);
            let mut slope = self.slope(violated) + give;
            if slope < NEAR * size {
                if !self.build_factor(p) {
                    return false;
                }
                product = self.direction(p, violated);
                slope = self.slope(violated) + give;
            }
            let (blocked, blocking) = self.first_event(p, NOISE * size);
            if slope < SUSPECT * size && blocked.min(bend).is_infinite() && self.is_empty(p, violated) {
                self.empty = true;
                return false;
            }
            let full = match slope > DEPENDENT * size {
                true => (self.excess(p, violated) - slack) / slope,
                false => f64::INFINITY,
            };
            let step = blocked.min(full).min(bend);
            if step.is_infinite() {
                return false;
            }
            self.advance(step, full.is_finite());
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

    /// With the held constraints written `g_a'y <= h_a`, nothing lets go of them: `g = G_R' r + rest` with `r <= 0` and `rest` of
    /// the held bounds' signs against them. So every y in the box that exceeds no hard held one by more than some share exceeds `violated` by
    /// what the present `y` does, less that share times the multipliers' sum, less what the free dofs and the soft rows can make up for.
    fn is_empty(&self, p: &Coupled, violated: Constraint) -> bool {
        if matches!(violated, Constraint::Row(r, _) if p.soft[r].is_some()) {
            return false;
        }
        let hard = self.held.iter().zip(&self.r).filter(|(row, _)| p.soft[**row].is_none());
        let rows: f64 = hard.map(|(_, r)| r.abs()).sum();
        let bounds: f64 = self.rest.iter().zip(&self.box_side).map(|(rest, side)| (rest * side).abs()).sum();
        let reach = |k: usize| (p.upper[k] - self.y[k]).max(self.y[k] - p.lower[k]);
        let free = (0..p.n).filter(|k| self.box_side[*k] == 0.0);
        let left: f64 = free.map(|k| self.rest[k].abs() * reach(k)).sum();
        let soft = self.held.iter().zip(&self.r).filter(|(row, r)| p.soft[**row].is_some() && **r != 0.0);
        let give = soft.map(|(row, r)| {
            let most: f64 = p.gradient(*row).iter().enumerate().map(|(k, g)| g.abs() * reach(k)).sum();
            r.abs() * most
        });
        self.excess(p, violated) - left - give.sum::<f64>() > CLEAR * (1.0 + rows + bounds)
    }

    /// `g'H^-1 g`.
    fn size(&self, p: &Coupled, constraint: Constraint) -> f64 {
        match constraint {
            Constraint::Box(k, _) => self.inverse[k],
            Constraint::Row(r, _) => {
                p.gradient(r).iter().zip(&self.inverse).map(|(g, inverse)| g * g * inverse).sum()
            }
        }
    }

    /// `r` and `g - G_R' r` for the gradient g of `violated`; returns `g_F' H_F^-1 g_F`.
    fn direction(&mut self, p: &Coupled, violated: Constraint) -> f64 {
        let (n, count) = (p.n, self.held.len());
        let product = match violated {
            Constraint::Box(k, side) => {
                let own = side * self.inverse[k];
                for (forward, row) in self.forward.iter_mut().zip(&self.held) {
                    *forward = p.rows[row * n + k] * own;
                }
                self.rest.fill(0.0);
                self.rest[k] = side;
                self.inverse[k]
            }
            Constraint::Row(r, side) => {
                let g = p.gradient(r);
                for k in 0..n {
                    self.rest[k] = side * g[k];
                    self.scaled[k] = self.rest[k] * self.weight[k];
                }
                for (forward, row) in self.forward.iter_mut().zip(&self.held) {
                    *forward = dot(p.gradient(*row), &self.scaled);
                }
                dot(&self.rest, &self.scaled)
            }
        };
        self.factor.forward(&mut self.forward);
        self.r[..count].copy_from_slice(&self.forward[..count]);
        self.factor.backward(&mut self.r);
        for (&row, &r) in self.held.iter().zip(&self.r) {
            for (rest, g) in self.rest.iter_mut().zip(p.gradient(row)) {
                *rest -= r * g;
            }
        }
        product
    }

    /// `-g'z`.
    fn slope(&self, violated: Constraint) -> f64 {
        match violated {
            Constraint::Box(k, side) => side * self.rest[k] * self.inverse[k],
            Constraint::Row(..) => dot(&self.scaled, &self.rest),
        }
    }

    /// The first multiplier to reach zero or its row's linear weight, and the step at which it does. A rate whose square, times what
    /// it counts for in S, is below `noise` is none.
    fn first_event(&self, p: &Coupled, noise: f64) -> (f64, Option<Event>) {
        let (mut least, mut found) = (f64::INFINITY, None);
        let mut see = |distance: f64, rate: f64, counts: f64, event: Event| {
            if rate > 0.0 && distance < least * rate && rate * rate * counts > noise {
                (least, found) = (distance.max(0.0) / rate, Some(event));
            }
        };
        for (a, (&row, r)) in self.held.iter().zip(&self.r).enumerate() {
            let (side, counts) = (self.row_side[row], self.factor.diagonal(a));
            let (multiplier, rate) = (side * self.lambda[row], side * r);
            match p.soft[row] {
                None if p.equality[row] => {}
                None => see(multiplier, rate, counts, Event::Release(a)),
                Some(soft) if self.elastic[row] && soft.linear > 0.0 => {
                    see(multiplier - soft.linear, rate, counts, Event::Bend(a));
                }
                Some(_) if self.elastic[row] => see(multiplier, rate, counts, Event::Release(a)),
                Some(soft) => {
                    see(multiplier, rate, counts, Event::Release(a));
                    see(soft.linear - multiplier, -rate, counts, Event::Bend(a));
                }
            }
        }
        let bounds = self.box_side.iter().zip(&self.mu).zip(&self.rest).zip(&self.inverse);
        for (k, (((side, mu), rest), inverse)) in bounds.enumerate() {
            see(side * mu, side * rest, *inverse, Event::Free(k)); // at rate 0 if not held
        }
        (least, found)
    }

    /// Moves the multipliers, and `y` if it can move.
    fn advance(&mut self, step: f64, moves: bool) {
        for (&row, r) in self.held.iter().zip(&self.r) {
            self.lambda[row] -= step * r;
        }
        let along = if moves { step } else { 0.0 };
        for ((y, rest), weight) in self.y.iter_mut().zip(&self.rest).zip(&self.weight) {
            *y -= along * rest * weight;
        }
        for ((mu, rest), side) in self.mu.iter_mut().zip(&self.rest).zip(&self.box_side) {
            *mu -= step * rest * side.abs();
        }
    }

    fn happen(&mut self, p: &Coupled, event: Event) -> bool {
        match event {
            Event::Free(k) => {
                (self.box_side[k], self.mu[k], self.weight[k]) = (0.0, 0.0, self.inverse[k]);
                self.reweigh(p, k, self.inverse[k])
            }
            Event::Release(a) => {
                let row = self.held.remove(a);
                (self.row_side[row], self.lambda[row], self.elastic[row]) = (0.0, 0.0, false);
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
                (self.box_side[k], self.mu[k]) = (side, side * multiplier);
                (self.weight[k], self.y[k]) = (0.0, if side > 0.0 { p.upper[k] } else { p.lower[k] });
                self.reweigh(p, k, -self.inverse[k])
            }
            Constraint::Row(row, side) => {
                (self.row_side[row], self.lambda[row]) = (side, side * multiplier);
                self.elastic[row] = p.soft[row].is_some_and(|s| multiplier >= s.linear * (1.0 - EXACT));
                self.held.push(row);
                if side < 0.0 {
                    self.forward[..self.factor.size].iter_mut().for_each(|x| *x = -*x);
                }
                self.factor.append(&self.forward, product) || self.build_factor(p)
            }
        }
    }

    fn excess(&self, p: &Coupled, constraint: Constraint) -> f64 {
        match constraint {
            Constraint::Box(k, side) => side * (self.y[k] - if side > 0.0 { p.upper[k] } else { p.lower[k] }),
            Constraint::Row(r, side) => side * (dot(p.gradient(r), &self.y) - bound(p, r, side)),
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
