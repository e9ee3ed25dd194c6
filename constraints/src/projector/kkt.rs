//! The optimality conditions of an active set as linear equations, for Newton's method and for derivatives.
//!
//! With F the dofs off their bounds, A the rows and cone normals that hold back, and D by how much the elastic ones of them give way:
//!
//! ```text
//!     K = [ H + C   A' ]      C = nu (G_c'G_c - s s') / |G_c y + c|,   s = G_c' u,   u = (G_c y + c) / |G_c y + c|
//!         [   A    -D  ]
//! ```

use super::coupled::Coupled;

/// An active set, and `K x = b` for it.
#[derive(Debug, Default)]
pub(super) struct Kkt {
    /// Dofs off their bounds.
    pub(super) free: Vec<usize>,
    /// Rows that hold back, and what each gives per multiplier.
    pub(super) rows: Vec<(usize, f64)>,
    /// Cones that hold back, and what each gives per multiplier.
    pub(super) cones: Vec<(usize, f64)>,
    /// `|G_c y + c|` of each cone of the problem.
    pub(super) norm: Vec<f64>,
    /// `s` of each cone of the problem (n).
    pub(super) normal: Vec<Vec<f64>>,
    /// The right-hand side, then the solution: dofs, rows, cones, in the order above.
    pub(super) x: Vec<f64>,
    k: Vec<f64>,
    point: Vec<f64>,
}

impl Kkt {
    /// With room for every active set of `p`.
    pub(super) fn with_room(p: &Coupled) -> Kkt {
        let (n, m, cones) = (p.n, p.m, p.cones.len());
        let size = n + m + cones;
        Kkt {
            free: Vec::with_capacity(n),
            rows: Vec::with_capacity(m),
            cones: Vec::with_capacity(cones),
            norm: Vec::with_capacity(cones),
            normal: vec![vec![0.0; n]; cones],
            x: Vec::with_capacity(size),
            k: Vec::with_capacity(size * size),
            point: Vec::with_capacity(p.cones.iter().map(|c| c.c.len()).max().unwrap_or(0)),
        }
    }

    /// Finds norms and slopes of the cones at `y`.
    pub(super) fn look(&mut self, p: &Coupled, y: &[f64]) {
        self.norm.clear();
        self.normal.resize(p.cones.len(), Vec::new());
        for (cone, normal) in p.cones.iter().zip(&mut self.normal) {
            self.point.clear();
            let rows = cone.g.chunks_exact(p.n).zip(&cone.c);
            self.point.extend(rows.map(|(g, c)| c + g.iter().zip(y).map(|(g, y)| g * y).sum::<f64>()));
            let norm = self.point.iter().map(|x| x * x).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
            normal.clear();
            normal.resize(p.n, 0.0);
            for (x, row) in self.point.iter().zip(cone.g.chunks_exact(p.n)) {
                normal.iter_mut().zip(row).for_each(|(s, g)| *s += x / norm * g);
            }
            self.norm.push(norm);
        }
    }

    /// Solves `K x = x` at the `y` last looked at, with multipliers `nu` of all cones; false when what holds back depends on each other.
    pub(super) fn solve(&mut self, p: &Coupled, nu: &[f64]) -> bool {
        let (f, r) = (self.free.len(), self.rows.len());
        let size = f + r + self.cones.len();
        let k = &mut self.k;
        k.clear();
        k.resize(size * size, 0.0);
        for (a, &i) in self.free.iter().enumerate() {
            k[a * size + a] = p.hessian[i];
        }
        let gradients = self.rows.iter().map(|(row, give)| (p.gradient(*row), *give));
        let slopes = self.cones.iter().map(|(c, give)| (&self.normal[*c][..], *give));
        for (a, (gradient, give)) in gradients.chain(slopes).enumerate().map(|(a, x)| (a + f, x)) {
            for (b, &i) in self.free.iter().enumerate() {
                (k[a * size + b], k[b * size + a]) = (gradient[i], gradient[i]);
            }
            k[a * size + a] = -give;
        }
        for &(c, _) in &self.cones {
            let (s, turn) = (&self.normal[c], nu[c] / self.norm[c]);
            let curve = |k: &mut [f64], g: &[f64], scale: f64| {
                for (a, &i) in self.free.iter().enumerate() {
                    for (b, &j) in self.free.iter().enumerate() {
                        k[a * size + b] += scale * g[i] * g[j];
                    }
                }
            };
            p.cones[c].g.chunks_exact(p.n).for_each(|g| curve(k, g, turn));
            curve(k, s, -turn);
        }
        eliminate(k, &mut self.x, size) && self.x.iter().all(|x| x.is_finite())
    }
}

/// Solves `K x = b` in place by elimination with pivots; false when K is singular.
fn eliminate(k: &mut [f64], b: &mut [f64], n: usize) -> bool {
    let largest = k.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
    for col in 0..n {
        let pivot =
            (col..n).max_by(|a, c| k[a * n + col].abs().total_cmp(&k[c * n + col].abs())).unwrap_or(col);
        if k[pivot * n + col].abs() <= 1e-14 * largest {
            return false;
        }
        if pivot != col {
            (0..n).for_each(|j| k.swap(col * n + j, pivot * n + j));
            b.swap(col, pivot);
        }
        for row in col + 1..n {
            let factor = k[row * n + col] / k[col * n + col];
            if factor != 0.0 {
                (col..n).for_each(|j| k[row * n + j] -= factor * k[col * n + j]);
                b[row] -= factor * b[col];
            }
        }
    }
    for row in (0..n).rev() {
        let sum: f64 = (row + 1..n).map(|j| k[row * n + j] * b[j]).sum();
        b[row] = (b[row] - sum) / k[row * n + row];
    }
    true
}
