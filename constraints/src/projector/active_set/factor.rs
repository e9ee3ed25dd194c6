//! `S = L D L'` of the held rows, kept up to date as rows come and go and dofs are held and freed ("Methods for modifying matrix
//! factorizations", Gill, Golub, Murray and Saunders 1974, method C1).

/// The factor of a matrix of growing and shrinking size.
#[derive(Debug)]
pub(super) struct Factor {
    /// Rows in the factor.
    pub(super) size: usize,
    /// Room for this many rows.
    room: usize,
    /// Unit lower triangle, column by column (room x room).
    l: Vec<f64>,
    d: Vec<f64>,
    /// Diagonal of S when each row came in: a pivot far below it is noise.
    diagonal: Vec<f64>,
    w: Vec<f64>,
}

/// A pivot below this share of the diagonal is noise: the rows depend on each other.
const DEPENDENT: f64 = 1e-12;

impl Factor {
    pub(super) fn new(room: usize) -> Factor {
        let zero = || vec![0.0; room];
        Factor { size: 0, room, l: vec![0.0; room * room], d: zero(), diagonal: zero(), w: zero() }
    }

    pub(super) fn clear(&mut self) {
        self.size = 0;
    }

    /// Solves `L x = x`.
    pub(super) fn forward(&self, x: &mut [f64]) {
        let x = &mut x[..self.size];
        for j in 0..x.len() {
            let (xj, column) = (x[j], &self.l[j * self.room..j * self.room + x.len()]);
            for (x, l) in x[j + 1..].iter_mut().zip(&column[j + 1..]) {
                *x -= l * xj;
            }
        }
    }

    /// Solves `D L' x = x`.
    pub(super) fn backward(&self, x: &mut [f64]) {
        let x = &mut x[..self.size];
        for j in (0..x.len()).rev() {
            let column = &self.l[j * self.room..j * self.room + x.len()];
            let sum: f64 = x[j + 1..].iter().zip(&column[j + 1..]).map(|(x, l)| x * l).sum();
            x[j] = x[j] / self.d[j] - sum;
        }
    }

    /// Adds a row with `forward(c)` of its products with the rows before it and its own product `s`; false when it depends on them.
    #[must_use]
    pub(super) fn append(&mut self, forward: &[f64], s: f64) -> bool {
        let at = self.size;
        let mut pivot = s;
        for j in 0..at {
            let l = forward[j] / self.d[j];
            pivot -= l * forward[j];
            self.l[j * self.room + at] = l;
        }
        (self.d[at], self.diagonal[at]) = (pivot, s);
        self.size += 1;
        pivot > DEPENDENT * s && pivot > 0.0
    }

    /// Takes row `a` out.
    pub(super) fn remove(&mut self, a: usize) {
        let (size, room) = (self.size, self.room);
        let count = size - a - 1;
        self.w[..count].copy_from_slice(&self.l[a * room + a + 1..a * room + size]);
        let alpha = self.d[a];
        for j in 0..a {
            self.l.copy_within(j * room + a + 1..j * room + size, j * room + a);
        }
        for j in a + 1..size {
            self.l.copy_within(j * room + j + 1..j * room + size, (j - 1) * room + j);
        }
        self.d.copy_within(a + 1..size, a);
        self.diagonal.copy_within(a + 1..size, a);
        self.size -= 1;
        self.w.copy_within(0..count, a);
        let _ = self.update(a, alpha); // adds: cannot fail
    }

    /// `S + alpha w w'` with w of each row; false when it is no longer positive definite.
    #[must_use]
    pub(super) fn rank_one(&mut self, alpha: f64, w: impl Fn(usize) -> f64) -> bool {
        for a in 0..self.size {
            self.w[a] = w(a);
            self.diagonal[a] += alpha * self.w[a] * self.w[a];
        }
        self.update(0, alpha)
    }

    fn update(&mut self, from: usize, mut alpha: f64) -> bool {
        let size = self.size;
        for j in from..size {
            let p = self.w[j];
            if p == 0.0 {
                continue;
            }
            let pivot = self.d[j] + alpha * p * p;
            if !(pivot > LOST * self.d[j] && pivot > 0.0) {
                return false;
            }
            let beta = alpha * p / pivot;
            alpha *= self.d[j] / pivot;
            self.d[j] = pivot;
            let column = &mut self.l[j * self.room + j + 1..j * self.room + size];
            for (l, w) in column.iter_mut().zip(&mut self.w[j + 1..size]) {
                *w -= p * *l;
                *l += beta * *w;
            }
        }
        true
    }

    /// Entry `a` of the diagonal of S.
    pub(super) fn diagonal(&self, a: usize) -> f64 {
        self.diagonal[a]
    }

    /// The smallest pivot as share of the diagonal of S.
    pub(super) fn conditioning(&self) -> f64 {
        (0..self.size).fold(1.0, |least: f64, a| least.min(self.d[a] / self.diagonal[a]))
    }
}

/// A downdate that leaves less than this share of a pivot has lost too many digits.
const LOST: f64 = 1e-4;

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DMatrix;

    fn product(f: &Factor) -> DMatrix<f64> {
        let n = f.size;
        let l = DMatrix::from_fn(n, n, |i, j| match i.cmp(&j) {
            std::cmp::Ordering::Less => 0.0,
            std::cmp::Ordering::Equal => 1.0,
            std::cmp::Ordering::Greater => f.l[j * f.room + i],
        });
        let d = DMatrix::from_fn(n, n, |i, j| if i == j { f.d[i] } else { 0.0 });
        &l * d * l.transpose()
    }

    #[test]
    fn follows_rows_and_rank_one_changes() {
        let a = DMatrix::from_fn(6, 9, |i, j| ((i * 7 + j * 3) % 11) as f64 * 0.3 - 1.0 + f64::from(i == j));
        let mut s = &a * a.transpose();
        let mut f = Factor::new(6);
        for i in 0..6 {
            let mut c: Vec<f64> = (0..i).map(|j| s[(i, j)]).collect();
            f.forward(&mut c);
            assert!(f.append(&c, s[(i, i)]));
        }
        assert!((product(&f) - &s).amax() < 1e-12);
        let w = [0.3, -1.0, 0.0, 2.0, 0.1, -0.4];
        s += 0.7 * DMatrix::from_fn(6, 6, |i, j| w[i] * w[j]);
        assert!(f.rank_one(0.7, |i| w[i]));
        assert!((product(&f) - &s).amax() < 1e-12);
        f.remove(2);
        let mut s = s.remove_row(2).remove_column(2);
        assert!((product(&f) - &s).amax() < 1e-12);
        s -= 0.05 * DMatrix::from_fn(5, 5, |i, j| w[i] * w[j]);
        assert!(f.rank_one(-0.05, |i| w[i]));
        assert!((product(&f) - &s).amax() < 1e-11);
        let b = DMatrix::from_fn(5, 1, |i, _| i as f64 - 1.5);
        let mut x: Vec<f64> = b.iter().copied().collect();
        f.forward(&mut x);
        f.backward(&mut x);
        assert!((&s * DMatrix::from_vec(5, 1, x) - b).amax() < 1e-10);
        assert!(!f.rank_one(-1e3, |i| w[i]), "no longer positive definite");
    }
}
