//! Forward dynamics over a whole period, and back.

use crate::drive::Held;
use crate::friction::MadeUpFor;
use crate::{Dynamics, Model, Period};

/// What motor forces that are held for a period do, and which forces do what is wanted. With `R` and `b` of
/// [`Dynamics::motor_rows`], and `F` that makes up for the dry friction of the joints as [`Dynamics::motors`] does:
///
/// ```text
///     tau + external = R a + b + F(a)
/// ```
///
/// [`PeriodDynamics::accelerate`] and [`PeriodDynamics::drive`] solve the same equations, so that one is the inverse of the other to rounding.
/// They are linear where no joint rubs; with dry friction, which grows with the acceleration of its joint, they have one solution all the same.
/// Nothing allocates after [`PeriodDynamics::new`]. Units: rad or m, s, N·m or N.
pub struct PeriodDynamics {
    dynamics: Dynamics,
    period: Period,
    /// Some joint rubs.
    rubs: bool,
    /// An Euler step of the plant takes dampers implicitly.
    dampers: bool,
    /// Dofs with a motor, ascending.
    driven: Vec<usize>,
    /// The others, on which no motor acts.
    loose: Vec<usize>,
    /// Velocity at the start of the period (nv).
    v: Vec<f64>,
    /// `R` (nv x nv, row-major).
    rows: Vec<f64>,
    /// `b` less the external forces (nv).
    bias: Vec<f64>,
    /// `M^-1 (M + tau_s D)` (nv x nv, row-major): what friction sees of an acceleration before an implicit damper takes its share.
    before: Vec<f64>,
    /// What of that does not depend on the acceleration, as a base turns (nv).
    turned: Vec<f64>,
    /// Dofs whose acceleration is looked for.
    free: Vec<usize>,
    /// Forces that fall away for a unit of acceleration of a dof (nv), and those without acceleration.
    resistance: Vec<f64>,
    force: Vec<f64>,
    /// Scratch: a matrix (nv x nv), a step and what is tried.
    matrix: Vec<f64>,
    step: Vec<f64>,
    tried: Vec<f64>,
}

/// Newton steps before a solution is given up; some two to ten are needed.
const ROUNDS: usize = 100;
/// Halvings of a step that a corner of the friction ends.
const HALVINGS: usize = 60;
/// What is left of the forces, as a share of all that act, at which a solution is one.
const LEFT: f64 = 1e-9;
/// The same at which a further step is not worth its time.
const ROUNDING: f64 = 1e-14;

impl PeriodDynamics {
    /// For motors on the dofs `driven` of `model`, held over `period`.
    pub fn new(model: &Model, driven: &[usize], period: Period) -> PeriodDynamics {
        let nv = model.nv();
        let loose = (0..nv).filter(|i| !driven.contains(i)).collect();
        let rubs = model.friction().iter().any(|f| *f > 0.0);
        let mut before = vec![0.0; nv * nv];
        (0..nv).for_each(|i| before[i * nv + i] = 1.0);
        PeriodDynamics {
            dynamics: Dynamics::new(model),
            period,
            rubs,
            dampers: (0..nv).any(|i| period.implicit(model, i) > 0.0),
            driven: driven.to_vec(),
            loose,
            v: vec![0.0; nv],
            rows: vec![0.0; nv * nv],
            bias: vec![0.0; nv],
            before,
            turned: vec![0.0; nv],
            free: Vec::with_capacity(nv),
            resistance: vec![0.0; nv],
            force: vec![0.0; nv],
            matrix: vec![0.0; nv * nv],
            step: vec![0.0; nv],
            tried: vec![0.0; nv],
        }
    }

    /// Takes the state at the start of a period: `q` (nq), `v` (nv) and the generalised forces beside the motors' (nv).
    pub fn update(&mut self, q: &[f64], v: &[f64], external: &[f64]) {
        self.dynamics.motor_rows(&self.period, q, v, &mut self.rows, &mut self.bias);
        self.bias.iter_mut().zip(external).for_each(|(b, external)| *b -= external);
        self.v.copy_from_slice(v);
        if self.rubs && self.dampers {
            let nv = v.len();
            self.dynamics.mass(q, &mut self.matrix);
            let model = self.dynamics.model();
            self.before.fill(0.0);
            (0..nv).for_each(|i| self.before[i * nv + i] = self.period.implicit(model, i));
            solve(nv, nv, &mut self.matrix, &mut self.before);
            self.turned.fill(0.0);
            for (j, more) in self.dynamics.turning(v) {
                (0..nv).for_each(|i| self.turned[i] += self.before[i * nv + j] * more);
            }
            (0..nv).for_each(|i| self.before[i * nv + i] += 1.0);
        }
    }

