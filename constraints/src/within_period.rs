//! How much the forces of drives differ from their mean within a period.

use crate::period_dynamics::solve;
use crate::{Drive, Model, Period};

/// By how much drives push harder at the first or the last evaluation of their force in a period than on average over it. A target is held, so that its
/// drive pushes less the nearer its joint comes, and the joint does not accelerate evenly. A motion that the plant makes in physics steps of length
/// `tau_s` is off a motion of constant acceleration `a` from `v`, that ends at the same velocity, by `u` and `w`:
///
/// ```text
///     w <- w + tau_s S^-1 (y - K s - D s'),   u <- u + tau_s w,   s = constant acceleration + u,   s' = its velocity + w
/// ```
///
/// with the mass matrix and what steps take implicitly of dampers in `S`, springs and dampers of joints and drives in `K` and `D`, and what is held in `y`:
/// forces such that `w = 0` at the end, as it is at the start. The mass matrix stays what it is at the start of the period. Over a single physics step and
/// without any `u` and `w` are zero.
///
/// Nothing allocates after [`WithinPeriod::new`]. Units: rad or m, s, N·m or N.
pub(crate) struct WithinPeriod {
    period: Period,
    /// Dofs that forces move, ascending; the others accelerate evenly, whatever it takes.
    free: Vec<usize>,
    /// By free dof: gains of its drive, spring and damper of its joint, and what steps take implicitly of dampers, as an inertia.
    drives: Vec<[f64; 2]>,
    joints: Vec<[f64; 2]>,
    implicit: Vec<f64>,
    /// `S^-1` (free x free, row-major), and scratch of it.
    inverse: Vec<f64>,
    mass: Vec<f64>,
    /// Of what is held on one free dof after the other, then of the motions (free x (free + motions), row-major).
    push: Vec<f64>,
    now: [Vec<f64>; 2],
    last: [Vec<f64>; 2],
    sum: [Vec<f64>; 2],
    /// What is held in each motion (free x motions).
    held: Vec<f64>,
    /// `u` and `w` on average and at the last evaluation, by free dof and motion ((free x motions) each).
    mean: [Vec<f64>; 2],
    end: [Vec<f64>; 2],
    motions: usize,
}

impl WithinPeriod {
    /// Of a robot whose dofs are commanded what `drives` (nv) names; forces move the dofs `free`.
    pub(crate) fn new(model: &Model, drives: &[Drive], free: Vec<usize>, period: Period) -> WithinPeriod {
        let gains = |i: &usize| match drives[*i] {
            Drive::Pd { stiffness, damping } => [stiffness, damping],
            _ => [0.0; 2],
        };
        let n = free.len();
        let zero = |columns: usize| vec![0.0; n * columns];
        let pair = |columns| [zero(columns), zero(columns)];
        WithinPeriod {
            period,
            drives: free.iter().map(gains).collect(),
            joints: free.iter().map(|i| [model.stiffness()[*i], model.damping()[*i]]).collect(),
            implicit: free.iter().map(|i| period.implicit(model, *i)).collect(),
            inverse: zero(n),
            mass: zero(n),
            push: zero(2 * n + 1),
            now: pair(2 * n + 1),
            last: pair(2 * n + 1),
            sum: pair(2 * n + 1),
            held: zero(n + 1),
            mean: pair(n + 1),
            end: pair(n + 1),
            motions: 0,
            free,
        }
    }

    /// Dofs that forces move, ascending.
    pub(crate) fn free(&self) -> &[usize] {
        &self.free
    }

    /// Reckons with motions of a robot with this mass matrix (nv x nv): `motion(r, i, c)` has velocity at the start and mean acceleration of free dof `r`,
    /// which is dof `i` of the robot, in motion `c`. At most one motion more than free dofs.
    pub(crate) fn update(
        &mut self,
        mass: &[f64],
        nv: usize,
        motions: usize,
        motion: impl Fn(usize, usize, usize) -> [f64; 2],
    ) {
        let n = self.free.len();
        self.motions = motions;
        for array in self.mean.iter_mut().chain(&mut self.end) {
            array[..n * motions].fill(0.0);
        }
        if self.period.sub_steps < 2 {
            return;
        }
        self.invert(mass, nv);
        self.walk(n + motions, motion);
        let all = n + motions;
        for r in 0..n {
            let row = &self.now[1][r * all..(r + 1) * all];
            self.mass[r * n..(r + 1) * n].copy_from_slice(&row[..n]);
            let held = &mut self.held[r * motions..(r + 1) * motions];
            held.iter_mut().zip(&row[n..]).for_each(|(held, w)| *held = -w);
        }
        solve(n, motions, &mut self.mass, &mut self.held[..n * motions]);
        if self.held[..n * motions].iter().any(|held| !held.is_finite()) {
            return; // nothing that is held ends at these velocities
        }
        let steps = f64::from(self.period.sub_steps);
        for k in 0..2 {
            for r in 0..n {
                let (sum, last) =
                    (&self.sum[k][r * all..(r + 1) * all], &self.last[k][r * all..(r + 1) * all]);
                for c in 0..motions {
                    let held = |of: &[f64]| -> f64 {
                        of[n + c] + (0..n).map(|j| of[j] * self.held[j * motions + c]).sum::<f64>()
                    };
                    self.mean[k][r * motions + c] = held(sum) / steps;
                    self.end[k][r * motions + c] = held(last);
                }
            }
        }
    }

