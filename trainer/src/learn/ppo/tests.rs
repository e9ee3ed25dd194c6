//! PPO's gradients against central differences of the textbook loss in f64, and a bandit it must solve.

use super::*;
use crate::learn::reference::{self, *};
use nearl_runtime::net::kernel::scalars_mut;
use rand_distr::{Distribution, StandardNormal};

fn dims() -> Dims {
    Dims { n_obs: 7, n_state: 5, n_act: 3, seen_obs: vec![1, 2, 6], seen_state: vec![0, 2, 4] }
}

#[test]
fn gradients_equal_central_differences() {
    let settings =
        PpoSettings { hidden: vec![6, 5], log_std: -0.3, ent_coef: 0.05, ..PpoSettings::default() };
    let mut l = Ppo::new(dims(), settings, 1, &mut crate::rollout::stream(1, 1));
    // the small last layer would hide errors in what lies below it
    scalars_mut(&mut l.params.groups[ACTOR].p).iter_mut().filter(|x| x.abs() < 0.02).for_each(|x| *x *= 50.0);
    l.nets.refresh(ACTOR, &mut l.params);
    let (b, d) = (batch(&dims(), TILE, 3), dims());
    let (mean, std) = crate::learn::stats_of(&b.advantage);
    let idx: Vec<u32> = (0..b.n as u32).collect();
    let tile =
        Tile { batch: &b, idx: &idx, scale: 1.0 / b.n as f32, advantage: (mean as f32, (1.0 / std) as f32) };
    let mut grad = vec![ZERO; l.nets.len + 1];
    l.nets.tile(ACTOR, &l.params, tile, &mut l.nets.work(), &mut grad);
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
    let (policy, value) =
        (Net64::of(&l.nets.policy.mlp.to_dense(p)), Net64::of(&l.nets.value.mlp.to_dense(p)));
    let errors = [
        relative_error(&policy, &flat32(&l.nets.policy.mlp.to_dense(&grad)), |n| loss(n, &value, &lanes)),
        relative_error(&value, &flat32(&l.nets.value.mlp.to_dense(&grad)), |n| loss(&policy, n, &lanes)),
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

/// One step, reward `-|a - f(s)|^2`: any correct policy gradient finds `f`.
#[test]
fn solves_a_one_step_environment() {
    let d = Dims { n_obs: 2, n_state: 2, n_act: 2, seen_obs: vec![0, 1], seen_state: vec![0, 1] };
    let mut rng = crate::rollout::stream(4, 0);
    let settings = PpoSettings { lr: 1e-3, log_std: -0.5, ..PpoSettings::default() };
    let mut l = Ppo::new(d, settings, 1, &mut rng);
    let goal = |x: &[f32]| [0.5 * x[0], -0.3 * x[1] + 0.4];
    let normaliser = Normaliser::identity(2, 2);
    let (n, mut miss) = (1024, (f64::NAN, f64::NAN));
    for round in 0..40 {
        let nets = l.networks(&normaliser);
        let mut policy = nearl_runtime::net::Forward::from_dense(&nets.policy);
        let mut b = Batch { n, ..Batch::default() };
        let mut error = 0.0;
        for _ in 0..n {
            let x: [f32; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut rng));
            let (mean, to) = (policy.forward(&x).to_vec(), goal(&x));
            let (mut log_prob, mut reward) = (0.0, 0.0);
            for k in 0..2 {
                let z: f32 = StandardNormal.sample(&mut rng);
                let a = mean[k] + nets.policy_log_std[k].exp() * z;
                log_prob -= 0.5 * z * z + nets.policy_log_std[k] + 0.918_938_5;
                reward -= (a - to[k]).powi(2);
                error += f64::from((mean[k] - to[k]).powi(2));
                b.sampled.push(a);
            }
            b.obs.extend(x);
            b.log_prob.push(log_prob);
            b.advantage.push(reward);
            b.returns.push(reward);
        }
        for column in [&mut b.reached, &mut b.action, &mut b.proposal, &mut b.lower, &mut b.upper] {
            column.resize(2 * n, 0.0);
        }
        error /= n as f64;
        miss = if round == 0 { (error, error) } else { (miss.0, error) };
        l.update(&b, 1.0, &mut rng);
    }
    assert!(miss.0 > 0.2 && miss.1 < 0.01, "squared distance {} at first, {} at last", miss.0, miss.1);
}
