//! Adam (Kingma & Ba 2015) on a flat padded parameter vector.

use nearl_runtime::multiversion;
use nearl_runtime::net::kernel::{V, ZERO, scalars, scalars_mut};

/// First and second moments, and the step count.
#[derive(Clone, Debug)]
pub struct Adam {
    /// First moment.
    pub m: Vec<V>,
    /// Second moment.
    pub v: Vec<V>,
    /// Steps taken.
    pub t: i32,
    /// Learning rate.
    pub lr: f32,
}

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPS: f32 = 1e-5;

struct Update<'a> {
    p: &'a mut [V],
    g: &'a [V],
    m: &'a mut [V],
    v: &'a mut [V],
    scale: f32,
    rate: f32,
    correction: [f32; 2],
}

/// `m <- b1 m + (1 - b1) g`, `v <- b2 v + (1 - b2) g^2`, `p <- p - lr m^ / (sqrt(v^) + eps)`.
#[inline(always)]
fn body(s: Update<'_>) {
    let [c1, c2] = s.correction;
    // number by number: whole vectors of 16 make the compiler work across them, with scattered loads and stores
    let moments = scalars_mut(s.m).iter_mut().zip(scalars_mut(s.v));
    for ((p, &g), (m, v)) in scalars_mut(s.p).iter_mut().zip(scalars(s.g)).zip(moments) {
        let g = g * s.scale;
        *m = *m * BETA1 + g * (1.0 - BETA1);
        *v = *v * BETA2 + g * g * (1.0 - BETA2);
        *p -= s.rate * (*m * c1) / ((*v * c2).sqrt() + EPS);
    }
}
multiversion!(fn run(s: Update<'_>) = body);

impl Adam {
    /// Moments zero for `n` vectors of parameters.
    pub fn new(n: usize, lr: f32) -> Self {
        Self { m: vec![ZERO; n], v: vec![ZERO; n], t: 0, lr }
    }

    /// One step on `p` with gradient `scale g`, at `rate` times the learning rate.
    pub fn step(&mut self, p: &mut [V], g: &[V], scale: f32, rate: f32) {
        self.t += 1;
        let correction = [1.0 / (1.0 - BETA1.powi(self.t)), 1.0 / (1.0 - BETA2.powi(self.t))];
        run(Update { p, g, m: &mut self.m, v: &mut self.v, scale, rate: self.lr * rate, correction });
    }
}

#[inline(always)]
fn square_sum(g: &[V], out: &mut f32) {
    let mut acc = [ZERO; 4];
    for chunk in g.chunks(4) {
        for (a, &x) in acc.iter_mut().zip(chunk) {
            *a = a.fma(x, x);
        }
    }
    *out = ((acc[0] + acc[1]) + (acc[2] + acc[3])).sum();
}
multiversion!(fn run_square_sum(g: &[V], out: &mut f32) = square_sum);

/// Squared Euclidean length of a gradient.
pub(super) fn square(g: &[V]) -> f32 {
    let mut sum = 0.0;
    run_square_sum(g, &mut sum);
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three steps by hand on one parameter with gradients 1, -2, 0.5.
    #[test]
    fn three_steps_equal_hand_arithmetic() {
        let (mut p, mut adam) = (vec![V::splat(1.0)], Adam::new(1, 0.1));
        let (mut m, mut v, mut want) = (0.0f64, 0.0f64, 1.0f64);
        for (t, g) in [1.0f64, -2.0, 0.5].into_iter().enumerate() {
            adam.step(&mut p, &[V::splat(g as f32)], 1.0, 1.0);
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            let n = t as i32 + 1;
            want -= 0.1 * (m / (1.0 - 0.9f64.powi(n))) / ((v / (1.0 - 0.999f64.powi(n))).sqrt() + 1e-5);
            assert!((f64::from(p[0].0[3]) - want).abs() < 1e-5, "step {n}: {} {want}", p[0].0[3]);
        }
    }
}
