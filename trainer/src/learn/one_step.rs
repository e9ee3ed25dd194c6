//! For tests: one step, reward `-|a - f(x)|^2`. Any correct policy gradient finds `f`, whatever stands between the policy and
//! the action.

use super::nearl::{Nearl, NearlSettings};
use super::pid2::{Pid2, Pid2Settings};
use super::{
    Base, Batch, Bc, Bco, Dapg, Dims, Gaifo, Imitating, Kind, Learner, NetSettings, Pace, Pid2Il, Ppo,
    PpoSettings, Soil, Stretch,
};
use crate::demos::DemoSettings;
use nearl_runtime::Networks;
use nearl_runtime::net::{Activation, Forward};
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

const DETERMINISTIC: Kind = Kind { stochastic: false, learned: true };
const STOCHASTIC: Kind = Kind { stochastic: true, learned: true };
const ANALYTIC: Kind = Kind { stochastic: true, learned: false };

/// The best action.
fn goal(x: [f32; 2]) -> [f32; 2] {
    [0.5 * x[0], -0.3 * x[1] + 0.4]
}

/// The change of state an action makes, and the action that makes it.
fn reached(a: [f32; 2]) -> [f32; 2] {
    [a[0] + 0.4 * a[1], a[1]]
}
fn analytic(w: [f32; 2]) -> [f32; 2] {
    [w[0] - 0.4 * w[1], w[1]]
}

/// The networks of a learner as they act: `policy -> (inverse model) -> action`.
struct Actor {
    kind: Option<Kind>,
    activation: Activation,
    nets: Networks,
}

#[derive(Debug)]
struct Sample {
    proposal: [f32; 2],
    action: [f32; 2],
    log_prob: f32,
}

impl Actor {
    fn act(&self, x: [f32; 2], mut noise: impl FnMut() -> f32) -> Sample {
        let mut log_prob = 0.0;
        let mut sample = |mean: &[f32], log_std: &[f32], random: bool| -> [f32; 2] {
            std::array::from_fn(|k| {
                if !random {
                    return mean[k];
                }
                let z = noise();
                log_prob -= 0.5 * z * z + log_std[k] + 0.918_938_5;
                mean[k] + log_std[k].exp() * z
            })
        };
        let mean = Forward::new(&self.nets.policy, self.activation).forward(&x).to_vec();
        let Some(kind) = self.kind else {
            let action = sample(&mean, &self.nets.policy_log_std, true);
            return Sample { proposal: [0.0; 2], action, log_prob };
        };
        let proposal = sample(&mean, &self.nets.policy_log_std, kind.stochastic);
        let action = match &self.nets.idm {
            None => analytic(proposal),
            Some((idm, log_std)) => {
                let mean = Forward::new(idm, self.activation).forward(&[x, proposal].concat()).to_vec();
                sample(&mean, log_std, true)
            }
        };
        Sample { proposal, action, log_prob }
    }

    fn miss(&self, x: [f32; 2]) -> f64 {
        let (a, g) = (self.act(x, || 0.0).action, goal(x));
        (0..2).map(|k| f64::from((a[k] - g[k]).powi(2))).sum()
    }
}

fn collect(actor: &Actor, n: usize, rng: &mut ChaCha8Rng) -> (Batch, f64) {
    let mut b = Batch { n, ..Batch::default() };
    let mut miss = 0.0;
    for _ in 0..n {
        let x: [f32; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut *rng));
        let s = actor.act(x, || StandardNormal.sample(&mut *rng));
        miss += actor.miss(x) / n as f64;
        let g = goal(x);
        let reward = -(0..2).map(|k| (s.action[k] - g[k]).powi(2)).sum::<f32>();
        b.obs.extend(x);
        b.change.extend(s.proposal);
        b.target_change.extend(s.proposal);
        b.reached.extend(reached(s.action));
        b.sampled.extend(s.action);
        b.action.extend(s.action);
        b.log_prob.push(s.log_prob);
        b.advantage.push(reward);
        b.returns.push(reward);
        b.lower.extend([-9.0; 2]);
        b.upper.extend([9.0; 2]);
    }
    (b, miss)
}

