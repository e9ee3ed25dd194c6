//! The forward pass of one sample: what runs in the control loop.

use super::activation::Activation;
use super::dense::Dense;
use super::function::Function;
use super::kernel::{LANES, V, ZERO, scalars};
use super::mlp::{Layer, Mlp};

/// A network and its activations. Nothing is allocated after construction.
#[derive(Clone)]
pub struct Forward {
    mlp: Mlp,
    /// What follows each layer.
    functions: Vec<Function>,
    params: Vec<V>,
    /// Input and output of every layer, padded.
    activations: Vec<Vec<V>>,
}

impl Forward {
    /// Packs a network with `activation` between its layers.
    pub fn new(dense: &Dense, activation: Activation) -> Self {
        Self::layered(dense, Function::between(activation, dense.layers.len()))
    }

    /// Packs a network with a function of its own after each layer.
    ///
    /// # Panics
    /// When there are not as many functions as layers.
    pub fn layered(dense: &Dense, functions: Vec<Function>) -> Self {
        assert_eq!(dense.layers.len(), functions.len(), "one function a layer");
        let mut len = 0;
        // the layout alone is used; what follows a layer is ours
        let make = if dense.skip.is_some() { Mlp::with_skip } else { Mlp::new };
        let mlp = make(&dense.widths(), Activation::default(), &mut len);
        let mut params = vec![ZERO; len];
        mlp.write_dense(dense, &mut params);
        let activations = dense.widths().iter().map(|w| vec![ZERO; w.div_ceil(LANES)]).collect();
        Self { mlp, functions, params, activations }
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
    for (i, (layer, &function)) in net.mlp.layers.iter().zip(&net.functions).enumerate() {
        let (before, after) = net.activations.split_at_mut(i + 1);
        affine(layer, &net.params, scalars(&before[i]), &mut after[0], function);
    }
    if let Some(l) = &net.mlp.skip {
        let (x, y) = net.activations.split_at_mut(net.mlp.layers.len());
        add_linear(l, &net.params, scalars(&x[0]), &mut y[0]);
    }
}

/// `y += W' x`, each sum over the inputs in order.
#[inline(always)]
fn add_linear(l: &Layer, params: &[V], x: &[f32], y: &mut [V]) {
    let n = l.n_vectors();
    for (k, &x) in x[..l.k].iter().enumerate() {
        for j in 0..n {
            y[j] = y[j].fma(V::splat(x), params[l.w + k * n + j]);
        }
    }
}

/// `y = f(W' x + b)`; each output's sum runs over the inputs in four interleaved chains, in a fixed order.
#[inline(always)]
fn affine(l: &Layer, params: &[V], x: &[f32], y: &mut [V], function: Function) {
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
        y[j] = function.apply(sum);
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
        Dense { layers: widths.windows(2).map(|d| layer(d, &mut next)).collect(), skip: None }
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

    type Scalar = fn(f64) -> f64;
    const FUNCTIONS: [(Activation, Scalar); 2] =
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

    /// One function after each layer, in f64.
    fn layered_reference(net: &Dense, functions: &[Function], x: &[f32]) -> Vec<f64> {
        let exact = |f: Function, x: f64| match f {
            Function::Identity => x,
            Function::Tanh => x.tanh(),
            Function::Relu => x.max(0.0),
            Function::Elu => x.max(x.min(0.0).exp_m1()),
            Function::Silu => x / (1.0 + (-x).exp()),
            Function::Softplus => x.exp().ln_1p(),
            Function::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        };
        let mut h: Vec<f64> = x.iter().map(|&v| f64::from(v)).collect();
        for (l, &f) in net.layers.iter().zip(functions) {
            let one = Dense { layers: vec![l.clone()], skip: None };
            let x32: Vec<f32> = h.iter().map(|&v| v as f32).collect();
            h = reference(&one, |x| x, &x32).into_iter().map(|v| exact(f, v)).collect();
        }
        h
    }

    #[test]
    fn every_layer_has_its_own_function() {
        for functions in
            Function::ALL.windows(3).chain([&[Function::Softplus, Function::Sigmoid, Function::Tanh][..]])
        {
            let net = network(&[48, 96, 33, 12]);
            let mut forward = Forward::layered(&net, functions.to_vec());
            for s in 0..20 {
                let x: Vec<f32> = (0..48).map(|i| ((i * 7 + s * 13) as f32 * 0.37).sin() * 2.0).collect();
                for (y, want) in forward.forward(&x).iter().zip(layered_reference(&net, functions, &x)) {
                    assert!(
                        (f64::from(*y) - want).abs() < 1e-5 * (1.0 + want.abs()),
                        "{functions:?}: {y} {want}"
                    );
                }
            }
        }
    }

    /// `f(x) + W x`, and zero beside the layers is as if it were not there.
    #[test]
    fn a_linear_map_beside_the_layers_is_added() {
        for widths in [&[5, 7, 3][..], &[19, 3], &[40, 32, 32, 17]] {
            let plain = network(widths);
            let (n_in, n_out) = (plain.n_in(), plain.n_out());
            let skip: Vec<f32> = (0..n_in * n_out).map(|i| ((i * 7) % 11) as f32 * 0.1 - 0.5).collect();
            let both = Dense { skip: Some(skip.clone()), ..plain.clone() };
            let x: Vec<f32> = (0..n_in).map(|i| (i as f32 * 0.7).sin()).collect();
            let y = Forward::new(&plain, Activation::Tanh).forward(&x).to_vec();
            let z = Forward::new(&both, Activation::Tanh).forward(&x).to_vec();
            for n in 0..n_out {
                let linear: f64 = (0..n_in).map(|k| f64::from(skip[n * n_in + k]) * f64::from(x[k])).sum();
                assert!((f64::from(z[n]) - f64::from(y[n]) - linear).abs() < 1e-5, "{widths:?}, output {n}");
            }
            let mut len = 0;
            let mlp = Mlp::with_skip(widths, Activation::Tanh, &mut len);
            let mut p = vec![ZERO; len];
            mlp.write_dense(&both, &mut p);
            assert_eq!(mlp.to_dense(&p), both);
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
