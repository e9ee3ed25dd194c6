//! The gradients of NEARL against central differences of the textbook losses in f64.

use super::*;
use crate::learn::optimise::TILE;
use crate::learn::reference::{self, *};
use nearl_runtime::net::Activation;
use nearl_runtime::net::kernel::scalars;

/// A learner with weights far from zero.
fn learner(kind: Kind, activation: Activation) -> Nearl {
    let nets = NetSettings {
        policy: vec![6, 5],
        idm: vec![4],
        value: vec![5, 4, 3],
        activation,
        ..NetSettings::default()
    };
    let ppo = PpoSettings { log_std: -0.3, ent_coef: 0.05, ..PpoSettings::default() };
    let mut rng = crate::rollout::stream(1, 1);
    let settings = NearlSettings { gradient: Gradient::Projection, ..NearlSettings::default() };
    let mut l = Nearl::new(dims(), &nets, ppo, settings, kind, 1, &mut rng);
    let c = &l.nets.combined;
    let inverse = c.inverse.as_ref().map(|(m, _)| &m.net);
    let nets: Vec<_> = [&c.policy].into_iter().chain(inverse).collect();
    spread(&mut l.params.groups[COMBINED].p, &nets);
    spread(&mut l.params.groups[CRITIC].p, &[&c.value.net]);
    [ACTOR, VALUE].iter().for_each(|&phase| l.nets.refresh(phase, &mut l.params));
    l
}

fn gradient(l: &Nearl, batch: &Batch, phase: usize) -> Vec<V> {
    let mut grad = vec![ZERO; l.params.groups[l.nets.group(phase)].p.len() + 1];
    let idx: Vec<u32> = (0..batch.n as u32).collect();
    l.nets.tile(phase, &l.params, tile(batch, &idx), &mut l.nets.scratch(), &mut grad);
    grad
}

const DETERMINISTIC: Kind = Kind { stochastic: false, learned: true };
const STOCHASTIC: Kind = Kind { stochastic: true, learned: true };

#[test]
fn imitation_gradient_equals_central_differences() {
    for activation in [Activation::Tanh, Activation::Relu] {
        for kind in [DETERMINISTIC, STOCHASTIC] {
            let (l, b, d) = (learner(kind, activation), batch(&dims(), TILE, 3), dims());
            let (grad, policy) = (gradient(&l, &b, IMITATE), &l.nets.combined.policy);
            let net = Net64::of(&policy.mlp.to_dense(l.actor()), activation);
            let loss = |net: &Net64| {
                let one = |i: usize| {
                    let u = net.forward(&row(&b.obs, i, d.n_obs));
                    let reached = row(&b.reached, i, d.n_state);
                    u.iter().zip(&reached).map(|(u, r)| 0.5 * (u - r).powi(2)).sum::<f64>()
                };
                (0..b.n).map(one).sum::<f64>() / b.n as f64
            };
            let error = relative_error(&net, &flat32(&policy.mlp.to_dense(&grad)), loss);
            assert!(error < 2e-4, "{activation:?} {kind:?}: relative error {error:e}");
            let rest = &grad[l.nets.combined.policy_range.end..l.nets.combined.len];
            assert!(scalars(rest).iter().all(|g| *g == 0.0), "{kind:?}: only the policy's network learns");
        }
    }
}

/// `log pi(u | s) + log I(a | s_c, w)` of a row.
fn log_prob(b: &Batch, i: usize, policy: &Net64, inverse: &Net64, log_std: &[Vec<f64>; 2]) -> f64 {
    let d = dims();
    let input = inverse_input(b, i, &d, &row(&b.target_change, i, d.n_state));
    log_normal(&row(&b.change, i, d.n_state), &policy.forward(&row(&b.obs, i, d.n_obs)), &log_std[0])
        + log_normal(&row(&b.sampled, i, d.n_act), &inverse.forward(&input), &log_std[1])
}

/// With both parts Gaussian the ratio is on `log pi(u | s) + log I(a | s_c, w)`.
#[test]
fn joint_ratio_equals_central_differences() {
    for activation in [Activation::Tanh, Activation::Relu] {
        let (l, mut b, d) = (learner(STOCHASTIC, activation), batch(&dims(), TILE, 3), dims());
        let (c, p) = (&l.nets.combined, l.actor());
        let (model, spread_i) = c.inverse.as_ref().expect("learned");
        let spread_pi = c.policy_log_std.as_ref().expect("stochastic");
        let wide = |r: &Range<usize>, n: usize, from: &[V]| -> Vec<f64> {
            scalars(&from[r.clone()])[..n].iter().map(|&v| f64::from(v)).collect()
        };
        let spreads = [wide(spread_pi, d.n_state, p), wide(spread_i, d.n_act, p)];
        let of = |net: &crate::learn::Net| Net64::of(&net.mlp.to_dense(p), activation);
        let (policy, inverse) = (of(&c.policy), of(&model.net));
        let value = Net64::of(&c.value.net.mlp.to_dense(&l.params.groups[CRITIC].p), activation);
        for i in 0..b.n {
            // ratios around 1, some of them clipped
            let old = log_prob(&b, i, &policy, &inverse, &spreads) as f32;
            b.log_prob[i] = old + 0.3 * (b.log_prob[i] + 4.0);
        }
        let (b, grad, value_grad) = (&b, gradient(&l, &b, ACTOR), gradient(&l, &b, VALUE));
        let loss = |policy: &Net64, inverse: &Net64, value: &Net64, s: &[Vec<f64>; 2]| {
            let one = |i: usize| {
                let e = value.forward(&row(&b.obs, i, d.n_obs))[0] - f64::from(b.returns[i]);
                reference::surrogate(b, i, log_prob(b, i, policy, inverse, s), 0.2) + 0.5 * e * e
            };
            let entropy = s.iter().flatten().sum::<f64>();
            (0..b.n).map(one).sum::<f64>() / b.n as f64 - 0.05 * entropy
        };
        let flat = |net: &crate::learn::Net| flat32(&net.mlp.to_dense(&grad));
        let errors = [
            relative_error(&policy, &flat(&c.policy), |n| loss(n, &inverse, &value, &spreads)),
            relative_error(&inverse, &flat(&model.net), |n| loss(&policy, n, &value, &spreads)),
            relative_error(&value, &flat32(&c.value.net.mlp.to_dense(&value_grad)), |n| {
                loss(&policy, &inverse, n, &spreads)
            }),
        ];
        assert!(errors.iter().all(|e| *e < 2e-4), "{activation:?}: policy, inverse, value: {errors:?}");
        for (which, (range, n)) in [(spread_pi, d.n_state), (spread_i, d.n_act)].into_iter().enumerate() {
            let analytic = wide(range, n, &grad);
            for k in 0..n {
                let at = |x: f64| {
                    let mut s = spreads.clone();
                    s[which][k] += x;
                    loss(&policy, &inverse, &value, &s)
                };
                let slope = (at(1e-5) - at(-1e-5)) / 2e-5;
                let error = (slope - analytic[k]).abs();
                assert!(error < 1e-4 * (1.0 + slope.abs()), "log std {which} {k}: {slope} {}", analytic[k]);
            }
        }
    }
}