    /// The acceleration (nv) that what is `held` (nv; a force of 0 where there is no motor) makes. NaN where the equations have no solution.
    pub fn accelerate(&mut self, held: &[Held], a: &mut [f64]) {
        self.free.clear();
        for (i, held) in held.iter().enumerate() {
            let (resistance, force) = match *held {
                Held::Force(tau) => (0.0, tau),
                Held::Servo { resistance, force } => (resistance, force),
                Held::Acceleration(wanted) => {
                    a[i] = wanted;
                    continue;
                }
            };
            (self.resistance[i], self.force[i]) = (resistance, force);
            self.free.push(i);
        }
        self.settle(a);
    }

    /// The motor forces `tau` (nv) that keep the accelerations `a` of the driven dofs. Those of the others, which follow, are written to `a`;
    /// their `tau` is 0. NaN where the equations have no solution.
    pub fn drive(&mut self, a: &mut [f64], tau: &mut [f64]) {
        self.free.clone_from(&self.loose);
        for &i in &self.loose {
            (self.resistance[i], self.force[i], tau[i]) = (0.0, 0.0, 0.0);
        }
        self.settle(a);
        let nv = a.len();
        for &i in &self.driven {
            let row = &self.rows[i * nv..(i + 1) * nv];
            let smooth = self.bias[i] + row.iter().zip(a.iter()).map(|(r, a)| r * a).sum::<f64>();
            tau[i] = smooth + self.friction(i, a).force;
        }
    }

    /// The control period.
    pub fn period(&self) -> &Period {
        &self.period
    }

    /// The model these equations belong to.
    pub(crate) fn model(&self) -> &Model {
        self.dynamics.model()
    }

    /// `R` of the state of [`PeriodDynamics::update`] (nv x nv, row-major).
    pub(crate) fn rows(&self) -> &[f64] {
        &self.rows
    }

    /// [`Dynamics::integrate`].
    pub(crate) fn integrate(&mut self, q: &[f64], dq: &[f64], out: &mut [f64]) {
        self.dynamics.integrate(q, dq, out);
    }

    /// Finds the accelerations of the free dofs; those of the others are in `a`.
    fn settle(&mut self, a: &mut [f64]) {
        // as if no joint rubbed
        self.free.iter().for_each(|&i| a[i] = 0.0);
        self.newton(a, |_, _, _| MadeUpFor::default());
        a.copy_from_slice(&self.tried);
        if !self.rubs {
            return;
        }
        let mut left = self.left(a);
        for _ in 0..ROUNDS {
            if left <= ROUNDING || !left.is_finite() {
                break;
            }
            self.newton(a, Self::friction);
            let is_whole = !self.shorten(a);
            let after = self.left(&self.tried);
            if left <= LEFT && after > 0.5 * left {
                break;
            }
            a.copy_from_slice(&self.tried);
            if is_whole || after <= LEFT {
                left = after;
            } else {
                self.sweep(a);
                left = self.left(a);
            }
        }
        if left > LEFT || left.is_nan() {
            self.free.iter().for_each(|&i| a[i] = f64::NAN);
        }
    }

    /// What makes up for the friction of dof `i` at the accelerations `a`.
    fn friction(&self, i: usize, a: &[f64]) -> MadeUpFor {
        if !self.rubs {
            return MadeUpFor::default();
        }
        let before = &self.before[i * a.len()..(i + 1) * a.len()];
        let solved = match self.dampers {
            true => before.iter().zip(a).map(|(s, a)| s * a).sum::<f64>() + self.turned[i],
            false => a[i],
        };
        MadeUpFor::of(self.dynamics.model(), i, &self.period, self.v[i], a[i], solved)
    }

    /// What acts on dof `i` beside friction and is not balanced at the accelerations `a`, and the sum of the sizes of all that acts.
    fn unbalanced(&self, i: usize, a: &[f64]) -> [f64; 2] {
        let row = &self.rows[i * a.len()..(i + 1) * a.len()];
        let mut sums = [self.bias[i] - self.force[i], self.bias[i].abs() + self.force[i].abs()];
        let terms = row.iter().zip(a).map(|(r, a)| r * a);
        for term in terms.chain([self.resistance[i] * a[i]]) {
            sums = [sums[0] + term, sums[1] + term.abs()];
        }
        sums
    }

    /// The share of all that acts on the free dofs that is not balanced at the accelerations `a`.
    fn left(&self, a: &[f64]) -> f64 {
        let (mut left, mut all) = (0.0, f64::MIN_POSITIVE);
        for &i in &self.free {
            let ([smooth, size], friction) = (self.unbalanced(i, a), self.friction(i, a).force);
            left += (smooth + friction).abs();
            all += size + friction.abs();
        }
        left / all
    }

