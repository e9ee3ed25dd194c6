//! PPO's gradients against central differences of the textbook loss in f64.

use super::*;
use crate::learn::reference::{self, *};
use nearl_runtime::net::Activation;

#[test]
fn gradients_equal_central_differences() {
    [Activation::Tanh, Activation::Relu, Activation::Elu, Activation::Silu].into_iter().for_each(gradients);
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
        l.nets.tile(phase, &l.params, tile(&b, &idx), &mut l.nets.scratch(), &mut grad);
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
        l.update(&mut batch(&dims(), TILE, 3), Pace::default(), &mut rng);
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
        l.update(&mut batch(&dims(), 2 * TILE, 3), Pace::default(), &mut rng);
        [ACTOR, VALUE].map(|phase| scalars(&l.params.groups[phase].p).to_vec())
    };
    assert!(learned(vec![]) == learned(vec![32, 32]), "other weights of policy or value");
}

/// What a setting makes of three updates on one batch: numbers of the last, and how many passes it took.
fn last_of(settings: PpoSettings) -> (Ppo, Metrics) {
    let mut rng = crate::rollout::stream(1, 1);
    let mut l = Ppo::new(dims(), &NetSettings::default(), settings, 1, &mut rng);
    let mut metrics = Metrics::new();
    for _ in 0..3 {
        metrics = l.update(&mut batch(&dims(), 4 * TILE, 3), Pace::default(), &mut rng);
    }
    (l, metrics)
}

fn of(metrics: &Metrics, name: &str) -> f64 {
    metrics.iter().find(|(n, _)| *n == name).unwrap_or_else(|| panic!("{name}")).1
}

#[test]
fn passes_end_where_the_divergence_is_reached() {
    let settings = PpoSettings { batch_size: TILE, ..PpoSettings::default() };
    let (_, all) = last_of(settings.clone());
    let (_, few) = last_of(PpoSettings { target_kl: 1e-6, ..settings.clone() });
    let (_, wide) = last_of(PpoSettings { target_kl: 1e6, ..settings });
    assert_eq!([&all, &few, &wide].map(|m| of(m, "train/epochs")), [10.0, 1.0, 10.0]);
    assert_eq!(
        of(&all, "train/approx_kl"),
        of(&wide, "train/approx_kl"),
        "passes apart are passes in one go"
    );
}

#[test]
fn the_rate_follows_the_divergence() {
    let settings = PpoSettings { batch_size: TILE, ..PpoSettings::default() };
    let rate =
        |desired_kl| of(&last_of(PpoSettings { desired_kl, ..settings.clone() }).1, "train/learning_rate");
    // The third update has the rate that the two before it asked for.
    let third = |factor: f64| 3e-4 * factor.powi(2);
    assert!((rate(1e-9) / third(1.0 / 1.5) - 1.0).abs() < 1e-5, "twice slower: {}", rate(1e-9));
    assert!((rate(1e9) / third(1.5) - 1.0).abs() < 1e-5, "twice faster: {}", rate(1e9));
    assert_eq!(rate(0.0), f64::from(3e-4f32), "held");
}

#[test]
fn the_value_has_a_rate_of_its_own() {
    let settings = PpoSettings { batch_size: TILE, max_grad_norm: f32::INFINITY, ..PpoSettings::default() };
    let value = |s: PpoSettings| scalars(&last_of(s).0.params.groups[VALUE].p).to_vec();
    let same = value(settings.clone());
    assert!(same == value(PpoSettings { value_lr: 3e-4, ..settings.clone() }), "0 is the policy's");
    assert!(same != value(PpoSettings { value_lr: 1e-3, ..settings }));
}

/// `max((V - R)^2, (clip(V, V_old +- range) - R)^2)` by central differences; the value was that of the estimate.
#[test]
fn the_clipped_value_loss_equals_central_differences() {
    let range = 0.4;
    let nets = NetSettings { value: vec![4, 6], ..NetSettings::default() };
    let settings = PpoSettings { clip_value: range, ..PpoSettings::default() };
    let mut l = Ppo::new(dims(), &nets, settings, 1, &mut crate::rollout::stream(1, 1));
    spread(&mut l.params.groups[VALUE].p, &[&l.nets.value.net]);
    l.nets.refresh(VALUE, &mut l.params);
    let (mut b, d) = (batch(&dims(), TILE, 3), dims());
    b.value = b.returns.iter().zip(&b.advantage).map(|(r, a)| r - a).collect();
    let idx: Vec<u32> = (0..b.n as u32).collect();
    let mut grad = vec![ZERO; l.params.groups[VALUE].p.len() + 1];
    l.nets.tile(VALUE, &l.params, tile(&b, &idx), &mut l.nets.scratch(), &mut grad);
    let value = Net64::of(&l.nets.value.net.mlp.to_dense(&l.params.groups[VALUE].p), Activation::Tanh);
    let error = |net: &Net64, i: usize| {
        let (v, r) = (net.forward(&row(&b.obs, i, d.n_obs))[0], f64::from(b.returns[i]));
        let before = f64::from(b.value[i]);
        let held = v.clamp(before - f64::from(range), before + f64::from(range));
        ((v - r).powi(2), (held - r).powi(2))
    };
    let held = (0..b.n).filter(|&i| error(&value, i).1 > error(&value, i).0).count();
    assert!(held > 2 && held < b.n - 2, "some are held, some are not: {held}");
    let loss =
        |net: &Net64| (0..b.n).map(|i| 0.5 * error(net, i).0.max(error(net, i).1)).sum::<f64>() / b.n as f64;
    let error = relative_error(&value, &flat32(&l.nets.value.net.mlp.to_dense(&grad)), loss);
    assert!(error < 2e-4, "relative error {error:e}");
}

