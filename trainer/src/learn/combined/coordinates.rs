//! What actions change and what the robot does by itself, found by least squares: the coordinates in which a policy proposes.
//!
//! A proposal reaches the robot through the inverse model, whose slope is not the same in each direction: a step of the policy's
//! output along one of them moves the action far, along another hardly. So the policy puts out `z` and proposes `u = L z`. Of a batch
//!
//! ```text
//! reached change = F x + c + G a             (x observation, a action, all normalised)
//! action         = A [x_c, change_c] + b
//! ```
//!
//! the first columns of `L` are those of `G`, and the others are unit vectors at right angles to them, for what no action changes. A linear
//! map beside the policy's layers adds `F x + c` to the proposal: where the layers put out zero, what the robot does by itself is
//! proposed, and their first entries are actions. The inverse model begins as `A` and `b`. `L` stays as it is from then on.

use super::super::batch::Batch;
use super::super::inverse::CLIP;
use super::super::net::{Net, Tape};
use super::super::optimise::Group;
use super::Combined;
use nalgebra::{DMatrix, DVector};
use nearl_runtime::net::kernel::V;
use nearl_runtime::net::{Dense, DenseLayer};

/// Added to the mean square of each input, whose own is near 1.
const RIDGE: f64 = 1e-4;
/// No column of `L` is shorter than this in its own direction.
const SHORTEST: f64 = 1e-3;

/// Buffers of what the policy puts out and of what it proposes by it.
pub(in super::super) struct Proposing {
    pub(super) policy: Tape,
    pub(super) coordinates: Option<Tape>,
}

impl Proposing {
    /// The proposals, row by row.
    pub(in super::super) fn output(&self) -> &[V] {
        self.coordinates.as_ref().unwrap_or(&self.policy).output()
    }
}

/// Row-major weights of a linear map, and its bias.
struct Affine {
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Affine {
    fn new(weight: &DMatrix<f64>, bias: &DVector<f64>) -> Self {
        Self { weight: row_major(weight), bias: bias.iter().map(|&b| b as f32).collect() }
    }
}

fn row_major(m: &DMatrix<f64>) -> Vec<f32> {
    m.transpose().iter().map(|&v| v as f32).collect()
}

/// `y = weight x + bias`.
struct Regression {
    weight: DMatrix<f64>,
    bias: DVector<f64>,
}

impl Regression {
    /// Of `n` rows that `read` writes: inputs, then outputs.
    fn of(n: usize, inputs: usize, outputs: usize, read: impl Fn(usize, &mut [f64])) -> Self {
        // one row and column more for the bias
        let all = 1 + inputs + outputs;
        let (mut row, mut sums) = (DVector::zeros(all), DMatrix::zeros(all, all));
        for i in 0..n {
            row[0] = 1.0;
            read(i, &mut row.as_mut_slice()[1..]);
            sums.ger(1.0 / n as f64, &row, &row, 1.0);
        }
        let k = 1 + inputs;
        let (mut xx, xy) = (sums.view((0, 0), (k, k)).into_owned(), sums.view((0, k), (k, outputs)));
        for i in 1..k {
            xx[(i, i)] += RIDGE;
        }
        let Some(factor) = xx.cholesky() else { unreachable!("finite sums with a ridge are positive") };
        let found = factor.solve(&xy);
        Self { weight: found.rows(1, inputs).transpose(), bias: found.row(0).transpose() }
    }
}

impl Combined {
    /// The layer of `L`, as the identity.
    pub(super) fn begin_coordinates(&self, group: &mut Group) {
        if let Some(net) = &self.coordinates {
            write(net, &DMatrix::identity(self.dims.n_state, self.dims.n_state), group);
        }
    }