/// Squared distance of the noise-free action from the best one before and after `rounds` updates.
fn train(
    kind: Option<Kind>,
    nets: &NetSettings,
    rounds: usize,
    make: impl FnOnce(Dims, PpoSettings, &mut ChaCha8Rng) -> Box<dyn Learner>,
) -> (f64, f64) {
    let dims = Dims {
        n_obs: 2,
        n_privileged: 0,
        n_state: 2,
        n_act: 2,
        seen_obs: vec![0, 1],
        seen_state: vec![0, 1],
    };
    let mut rng = crate::rollout::stream(4, 0);
    let settings = PpoSettings { lr: 1e-3, log_std: -0.5, ..PpoSettings::default() };
    let mut learner = make(dims, settings, &mut rng);
    let normaliser = Normaliser::identity(2, 2);
    let actor = |l: &dyn Learner| Actor { kind, activation: nets.activation, nets: l.networks(&normaliser) };
    let mut first = f64::NAN;
    for round in 0..rounds {
        let (mut batch, miss) = collect(&actor(&*learner), 1024, &mut rng);
        if round == 0 {
            first = miss;
        }
        let pace = Pace { rate: 1.0 - round as f32 / rounds as f32, clip: 1.0 };
        learner.update(&mut batch, pace, &mut rng);
    }
    (first, collect(&actor(&*learner), 1024, &mut rng).1)
}

fn solves(name: &str, (first, last): (f64, f64)) {
    assert!(first > 0.2 && last < 0.01, "{name}: squared distance {first} at first, {last} at last");
}

fn nets(activation: Activation) -> NetSettings {
    NetSettings { activation, ..NetSettings::default() }
}

#[test]
fn ppo_solves_it_with_every_activation() {
    for f in [Activation::Tanh, Activation::Relu, Activation::Elu, Activation::Silu] {
        let n = nets(f);
        let got = train(None, &n, 40, |d, s, rng| Box::new(Ppo::new(d, &n, s, 1, rng)));
        solves(&format!("ppo {f:?}"), got);
    }
}

#[test]
fn nearl_solves_it() {
    let n = nets(Activation::Tanh);
    for (kind, rounds) in [(DETERMINISTIC, 50), (STOCHASTIC, 50), (ANALYTIC, 50)] {
        let got = train(Some(kind), &n, rounds, |d, s, rng| {
            Box::new(Nearl::new(d, &n, s, NearlSettings::default(), kind, 1, rng))
        });
        solves(&format!("nearl {kind:?}"), got);
    }
}

#[test]
fn pid2_solves_it_with_and_without_bottleneck() {
    for bottleneck in [false, true] {
        let n = nets(Activation::Tanh);
        for (kind, rounds) in [(DETERMINISTIC, 50), (STOCHASTIC, 50), (ANALYTIC, 50)] {
            let got = train(Some(kind), &n, rounds, |d, s, rng| {
                Box::new(Pid2::new(d, &n, s, Pid2Settings::default(), kind, bottleneck, 1, rng))
            });
            solves(&format!("pid2, bottleneck {bottleneck}, {kind:?}"), got);
        }
    }
    let (n, settings) =
        (nets(Activation::Tanh), Pid2Settings { null_space: true, ..Pid2Settings::default() });
    let got = train(Some(DETERMINISTIC), &n, 50, |d, s, rng| {
        Box::new(Pid2::new(d, &n, s, settings.clone(), DETERMINISTIC, true, 1, rng))
    });
    solves("pid2, null space", got);
}

/// An expert: from `x` the best action, and the state it leads to.
fn demonstrated(n: usize, rng: &mut ChaCha8Rng) -> Batch {
    let mut b = Batch { n, advantage: vec![0.0; n], ..Batch::default() };
    for _ in 0..n {
        let x: [f32; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut *rng));
        b.obs.extend(x);
        b.reached.extend(reached(goal(x)));
        b.action.extend(goal(x));
    }
    b
}

/// Affine networks: what is to be found can be found exactly.
fn affine() -> NetSettings {
    NetSettings { policy: vec![], idm: vec![], ..NetSettings::default() }
}

fn plain() -> (Dims, PpoSettings, DemoSettings) {
    let dims = Dims {
        n_obs: 2,
        n_privileged: 0,
        n_state: 2,
        n_act: 2,
        seen_obs: vec![0, 1],
        seen_state: vec![0, 1],
    };
    let demos = DemoSettings { epochs: 200, lr: 1e-2, ..DemoSettings::default() };
    (dims, PpoSettings { lr: 1e-3, n_epochs: 100, ..PpoSettings::default() }, demos)
}

