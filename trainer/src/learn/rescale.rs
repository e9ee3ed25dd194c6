//! The normaliser changes while a policy learns. Here the layers of a network are changed with it, so that its function stays the same.
//!
//! With `x_old = a x_new + c` for what goes in and `y_new = g y_old` for what comes out, `W <- W diag(a)` and `b <- b + W c` in the first
//! layer, `W <- diag(g) W` and `b <- diag(g) b` in the last, and both in a linear map beside them: the function stays the same.

use super::net::Net;
use nearl_runtime::net::Dense;
use nearl_runtime::net::kernel::V;
use nearl_runtime::normaliser::Normaliser;

/// What becomes of the inputs of a network: `x_old = a x_new + c`.
pub(super) struct Inputs {
    pub(super) a: Vec<f64>,
    pub(super) c: Vec<f64>,
}

impl Inputs {
    /// Inputs that stay what they are.
    pub(super) fn same(n: usize) -> Self {
        Self { a: vec![1.0; n], c: vec![0.0; n] }
    }

    /// Normalised observations.
    pub(super) fn observation(from: &Normaliser, to: &Normaliser) -> Self {
        let a = to.std.iter().zip(&from.std).map(|(to, from)| to / from).collect();
        let moved = to.mean.iter().zip(&from.mean).zip(&from.std);
        Self { a, c: moved.map(|((to, from), std)| (to - from) / std).collect() }
    }

    /// What the inverse model sees: some entries of the observation, then some of the change.
    pub(super) fn seen(from: &Normaliser, to: &Normaliser, obs: &[usize], state: &[usize]) -> Self {
        let all = Self::observation(from, to);
        let change = state.iter().map(|&k| to.scale[k] / from.scale[k]);
        Self {
            a: obs.iter().map(|&o| all.a[o]).chain(change).collect(),
            c: obs.iter().map(|&o| all.c[o]).chain(state.iter().map(|_| 0.0)).collect(),
        }
    }
}

/// Factor on a proposed change.
pub(super) fn outputs(from: &Normaliser, to: &Normaliser) -> Vec<f64> {
    from.scale.iter().zip(&to.scale).map(|(from, to)| from / to).collect()
}

/// Carries the network over in its parameter vector; `gain` is empty where what comes out has no unit that moves.
pub(super) fn carry(net: &Net, p: &mut [V], inputs: &Inputs, gain: &[f64]) {
    let mut dense = net.mlp.to_dense(p);
    carry_dense(&mut dense, inputs, gain);
    net.mlp.write_dense(&dense, p);
}

fn carry_dense(dense: &mut Dense, inputs: &Inputs, gain: &[f64]) {
    let first = &mut dense.layers[0];
    let added = take_in(&mut first.weight, inputs);
    first.bias.iter_mut().zip(added).for_each(|(b, c)| *b += c as f32);
    let beside = dense.skip.as_mut().map(|skip| take_in(skip, inputs));
    let Some(last) = dense.layers.last_mut() else { return };
    for (b, c) in last.bias.iter_mut().zip(beside.into_iter().flatten()) {
        *b += c as f32;
    }
    let n_in = last.n_in;
    for (k, g) in gain.iter().enumerate() {
        let g = *g as f32;
        last.bias[k] *= g;
        last.weight[k * n_in..][..n_in].iter_mut().for_each(|w| *w *= g);
        if let Some(skip) = &mut dense.skip {
            let n = inputs.a.len();
            skip[k * n..][..n].iter_mut().for_each(|w| *w *= g);
        }
    }
}

/// `W <- W diag(a)`; returns `W c` of each row.
fn take_in(weight: &mut [f32], inputs: &Inputs) -> Vec<f64> {
    let row = |row: &mut [f32]| {
        let mut added = 0.0;
        for ((w, a), c) in row.iter_mut().zip(&inputs.a).zip(&inputs.c) {
            added += f64::from(*w) * c;
            *w = (f64::from(*w) * a) as f32;
        }
        added
    };
    weight.chunks_exact_mut(inputs.a.len()).map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learn::init;
    use nearl_runtime::net::{Activation, Forward};

    /// The same proposal in the robot's units from the same observation, whatever the statistics are.
    #[test]
    fn outputs_stay_when_statistics_move() {
        let mut rng = crate::rollout::stream(3, 0);
        let from = Normaliser::new(vec![0.3, -2.0, 0.0], vec![1.5, 0.2, 7.0], vec![0.1, 4.0]);
        let to = Normaliser::new(vec![0.5, -1.9, 1.0], vec![1.0, 0.25, 9.0], vec![0.3, 3.0]);
        for dense in
            [init::orthogonal(&[3, 8, 8, 2], 1.0, &mut rng), init::linear_beside(&[3, 8, 2], 1.0, &mut rng)]
        {
            let mut carried = dense.clone();
            carry_dense(&mut carried, &Inputs::observation(&from, &to), &outputs(&from, &to));
            assert_ne!(dense, carried);
            for i in 0..50 {
                let obs: Vec<f64> =
                    (0..3).map(|k| to.mean[k] + to.std[k] * (1.3 * f64::from(i) + k as f64).sin()).collect();
                let change = |n: &Normaliser, net: &Dense| {
                    let mut x = vec![0.0; 3];
                    n.observation(&obs, &mut x);
                    let u = Forward::new(net, Activation::Tanh).forward(&x).to_vec();
                    u.iter().zip(&n.scale).map(|(u, s)| f64::from(*u) * s).collect::<Vec<f64>>()
                };
                let (before, after) = (change(&from, &dense), change(&to, &carried));
                for (b, a) in before.iter().zip(&after) {
                    assert!((b - a).abs() < 1e-5 * (1.0 + b.abs()), "{before:?} {after:?}");
                }
            }
        }
    }

    /// The inverse model sees some entries of the observation and of the change.
    #[test]
    fn what_the_inverse_model_sees_is_carried_entry_by_entry() {
        let from = Normaliser::new(vec![1.0, 2.0], vec![2.0, 4.0], vec![0.5, 3.0, 1.0]);
        let to = Normaliser::new(vec![3.0, 2.0], vec![4.0, 4.0], vec![0.5, 3.0, 8.0]);
        let seen = Inputs::seen(&from, &to, &[0], &[2]);
        assert_eq!((seen.a, seen.c), (vec![2.0, 8.0], vec![1.0, 0.0]));
    }
}
