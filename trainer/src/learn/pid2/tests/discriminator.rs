//! What the discriminator learns, and what fooling it gives.

use nearl_runtime::net::kernel::{LANES, scalars};

use super::super::*;
use super::{RELU, TANH, check, dims, discriminate, gradient, learner, nets64, noise};
use crate::learn::optimise::TILE;
use crate::learn::reference::*;

/// `gamma |d D / d s'|^2 / 2` on the reached changes: its gradient by the parameters, both slopes by central differences.
#[test]
fn the_gradient_penalty_is_the_slope_of_the_squared_slope() {
    let (mut l, b) = learner(false, true, TANH);
    let (without, _) = gradient(&l, &b, DISCRIMINATOR);
    l.nets.settings.gradient_penalty = 2.0;
    let (with, _) = gradient(&l, &b, DISCRIMINATOR);
    let penalty: Vec<V> = with.iter().zip(&without).map(|(&a, &b)| a - b).collect();
    let (n, d) = (nets64(&l), dims());
    let loss = |enc: &Net64, dec: &Net64| {
        let one = |i: usize| {
            let (change, obs) = (row(&b.reached, i, d.n_state), row(&b.obs, i, d.n_obs));
            let slope = |k: usize| {
                let at = |x: f64| {
                    let mut change = change.clone();
                    change[k] += x;
                    discriminate(enc, dec, &[change, obs.clone()].concat(), &noise(&l, Pass::Real, i), true).0
                };
                (at(1e-4) - at(-1e-4)) / 2e-4
            };
            (0..d.n_state).map(|k| slope(k).powi(2)).sum::<f64>()
        };
        (0..b.n).map(one).sum::<f64>() / b.n as f64
    };
    let (enc, dec) = l.nets.discriminator.nets();
    let errors = [
        relative_error(&n.enc, &flat32(&enc.mlp.to_dense(&penalty)), |p| loss(p, &n.dec)),
        relative_error(&n.dec, &flat32(&dec.mlp.to_dense(&penalty)), |p| loss(&n.enc, p)),
    ];
    assert!(errors.iter().all(|e| *e < 5e-3), "encoder, decoder: {errors:?}");
}

/// Reached changes are `f(s) + B noise`, proposals exactly `f(s)`: as they are a discriminator finds them out, with matched noise it
/// does not.
#[test]
fn right_proposals_cannot_be_told_from_what_was_reached() {
    let accuracy = |match_noise: bool| {
        let (mut rng, d) = (crate::rollout::stream(5, 0), dims());
        let settings = Pid2Settings {
            match_noise,
            fresh_fakes: false,
            discriminator_lr: 3e-3,
            alpha: 0.0,
            beta: 0.0,
            ..Pid2Settings::default()
        };
        let ppo = PpoSettings { lr: 1e-12, batch_size: 512, ..PpoSettings::default() };
        let kind = Kind { stochastic: false, learned: true };
        let mut l = Pid2::new(dims(), &NetSettings::default(), ppo, settings, kind, false, 1, &mut rng);
        let mut last = f64::NAN;
        for round in 0..12 {
            let mut b = batch(&dims(), 2048, 10 + round);
            for i in 0..b.n {
                let z: [f32; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut rng));
                for k in 0..d.n_state {
                    b.change[i * d.n_state + k] = 0.8 * b.obs[i * d.n_obs + k];
                    let noise = [
                        0.5 * z[0],
                        0.5 * z[1],
                        0.3 * z[0] + 0.3 * z[1],
                        0.4 * z[0] - 0.2 * z[1],
                        -0.5 * z[1],
                    ][k];
                    b.reached[i * d.n_state + k] = b.change[i * d.n_state + k] + noise;
                }
            }
            let metrics = l.update(&mut b, Pace::default(), &mut rng);
            last = metrics
                .iter()
                .find(|(name, _)| *name == "discriminator/accuracy")
                .expect("a discriminator")
                .1;
        }
        last
    };
    let (bare, matched) = (accuracy(false), accuracy(true));
    assert!(bare > 0.9, "a bare proposal is found out: {bare}");
    assert!((matched - 0.5).abs() < 0.05, "a noisy one is not: {matched}");
}

/// Fresh proposals are those of the policy as it is, to the bit where nothing is added.
#[test]
fn renewed_fakes_are_the_proposals_of_the_current_policy() {
    let (mut l, b) = learner(false, true, TANH);
    let (n, d, mut rng) = (nets64(&l), dims(), crate::rollout::stream(9, 0));
    l.nets.fakes.renew(&l.nets.combined, &l.params.groups[COMBINED], &b, 1, &mut rng);
    for i in 0..b.n {
        let u = n.policy.forward(&row(&b.obs, i, d.n_obs));
        let shown = row(l.nets.fakes.shown(&b), i, d.n_state);
        assert!(u.iter().zip(&shown).all(|(u, j)| (u - j).abs() < 1e-4), "row {i}: {u:?} {shown:?}");
    }
}

