//! Newton's method on the optimality conditions, from Clarabel's answer on.
//!
//! An interior-point method ends where further steps gain little, up to 3e-4 of the largest velocity change away from the optimum. From there
//! each step solves `K (dy, lambda) = (H (goal - y), bound - A y)` (`kkt.rs`), then releases the rows whose multipliers have the wrong sign and
//! adds those that are exceeded. The answer counts only when nothing is left to change; otherwise, and when the steps or the time run out,
//! Clarabel's answer stays.

use super::conic::Conic;
use super::coupled::Coupled;
use super::kkt::Kkt;

/// Steps allowed.
const STEPS: u32 = 30;

/// A bound exceeded by more than this is taken up: rows and cones as shares of their limits, dofs of the largest velocity change.
const EXCESS: f64 = 1e-12;

/// A multiplier below this share of the largest is none; of Clarabel's, below the second number.
const ROUNDING: (f64, f64) = (1e-11, 1e-6);

/// What of a dof, a row or a cone holds back.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Held {
    Not,
    Lower,
    Upper,
    /// A soft row or cone beyond its lower or upper bound.
    BeyondLower,
    BeyondUpper,
}

/// Scratch, and the answer.
pub(crate) struct Polish {
    dofs: Vec<Held>,
    rows: Vec<Held>,
    cones: Vec<Held>,
    y: Vec<f64>,
    mu: Vec<f64>,
    lambda: Vec<f64>,
    nu: Vec<f64>,
    kkt: Kkt,
}

impl Polish {
    pub(crate) fn new(p: &Coupled) -> Polish {
        let (n, m, cones) = (p.n, p.m, p.cones.len());
        Polish {
            dofs: vec![Held::Not; n],
            rows: vec![Held::Not; m],
            cones: vec![Held::Not; cones],
            y: vec![0.0; n],
            mu: vec![0.0; n],
            lambda: vec![0.0; m],
            nu: vec![0.0; cones],
            kkt: Kkt::with_room(p),
        }
    }

    /// Replaces the answer by the optimum near it, where Newton's method finds it before `late`; true when it did.
    pub(crate) fn refine(&mut self, p: &Coupled, answer: &mut Conic, late: impl Fn() -> bool) -> bool {
        self.start(p, answer);
        let reach = (0..p.n).fold(f64::MIN_POSITIVE, |w: f64, k| w.max(p.upper[k] - p.lower[k]));
        for _ in 0..STEPS {
            if late() {
                return false;
            }
            let Some(moved) = self.step(p) else { return false };
            let changed = self.change(p, reach);
            if !changed && moved <= 1e-13 * reach {
                answer.y.copy_from_slice(&self.y);
                answer.mu.copy_from_slice(&self.mu);
                answer.lambda.copy_from_slice(&self.lambda);
                answer.nu.copy_from_slice(&self.nu);
                return true;
            }
        }
        false
    }

    /// A multiplier of the last answer that is no larger is none.
    pub(crate) fn rounding(&self) -> f64 {
        let all = self.mu.iter().chain(&self.lambda).chain(&self.nu);
        ROUNDING.0 * all.fold(0.0, |most: f64, x| most.max(x.abs()))
    }

    /// Takes over the answer and what holds it back: the bounds whose force is larger than what moving to them would cost. Where
    /// Clarabel stopped early every bound has a force.
    fn start(&mut self, p: &Coupled, answer: &Conic) {
        let all = answer.mu.iter().chain(&answer.lambda).chain(&answer.nu);
        let floor = ROUNDING.1 * all.fold(0.0, |most: f64, x| most.max(x.abs()));
        let side = |x: f64| match x {
            x if x > floor => Held::Upper,
            x if x < -floor => Held::Lower,
            _ => Held::Not,
        };
        self.y.copy_from_slice(&answer.y);
        self.nu.copy_from_slice(&answer.nu);
        let stiffness = p.stiffest();
        for k in 0..p.n {
            let held = side(answer.mu[k]);
            let gap = if held == Held::Upper { p.upper[k] - self.y[k] } else { self.y[k] - p.lower[k] };
            self.dofs[k] = if answer.mu[k].abs() > gap * p.hessian[k] { held } else { Held::Not };
        }
        for r in 0..p.m {
            let held = if p.equality[r] && p.soft[r].is_none() && p.row_upper[r].is_finite() {
                Held::Upper
            } else {
                let held = side(answer.lambda[r]);
                let value = p.row(r, &self.y);
                let gap = if held == Held::Upper { p.row_upper[r] - value } else { value - p.row_lower[r] };
                let slope = p.gradient(r).iter().fold(0.0, |most: f64, g| most.max(g.abs()));
                if answer.lambda[r].abs() * slope * slope > gap * stiffness { held } else { Held::Not }
            };
            let gives = p.soft[r].is_some_and(|s| answer.lambda[r].abs() > s.linear * (1.0 + ROUNDING.1));
            self.rows[r] = if gives { beyond(held) } else { held };
        }
        for (c, cone) in p.cones.iter().enumerate() {
            let nu = answer.nu[c];
            let gives = cone.soft.is_some_and(|s| nu > s.linear * (1.0 + ROUNDING.1));
            let held = if cone.radius.is_finite() { side(nu.max(0.0)) } else { Held::Not };
            self.cones[c] = if gives { beyond(held) } else { held };
        }
    }

