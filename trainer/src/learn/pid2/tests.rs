//! Every gradient of PID^2 against central differences of the textbook losses in f64.

use super::fakes::Fakes;
use super::*;
use crate::learn::optimise::TILE;
use crate::learn::reference::{self, *};
use crate::learn::{Base, Net};
use nalgebra::{DMatrix, DVector};
use nearl_runtime::net::kernel::{LANES, scalars};
use nearl_runtime::net::{Activation, Dense};

const LIMIT: f64 = 2e-4;
const BOUND: f32 = 0.4;
const TANH: Activation = Activation::Tanh;
const RELU: Activation = Activation::Relu;

fn dims() -> Dims {
    Dims {
        n_obs: 7,
        n_privileged: 0,
        n_state: 5,
        n_act: 2,
        seen_obs: vec![1, 2, 6],
        seen_state: vec![0, 2, 4],
    }
}

/// A learner with weights far from zero, and a minibatch.
fn learner(stochastic: bool, bottleneck: bool, activation: Activation) -> (Pid2, Batch) {
    learner_that_warms_up(stochastic, bottleneck, activation, 0)
}

/// The same, with coordinates for a proposal where `warmup` is not 0.
fn learner_that_warms_up(
    stochastic: bool,
    bottleneck: bool,
    activation: Activation,
    warmup: u64,
) -> (Pid2, Batch) {
    let nets = NetSettings {
        policy: vec![6, 5],
        idm: vec![6, 5],
        value: vec![7],
        discriminator: vec![6, 5],
        activation,
        idm_residual: activation == TANH, // plain networks with the other
    };
    let ppo = PpoSettings { log_std: -0.3, ..PpoSettings::default() };
    // Of the three, only this is the derivative of a loss.
    let gradient = Gradient::Projection;
    let settings = Pid2Settings {
        warmup,
        generator_weight: 0.7,
        beta: 0.2,
        gradient,
        bound_weight: BOUND,
        ..Pid2Settings::default()
    };
    let mut rng = crate::rollout::stream(1, 1);
    let kind = Kind { stochastic, learned: !stochastic };
    let mut l = Pid2::new(dims(), &nets, ppo, settings, kind, bottleneck, 1, &mut rng);
    let c = &l.nets.combined;
    let inverse = c.inverse.as_ref().map(|(m, _)| &m.net);
    let actor: Vec<_> = [&c.policy].into_iter().chain(inverse).chain(&c.coordinates).collect();
    spread(&mut l.params.groups[COMBINED].p, &actor);
    spread(&mut l.params.groups[CRITIC].p, &[&c.value.net]);
    let (encoder, decoder) = l.nets.discriminator.nets();
    spread(&mut l.params.groups[ADVERSARY].p, &[encoder, decoder]);
    for phase in [ACTOR, VALUE, DISCRIMINATOR] {
        l.nets.refresh(phase, &mut l.params);
    }
    let batch = batch(&dims(), TILE, 3);
    l.nets.noise.resize(batch.n * LATENT, 0.0);
    l.nets.noise.fill_with(|| StandardNormal.sample(&mut rng));
    l.nets.fakes = Fakes::new(&l.nets.settings, &l.nets.combined, &batch, &mut rng);
    (l, batch)
}

/// Gradient of a phase over the one tile of the minibatch, and the phase's sums.
fn gradient(l: &Pid2, batch: &Batch, phase: usize) -> (Vec<V>, [f32; SUMS]) {
    let len = l.params.groups[l.nets.group(phase)].p.len();
    let mut grad = vec![ZERO; len + 1];
    let idx: Vec<u32> = (0..batch.n as u32).collect();
    l.nets.tile(phase, &l.params, tile(batch, &idx), &mut l.nets.scratch(), &mut grad);
    let sums = grad[len].0;
    (grad, sums)
}

/// Discriminator on `[change, obs]` with given latent noise: logit and KL.
fn discriminate(enc: &Net64, dec: &Net64, x: &[f64], noise: &[f64], bottleneck: bool) -> (f64, f64) {
    let code = enc.forward(x);
    let (mut z, mut kl) = (vec![0.0; LATENT], 0.0);
    for j in 0..LATENT {
        let (mean, log_var) = (code[j], code[LATENT + j]);
        z[j] = mean;
        if bottleneck {
            z[j] += (0.5 * log_var).exp() * noise[j];
            kl += 0.5 * (log_var.exp() + mean * mean - 1.0 - log_var);
        }
    }
    (dec.forward(&z)[0], kl)
}

fn noise(l: &Pid2, pass: Pass, i: usize) -> Vec<f64> {
    l.nets.noise(pass, i).iter().map(|&x| f64::from(x)).collect()
}

struct Nets64 {
    policy: Net64,
    coordinates: Option<Net64>,
    value: Net64,
    inverse: Option<Net64>,
    log_std: Vec<f64>,
    enc: Net64,
    dec: Net64,
}

fn nets64(l: &Pid2) -> Nets64 {
    let [a, v, d] = [COMBINED, CRITIC, ADVERSARY].map(|group| &l.params.groups[group].p);
    let (enc, dec) = l.nets.discriminator.nets();
    let of = |dense: &Dense| Net64::of(dense, enc.mlp.activation);
    Nets64 {
        policy: of(&l.nets.combined.policy.mlp.to_dense(a)),
        coordinates: l.nets.combined.coordinates.as_ref().map(|c| of(&c.mlp.to_dense(a))),
        value: of(&l.nets.combined.value.net.mlp.to_dense(v)),
        inverse: l.nets.combined.inverse.as_ref().map(|(m, _)| of(&m.net.mlp.to_dense(a))),
        log_std: l.nets.combined.log_std(l.actor()).iter().map(|&v| f64::from(v)).collect(),
        enc: of(&enc.mlp.to_dense(d)),
        dec: of(&dec.mlp.to_dense(d)),
    }
}

