//! Forward dynamics over a whole period, and back.

use crate::drive::Held;
use crate::{Dynamics, Model, Period};

/// What motor forces that are held for a period do, and which forces do what is wanted. With `R` and `b` of
/// [`Dynamics::motor_rows`], the equations of motion of the period are linear:
///
/// ```text
///     tau + external = R a + b
/// ```
///
/// [`PeriodDynamics::accelerate`] and [`PeriodDynamics::drive`] solve the same ones, so that one is the inverse of the other to rounding.
/// Nothing allocates after [`PeriodDynamics::new`]. Units: rad or m, s, N·m or N.
pub struct PeriodDynamics {
    dynamics: Dynamics,
    period: Period,
    /// Dofs with a motor, ascending.
    driven: Vec<usize>,
    /// The others, on which no motor acts.
    loose: Vec<usize>,
    /// `R` (nv x nv, row-major).
    rows: Vec<f64>,
    /// `b` less the external forces (nv).
    bias: Vec<f64>,
    /// Scratch of the elimination.
    matrix: Vec<f64>,
    right: Vec<f64>,
}

impl PeriodDynamics {
    /// For motors on the dofs `driven` of `model`, held over `period`.
    pub fn new(model: &Model, driven: &[usize], period: Period) -> PeriodDynamics {
        let nv = model.nv();
        let loose = (0..nv).filter(|i| !driven.contains(i)).collect();
        PeriodDynamics {
            dynamics: Dynamics::new(model),
            period,
            driven: driven.to_vec(),
            loose,
            rows: vec![0.0; nv * nv],
            bias: vec![0.0; nv],
            matrix: vec![0.0; nv * nv],
            right: vec![0.0; nv],
        }
    }

    /// Takes the state at the start of a period: `q` (nq), `v` (nv) and the generalised forces beside the motors' (nv).
    pub fn update(&mut self, q: &[f64], v: &[f64], external: &[f64]) {
        self.dynamics.motor_rows(&self.period, q, v, &mut self.rows, &mut self.bias);
        self.bias.iter_mut().zip(external).for_each(|(b, external)| *b -= external);
    }

    /// The acceleration (nv) that what is `held` (nv; a force of 0 where there is no motor) makes. NaN where the equations have no solution.
    pub fn accelerate(&mut self, held: &[Held], a: &mut [f64]) {
        let nv = self.bias.len();
        self.matrix.copy_from_slice(&self.rows);
        for (i, held) in held.iter().enumerate() {
            self.right[i] = match *held {
                Held::Force(tau) => tau - self.bias[i],
                Held::Servo { resistance, force } => {
                    self.matrix[i * nv + i] += resistance;
                    force - self.bias[i]
                }
                Held::Acceleration(a) => {
                    let row = &mut self.matrix[i * nv..(i + 1) * nv];
                    row.fill(0.0);
                    row[i] = 1.0;
                    a
                }
            };
        }
        solve(nv, &mut self.matrix, &mut self.right);
        a.copy_from_slice(&self.right);
    }

    /// The motor forces `tau` (nv) that keep the accelerations `a` of the driven dofs. Those of the others, which follow, are written to `a`;
    /// their `tau` is 0.
    pub fn drive(&mut self, a: &mut [f64], tau: &mut [f64]) {
        let (nv, n) = (self.bias.len(), self.loose.len());
        for (r, &i) in self.loose.iter().enumerate() {
            let row = &self.rows[i * nv..(i + 1) * nv];
            self.right[r] = -self.bias[i] - self.driven.iter().map(|&j| row[j] * a[j]).sum::<f64>();
            for (c, &j) in self.loose.iter().enumerate() {
                self.matrix[r * n + c] = row[j];
            }
        }
        solve(n, &mut self.matrix[..n * n], &mut self.right[..n]);
        for (r, &i) in self.loose.iter().enumerate() {
            (a[i], tau[i]) = (self.right[r], 0.0);
        }
        for &i in &self.driven {
            let row = &self.rows[i * nv..(i + 1) * nv];
            tau[i] = self.bias[i] + row.iter().zip(a.iter()).map(|(r, a)| r * a).sum::<f64>();
        }
    }

    /// The control period.
    pub fn period(&self) -> &Period {
        &self.period
    }
}

/// Gaussian elimination with partial pivoting: `matrix` (n x n, row-major) is spoilt, `x` is the right side and then the solution; NaN for
/// a singular matrix.
pub(crate) fn solve(n: usize, matrix: &mut [f64], x: &mut [f64]) {
    for k in 0..n {
        let size = |r: &usize| matrix[r * n + k].abs();
        let pivot = (k..n).max_by(|a, b| size(a).total_cmp(&size(b))).unwrap_or(k);
        if pivot != k {
            (0..n).for_each(|c| matrix.swap(k * n + c, pivot * n + c));
            x.swap(k, pivot);
        }
        for r in k + 1..n {
            let share = matrix[r * n + k] / matrix[k * n + k];
            for c in k + 1..n {
                matrix[r * n + c] -= share * matrix[k * n + c];
            }
            x[r] -= share * x[k];
        }
    }
    for k in (0..n).rev() {
        let known: f64 = (k + 1..n).map(|c| matrix[k * n + c] * x[c]).sum();
        let value = (x[k] - known) / matrix[k * n + k];
        x[k] = if value.is_finite() { value } else { f64::NAN };
    }
}