/// Behaviour cloning of states finds the shift that the expert's actions make, and with an inverse model from random actions acts like it.
#[test]
fn bc_recovers_the_known_shift() {
    let (dims, ppo, demos) = plain();
    let (n, mut rng) = (affine(), crate::rollout::stream(4, 0));
    let settings = Pid2Settings { idm_lr: 1e-2, ..Pid2Settings::default() };
    let pid2 = Pid2::new(dims, &n, ppo, settings, DETERMINISTIC, true, 1, &mut rng);
    let mut bc = Imitating::<Bc>::new(pid2, demos);
    let normaliser = Normaliser::identity(2, 2);
    let actor = |l: &dyn Learner| Actor {
        kind: Some(DETERMINISTIC),
        activation: n.activation,
        nets: l.networks(&normaliser),
    };
    let (batch, first) = collect(&actor(&bc), 1024, &mut rng);
    bc.warm_up(&batch, &mut rng);
    let imitator = bc.imitator().expect("it imitates");
    imitator.see(demonstrated(1024, &mut rng), 0.0);
    imitator.pretrain(&mut rng);
    let cloned = actor(&bc);
    for x in [[0.0, 0.0], [1.0, -0.5], [-2.0, 1.0]] {
        let (proposed, shift) = (cloned.act(x, || 0.0).proposal, reached(goal(x)));
        assert!((0..2).all(|k| (proposed[k] - shift[k]).abs() < 1e-3), "{x:?}: {proposed:?} {shift:?}");
    }
    solves("bc", (first, collect(&cloned, 1024, &mut rng).1));
}

/// A plant that moves by itself: after the warm-up the policy proposes that movement, and the action that does it is the fresh networks'
/// own mean, near none.
#[test]
fn after_the_warm_up_what_the_robot_does_by_itself_is_proposed() {
    let (dims, ppo, _) = plain();
    let (n, mut rng) = (affine(), crate::rollout::stream(4, 0));
    let settings = Pid2Settings { warmup: 4096, ..Pid2Settings::default() };
    let mut pid2 = Pid2::new(dims, &n, ppo, settings, DETERMINISTIC, true, 1, &mut rng);
    let normaliser = Normaliser::identity(2, 2);
    let actor = |l: &dyn Learner| Actor {
        kind: Some(DETERMINISTIC),
        activation: n.activation,
        nets: l.networks(&normaliser),
    };
    let fresh = actor(&pid2);
    let drift = |x: [f32; 2]| [0.8 * x[0] - 0.3 * x[1], 0.5 * x[1] - 0.4];
    let (mut batch, _) = collect(&fresh, 4096, &mut rng);
    for (reached, x) in batch.reached.chunks_exact_mut(2).zip(batch.obs.chunks_exact(2)) {
        reached.iter_mut().zip(drift([x[0], x[1]])).for_each(|(to, d)| *to += d);
    }
    pid2.warm_up(&batch, &mut rng);
    let warm = actor(&pid2);
    for x in [[0.0, 0.0], [1.0, -0.5], [-2.0, 1.0]] {
        let (of_fresh, own) = (fresh.act(x, || 0.0), warm.act(x, || 0.0));
        let (moves, answer) = (drift(x), reached(of_fresh.action));
        let want: [f32; 2] = std::array::from_fn(|k| moves[k] + answer[k]);
        let furthest =
            |a: [f32; 2], b: [f32; 2]| a.iter().zip(b).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(furthest(of_fresh.proposal, want) > 0.3, "{x:?}: nothing had to be learned");
        assert!(furthest(own.proposal, want) < 0.1, "{x:?}: {own:?} instead of {want:?}");
        assert!(furthest(own.action, of_fresh.action) < 0.1, "{x:?}: {own:?}");
    }
}

/// Under linear dynamics an affine inverse model fills in the expert's own actions.
#[test]
fn soil_relabels_exactly_under_linear_dynamics() {
    let (dims, ppo, _) = plain();
    let mut rng = crate::rollout::stream(4, 0);
    let mut ppo = Ppo::new(dims, &affine(), PpoSettings { lr: 1e-2, ..ppo }, 1, &mut rng);
    let normaliser = Normaliser::identity(2, 2);
    let actor = Actor { kind: None, activation: affine().activation, nets: ppo.networks(&normaliser) };
    let (batch, _) = collect(&actor, 1024, &mut rng);
    ppo.learn_inverse(&batch, &mut rng);
    let mut demos = demonstrated(100, &mut rng);
    let actions = std::mem::take(&mut demos.action);
    ppo.relabel(&mut demos);
    assert_eq!(demos.action.len(), actions.len());
    for (inferred, own) in demos.action.iter().zip(&actions) {
        assert!((inferred - own).abs() < 1e-3, "{inferred} {own}");
    }
}

