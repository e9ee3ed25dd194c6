//! What the inverse model learns, and what moves it.

use super::super::*;
use super::{RELU, TANH, check, dims, gradient, learner, learner_that_warms_up, nets64};
use crate::learn::reference::*;

/// With policy and spread held, whatever the inverse model learns must leave PPO's ratio at 1.
#[test]
fn what_the_inverse_model_learns_does_not_move_the_ratio() {
    for stochastic in [false, true] {
        let mut rng = crate::rollout::stream(5, 0);
        let settings = Pid2Settings {
            idm_threshold: 0.0,
            idm_lr: 1e-2,
            generator_weight: 0.0,
            ..Pid2Settings::default()
        };
        let ppo = PpoSettings { lr: 1e-12, log_std: -1.0, ..PpoSettings::default() };
        let kind = Kind { stochastic, learned: true };
        let mut l = Pid2::new(dims(), &NetSettings::default(), ppo, settings, kind, true, 1, &mut rng);
        let mut b = batch(&dims(), 256, 3);
        b.log_prob = l.nets.combined.log_probs(&l.params.groups[COMBINED], &b, 1);
        let metrics = l.update(&mut b, Pace::default(), &mut rng);
        let of = |name: &str| metrics.iter().find(|(n, _)| *n == name).expect(name).1;
        assert!(of("idm/mse_after") < 0.99 * of("idm/mse_before"), "it learned");
        assert!(of("train/approx_kl").abs() < 1e-5, "stochastic {stochastic}: {}", of("train/approx_kl"));
    }
}

/// `|(I(s, C(pi(s))) - kept) / sigma|² / 2` by the policy, and nothing by anything else.
#[test]
fn what_keeps_actions_has_the_gradient_of_central_differences() {
    for (activation, warmup) in [(TANH, 0), (TANH, 1), (RELU, 0)] {
        let (mut l, b) = learner_that_warms_up(false, true, activation, warmup);
        let d = dims();
        l.nets.kept = (0..b.n * d.n_act).map(|k| (k as f32).sin()).collect();
        let (grad, sums) = gradient(&l, &b, KEEP);
        let n = nets64(&l);
        let loss = |policy: &Net64| {
            let policy = policy.clone().unread(d.n_obs, |k| !d.seen_obs.contains(&k));
            let one = |i: usize| {
                let z = policy.forward(&row(&b.obs, i, d.n_obs));
                let u = n.coordinates.as_ref().map_or(z.clone(), |c| c.forward(&z));
                let (lo, hi) = (row(&b.lower, i, d.n_state), row(&b.upper, i, d.n_state));
                let w: Vec<f64> = (0..d.n_state).map(|k| u[k].max(lo[k]).min(hi[k])).collect();
                let inverse = n.inverse.as_ref().expect("inverse");
                let mean = inverse.forward(&inverse_input(&b, i, &d, &w));
                let kept = row(&l.nets.kept, i, d.n_act);
                let away = mean.iter().zip(&kept).zip(&n.log_std);
                away.map(|((m, k), s)| 0.5 * ((m - k) / s.exp()).powi(2)).sum::<f64>()
            };
            (0..b.n).map(one).sum::<f64>() / b.n as f64
        };
        check("policy", &n.policy, &l.nets.combined.policy.mlp.to_dense(&grad), loss);
        let sum = f64::from(sums[0]) / b.n as f64;
        assert!((sum - loss(&n.policy)).abs() < 1e-4 * (1.0 + sum), "{sum} {}", loss(&n.policy));
        let inverse = l.nets.combined.inverse_range();
        assert!(grad[inverse.start..l.actor().len()].iter().all(|g| g.0 == ZERO.0));
    }
}

/// An inverse model that learns makes other actions of the same proposals; with `keep_actions` the policy follows it.
#[test]
fn actions_stay_where_the_inverse_model_learns() {
    let moved = |keep_actions: bool| {
        let settings = Pid2Settings {
            keep_actions,
            idm_threshold: 0.0,
            idm_lr: 3e-3,
            generator_weight: 0.0,
            ..Pid2Settings::default()
        };
        let ppo = PpoSettings { lr: 1e-12, log_std: -1.0, n_epochs: 40, ..PpoSettings::default() };
        let (kind, mut rng) = (Kind { stochastic: false, learned: true }, crate::rollout::stream(5, 0));
        let nets = NetSettings::default();
        let mut l = Pid2::new(dims(), &nets, ppo.clone(), settings, kind, true, 1, &mut rng);
        let mut b = batch(&dims(), 256, 3);
        let (mut before, mut after) = (Vec::new(), Vec::new());
        l.nets.combined.mean_actions(&l.params.groups[COMBINED], &b, 1, &mut before);
        b.log_prob = l.nets.combined.log_probs(&l.params.groups[COMBINED], &b, 1);
        let metrics = l.update(&mut b, Pace::default(), &mut rng);
        l.nets.combined.mean_actions(&l.params.groups[COMBINED], &b, 1, &mut after);
        let of = |name: &str| metrics.iter().find(|(n, _)| *n == name).expect(name).1;
        assert!(of("idm/mse_after") < 0.99 * of("idm/mse_before"), "it learned");
        let squares = before.iter().zip(&after).map(|(a, b)| f64::from(a - b).powi(2));
        let square = squares.sum::<f64>() / b.n as f64;
        let divergence = 0.5 * square / f64::from(ppo.log_std).exp().powi(2);
        let told = of("idm/divergence");
        assert!((told / divergence - 1.0).abs() < 1e-4, "{told} {divergence}");
        divergence
    };
    let (without, with) = (moved(false), moved(true));
    println!("divergence of the mean actions: {without:.4} without and {with:.4} with");
    assert!(with < 0.25 * without && without > 0.01, "{without} {with}");
}

