//! Newton's method on the optimality conditions, from Clarabel's answer on, for problems with cones.
//!
//! An interior point ends where its steps stop paying: up to 3e-4 of the largest velocity change from the optimum. With F the dofs off
//! their bounds and A the rows and cone normals that hold back, each step solves
//!
//! ```text
//!     [ H + C   A' ] [ dy     ]   [ H (goal - y)   ]
//!     [   A    -D  ] [ lambda ] = [ bound - A y    ]      C = nu (G_c'G_c - s s') / |G_c y + c|,   s = G_c' u
//! ```
//!
//! (letters as in `gradient.rs`), then lets go what pulls the wrong way and takes up what is exceeded. The answer counts only when
//! nothing is left to change; else Clarabel's stays.

use super::conic::Conic;
use super::coupled::Coupled;
use super::gradient::solve;

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
    /// A soft row beyond its lower or upper bound.
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
    /// `G_c' G_c` (n x n) and `s` (n) of each cone, and `|G_c y + c|`.
    gram: Vec<Vec<f64>>,
    normal: Vec<Vec<f64>>,
    norm: Vec<f64>,
    point: Vec<f64>,
    /// Unknowns: dofs, then n + rows, then n + m + cones.
    active: Vec<usize>,
    k: Vec<f64>,
    x: Vec<f64>,
}

impl Polish {
    pub(crate) fn new(p: &Coupled) -> Polish {
        let (n, m, cones) = (p.n, p.m, p.cones.len());
        let size = if cones == 0 { 0 } else { n + m + cones };
        Polish {
            dofs: vec![Held::Not; n],
            rows: vec![Held::Not; m],
            cones: vec![Held::Not; cones],
            y: vec![0.0; n],
            mu: vec![0.0; n],
            lambda: vec![0.0; m],
            nu: vec![0.0; cones],
            gram: vec![vec![0.0; n * n]; cones],
            normal: vec![vec![0.0; n]; cones],
            norm: vec![0.0; cones],
            point: vec![0.0; p.cones.iter().map(|c| c.c.len()).max().unwrap_or(0)],
            active: Vec::with_capacity(size),
            k: vec![0.0; size * size],
            x: vec![0.0; size],
        }
    }

    /// Replaces the answer by the optimum near it, where Newton's method finds it.
    pub(crate) fn refine(&mut self, p: &Coupled, answer: &mut Conic) {
        if p.cones.is_empty() {
            return;
        }
        self.start(p, answer);
        let reach = (0..p.n).fold(f64::MIN_POSITIVE, |w: f64, k| w.max(p.upper[k] - p.lower[k]));
        for _ in 0..STEPS {
            let Some(moved) = self.step(p) else { return };
            let changed = self.change(p, reach);
            if !changed && moved <= 1e-13 * reach {
                answer.y.copy_from_slice(&self.y);
                answer.mu.copy_from_slice(&self.mu);
                answer.lambda.copy_from_slice(&self.lambda);
                answer.nu.copy_from_slice(&self.nu);
                return;
            }
        }
    }