/// With a part of demonstrations, of actions or without, and the reward beside it.
#[test]
fn dapg_soil_and_pid2_il_solve_it() {
    let n = nets(Activation::Tanh);
    let demos = || DemoSettings { epochs: 5, ..DemoSettings::default() };
    let with = |mut learner: Box<dyn Learner>, rng: &mut ChaCha8Rng| {
        let imitator = learner.imitator().expect("it imitates");
        imitator.see(demonstrated(512, rng), 0.01);
        imitator.pretrain(rng);
        learner
    };
    let dapg = train(None, &n, 40, |d, s, rng| {
        with(Box::new(Imitating::<Dapg>::new(Ppo::new(d, &n, s, 1, rng), demos())), rng)
    });
    assert!(dapg.0 < 0.1, "cloned actions are good from the first: {dapg:?}");
    assert!(dapg.1 < 0.01, "{dapg:?}");
    solves(
        "soil",
        train(None, &n, 40, |d, s, rng| {
            with(Box::new(Imitating::<Soil>::new(Ppo::new(d, &n, s, 1, rng), demos())), rng)
        }),
    );
    solves(
        "pid2-il",
        train(Some(DETERMINISTIC), &n, 50, |d, s, rng| {
            let pid2 = Pid2::new(d, &n, s, Pid2Settings::default(), DETERMINISTIC, true, 1, rng);
            with(Box::new(Imitating::<Pid2Il>::new(pid2, demos())), rng)
        }),
    );
}

/// Under linear dynamics the inferred actions are the expert's own; the reward is NaN and nobody reads it.
#[test]
fn bco_acts_like_the_expert() {
    let (dims, ppo, demos) = plain();
    let (n, mut rng) = (affine(), crate::rollout::stream(4, 0));
    let mut bco =
        Imitating::<Bco>::new(Ppo::new(dims, &n, PpoSettings { lr: 1e-2, ..ppo }, 1, &mut rng), demos);
    let normaliser = Normaliser::identity(2, 2);
    let actor =
        |l: &dyn Learner| Actor { kind: None, activation: n.activation, nets: l.networks(&normaliser) };
    let (mut batch, first) = collect(&actor(&bco), 1024, &mut rng);
    batch.advantage.fill(f32::NAN);
    bco.warm_up(&batch, &mut rng);
    let imitator = bco.imitator().expect("it imitates");
    imitator.see(demonstrated(1024, &mut rng), 0.0);
    imitator.pretrain(&mut rng);
    bco.update(&mut batch, Pace::default(), &mut rng);
    solves("bco", (first, collect(&actor(&bco), 1024, &mut rng).1));
}

/// The expert's own spread is what a discriminator cannot tell from the learner's: with none demonstrated, the policy comes close.
#[test]
fn gaifo_comes_close_without_the_reward() {
    let n = nets(Activation::Tanh);
    let (dims, _, _) = plain();
    let mut rng = crate::rollout::stream(4, 0);
    let settings = PpoSettings { lr: 1e-3, log_std: -0.5, ..PpoSettings::default() };
    let ppo = Ppo::new(dims.clone(), &n, settings, 1, &mut rng);
    let gaifo = Imitating::<Gaifo>::new(ppo, DemoSettings::default());
    let mut gaifo = gaifo.by_likeness(&dims, &n, 1e-3, 64, 1, &mut rng);
    let normaliser = Normaliser::identity(2, 2);
    let actor =
        |l: &dyn Learner| Actor { kind: None, activation: n.activation, nets: l.networks(&normaliser) };
    let first = collect(&actor(&gaifo), 1024, &mut rng).1;
    gaifo.imitator().expect("it imitates").see(demonstrated(1024, &mut rng), 0.0);
    let rounds = 60;
    for round in 0..rounds {
        let (mut batch, _) = collect(&actor(&gaifo), 1024, &mut rng);
        batch.stretches = (0..batch.n)
            .map(|_| Stretch {
                reward: vec![f32::NAN],
                terminated: vec![true],
                truncated: vec![false],
                final_obs: Vec::new(),
                cost: Vec::new(),
            })
            .collect();
        let pace = Pace { rate: 1.0 - round as f32 / rounds as f32, clip: 1.0 };
        gaifo.update(&mut batch, pace, &mut rng);
    }
    let last = collect(&actor(&gaifo), 1024, &mut rng).1;
    assert!(first > 0.2 && last < 0.1 * first, "squared distance {first} at first, {last} at last");
}
