//! Orthogonal initialisation (Saxe et al. 2014), as PPO codebases use it.

use nearl_runtime::net::{Dense, DenseLayer};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// A network with orthogonal weights of gain sqrt(2), gain `last` in the output layer, and zero biases.
pub(super) fn orthogonal(widths: &[usize], last: f64, rng: &mut ChaCha8Rng) -> Dense {
    let n = widths.len() - 1;
    let layer = |(i, d): (usize, &[usize])| {
        let gain = if i + 1 == n { last } else { std::f64::consts::SQRT_2 };
        DenseLayer { n_in: d[0], n_out: d[1], weight: matrix(d[1], d[0], gain, rng), bias: vec![0.0; d[1]] }
    };
    Dense { layers: widths.windows(2).enumerate().map(layer).collect(), skip: None }
}

/// An orthogonal linear map of gain `gain` beside a network whose last layer is zero: it begins as the map alone.
pub(super) fn linear_beside(widths: &[usize], gain: f64, rng: &mut ChaCha8Rng) -> Dense {
    let (n_in, n_out) = (widths[0], widths[widths.len() - 1]);
    let skip = Some(matrix(n_out, n_in, gain, rng));
    Dense { skip, ..orthogonal(widths, 0.0, rng) }
}

/// (rows x cols), row-major, with orthonormal rows or columns (whichever are fewer) times `gain`.
fn matrix(rows: usize, cols: usize, gain: f64, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let (short, long) = (rows.min(cols), rows.max(cols));
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(short);
    while basis.len() < short {
        let mut x: Vec<f64> = (0..long).map(|_| StandardNormal.sample(&mut *rng)).collect();
        for _ in 0..2 {
            for b in &basis {
                let dot: f64 = x.iter().zip(b).map(|(x, b)| x * b).sum();
                x.iter_mut().zip(b).for_each(|(x, b)| *x -= dot * b);
            }
        }
        let norm = x.iter().map(|v| v * v).sum::<f64>().sqrt();
        if norm > 1e-6 {
            x.iter_mut().for_each(|v| *v /= norm);
            basis.push(x);
        }
    }
    let at = |r: usize, c: usize| if rows <= cols { basis[r][c] } else { basis[c][r] };
    (0..rows * cols).map(|i| (gain * at(i / cols, i % cols)) as f32).collect()
}