    /// Finds coordinates, policy and inverse model anew in a batch of what noise reached; nothing where the policy has no coordinates.
    pub(in super::super) fn identify(&self, group: &mut Group, batch: &Batch) {
        let Some(net) = &self.coordinates else { return };
        let d = &self.dims;
        let (o, s, a, seen) = (d.n_obs, d.n_state, d.n_act, d.seen_obs.len());
        let change = |i: usize, k: usize| f64::from(batch.reached[i * s + k].clamp(-CLIP, CLIP));
        let moves = Regression::of(batch.n, o + a, s, |i, to| {
            let inputs = batch.obs[i * o..][..o].iter().chain(&batch.action[i * a..][..a]);
            to.iter_mut().zip(inputs).for_each(|(to, &x)| *to = f64::from(x));
            to[o + a..].iter_mut().enumerate().for_each(|(k, to)| *to = change(i, k));
        });
        let l = columns(&moves.weight.columns(o, a).into_owned());
        let back = l.clone().lu();
        let solve = |m: DMatrix<f64>| {
            back.solve(&m).unwrap_or_else(|| unreachable!("no column of L lies in those before it"))
        };
        let bias = solve(DMatrix::from_columns(&[moves.bias])).column(0).into_owned();
        let by_itself = Affine::new(&solve(moves.weight.columns(0, o).into_owned()), &bias);
        write(net, &l, group);
        let mut dense = self.policy.mlp.to_dense(&group.p);
        dense.skip = Some(by_itself.weight);
        if let Some(last) = dense.layers.last_mut() {
            last.bias = by_itself.bias;
        }
        self.policy.mlp.write_dense(&dense, &mut group.p);
        if let Some((model, _)) = &self.inverse {
            let inverse = Regression::of(batch.n, 2 * seen, a, |i, to| {
                for j in 0..seen {
                    to[j] = f64::from(batch.obs[i * o + d.seen_obs[j]]);
                    to[seen + j] = change(i, d.seen_state[j]);
                }
                let action = &batch.action[i * a..][..a];
                to[2 * seen..].iter_mut().zip(action).for_each(|(to, &x)| *to = f64::from(x));
            });
            let inverse = Affine::new(&inverse.weight, &inverse.bias);
            model.begin_affine(&mut group.p, inverse.weight, inverse.bias);
        }
        self.refresh(group);
    }

    /// The policy with `L` in its last layer.
    pub(in super::super) fn in_changes(&self, p: &[V]) -> Dense {
        let mut dense = self.policy.mlp.to_dense(p);
        if let Some(net) = &self.coordinates {
            let (n, l) = (self.dims.n_state, net.mlp.to_dense(p).layers.remove(0).weight);
            let of = |m: &[f32]| -> Vec<f32> {
                let width = m.len() / n;
                let at = |r: usize, c: usize| (0..n).map(|k| l[r * n + k] * m[k * width + c]).sum();
                (0..n * width).map(|i| at(i / width, i % width)).collect()
            };
            dense.skip = dense.skip.map(|m| of(&m));
            if let Some(last) = dense.layers.last_mut() {
                (last.weight, last.bias) = (of(&last.weight), of(&last.bias));
            }
        }
        dense
    }
}

/// `L`: the columns of `g`, then unit vectors at right angles to them.
fn columns(g: &DMatrix<f64>) -> DMatrix<f64> {
    let (s, n) = (g.nrows(), g.ncols().min(g.nrows()));
    let mut wide = DMatrix::zeros(s, n + s);
    wide.columns_mut(0, n).copy_from(&g.columns(0, n));
    wide.columns_mut(n, s).fill_with_identity();
    let (mut l, mut r) = wide.qr().unpack();
    for k in 0..n {
        let own = r[(k, k)];
        r[(k, k)] = own.abs().max(SHORTEST).copysign(own);
    }
    let moved = l.columns(0, n) * r.view((0, 0), (n, n));
    l.columns_mut(0, n).copy_from(&moved);
    l
}

fn write(net: &Net, l: &DMatrix<f64>, group: &mut Group) {
    let (n, weight) = (l.nrows(), row_major(l));
    let layer = DenseLayer { n_in: n, n_out: n, weight, bias: vec![0.0; n] };
    net.mlp.write_dense(&Dense { layers: vec![layer], skip: None }, &mut group.p);
    net.transpose(&group.p, &mut group.transposed);
}