    /// Writes to `tried` where a Newton step from `a` leads.
    fn newton(&mut self, a: &[f64], friction: impl Fn(&Self, usize, &[f64]) -> MadeUpFor) {
        let (nv, n) = (a.len(), self.free.len());
        for r in 0..n {
            let i = self.free[r];
            let f = friction(self, i, a);
            self.step[r] = -self.unbalanced(i, a)[0] - f.force;
            for c in 0..n {
                let j = self.free[c];
                self.matrix[r * n + c] = self.rows[i * nv + j] + f.by_solved * self.before[i * nv + j];
            }
            self.matrix[r * n + r] += self.resistance[i] + f.by_acceleration;
        }
        solve(n, 1, &mut self.matrix[..n * n], &mut self.step[..n]);
        self.tried.copy_from_slice(a);
        for (&i, step) in self.free.iter().zip(&self.step) {
            self.tried[i] += step;
        }
    }

    /// Ends a Newton step from `a` where the forces begin to push it back, which a corner of the friction makes them do: as they grow with the
    /// acceleration, a step up to there never leads away from the solution. Returns whether it ended one.
    fn shorten(&mut self, a: &[f64]) -> bool {
        let start = self.along(a);
        let (mut low, mut high) = (0.0, 1.0);
        // a step that ends on the solution is pushed by rounding alone
        if self.along(&self.tried) <= 1e-9 * start.abs() {
            return false;
        }
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            for (r, &i) in self.free.iter().enumerate() {
                self.tried[i] = a[i] + middle * self.step[r];
            }
            let push = self.along(&self.tried);
            *(if push > 0.0 { &mut high } else { &mut low }) = middle;
            if push <= 0.0 && push >= 0.1 * start {
                break;
            }
        }
        true
    }

    /// Balances the free dofs one after the other, each for the accelerations of the others, which finds the side of its corners that each is on.
    fn sweep(&self, a: &mut [f64]) {
        for &i in &self.free {
            let slope = self.rows[i * a.len() + i] + self.resistance[i];
            // without friction, and as far from there as it can push
            let smooth = a[i] - self.unbalanced(i, a)[0] / slope;
            let reach = self.dynamics.model().friction()[i] / slope;
            let (mut low, mut high) = (smooth - reach, smooth + reach);
            a[i] = a[i].max(low).min(high);
            for _ in 0..HALVINGS {
                let f = self.friction(i, a);
                let push = slope * (a[i] - smooth) + f.force;
                *(if push > 0.0 { &mut high } else { &mut low }) = a[i];
                let slopes = slope + f.by_acceleration + f.by_solved * self.before[i * a.len() + i];
                let newton = a[i] - push / slopes;
                let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
                if next == a[i] {
                    break;
                }
                a[i] = next;
            }
        }
    }

    /// What the forces that are not balanced at the accelerations `a` do along the step.
    fn along(&self, a: &[f64]) -> f64 {
        let push = |&i: &usize| self.unbalanced(i, a)[0] + self.friction(i, a).force;
        self.free.iter().zip(&self.step).map(|(i, step)| step * push(i)).sum()
    }
}

/// Gaussian elimination with partial pivoting: `matrix` (n x n, row-major) is spoilt, `x` (n x m, row-major) is the right side and then the
/// solution; NaN for a singular matrix.
pub(crate) fn solve(n: usize, m: usize, matrix: &mut [f64], x: &mut [f64]) {
    for k in 0..n {
        let size = |r: &usize| matrix[r * n + k].abs();
        let pivot = (k..n).max_by(|a, b| size(a).total_cmp(&size(b))).unwrap_or(k);
        if pivot != k {
            (0..n).for_each(|c| matrix.swap(k * n + c, pivot * n + c));
            (0..m).for_each(|c| x.swap(k * m + c, pivot * m + c));
        }
        for r in k + 1..n {
            let share = matrix[r * n + k] / matrix[k * n + k];
            for c in k + 1..n {
                matrix[r * n + c] -= share * matrix[k * n + c];
            }
            for c in 0..m {
                x[r * m + c] -= share * x[k * m + c];
            }
        }
    }
    for k in (0..n).rev() {
        for c in 0..m {
            let known: f64 = (k + 1..n).map(|j| matrix[k * n + j] * x[j * m + c]).sum();
            let value = (x[k * m + c] - known) / matrix[k * n + k];
            x[k * m + c] = if value.is_finite() { value } else { f64::NAN };
        }
    }
}
