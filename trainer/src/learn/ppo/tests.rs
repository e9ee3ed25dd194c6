//! PPO's gradients against central differences of the textbook loss in f64.

use super::*;
use crate::learn::reference::{self, *};
use nearl_runtime::net::Activation;

fn dims() -> Dims {
    Dims { n_obs: 7, n_state: 5, n_act: 3, seen_obs: vec![1, 2, 6], seen_state: vec![0, 2, 4] }
}

#[test]
fn gradients_equal_central_differences() {
    [Activation::Tanh, Activation::Relu].into_iter().for_each(gradients);
}

fn gradients(activation: Activation) {
    let nets = NetSettings { policy: vec![6, 5], value: vec![4, 6], activation, ..NetSettings::default() };
    let settings = PpoSettings { log_std: -0.3, ent_coef: 0.05, ..PpoSettings::default() };
    let mut l = Ppo::new(dims(), &nets, settings, 1, &mut crate::rollout::stream(1, 1));
    spread(&mut l.params.groups[ACTOR].p, &[&l.nets.policy]);
    spread(&mut l.params.groups[VALUE].p, &[&l.nets.value.net]);
    [ACTOR, VALUE].iter().for_each(|&phase| l.nets.refresh(phase, &mut l.params));
    let (b, d) = (batch(&dims(), TILE, 3), dims());
    let idx: Vec<u32> = (0..b.n as u32).collect();
    let gradient = |phase: usize| {
        let mut grad = vec![ZERO; l.params.groups[phase].p.len() + 1];
        l.nets.tile(phase, &l.params, tile(&b, &idx), &mut l.nets.work(), &mut grad);
        grad
    };
    let (grad, value_grad) = (gradient(ACTOR), gradient(VALUE));
    let p = &l.params.groups[ACTOR].p;
    let lanes: Vec<f64> =
        scalars(&p[l.nets.log_std.clone()])[..d.n_act].iter().map(|&v| f64::from(v)).collect();
    let loss = |policy: &Net64, value: &Net64, log_std: &[f64]| {
        let one = |i: usize| {
            let obs = row(&b.obs, i, d.n_obs);
            let log_prob = log_normal(&row(&b.sampled, i, d.n_act), &policy.forward(&obs), log_std);
            let e = value.forward(&obs)[0] - f64::from(b.returns[i]);
            reference::surrogate(&b, i, log_prob, 0.2) + 0.5 * e * e
        };
        (0..b.n).map(one).sum::<f64>() / b.n as f64 - 0.05 * log_std.iter().sum::<f64>()
    };
    let of = |net: &Net, group: usize| Net64::of(&net.mlp.to_dense(&l.params.groups[group].p), activation);
    let (policy, value) = (of(&l.nets.policy, ACTOR), of(&l.nets.value.net, VALUE));
    let errors = [
        relative_error(&policy, &flat32(&l.nets.policy.mlp.to_dense(&grad)), |n| loss(n, &value, &lanes)),
        relative_error(&value, &flat32(&l.nets.value.net.mlp.to_dense(&value_grad)), |n| {
            loss(&policy, n, &lanes)
        }),
    ];
    assert!(errors.iter().all(|e| *e < 2e-4), "policy, value: {errors:?}");
    for k in 0..d.n_act {
        let at = |x: f64| {
            let mut s = lanes.clone();
            s[k] += x;
            loss(&policy, &value, &s)
        };
        let (slope, analytic) = ((at(1e-5) - at(-1e-5)) / 2e-5, scalars(&grad[l.nets.log_std.clone()])[k]);
        assert!(
            (slope - f64::from(analytic)).abs() < 1e-4 * (1.0 + slope.abs()),
            "log std {k}: {slope} {analytic}"
        );
    }
}

/// After one step Adam's first moment is a tenth of the clipped gradient.
#[test]
fn gradients_of_policy_and_value_are_clipped_as_one_vector() {
    let length = |max_grad_norm: f32| {
        let settings = PpoSettings { max_grad_norm, n_epochs: 1, batch_size: TILE, ..PpoSettings::default() };
        let mut rng = crate::rollout::stream(1, 1);
        let mut l = Ppo::new(dims(), &NetSettings::default(), settings, 1, &mut rng);
        l.update(&batch(&dims(), TILE, 3), 1.0, &mut rng);
        [ACTOR, VALUE].map(|phase| {
            let m = scalars(&l.params.adam[phase].m);
            10.0 * m.iter().map(|&m| f64::from(m).powi(2)).sum::<f64>().sqrt()
        })
    };
    let (free, held) = (length(f32::INFINITY), length(0.01));
    assert!(free.iter().all(|l| *l > 0.02), "both would be cut alone: {free:?}");
    assert!((held[0].hypot(held[1]) - 0.01).abs() < 1e-7, "{held:?}");
    assert!((held[0] / held[1] - free[0] / free[1]).abs() < 1e-4 * free[0] / free[1], "{held:?} {free:?}");
}

/// Its first weights come from a stream of its own, so that runs of PPO with other inverse models beside it are the same.
#[test]
fn the_inverse_model_on_the_side_changes_nothing() {
    let learned = |idm: Vec<usize>| {
        let nets = NetSettings { idm, ..NetSettings::default() };
        let settings = PpoSettings { n_epochs: 2, batch_size: TILE, ..PpoSettings::default() };
        let mut rng = crate::rollout::stream(1, 1);
        let mut l = Ppo::new(dims(), &nets, settings, 1, &mut rng);
        l.update(&batch(&dims(), 2 * TILE, 3), 1.0, &mut rng);
        [ACTOR, VALUE].map(|phase| scalars(&l.params.groups[phase].p).to_vec())
    };
    assert!(learned(vec![]) == learned(vec![32, 32]), "other weights of policy or value");
}