    /// One step of Newton's method; how far it went, `None` when the rows depend on each other.
    fn step(&mut self, p: &Coupled) -> Option<f64> {
        let (n, m) = (p.n, p.m);
        for k in 0..n {
            match self.dofs[k] {
                Held::Not => {}
                Held::Lower => self.y[k] = p.lower[k],
                _ => self.y[k] = p.upper[k],
            }
        }
        let kkt = &mut self.kkt;
        kkt.look(p, &self.y);
        kkt.free.clear();
        kkt.rows.clear();
        kkt.cones.clear();
        kkt.x.clear();
        for k in (0..n).filter(|k| self.dofs[*k] == Held::Not) {
            kkt.free.push(k);
            kkt.x.push(p.hessian[k] * (p.goal[k] - self.y[k]));
        }
        // lambda = +-(linear + quadratic s) with the slack s beyond the bound
        for r in (0..m).filter(|r| self.rows[*r] != Held::Not) {
            let upper = matches!(self.rows[r], Held::Upper | Held::BeyondUpper);
            let bound = if upper { p.row_upper[r] } else { p.row_lower[r] } - p.row(r, &self.y);
            let soft = p.soft[r].filter(|_| self.rows[r].gives());
            let linear = soft.map_or(0.0, |s| s.linear / s.quadratic);
            kkt.rows.push((r, soft.map_or(0.0, |s| 1.0 / s.quadratic)));
            kkt.x.push(if upper { bound - linear } else { bound + linear });
        }
        for c in (0..p.cones.len()).filter(|c| self.cones[*c] != Held::Not) {
            let soft = p.cones[c].soft.filter(|_| self.cones[c].gives());
            kkt.cones.push((c, soft.map_or(0.0, |s| 1.0 / s.quadratic)));
            kkt.x.push(p.cones[c].radius - kkt.norm[c] - soft.map_or(0.0, |s| s.linear / s.quadratic));
        }
        if !kkt.solve(p, &self.nu) {
            return None;
        }
        self.lambda.fill(0.0);
        self.nu.fill(0.0);
        let (dy, multipliers) = kkt.x.split_at(kkt.free.len());
        let (lambda, nu) = multipliers.split_at(kkt.rows.len());
        kkt.free.iter().zip(dy).for_each(|(k, dy)| self.y[*k] += dy);
        kkt.rows.iter().zip(lambda).for_each(|((r, _), x)| self.lambda[*r] = *x);
        kkt.cones.iter().zip(nu).for_each(|((c, _), x)| self.nu[*c] = *x);
        let moved = dy.iter().fold(0.0, |most: f64, dy| most.max(dy.abs()));
        kkt.look(p, &self.y);
        for i in 0..n {
            let rows: f64 = (0..m).map(|r| self.lambda[r] * p.rows[r * n + i]).sum();
            let cones: f64 = self.nu.iter().zip(&kkt.normal).map(|(nu, s)| nu * s[i]).sum();
            let pull = p.hessian[i] * (p.goal[i] - self.y[i]) - rows - cones;
            self.mu[i] = if self.dofs[i] == Held::Not { 0.0 } else { pull };
        }
        Some(moved)
    }

    /// Lets go and takes up; true when something did.
    fn change(&mut self, p: &Coupled, reach: f64) -> bool {
        let floor = self.rounding();
        let mut changed = false;
        let mut set = |held: &mut Held, to: Held| {
            changed |= *held != to;
            *held = to;
        };
        for k in 0..p.n {
            let (y, mu, now) = (self.y[k], self.mu[k], self.dofs[k]);
            let to = match now {
                Held::Not if y > p.upper[k] + EXCESS * reach => Held::Upper,
                Held::Not if y < p.lower[k] - EXCESS * reach => Held::Lower,
                Held::Upper if mu < -floor => Held::Not,
                Held::Lower if mu > floor => Held::Not,
                now => now,
            };
            set(&mut self.dofs[k], if p.lower[k] == p.upper[k] { Held::Upper } else { to });
        }
        for r in 0..p.m {
            if p.equality[r] && p.soft[r].is_none() {
                continue;
            }
            let (value, lambda) = (p.row(r, &self.y), self.lambda[r]);
            let linear = p.soft[r].map_or(f64::INFINITY, |s| s.linear);
            let to = match self.rows[r] {
                Held::Not if value > p.row_upper[r] + EXCESS => Held::Upper,
                Held::Not if value < p.row_lower[r] - EXCESS => Held::Lower,
                Held::Upper | Held::BeyondUpper if lambda < -floor => Held::Not,
                Held::Lower | Held::BeyondLower if lambda > floor => Held::Not,
                held @ (Held::Upper | Held::Lower) if lambda.abs() > linear + floor => beyond(held),
                Held::BeyondUpper if lambda.abs() < linear - floor => Held::Upper,
                Held::BeyondLower if lambda.abs() < linear - floor => Held::Lower,
                now => now,
            };
            set(&mut self.rows[r], to);
        }
        for (c, cone) in p.cones.iter().enumerate() {
            let nu = self.nu[c];
            let linear = cone.soft.map_or(f64::INFINITY, |s| s.linear);
            let to = match self.cones[c] {
                Held::Not if self.kkt.norm[c] > cone.radius + EXCESS => Held::Upper,
                Held::Upper | Held::BeyondUpper if nu < -floor => Held::Not,
                Held::Upper if nu > linear + floor => Held::BeyondUpper,
                Held::BeyondUpper if nu < linear - floor => Held::Upper,
                now => now,
            };
            set(&mut self.cones[c], to);
        }
        changed
    }
}

impl Held {
    fn gives(self) -> bool {
        matches!(self, Held::BeyondLower | Held::BeyondUpper)
    }
}

fn beyond(held: Held) -> Held {
    match held {
        Held::Upper => Held::BeyondUpper,
        Held::Lower => Held::BeyondLower,
        other => other,
    }
}

#[cfg(test)]
mod tests;
