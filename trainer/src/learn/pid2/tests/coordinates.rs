//! Coordinates of proposals, found in a warm-up.

use nalgebra::{DMatrix, DVector};
use nearl_runtime::net::kernel::{LANES, scalars};

use super::super::*;
use super::{RELU, TANH, dims, learner, learner_that_warms_up, nets64};
use crate::learn::reference::*;

/// `dL / du` of the policy, row by row, and the proposals.
fn slopes(l: &Pid2, b: &Batch) -> (Vec<V>, Vec<V>) {
    let (mut w, idx) = (l.nets.scratch(), (0..b.n as u32).collect::<Vec<_>>());
    let mut grad = vec![ZERO; l.params.groups[COMBINED].p.len() + 1];
    l.nets.tile(ACTOR, &l.params, tile(b, &idx), &mut w, &mut grad);
    (w.actor.d_change, w.actor.policy.output().to_vec())
}

/// `(1 - J+ J)` with the Jacobian by central differences and its pseudo-inverse by singular values, in f64.
#[test]
fn in_the_null_space_the_adversary_leaves_the_mean_action_as_it_is() {
    let d = dims();
    for activation in [TANH, RELU] {
        let (mut l, b) = learner(false, true, activation);
        let mut with = |weight, null_space| {
            l.nets.settings.generator_weight = weight;
            l.nets.settings.null_space = null_space;
            slopes(&l, &b)
        };
        let (alone, u) = with(0.0, false);
        let [full, left] = [false, true].map(|null_space| with(0.7, null_space).0);
        let inverse = nets64(&l).inverse.expect("inverse");
        let of = |rows: &[V], i: usize| row(scalars(rows), i, LANES);
        let (mut free_entries, mut size) = (0, 0.0);
        for i in 0..b.n {
            let part = |rows: &[V]| {
                let of_both = of(rows, i).into_iter().zip(of(&alone, i));
                of_both.map(|(both, alone)| both - alone).collect::<Vec<f64>>()
            };
            let (asked, got, u) = (part(&full), part(&left), of(&u, i));
            let (lower, upper) = (row(&b.lower, i, d.n_state), row(&b.upper, i, d.n_state));
            let mean = |u: &[f64]| {
                let w: Vec<f64> = (0..d.n_state).map(|k| u[k].max(lower[k]).min(upper[k])).collect();
                inverse.forward(&inverse_input(&b, i, &d, &w))
            };
            let jacobian = DMatrix::from_fn(d.n_act, d.n_state, |a, k| {
                let at = |x: f64| {
                    let mut moved = u.clone();
                    moved[k] += x;
                    mean(&moved)[a]
                };
                (at(1e-6) - at(-1e-6)) / 2e-6
            });
            let slope = DVector::from_row_slice(&asked[..d.n_state]);
            let pseudo = jacobian.clone().pseudo_inverse(1e-7).expect("positive");
            let want = &slope - pseudo * (&jacobian * &slope);
            free_entries += jacobian.column_iter().filter(|c| c.norm() > 0.0).count();
            size += (&want - &slope).norm();
            for k in 0..d.n_state {
                let error = (got[k] - want[k]).abs();
                assert!(error < 2e-4 * slope.norm(), "row {i}, entry {k}: {} instead of {}", got[k], want[k]);
            }
        }
        assert!(
            free_entries > 2 * b.n && size > 0.0,
            "some entries are free, and what they do to the action is taken out"
        );
    }
}