#[test]
fn discriminator_gradients_equal_central_differences() {
    for (bottleneck, activation) in [(true, TANH), (false, TANH), (true, RELU), (false, RELU)] {
        let (l, b) = learner(false, bottleneck, activation);
        let (grad, sums) = gradient(&l, &b, DISCRIMINATOR);
        let (n, d) = (nets64(&l), dims());
        let loss = |enc: &Net64, dec: &Net64| {
            let one = |i: usize| {
                let obs = row(&b.obs, i, d.n_obs);
                let real = [row(&b.reached, i, d.n_state), obs.clone()].concat();
                let fake = [row(&b.change, i, d.n_state), obs].concat();
                let (lr, kr) = discriminate(enc, dec, &real, &noise(&l, Pass::Real, i), bottleneck);
                let (lf, kf) = discriminate(enc, dec, &fake, &noise(&l, Pass::Proposed, i), bottleneck);
                softplus(-lr) + softplus(lf) + 0.2 * 0.5 * (kr + kf)
            };
            (0..b.n).map(one).sum::<f64>() / b.n as f64
        };
        let (enc, dec) = l.nets.discriminator.nets();
        check("encoder", &n.enc, &enc.mlp.to_dense(&grad), |p| loss(p, &n.dec));
        check("decoder", &n.dec, &dec.mlp.to_dense(&grad), |p| loss(&n.enc, p));
        assert_eq!(sums[1] > 0.0, bottleneck, "the bottleneck's KL is reported where there is one");
    }
}

/// A learner whose adversary sees demonstrations too.
fn united() -> (Pid2, Batch) {
    let (mut l, b) = learner(false, true, TANH);
    l.nets.settings.generator_lr = 1e-3;
    let mut rng = crate::rollout::stream(7, 0);
    l.unite(&b, &batch(&dims(), 2 * TILE, 12), &mut rng);
    l.nets.renew(&l.params.groups[COMBINED], &b, 1, &mut rng);
    (l, b)
}

/// Rows of both in nearly equal parts, each with the proposal for its own state; discriminator and generator by central differences.
#[test]
fn gradients_of_the_union_equal_central_differences() {
    let (l, b) = united();
    let (n, d, union) = (nets64(&l), dims(), l.nets.union.as_ref().expect("united"));
    let own = (0..b.n).filter(|&i| row(&union.obs, i, d.n_obs) == row(&b.obs, i, d.n_obs)).count();
    assert!((b.n / 4..=3 * b.n / 4).contains(&own), "{own} of {} rows are own ones", b.n);
    let mean = |one: &dyn Fn(usize) -> f64| (0..b.n).map(one).sum::<f64>() / b.n as f64;
    let fake = |policy: &Net64, i: usize| {
        let obs = row(&union.obs, i, d.n_obs);
        [policy.forward(&obs), obs].concat()
    };
    let judging = |enc: &Net64, dec: &Net64| {
        mean(&|i| {
            let real = [row(&union.reached, i, d.n_state), row(&union.obs, i, d.n_obs)].concat();
            let (lr, kr) = discriminate(enc, dec, &real, &noise(&l, Pass::Real, i), true);
            let (lf, kf) = discriminate(enc, dec, &fake(&n.policy, i), &noise(&l, Pass::Proposed, i), true);
            softplus(-lr) + softplus(lf) + 0.2 * 0.5 * (kr + kf)
        })
    };
    let (grad, _) = gradient(&l, &b, DISCRIMINATOR);
    let (enc, dec) = l.nets.discriminator.nets();
    check("encoder", &n.enc, &enc.mlp.to_dense(&grad), |p| judging(p, &n.dec));
    check("decoder", &n.dec, &dec.mlp.to_dense(&grad), |p| judging(&n.enc, p));
    let fooling = |policy: &Net64| {
        mean(&|i| {
            0.7 * softplus(
                -discriminate(&n.enc, &n.dec, &fake(policy, i), &noise(&l, Pass::Generator, i), true).0,
            )
        })
    };
    let (grad, _) = gradient(&l, &b, GENERATOR);
    check("policy", &n.policy, &l.nets.combined.policy.mlp.to_dense(&grad), fooling);
}

/// With the optimiser of the policy gradient the adversary's part is the same as with its own.
#[test]
fn the_union_is_fooled_alike_with_one_optimiser_and_with_two() {
    let (mut l, b) = united();
    let [actor, generator] = [ACTOR, GENERATOR].map(|phase| gradient(&l, &b, phase).0);
    l.nets.settings.generator_lr = 0.0;
    let (both, _) = gradient(&l, &b, ACTOR);
    let range = l.nets.combined.proposal_range();
    for ((both, a), g) in both[range.clone()].iter().zip(&actor[range.clone()]).zip(&generator[range]) {
        for k in 0..LANES {
            assert!((both.0[k] - a.0[k] - g.0[k]).abs() < 1e-5 * (1.0 + both.0[k].abs()));
        }
    }
}

/// A discriminator that tells by `s` alone has nothing to say about `s'`.
#[test]
fn a_discriminator_that_ignores_the_next_state_leaves_no_signal() {
    let (mut l, b) = united();
    let (encoder, _) = l.nets.discriminator.nets();
    let mut dense = encoder.mlp.to_dense(&l.params.groups[ADVERSARY].p);
    for row in dense.layers[0].weight.chunks_exact_mut(dims().n_state + dims().n_obs) {
        row[..dims().n_state].fill(0.0);
    }
    let slope = |l: &Pid2| {
        let (grad, sums) = gradient(l, &b, GENERATOR);
        (scalars(&grad[l.nets.combined.proposal_range()]).iter().fold(0.0f32, |m, g| m.max(g.abs())), sums[0])
    };
    assert!(slope(&l).0 > 1e-3);
    encoder.mlp.write_dense(&dense, &mut l.params.groups[ADVERSARY].p);
    l.nets.refresh(DISCRIMINATOR, &mut l.params);
    let (largest, loss) = slope(&l);
    assert!(largest == 0.0 && loss > 0.0, "{largest} {loss}");
}
