//! Every gradient of PID^2 against central differences of the textbook losses in f64.

mod coordinates;
mod discriminator;
mod inverse;

use nearl_runtime::net::kernel::scalars;
use nearl_runtime::net::{Activation, Dense};

use super::fakes::Fakes;
use super::*;
use crate::learn::Net;
use crate::learn::optimise::TILE;
use crate::learn::reference::{self, *};

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