fn actor_loss(l: &Pid2, b: &Batch, n: &Nets64) -> f64 {
    let d = dims();
    let one = |i: usize| {
        let obs = row(&b.obs, i, d.n_obs);
        let z = n.policy.forward(&obs);
        let u = n.coordinates.as_ref().map_or(z.clone(), |c| c.forward(&z));
        let mut outside = 0.0;
        let log_prob = match &n.inverse {
            Some(inverse) => {
                let (lo, hi) = (row(&b.lower, i, d.n_state), row(&b.upper, i, d.n_state));
                let w: Vec<f64> = (0..d.n_state).map(|k| u[k].max(lo[k]).min(hi[k])).collect();
                outside = u.iter().zip(&w).map(|(u, w)| (u - w).powi(2)).sum();
                let mean = inverse.forward(&inverse_input(b, i, &d, &w));
                log_normal(&row(&b.sampled, i, d.n_act), &mean, &n.log_std)
            }
            None => log_normal(&row(&b.change, i, d.n_state), &u, &n.log_std),
        };
        let e = n.value.forward(&obs)[0] - f64::from(b.returns[i]);
        // a stochastic proposal is shown as it is sampled: the loss reaches its spread
        let shown = |(k, u): (usize, &f64)| match l.nets.fakes.normal(i) {
            [] => *u,
            z => u + n.log_std[k].exp() * f64::from(z[k]),
        };
        let x = [u.iter().enumerate().map(shown).collect(), obs].concat();
        let noise = noise(l, Pass::Generator, i);
        let (logit, _) = discriminate(&n.enc, &n.dec, &x, &noise, true);
        let pulled = 0.5 * f64::from(BOUND) * outside;
        reference::surrogate(b, i, log_prob, 0.2) + pulled + 0.5 * e * e + 0.7 * softplus(-logit)
    };
    (0..b.n).map(one).sum::<f64>() / b.n as f64
}

fn check(name: &str, net: &Net64, dense: &Dense, loss: impl Fn(&Net64) -> f64) {
    let error = relative_error(net, &flat32(dense), loss);
    assert!(error < LIMIT, "{name}: relative error {error:e}");
}

#[test]
fn actor_gradients_equal_central_differences() {
    for (stochastic, activation, warmup) in [
        (false, TANH, 0),
        (false, TANH, 1),
        (true, TANH, 0),
        (false, RELU, 0),
        (true, RELU, 0),
        (false, Activation::Elu, 0),
        (false, Activation::Silu, 0),
    ] {
        let (l, b) = learner_that_warms_up(stochastic, true, activation, warmup);
        let (grad, sums) = gradient(&l, &b, ACTOR);
        let (value_grad, _) = gradient(&l, &b, VALUE);
        let n = nets64(&l);
        let with = |f: &dyn Fn(&mut Nets64)| {
            let mut m = nets64(&l);
            f(&mut m);
            actor_loss(&l, &b, &m)
        };
        let mlp = |net: &Net| net.mlp.to_dense(&grad);
        // the linear map reads what the inverse model sees
        let d = dims();
        let read = |p: &Net64| p.clone().unread(d.n_obs, |k| !d.seen_obs.contains(&k));
        check("policy", &n.policy, &mlp(&l.nets.combined.policy), |p| with(&|m| m.policy = read(p)));
        let value = l.nets.combined.value.net.mlp.to_dense(&value_grad);
        check("value", &n.value, &value, |p| with(&|m| m.value = p.clone()));
        let range = match (&l.nets.combined.inverse, &l.nets.combined.policy_log_std) {
            (Some((model, range)), _) => {
                let net = n.inverse.as_ref().expect("inverse");
                check("inverse", net, &mlp(&model.net), |p| with(&|m| m.inverse = Some(p.clone())));
                assert!(sums[3] > 0.0, "the projection clamps some entries");
                range.clone()
            }
            (None, range) => range.clone().expect("log std"),
        };
        for k in 0..n.log_std.len() {
            let slope = (with(&|m| m.log_std[k] += 1e-5) - with(&|m| m.log_std[k] -= 1e-5)) / 2e-5;
            let analytic = f64::from(scalars(&grad[range.clone()])[k]);
            assert!((slope - analytic).abs() < 1e-4 * (1.0 + slope.abs()), "log std {k}: {slope} {analytic}");
        }
    }
}

/// With an optimiser of its own the adversarial loss is a phase of its own: together they are what one phase was.
#[test]
fn the_generator_apart_has_the_same_gradient() {
    for (stochastic, null_space) in [(false, false), (true, false), (false, true)] {
        let (mut l, b) = learner(stochastic, true, TANH);
        l.nets.settings.null_space = null_space;
        let (both, _) = gradient(&l, &b, ACTOR);
        l.nets.settings.generator_lr = 1e-3;
        let (actor, _) = gradient(&l, &b, ACTOR);
        let (generator, sums) = gradient(&l, &b, GENERATOR);
        let range = l.nets.combined.proposal_range();
        let (both, actor, own) =
            (scalars(&both[range.clone()]), scalars(&actor[range.clone()]), scalars(&generator[range]));
        let size = own.iter().map(|g| g * g).sum::<f32>().sqrt();
        assert!(sums[0] > 0.0 && size > 1e-3, "{size}");
        for ((both, actor), own) in both.iter().zip(actor).zip(own) {
            assert!((both - actor - own).abs() < 1e-5 * (1.0 + size), "{both} {actor} {own}");
        }
    }
}

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