/// Anew under the values of the network as it learns, and by hand where that is zero: a stretch of two steps, gamma = lambda = 1.
#[test]
fn advantages_are_estimated_anew_before_each_pass() {
    let learn = |recompute_advantages| {
        let settings =
            PpoSettings { batch_size: TILE, n_epochs: 3, recompute_advantages, ..PpoSettings::default() };
        let mut rng = crate::rollout::stream(1, 1);
        let mut l = Ppo::new(dims(), &NetSettings::default(), settings, 1, &mut rng);
        let mut b = batch(&dims(), TILE, 3);
        b.discount = (1.0, 1.0);
        for _ in 0..TILE / 2 {
            let (reward, terminated, truncated) = (vec![1.0, 2.0], vec![false, true], vec![false; 2]);
            b.stretches.push(super::super::Stretch { reward, terminated, truncated, ..Default::default() });
        }
        b.estimate(|x| vec![0.0; x.len() / dims().n_obs]);
        assert_eq!(b.returns[..4], [3.0, 2.0, 3.0, 2.0]);
        l.update(&mut b, Pace::default(), &mut rng);
        let values = l.values(&b.obs);
        (b, values)
    };
    let (still, _) = learn(false);
    assert_eq!(still.advantage[..2], [3.0, 2.0]);
    let (anew, values) = learn(true);
    let near = |got: f32, want: f32| (got - want).abs() < 1e-5;
    assert!(
        near(anew.returns[0], 3.0) && near(anew.returns[1], 2.0),
        "with lambda 1 returns do not depend on values"
    );
    assert!(
        (anew.advantage[0] - (3.0 - values[0])).abs() < 0.1 && anew.advantage[0] != 3.0,
        "{:?} {:?}",
        &anew.advantage[..2],
        &values[..2]
    );
}

/// `-weight mean log pi(a | s)` over the demonstrations that go with the rows, by the network and by its spread.
#[test]
fn the_demonstration_term_equals_central_differences() {
    let nets = NetSettings { policy: vec![6, 5], ..NetSettings::default() };
    let settings = PpoSettings { log_std: -0.3, ..PpoSettings::default() };
    let (d, b, demos) = (dims(), batch(&dims(), TILE, 3), batch(&dims(), 3 * TILE, 8));
    let mut rng = crate::rollout::stream(1, 1);
    let mut l = Ppo::new(dims(), &nets, settings, 1, &mut rng);
    spread(&mut l.params.groups[ACTOR].p, &[&l.nets.policy]);
    l.nets.refresh(ACTOR, &mut l.params);
    let idx: Vec<u32> = (0..b.n as u32).collect();
    let gradient = |l: &Ppo| {
        let mut grad = vec![ZERO; l.params.groups[ACTOR].p.len() + 1];
        l.nets.tile(ACTOR, &l.params, tile(&b, &idx), &mut l.nets.scratch(), &mut grad);
        grad
    };
    let without = gradient(&l);
    l.augment(demos.clone(), 0.25, b.n, &mut rng);
    let with = gradient(&l);
    let own: Vec<V> = with.iter().zip(&without).map(|(&a, &b)| a - b).collect();
    let (term, p) = (l.nets.term.as_ref().expect("just given"), &l.params.groups[ACTOR].p);
    assert!((term.weight - 0.75).abs() < 1e-6, "three demonstrated rows for an own one, a quarter each");
    assert!(term.with.iter().any(|&k| k as usize >= b.n), "they come from all over the demonstrations");
    let spread: Vec<f64> =
        scalars(&p[l.nets.log_std.clone()])[..d.n_act].iter().map(|&v| f64::from(v)).collect();
    let loss = |policy: &Net64, log_std: &[f64]| {
        let one = |&k: &u32| {
            let mean = policy.forward(&row(&demos.obs, k as usize, d.n_obs));
            log_normal(&row(&demos.action, k as usize, d.n_act), &mean, log_std)
        };
        -0.75 * term.with.iter().map(one).sum::<f64>() / b.n as f64
    };
    let policy = Net64::of(&l.nets.policy.mlp.to_dense(p), nets.activation);
    let error = relative_error(&policy, &flat32(&l.nets.policy.mlp.to_dense(&own)), |n| loss(n, &spread));
    assert!(error < 2e-4, "relative error {error:e}");
    for k in 0..d.n_act {
        let at = |x: f64| {
            let mut s = spread.clone();
            s[k] += x;
            loss(&policy, &s)
        };
        let (slope, analytic) = ((at(1e-5) - at(-1e-5)) / 2e-5, scalars(&own[l.nets.log_std.clone()])[k]);
        assert!((slope - f64::from(analytic)).abs() < 1e-4 * (1.0 + slope.abs()), "{k}: {slope} {analytic}");
    }
    let sum = with[with.len() - 1].0[3] / b.n as f32;
    assert!((f64::from(sum) - loss(&policy, &spread)).abs() < 1e-4, "what is reported is the loss");
}
