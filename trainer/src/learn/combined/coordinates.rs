//! What actions change and what the robot does by itself, found by least squares: the coordinates in which a policy proposes.
//!
//! A proposal reaches the robot through the inverse model, whose slope is not the same in each direction: a step of the policy's
//! output along one of them moves the action far, along another hardly. So the policy puts out `z` and proposes `u = L z`. Of a batch
//!
//! ```text
//! reached change = F x + c + G a             (x what the inverse model sees of the observation, a action, all normalised)
//! G = U S V'                                 (the entries of the change that the inverse model sees)
//! A = V S^-1 U'
//! ```
//!
//! with the singular values in `S` raised to a part of the largest: two legs on the ground hold their hips, and what moves one against
//! the other changes nothing until one of them is lifted. The first columns of `L` are `U S V'`, the others unit vectors at right angles
//! to them in the entries that the inverse model sees, for what no action changes. A linear map beside the policy's layers adds `F x + c` to
//! the proposal, and the inverse model begins as `A (change - F x - c)`. So the first entries of what the layers put out are the action, and
//! the others leave it as it is: the combined policy begins as one that puts out actions. A regression of the actions on what was reached would
//! not do: noise in what is reached draws its slopes towards zero, furthest where an action changes least. `L` stays as it is from then on, and
//! the linear map reads nothing but `x`: Adam moves each of its weights by the whole rate, so that a map of all observations is mostly noise.

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
/// No singular value of `G` is taken for less than this part of the largest.
const LEAST: f64 = 0.3;
/// Nor for less than this, where no action changes anything.
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

    /// Finds coordinates, policy and inverse model anew in a batch of what noise reached; nothing where the policy has no coordinates. False
    /// where the inverse model cannot begin so: it has hidden layers and no linear map beside them.
    pub(in super::super) fn identify(&self, group: &mut Group, batch: &Batch) -> bool {
        let Some(net) = &self.coordinates else { return false };
        let d = &self.dims;
        let (o, s, a, seen) = (d.n_obs, d.n_state, d.n_act, d.seen_obs.len());
        let moves = Regression::of(batch.n, seen + a, s, |i, to| {
            let obs = d.seen_obs.iter().map(|&k| batch.obs[i * o + k]);
            let inputs = obs.chain(batch.action[i * a..][..a].iter().copied());
            to.iter_mut().zip(inputs).for_each(|(to, x)| *to = f64::from(x));
            let reached = batch.reached[i * s..][..s].iter();
            to[seen + a..].iter_mut().zip(reached).for_each(|(to, &x)| *to = f64::from(x.clamp(-CLIP, CLIP)));
        });
        let by_itself = moves.weight.columns(0, seen).into_owned();
        let Coordinates { l, back } =
            Coordinates::of(&moves.weight.columns(seen, a).into_owned(), &d.seen_state);
        let Some(inverse) = l.clone().try_inverse() else {
            unreachable!("no column of L lies in those before it")
        };
        write(net, &l, group);
        let mut beside = DMatrix::zeros(s, o);
        for (&k, column) in d.seen_obs.iter().zip((&inverse * &by_itself).column_iter()) {
            beside.column_mut(k).copy_from(&column);
        }
        let mut dense = self.policy.mlp.to_dense(&group.p);
        dense.skip = Some(row_major(&beside));
        if let Some(last) = dense.layers.last_mut() {
            last.bias = (inverse * &moves.bias).iter().map(|&b| b as f32).collect();
        }
        self.policy.mlp.write_dense(&dense, &mut group.p);
        let begun = self.inverse.as_ref().is_some_and(|(model, _)| {
            let mut weight = DMatrix::zeros(a, 2 * seen);
            weight.columns_mut(0, seen).copy_from(&-(&back * by_itself.select_rows(&d.seen_state)));
            weight.columns_mut(seen, seen).copy_from(&back);
            let bias = back * moves.bias.select_rows(&d.seen_state);
            model.begin_affine(&mut group.p, row_major(&weight), bias.iter().map(|&b| -b as f32).collect())
        });
        self.refresh(group);
        begun
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

/// `L`, and the inverse of what actions change.
struct Coordinates {
    l: DMatrix<f64>,
    /// `A` (n_act x seen).
    back: DMatrix<f64>,
}

impl Coordinates {
    /// Of what each action changes in each entry, of which the inverse model sees `seen`. More actions than entries have as many coordinates
    /// as there are entries, along `V`.
    fn of(g: &DMatrix<f64>, seen: &[usize]) -> Self {
        let (s, a, m) = (g.nrows(), g.ncols(), seen.len());
        let n = m.min(a);
        let (u, mut values, v) = of_svd(&g.select_rows(seen));
        let least = (LEAST * values.max()).max(SHORTEST);
        values.apply(|value| *value = value.max(least));
        let stretched = &u * DMatrix::from_diagonal(&values);
        let back = v.transpose() * DMatrix::from_diagonal(&values.map(f64::recip)) * u.transpose();
        let fits = a <= m;
        let first = if fits { stretched * &v } else { stretched };
        let mut wide = DMatrix::zeros(m, n + m);
        wide.columns_mut(0, n).copy_from(&u);
        wide.columns_mut(n, m).fill_with_identity();
        let others = wide.qr().q();
        let mut l = DMatrix::zeros(s, s);
        for (i, &k) in seen.iter().enumerate() {
            l.view_mut((k, 0), (1, n)).copy_from(&first.row(i));
            l.view_mut((k, n), (1, m - n)).copy_from(&others.view((i, n), (1, m - n)));
        }
        // what the inverse model does not see leaves its action as it is
        for (j, k) in (0..s).filter(|k| !seen.contains(k)).enumerate() {
            if fits {
                l.view_mut((k, 0), (1, n)).copy_from(&g.row(k));
            }
            l[(k, m + j)] = 1.0;
        }
        Self { l, back }
    }
}

/// `U`, the singular values and `V'`.
fn of_svd(m: &DMatrix<f64>) -> (DMatrix<f64>, DVector<f64>, DMatrix<f64>) {
    let svd = m.clone().svd(true, true);
    let (Some(u), Some(v)) = (svd.u, svd.v_t) else { unreachable!("asked for both") };
    (u, svd.singular_values, v)
}

fn write(net: &Net, l: &DMatrix<f64>, group: &mut Group) {
    let (n, weight) = (l.nrows(), row_major(l));
    let layer = DenseLayer { n_in: n, n_out: n, weight, bias: vec![0.0; n] };
    net.mlp.write_dense(&Dense { layers: vec![layer], skip: None }, &mut group.p);
    net.transpose(&group.p, &mut group.transposed);
}

#[cfg(test)]
mod tests {
    use super::Coordinates;
    use nalgebra::{DMatrix, DVector};

    /// Of three actions two change something: what they change leads back to them, and the third, which nothing shows, is given as none.
    #[test]
    fn more_actions_than_entries_come_back_as_far_as_they_change_anything() {
        let g = DMatrix::from_row_slice(3, 3, &[2.0, 0.0, 0.0, 9.0, 9.0, 9.0, 0.0, 1.0, 0.0]);
        let seen = [0, 2];
        let Coordinates { l, back } = Coordinates::of(&g, &seen);
        let action = DVector::from_column_slice(&[0.7, -0.4, 0.9]);
        let given = &back * (&g * &action).select_rows(&seen);
        assert!((given - DVector::from_column_slice(&[0.7, -0.4, 0.0])).amax() < 1e-12);
        // two coordinates move the action, each by its own length, and what the inverse model does not see moves none
        let slopes = &back * l.select_rows(&seen);
        let square = slopes.columns(0, 2).transpose() * slopes.columns(0, 2);
        assert!((square - DMatrix::identity(2, 2)).amax() < 1e-12);
        assert!(slopes.column(2).amax() < 1e-12 && (l[(1, 2)] - 1.0).abs() < 1e-12);
    }
}