/// Whatever statistics become, proposal and action in the robot's units stay.
#[test]
fn policy_and_inverse_model_stay_what_they_were_when_statistics_move() {
    use nearl_runtime::net::Forward;
    let d = dims();
    let from = Normaliser::new(vec![0.1; d.n_obs], vec![1.2; d.n_obs], vec![0.5; d.n_state]);
    let entry = |k: usize| 0.3 * (k as f64 + 1.0);
    let to = Normaliser::new(
        (0..d.n_obs).map(|k| 0.2 * entry(k)).collect(),
        (0..d.n_obs).map(|k| 0.8 + entry(k)).collect(),
        (0..d.n_state).map(entry).collect(),
    );
    let act = |l: &Pid2, n: &Normaliser, obs: &[f64]| {
        let nets = l.networks(n);
        let mut x = vec![0.0; d.n_obs];
        n.observation(obs, &mut x);
        let u = Forward::new(&nets.policy, TANH).forward(&x).to_vec();
        let change: Vec<f64> = u.iter().zip(&n.scale).map(|(&u, s)| f64::from(u) * s).collect();
        let seen: Vec<f32> =
            d.seen_obs.iter().map(|&o| x[o]).chain(d.seen_state.iter().map(|&k| u[k])).collect();
        let (idm, _) = nets.idm.as_ref().expect("learned");
        let action = Forward::new(idm, TANH).forward(&seen).iter().map(|&a| f64::from(a)).collect::<Vec<_>>();
        ([change, action].concat(), l.nets.combined.value.of(&l.params.groups[CRITIC], &x, 1)[0])
    };
    let observations: Vec<Vec<f64>> =
        (0..20).map(|i| (0..d.n_obs).map(|k| (0.7 * f64::from(i) + k as f64).sin()).collect()).collect();
    // a proposal as it is, and in coordinates
    for warmup in [0, 1] {
        let mut l = learner_that_warms_up(false, true, TANH, warmup).0;
        let before: Vec<_> = observations.iter().map(|o| act(&l, &from, o)).collect();
        l.rescale(&from, &to);
        for (o, (was, value)) in observations.iter().zip(before) {
            let (is, now) = act(&l, &to, o);
            let near = |a: &f64, b: &f64| (a - b).abs() < 1e-4 * (1.0 + a.abs());
            assert!(was.iter().zip(&is).all(|(a, b)| near(a, b)), "{was:?} {is:?}");
            assert!((value - now).abs() < 1e-4 * (1.0 + value.abs()), "{value} {now}");
        }
    }
}

