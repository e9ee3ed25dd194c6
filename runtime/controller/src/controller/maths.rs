//! Sampling a Gaussian, and the cubic between two policy ticks.

/// Draws `x = mean + exp(log_std) noise` and returns `log N(x; mean, exp(log_std)^2)`, summed in f64.
pub(super) fn sample(mean: &[f32], log_std: &[f32], noise: &[f32], x: &mut [f32]) -> f64 {
    let mut log_prob = 0.0;
    for i in 0..x.len() {
        let (s, z) = (log_std[i], noise[i]);
        x[i] = s.exp().mul_add(z, mean[i]);
        let z = f64::from(z);
        log_prob -= 0.5 * z * z + f64::from(s) + 0.918_938_533_204_672_7;
    }
    log_prob
}

/// Cubic through (q0, v0) at s = 0 and (q1, v1) at s = 1, velocities per unit of s: position and velocity at s.
pub(super) fn hermite(s: f64, q0: f64, v0: f64, q1: f64, v1: f64) -> (f64, f64) {
    let d = q1 - q0;
    let (a, b) = (v0 + v1 - 2.0 * d, 3.0 * d - 2.0 * v0 - v1);
    (q0 + s * (v0 + s * (b + s * a)), v0 + s * (2.0 * b + 3.0 * a * s))
}
