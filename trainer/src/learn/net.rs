//! A network over tiles of rows: forward with a tape, backward to parameters and inputs.

use nearl_runtime::multiversion;
use nearl_runtime::net::kernel::{Gemm, LANES, Out, V, ZERO, gemm, scalars};
use nearl_runtime::net::{Activation, Layer, Mlp};

/// Shapes of a network, and where its transposed weights lie (the backward pass reads them).
#[derive(Clone, Debug)]
pub struct Net {
    /// Shapes and offsets in the parameter vector.
    pub mlp: Mlp,
    /// Of each layer whose input's gradient is wanted: where they start, and vectors of that gradient.
    transposed: Vec<Option<(usize, usize)>>,
    /// The same of the linear map beside the layers.
    transposed_skip: Option<(usize, usize)>,
}

/// Activations of one tile of rows.
#[derive(Clone, Debug)]
pub struct Tape {
    rows: usize,
    outputs: Vec<Vec<V>>,
    /// What went into the activation after each hidden layer; empty where its output is enough.
    inputs: Vec<Vec<V>>,
    grads: [Vec<V>; 2],
}

impl Tape {
    /// The network's output, row by row.
    pub fn output(&self) -> &[V] {
        &self.outputs[self.outputs.len() - 1]
    }
}

impl Net {
    /// `at` and `transposed_at` are running lengths in vectors; the gradient of the first `input_grad` inputs is wanted.
    pub fn new(
        widths: &[usize],
        activation: Activation,
        input_grad: usize,
        at: &mut usize,
        transposed_at: &mut usize,
    ) -> Self {
        Self::of(Mlp::new(widths, activation, at), input_grad, transposed_at)
    }

    /// The same with a linear map from input to output beside the layers.
    pub fn with_skip(
        widths: &[usize],
        activation: Activation,
        input_grad: usize,
        at: &mut usize,
        transposed_at: &mut usize,
    ) -> Self {
        Self::of(Mlp::with_skip(widths, activation, at), input_grad, transposed_at)
    }

    fn of(mlp: Mlp, input_grad: usize, transposed_at: &mut usize) -> Self {
        let place = |(i, l): (usize, &Layer)| {
            let k = if i > 0 { l.k_vectors() } else { input_grad.div_ceil(LANES) };
            (k > 0).then(|| {
                let here = *transposed_at;
                *transposed_at += l.n_vectors() * LANES * k;
                (here, k)
            })
        };
        let mut place = place;
        let transposed = mlp.layers.iter().enumerate().map(&mut place).collect();
        let transposed_skip = mlp.skip.as_ref().and_then(|l| place((0, l)));
        Self { mlp, transposed, transposed_skip }
    }

    /// Buffers for `rows` rows, a multiple of 8.
    pub fn tape(&self, rows: usize) -> Tape {
        let widest = self.mlp.layers.iter().map(|l| l.n_vectors().max(l.k_vectors())).max().unwrap_or(0);
        let outputs: Vec<Vec<V>> = self.mlp.layers.iter().map(|l| vec![ZERO; rows * l.n_vectors()]).collect();
        let inputs = if self.mlp.activation.keeps_input() { outputs.clone() } else { Vec::new() };
        Tape { rows, outputs, inputs, grads: [vec![ZERO; rows * widest], vec![ZERO; rows * widest]] }
    }

    /// Refreshes the transposed weights; call after each change of the parameters `p`.
    pub fn transpose(&self, p: &[V], transposed: &mut [V]) {
        let beside = self.mlp.skip.iter().zip(std::iter::once(&self.transposed_skip));
        for (l, place) in self.mlp.layers.iter().zip(&self.transposed).chain(beside) {
            let (Some((at, k)), n) = (*place, l.n_vectors()) else { continue };
            transpose(&p[l.w..l.b], n, &mut transposed[at..at + n * LANES * k], k);
        }
    }