    fn invert(&mut self, mass: &[f64], nv: usize) {
        let n = self.free.len();
        self.inverse.fill(0.0);
        for (r, &i) in self.free.iter().enumerate() {
            self.inverse[r * n + r] = 1.0;
            for (c, &j) in self.free.iter().enumerate() {
                self.mass[r * n + c] = mass[i * nv + j];
            }
            self.mass[r * n + r] += self.implicit[r];
        }
        solve(n, n, &mut self.mass, &mut self.inverse);
    }

    /// Makes the steps of `all` columns.
    fn walk(&mut self, all: usize, motion: impl Fn(usize, usize, usize) -> [f64; 2]) {
        let (n, tau) = (self.free.len(), self.period.tau);
        for array in self.now.iter_mut().chain(&mut self.sum) {
            array[..n * all].fill(0.0);
        }
        let steps = self.period.sub_steps;
        for step in 0..steps {
            let time = f64::from(step) * tau;
            let way = 0.5 * time * (time + tau);
            for k in 0..2 {
                let now = &self.now[k][..n * all];
                self.sum[k].iter_mut().zip(now).for_each(|(sum, now)| *sum += now);
                if step + 1 == steps {
                    self.last[k][..n * all].copy_from_slice(now);
                }
            }
            for r in 0..n {
                let ([k, d], [spring, damper]) = (self.drives[r], self.joints[r]);
                let (k, d) = (k + spring, d + damper);
                for c in 0..all {
                    let at = r * all + c;
                    let by_motion = if c >= n {
                        let [v, a] = motion(r, self.free[r], c - n);
                        -k * (time * v + way * a) - d * time * a
                    } else if c == r {
                        1.0
                    } else {
                        0.0
                    };
                    self.push[at] = by_motion - k * self.now[0][at] - d * self.now[1][at];
                }
            }
            let [u, w] = &mut self.now;
            for r in 0..n {
                let (u, w) = (&mut u[r * all..(r + 1) * all], &mut w[r * all..(r + 1) * all]);
                for j in 0..n {
                    let by = tau * self.inverse[r * n + j];
                    let push = &self.push[j * all..(j + 1) * all];
                    w.iter_mut().zip(push).for_each(|(w, push)| *w += by * push);
                }
                u.iter_mut().zip(&*w).for_each(|(u, w)| *u += tau * w);
            }
        }
    }

    /// By how much the drive of free dof `r` pushes harder at its first evaluation of motion `c`, of velocity `v` and acceleration `a`, than the mean force
    /// that a constant acceleration takes. With `h` and `c` of [`Period::lag`] and [`Period::sag`], `u` and `w` on average, and spring and damper `k` and `d`
    /// of the joint:
    ///
    /// ```text
    ///     K (h v + c a + u) + D (h a + w) + k u + d w
    /// ```
    pub(crate) fn at_start(&self, r: usize, c: usize, [v, a]: [f64; 2]) -> f64 {
        let (lag, sag) = (self.period.lag(), self.period.sag());
        let ([stiffness, damping], [spring, damper]) = (self.drives[r], self.joints[r]);
        let [u, w] = self.mean.each_ref().map(|mean| mean[r * self.motions + c]);
        stiffness * (lag * v + sag * a + u) + damping * (lag * a + w) + spring * u + damper * w
    }

    /// The same at its last evaluation, at `e = T - tau_s`: by `K (e v + e T a / 2 + u) + D (e a + w)` less, `u` and `w` there.
    pub(crate) fn at_end(&self, r: usize, c: usize, [v, a]: [f64; 2]) -> f64 {
        let (t, end) = (self.period.dt, self.period.dt - self.period.tau);
        let [stiffness, damping] = self.drives[r];
        let [u, w] = self.end.each_ref().map(|end| end[r * self.motions + c]);
        self.at_start(r, c, [v, a]) - stiffness * (end * (v + 0.5 * t * a) + u) - damping * (end * a + w)
    }
}