#[test]
fn inverse_gradient_equals_central_differences() {
    for activation in [TANH, RELU] {
        let (l, b) = learner(false, true, activation);
        let (grad, _) = gradient(&l, &b, INVERSE);
        let (n, d) = (nets64(&l), dims());
        let loss = |net: &Net64| {
            let one = |i: usize| {
                let mean = net.forward(&inverse_input(&b, i, &d, &row(&b.reached, i, d.n_state)));
                let a = row(&b.action, i, d.n_act);
                mean.iter().zip(&a).map(|(m, a)| 0.5 * (m - a).powi(2)).sum::<f64>()
            };
            (0..b.n).map(one).sum::<f64>() / b.n as f64
        };
        let (model, _) = l.nets.combined.inverse.as_ref().expect("inverse");
        check("inverse", n.inverse.as_ref().expect("inverse"), &model.net.mlp.to_dense(&grad), loss);
    }
}

/// What the inverse model does not see reaches a proposal through the layers alone.
#[test]
fn the_linear_map_reads_what_the_inverse_model_sees() {
    let d = dims();
    let settings = Pid2Settings { warmup: 1, ..Pid2Settings::default() };
    let (kind, mut rng) = (Kind { stochastic: false, learned: true }, crate::rollout::stream(14, 0));
    let nets = NetSettings { idm: Vec::new(), ..NetSettings::default() };
    let mut l = Pid2::new(d.clone(), &nets, PpoSettings::default(), settings, kind, true, 1, &mut rng);
    let mut b = batch(&d, 256, 3);
    l.warm_up(&b, &mut rng);
    l.update(&mut b, Pace::default(), &mut rng);
    let map = l.nets.combined.policy.mlp.to_dense(l.actor()).skip.expect("a map");
    for (i, weight) in map.iter().enumerate() {
        assert_eq!(*weight != 0.0, d.seen_obs.contains(&(i % d.n_obs)), "observation {}", i % d.n_obs);
    }
}

/// The rate is that of policy and inverse model: the value keeps PPO's.
#[test]
fn a_rate_of_its_own_is_that_of_policy_and_inverse_model() {
    let learned = |ppo: PpoSettings, lr: f32| {
        let settings = Pid2Settings { lr, ..Pid2Settings::default() };
        let (kind, mut rng) = (Kind { stochastic: false, learned: true }, crate::rollout::stream(13, 0));
        let mut l = Pid2::new(dims(), &NetSettings::default(), ppo, settings, kind, true, 1, &mut rng);
        let mut b = batch(&dims(), 256, 3);
        let metrics = l.update(&mut b, Pace::default(), &mut rng);
        let told = metrics.iter().find(|(n, _)| *n == "train/learning_rate").expect("a rate").1;
        (l.params.groups.into_iter().map(|g| g.p).collect::<Vec<_>>(), told)
    };
    let ppo = PpoSettings { lr: 3e-4, ..PpoSettings::default() };
    let (own, told) = learned(ppo.clone(), 1e-3);
    assert!((told - 1e-3).abs() < 1e-9, "{told}");
    assert!(own == learned(PpoSettings { lr: 1e-3, value_lr: 3e-4, ..ppo.clone() }, 0.0).0);
    assert!(own != learned(ppo, 0.0).0);
}

/// Policy and spread learn the same through an inverse model that the reward does not move.
#[test]
fn without_its_policy_gradient_the_inverse_model_stays() {
    let (mut l, b) = learner(false, true, TANH);
    let (with, sums) = gradient(&l, &b, ACTOR);
    l.nets.combined.idm_policy_gradient = false;
    let (without, same) = gradient(&l, &b, ACTOR);
    let inverse = l.nets.combined.inverse_range();
    assert!(with[inverse.clone()].iter().any(|g| g.0 != ZERO.0));
    assert!(without[inverse.clone()].iter().all(|g| g.0 == ZERO.0));
    assert!(
        with[..inverse.start] == without[..inverse.start] && with[inverse.end..] == without[inverse.end..]
    );
    assert_eq!(sums, same);

    for stochastic in [false, true] {
        let settings =
            Pid2Settings { idm_policy_gradient: false, idm_threshold: 1e9, ..Pid2Settings::default() };
        let (kind, mut rng) = (Kind { stochastic, learned: true }, crate::rollout::stream(13, 0));
        let nets = NetSettings::default();
        let mut l = Pid2::new(dims(), &nets, PpoSettings::default(), settings, kind, false, 1, &mut rng);
        let (before, inverse) = (l.actor().to_vec(), l.nets.combined.inverse_range());
        l.update(&mut batch(&dims(), 256, 3), Pace::default(), &mut rng);
        assert!(before[inverse.clone()] == l.actor()[inverse.clone()], "stochastic {stochastic}");
        assert!(before[..inverse.start] != l.actor()[..inverse.start], "stochastic {stochastic}");
    }
}