    /// Output rows for the input rows `x` (padded with zeros).
    pub fn forward<'t>(&self, p: &[V], x: &[V], tape: &'t mut Tape) -> &'t [V] {
        let last = self.mlp.layers.len() - 1;
        let (f, keeps) = (self.mlp.activation, self.mlp.activation.keeps_input());
        for (i, l) in self.mlp.layers.iter().enumerate() {
            let (before, after) = tape.outputs.split_at_mut(i);
            let input = if i == 0 { x } else { &before[i - 1] };
            let bias = &p[l.b..l.b + l.n_vectors()];
            let product = Gemm {
                m: tape.rows,
                k: l.k,
                n: l.n_vectors(),
                a: scalars(input),
                rs: l.k_vectors() * LANES,
                cs: 1,
                b: &p[l.w..],
                ldb: l.n_vectors(),
                ldc: l.n_vectors(),
                out: if i < last && !keeps { Out::BiasThen(bias, f) } else { Out::Bias(bias) },
            };
            if i < last && keeps {
                gemm(&product, &mut tape.inputs[i]);
                activate(&tape.inputs[i], &mut after[0], f);
            } else {
                gemm(&product, &mut after[0]);
            }
        }
        if let Some(l) = &self.mlp.skip {
            let n = l.n_vectors();
            let product = Gemm {
                m: tape.rows,
                k: l.k,
                n,
                a: scalars(x),
                rs: l.k_vectors() * LANES,
                cs: 1,
                b: &p[l.w..],
                ldb: n,
                ldc: n,
                out: Out::Accumulate,
            };
            gemm(&product, &mut tape.outputs[last]);
        }
        &tape.outputs[last]
    }

    /// From the output's gradient `dy` (padding zero): adds the parameters' gradient to `grad` if given; returns the
    /// gradient of the inputs it was made for if `input` (whole vectors a row, what lies beyond those inputs is of no use),
    /// nothing otherwise.
    pub fn backward<'t>(
        &self,
        transposed: &[V],
        x: &[V],
        dy: &[V],
        tape: &'t mut Tape,
        mut grad: Option<&mut [V]>,
        input: bool,
    ) -> &'t [V] {
        let rows = tape.rows;
        let [mut current, mut next] = std::mem::take(&mut tape.grads);
        let last = self.mlp.layers.len() - 1;
        for (i, l) in self.mlp.layers.iter().enumerate().rev() {
            let n = l.n_vectors();
            let source = if i == 0 { x } else { &tape.outputs[i - 1] };
            let d = if i == last { &dy[..rows * n] } else { &current[..rows * n] };
            if let Some(g) = grad.as_deref_mut() {
                gemm(&weight_gradient(l, rows, source, d), &mut g[l.w..l.b]);
                column_sums(d, n, &mut g[l.b..l.b + n]);
            }
            if let Some((start, k)) = self.transposed[i].filter(|_| i > 0 || input) {
                let at = if i > 0 && !tape.inputs.is_empty() { &tape.inputs[i - 1] } else { source };
                let out = if i > 0 { Out::TimesDerivative(at, self.mlp.activation) } else { Out::Store };
                let product = input_gradient(l, rows, d, &transposed[start..], k, out);
                gemm(&product, &mut next);
                std::mem::swap(&mut current, &mut next);
            }
        }
        if let Some(l) = &self.mlp.skip {
            let n = l.n_vectors();
            if let Some(g) = grad {
                gemm(&weight_gradient(l, rows, x, &dy[..rows * n]), &mut g[l.w..l.b]);
            }
            if let Some((start, k)) = self.transposed_skip.filter(|_| input) {
                gemm(&input_gradient(l, rows, dy, &transposed[start..], k, Out::Accumulate), &mut current);
            }
        }
        tape.grads = [current, next];
        let wanted = self.transposed[0].filter(|_| input).map_or(0, |(_, k)| k);
        &tape.grads[0][..rows * wanted]
    }
}

/// `dW += x' d` over `rows` rows of input `x` and output gradient `d`.
fn weight_gradient<'a>(l: &Layer, rows: usize, x: &'a [V], d: &'a [V]) -> Gemm<'a> {
    let n = l.n_vectors();
    Gemm {
        m: l.k_padded(),
        k: rows,
        n,
        a: scalars(x),
        rs: 1,
        cs: l.k_vectors() * LANES,
        b: d,
        ldb: n,
        ldc: n,
        out: Out::Accumulate,
    }
}

/// `dx = d W'` over `rows` rows, the first `k` vectors of each.
fn input_gradient<'a>(
    l: &Layer,
    rows: usize,
    d: &'a [V],
    transposed: &'a [V],
    k: usize,
    out: Out<'a>,
) -> Gemm<'a> {
    let rs = l.n_vectors() * LANES;
    Gemm { m: rows, k: l.n, n: k, a: scalars(d), rs, cs: 1, b: transposed, ldb: k, ldc: k, out }
}

#[inline(always)]
fn apply(x: &[V], y: &mut [V], f: Activation) {
    y.iter_mut().zip(x).for_each(|(y, &x)| *y = f.apply(x));
}
multiversion!(fn activate(x: &[V], y: &mut [V], f: Activation) = apply);

/// Rows of `w` (n vectors each) to columns of `t` (k vectors a row), in squares of 16 x 16; rows beyond the last are zero.
#[inline(always)]
fn squares(w: &[V], n: usize, t: &mut [V], k: usize) {
    for i in 0..k {
        for j in 0..n {
            let mut from = [ZERO; LANES];
            for (r, from) in from.iter_mut().enumerate() {
                if let Some(v) = w.get((i * LANES + r) * n + j) {
                    *from = *v;
                }
            }
            for c in 0..LANES {
                let mut to = ZERO;
                for r in 0..LANES {
                    to.0[r] = from[r].0[c];
                }
                t[(j * LANES + c) * k + i] = to;
            }
        }
    }
}
multiversion!(fn transpose(w: &[V], n: usize, t: &mut [V], k: usize) = squares);

#[inline(always)]
fn sums(d: &[V], n: usize, out: &mut [V]) {
    for (j, out) in out.iter_mut().enumerate() {
        let mut acc = [ZERO; 4];
        for rows in d.chunks_exact(4 * n) {
            for c in 0..4 {
                acc[c] = acc[c] + rows[c * n + j];
            }
        }
        *out = *out + ((acc[0] + acc[1]) + (acc[2] + acc[3]));
    }
}
multiversion!(
    /// Adds the sum of the rows of `d` (n vectors each, a multiple of 4 rows) to `out` (n vectors).
    fn column_sums(d: &[V], n: usize, out: &mut [V]) = sums
);
