//! The forward pass of one sample: what runs in the control loop.

use super::activation::Activation;
use super::dense::Dense;
use super::kernel::{LANES, V, ZERO, scalars};
use super::mlp::{Layer, Mlp};

/// A network and its activations. Nothing is allocated after construction.
#[derive(Clone)]
pub struct Forward {
    mlp: Mlp,
    params: Vec<V>,
    /// Input and output of every layer, padded.
    activations: Vec<Vec<V>>,
}

impl Forward {
    /// Packs a network with `activation` between its layers.
    pub fn new(dense: &Dense, activation: Activation) -> Self {
        let mut len = 0;
        let mlp = Mlp::new(&dense.widths(), activation, &mut len);
        let mut params = vec![ZERO; len];
        mlp.write_dense(dense, &mut params);
        let activations = dense.widths().iter().map(|w| vec![ZERO; w.div_ceil(LANES)]).collect();
        Self { mlp, params, activations }
    }

    /// Inputs.
    pub fn n_in(&self) -> usize {
        self.mlp.n_in()
    }

    /// Outputs.
    pub fn n_out(&self) -> usize {
        self.mlp.n_out()
    }

    /// The network's output (n_out) for `x` (n_in).
    ///
    /// # Panics
    /// When `x` has another length.
    pub fn forward(&mut self, x: &[f32]) -> &[f32] {
        let input = super::kernel::scalars_mut(&mut self.activations[0]);
        input[..self.mlp.n_in()].copy_from_slice(x);
        run(self);
        &scalars(&self.activations[self.mlp.layers.len()])[..self.mlp.n_out()]
    }
}

#[inline(always)]
fn body(net: &mut Forward) {
    let last = net.mlp.layers.len() - 1;
    for (i, layer) in net.mlp.layers.iter().enumerate() {
        let (before, after) = net.activations.split_at_mut(i + 1);
        let between = (i < last).then_some(net.mlp.activation);
        affine(layer, &net.params, scalars(&before[i]), &mut after[0], between);
    }
}

/// `y = f(W' x + b)`; each output's sum runs over the inputs in four interleaved chains, in a fixed order.
#[inline(always)]
fn affine(l: &Layer, params: &[V], x: &[f32], y: &mut [V], between: Option<Activation>) {
    let n = l.n_vectors();
    let (w, b) = (&params[l.w..l.b], &params[l.b..l.b + n]);
    let x = &x[..l.k];
    for j in 0..n {
        let mut acc = [ZERO; 4];
        let mut k = 0;
        while k + 4 <= l.k {
            for c in 0..4 {
                acc[c] = acc[c].fma(V::splat(x[k + c]), w[(k + c) * n + j]);
            }
            k += 4;
        }
        while k < l.k {
            acc[0] = acc[0].fma(V::splat(x[k]), w[k * n + j]);
            k += 1;
        }
        let sum = ((acc[0] + acc[1]) + (acc[2] + acc[3])) + b[j];
        // no closure: it would be compiled without the vector instructions of its caller
        y[j] = match between {
            Some(f) => f.apply(sum),
            None => sum,
        };
    }
}

crate::multiversion!(fn run(net: &mut Forward) = body);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::DenseLayer;

    fn network(widths: &[usize]) -> Dense {
        let mut seed = 1u64;
        let mut next = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((seed >> 40) as f32 / (1u32 << 24) as f32 - 0.5) * 0.8
        };
        let layer = |d: &[usize], next: &mut dyn FnMut() -> f32| DenseLayer {
            n_in: d[0],
            n_out: d[1],
            weight: (0..d[0] * d[1]).map(|_| next()).collect(),
            bias: (0..d[1]).map(|_| next()).collect(),
        };
        Dense { layers: widths.windows(2).map(|d| layer(d, &mut next)).collect() }
    }

    /// The textbook sum in f64 with the library's functions.
    fn reference(net: &Dense, f: fn(f64) -> f64, x: &[f32]) -> Vec<f64> {
        let mut h: Vec<f64> = x.iter().map(|&v| f64::from(v)).collect();
        for (i, l) in net.layers.iter().enumerate() {
            let row = |n: usize| {
                l.weight[n * l.n_in..][..l.n_in].iter().zip(&h).map(|(&w, x)| f64::from(w) * x).sum::<f64>()
            };
            let y: Vec<f64> = (0..l.n_out).map(|n| row(n) + f64::from(l.bias[n])).collect();
            h = if i + 1 < net.layers.len() { y.iter().map(|v| f(*v)).collect() } else { y };
        }
        h
    }

    type Function = fn(f64) -> f64;
    const FUNCTIONS: [(Activation, Function); 2] =
        [(Activation::Tanh, f64::tanh), (Activation::Relu, |x| x.max(0.0))];

    #[test]
    fn forward_equals_the_textbook_sum() {
        for widths in [vec![17, 32, 32, 17], vec![3, 5, 1], vec![105, 32, 32, 8], vec![4, 2]] {
            let net = network(&widths);
            for (activation, f) in FUNCTIONS {
                let mut forward = Forward::new(&net, activation);
                for s in 0..50 {
                    let x: Vec<f32> =
                        (0..widths[0]).map(|i| ((i * 7 + s * 13) as f32 * 0.37).sin() * 2.0).collect();
                    let (y, want) = (forward.forward(&x).to_vec(), reference(&net, f, &x));
                    assert_eq!(y.len(), want.len());
                    for (y, w) in y.iter().zip(want) {
                        assert!(
                            (f64::from(*y) - w).abs() < 5e-6 * (1.0 + w.abs()),
                            "{activation:?}: {y} {w}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn tensors_survive_packing() {
        let net = network(&[19, 32, 7]);
        let mut len = 3;
        let mlp = Mlp::new(&net.widths(), Activation::Tanh, &mut len);
        let mut p = vec![ZERO; len];
        mlp.write_dense(&net, &mut p);
        assert_eq!(mlp.to_dense(&p), net);
    }
}