    /// Takes over the answer and what holds it back.
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
        (0..p.n).for_each(|k| self.dofs[k] = side(answer.mu[k]));
        for r in 0..p.m {
            let held = if p.equality[r] && p.soft[r].is_none() && p.row_upper[r].is_finite() {
                Held::Upper
            } else {
                side(answer.lambda[r])
            };
            let gives = p.soft[r].is_some_and(|s| answer.lambda[r].abs() > s.linear * (1.0 + ROUNDING.1));
            self.rows[r] = if gives { beyond(held) } else { held };
        }
        for (c, cone) in p.cones.iter().enumerate() {
            self.cones[c] = if cone.radius.is_finite() { side(answer.nu[c].max(0.0)) } else { Held::Not };
            for (i, row) in self.gram[c].chunks_exact_mut(p.n).enumerate() {
                for (j, g) in row.iter_mut().enumerate() {
                    *g = cone.g.chunks_exact(p.n).map(|g| g[i] * g[j]).sum();
                }
            }
        }
    }

    /// `|G_c y + c|` and its slope.
    fn look(&mut self, p: &Coupled) {
        for (c, cone) in p.cones.iter().enumerate() {
            let point = &mut self.point[..cone.c.len()];
            for (d, row) in cone.g.chunks_exact(p.n).enumerate() {
                point[d] = cone.c[d] + row.iter().zip(&self.y).map(|(g, y)| g * y).sum::<f64>();
            }
            self.norm[c] = point.iter().map(|x| x * x).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
            for (k, s) in self.normal[c].iter_mut().enumerate() {
                *s = point.iter().enumerate().map(|(d, x)| x * cone.g[d * p.n + k]).sum::<f64>()
                    / self.norm[c];
            }
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
        self.look(p);
        self.active.clear();
        self.active.extend((0..n).filter(|k| self.dofs[*k] == Held::Not));
        let free = self.active.len();
        self.active.extend((0..m).filter(|r| self.rows[*r] != Held::Not).map(|r| n + r));
        self.active.extend((0..p.cones.len()).filter(|c| self.cones[*c] != Held::Not).map(|c| n + m + c));
        let size = self.active.len();
        let (k, x) = (&mut self.k[..size * size], &mut self.x[..size]);
        k.fill(0.0);
        for a in 0..free {
            let i = self.active[a];
            k[a * size + a] = p.hessian[i];
            x[a] = p.hessian[i] * (p.goal[i] - self.y[i]);
        }
        for a in free..size {
            let at = self.active[a];
            for b in 0..free {
                let i = self.active[b];
                let g = if at < n + m { p.rows[(at - n) * n + i] } else { self.normal[at - n - m][i] };
                (k[a * size + b], k[b * size + a]) = (g, g);
            }
            if at >= n + m {
                let c = at - n - m;
                x[a] = p.cones[c].radius - self.norm[c];
                for (b, d) in (0..free).flat_map(|b| (0..free).map(move |d| (b, d))) {
                    let (i, j) = (self.active[b], self.active[d]);
                    let turn = self.gram[c][i * n + j] - self.normal[c][i] * self.normal[c][j];
                    k[b * size + d] += self.nu[c] * turn / self.norm[c];
                }
                continue;
            }
            let (r, held) = (at - n, self.rows[at - n]);
            let upper = matches!(held, Held::Upper | Held::BeyondUpper);
            x[a] = if upper { p.row_upper[r] } else { p.row_lower[r] } - p.row(r, &self.y);
            if let (Held::BeyondLower | Held::BeyondUpper, Some(soft)) = (held, p.soft[r]) {
                // lambda = +-(linear + quadratic s) with the slack s beyond the bound
                k[a * size + a] = -1.0 / soft.quadratic;
                x[a] -= if upper { soft.linear } else { -soft.linear } / soft.quadratic;
            }
        }
        if !solve(k, x, size) || !x.iter().all(|x| x.is_finite()) {
            return None;
        }
        self.lambda.fill(0.0);
        self.nu.fill(0.0);
        let mut moved = 0.0f64;
        for (a, &at) in self.active.iter().enumerate() {
            match at {
                i if i < n => {
                    self.y[i] += x[a];
                    moved = moved.max(x[a].abs());
                }
                r if r < n + m => self.lambda[r - n] = x[a],
                c => self.nu[c - n - m] = x[a],
            }
        }
        self.look(p);
        for i in 0..n {
            let rows: f64 = (0..m).map(|r| self.lambda[r] * p.rows[r * n + i]).sum();
            let cones: f64 = self.nu.iter().zip(&self.normal).map(|(nu, s)| nu * s[i]).sum();
            let pull = p.hessian[i] * (p.goal[i] - self.y[i]) - rows - cones;
            self.mu[i] = if self.dofs[i] == Held::Not { 0.0 } else { pull };
        }
        Some(moved)
    }

    /// Lets go and takes up; true when something did.
    fn change(&mut self, p: &Coupled, reach: f64) -> bool {
        let all = self.mu.iter().chain(&self.lambda).chain(&self.nu);
        let floor = ROUNDING.0 * all.fold(0.0, |most: f64, x| most.max(x.abs()));
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
            let to = match self.cones[c] {
                Held::Not if self.norm[c] > cone.radius + EXCESS => Held::Upper,
                Held::Upper if self.nu[c] < -floor => Held::Not,
                now => now,
            };
            set(&mut self.cones[c], to);
        }
        changed
    }
}

fn beyond(held: Held) -> Held {
    match held {
        Held::Upper => Held::BeyondUpper,
        Held::Lower => Held::BeyondLower,
        other => other,
    }
}