/// Of a plant that is linear: what it does by itself is proposed, and the policy's first entries are the actions, of which the inverse
/// model makes themselves. The others leave the action as it is.
#[test]
fn the_policys_first_entries_are_actions_after_the_warm_up() {
    // each action moves what it moves, or both together the same, so that one against the other moves nothing
    for alike in [false, true] {
        let (mut l, _) = learner_that_warms_up(false, true, TANH, 1);
        let (d, mut rng) = (dims(), crate::rollout::stream(11, 0));
        // only what the inverse model sees makes a change
        let of_obs = |k: usize, o: usize| match d.seen_obs.contains(&o) {
            true => 0.4 * ((3 * k + 2 * o) as f64).sin(),
            false => 0.0,
        };
        let of_action = |k: usize, j: usize| 0.8 * ((5 * k + 2 * if alike { 0 } else { j } + 1) as f64).cos();
        let moves = |x: &[f64], a: &[f64], k: usize| {
            let own: f64 = x.iter().enumerate().map(|(o, x)| of_obs(k, o) * x).sum();
            own + 0.1 * k as f64 + a.iter().enumerate().map(|(j, a)| of_action(k, j) * a).sum::<f64>()
        };
        let mut normal = |n: usize| -> Vec<f64> { (0..n).map(|_| StandardNormal.sample(&mut rng)).collect() };
        let mut b = Batch { n: 4096, ..Batch::default() };
        for _ in 0..b.n {
            let (x, a) = (normal(d.n_obs), normal(d.n_act));
            b.reached.extend((0..d.n_state).map(|k| moves(&x, &a, k) as f32));
            b.obs.extend(x.iter().map(|&x| x as f32));
            b.action.extend(a.iter().map(|&a| a as f32));
        }
        assert!(l.nets.combined.identify(&mut l.params.groups[COMBINED], &b));
        let n = nets64(&l);
        let coordinates = n.coordinates.as_ref().expect("coordinates");
        let column = |j: usize| -> Vec<f64> {
            let unit: Vec<f64> = (0..d.n_state).map(|k| f64::from(u8::from(k == j))).collect();
            let zero = coordinates.forward(&vec![0.0; d.n_state]);
            coordinates.forward(&unit).iter().zip(zero).map(|(a, b)| a - b).collect()
        };
        for j in 0..d.n_act {
            let of = column(j);
            let is_plant = (0..d.n_state).all(|k| (of[k] - of_action(k, j)).abs() < 2e-3);
            assert!(is_plant || alike, "column {j}: {of:?}");
            for rest in d.n_act..d.n_state {
                let unit = column(rest);
                let product: f64 = d.seen_state.iter().map(|&k| of[k] * unit[k]).sum();
                let square: f64 = unit.iter().map(|x| x * x).sum();
                assert!(product.abs() < 1e-5 && (square - 1.0).abs() < 1e-5, "columns {j}, {rest}");
            }
        }
        // with the layers' own output at nothing
        let c = &l.nets.combined;
        let mut dense = c.policy.mlp.to_dense(l.actor());
        dense.layers.last_mut().expect("a layer").weight.fill(0.0);
        c.policy.mlp.write_dense(&dense, &mut l.params.groups[COMBINED].p);
        let networks = l.nets.combined.networks(l.actor(), &Normaliser::identity(7, 5));
        let policy = Net64::of(&networks.policy, TANH);
        let inverse = n.inverse.as_ref().expect("learned");
        for _ in 0..20 {
            let (x, z) = (normal(d.n_obs), normal(d.n_state));
            let u = policy.forward(&x);
            for (k, u) in u.iter().enumerate() {
                let own = moves(&x, &[0.0; 2], k);
                assert!((u - own).abs() < 5e-3, "entry {k}: {u} instead of {own}");
            }
            let mut change = u;
            for (j, z) in z.iter().enumerate() {
                change.iter_mut().zip(column(j)).for_each(|(u, of)| *u += z * of);
            }
            let seen = d.seen_obs.iter().map(|&o| x[o]).chain(d.seen_state.iter().map(|&k| change[k]));
            let back = inverse.forward(&seen.collect::<Vec<_>>());
            let near = back.iter().zip(&z).all(|(b, a)| (b - a).abs() < 1e-4);
            assert!(near, "{back:?} instead of {:?}, alike: {alike}", &z[..d.n_act]);
        }
    }
}

/// An action that changes nothing, or more actions than proposed entries, leave a proposal its coordinates.
#[test]
fn coordinates_span_the_space_whatever_actions_change() {
    for (n_state, n_act) in [(5, 2), (2, 3), (1, 1)] {
        let dims = Dims { n_state, n_act, seen_state: vec![0], seen_obs: vec![1], ..dims() };
        let settings = Pid2Settings { warmup: 1, ..Pid2Settings::default() };
        let (kind, mut rng) = (Kind { stochastic: false, learned: true }, crate::rollout::stream(12, 0));
        let (nets, ppo) = (NetSettings::default(), PpoSettings::default());
        let mut l = Pid2::new(dims.clone(), &nets, ppo, settings, kind, true, 1, &mut rng);
        let mut normal = |n: usize| -> Vec<f32> { (0..n).map(|_| StandardNormal.sample(&mut rng)).collect() };
        let n = 256;
        let b = Batch {
            n,
            obs: normal(n * dims.n_obs),
            action: normal(n * n_act),
            reached: vec![0.0; n * n_state],
            ..Batch::default()
        };
        // the inverse model has hidden layers alone
        assert!(!l.nets.combined.identify(&mut l.params.groups[COMBINED], &b));
        let net = l.nets.combined.coordinates.as_ref().expect("coordinates");
        let weight = net.mlp.to_dense(l.actor()).layers.remove(0).weight;
        let m = DMatrix::from_fn(n_state, n_state, |i, j| f64::from(weight[i * n_state + j]));
        let smallest = m.singular_values().min();
        assert!(smallest > 1e-4, "{n_state} entries, {n_act} actions: {smallest:e}");
        assert!(l.nets.combined.in_changes(l.actor()).skip.expect("a map").iter().all(|w| w.is_finite()));
    }
}
