//! The guard: whatever a network puts out, the simulator's own state stays within the limits, and what is allowed comes through bit for bit.

use nearl_runtime::constraints::drive::{Arrival, Held};
use nearl_runtime::constraints::{Drive, Dynamics, Model, Period, PeriodDynamics, Rung};
use nearl_runtime::net::{Dense, Forward};
use nearl_runtime::rt::Brake;
use nearl_runtime::{Controller, PolicyKind, Snapshot, doctor};
use nearl_tests::training;
use nearl_trainer::env::{Env, Meter};
use nearl_trainer::foresight::{Bound, Foresight, Search, Verdict};
use nearl_trainer::mj;
use nearl_trainer::plant::{TOLERANCE, watched_limits};
use nearl_trainer::rollout::{make_env, stream};
use nearl_trainer::{tasks, train};
use rand::RngExt;
use std::path::Path;

/// Ticks of an attack: 50,000, or as many as `NEARL_TICKS` says (`results/doors/guard.md` has a million).
fn ticks() -> usize {
    std::env::var("NEARL_TICKS").map_or(50_000, |n| n.parse().expect("NEARL_TICKS: a number of ticks"))
}

/// A network with random weights, larger by `gain` in the last layer.
fn scramble(net: &mut Dense, seed: u64, gain: f32) {
    let mut rng = stream(seed, 9);
    let last = net.layers.len() - 1;
    for (k, layer) in net.layers.iter_mut().enumerate() {
        let gain = if k == last { gain } else { 1.0 };
        layer
            .weight
            .iter_mut()
            .chain(&mut layer.bias)
            .for_each(|w| *w = gain * (2.0 * rng.random::<f32>() - 1.0));
    }
}

fn direct(seed: u64, gain: f32, set: &[&str]) -> Snapshot {
    let mut snapshot = training("Panda-reach", "ppo", seed, 1, set).snapshot().clone();
    scramble(&mut snapshot.networks.policy, seed, gain);
    snapshot
}

fn learned(seed: u64, set: &[&str]) -> Snapshot {
    let mut all = vec!["idm.kind=learned", "time.policy_every=1"];
    all.extend_from_slice(set);
    let mut snapshot = training("Panda-reach", "pid2-ib", seed, 1, &all).snapshot().clone();
    scramble(&mut snapshot.networks.policy, seed, 3.0);
    let (idm, _) = snapshot.networks.idm.as_mut().expect("an inverse model");
    scramble(idm, seed + 1, 30.0);
    snapshot
}

struct Outcome {
    broken: [u64; 3],
    worst: f64,
    /// Ticks in which the guard changed the action.
    moved: u64,
    refused: u64,
    braked: u64,
}

impl Outcome {
    fn print(&self, what: &str) {
        let [q, v, tau] = self.broken;
        let (ticks, moved) = (ticks(), self.moved);
        println!("| {what} | 1 ms | {ticks} | {moved} | {q} | {v} | {tau} | {:.1e} |", self.worst);
    }
}

/// The Panda in MuJoCo under `snapshot`. Where the guard did not move the state, the action is the network's, bit for bit.
fn run(snapshot: &Snapshot, seed: u64, ticks: usize, restart_every: usize) -> Outcome {
    let mut env = make_env(snapshot).expect("environment");
    let mut controller = Controller::new(snapshot).expect("controller");
    let limits = watched_limits(env.as_ref(), controller.model(), controller.limits());
    let mut meter = Meter::new(limits, TOLERANCE, env.spec().dt).expect("limits");
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    let mut force = vec![0.0; env.spec().nv];
    let mut rng = stream(seed, 0);
    let guards = snapshot.manifest.guards();
    let (mut moved, mut refused, mut braked) = (0, 0, 0);
    for tick in 0..ticks {
        if tick % restart_every == 0 {
            env.reset(&mut rng).expect("reset");
            controller.reset();
            meter.begin(env.qvel());
        }
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        let status = controller.update(&state, &noise, &mut out);
        let ranges = snapshot.manifest.action_lower.iter().zip(&snapshot.manifest.action_upper);
        let asked = out.sampled.iter().zip(ranges).map(|(a, (l, u))| f64::from(*a).clamp(*l, *u));
        let same = asked.zip(&out.action).all(|(a, b)| a.to_bits() == b.to_bits());
        if guards {
            let ledger = &out.next.ledger;
            assert!(ledger.moved > 0.0 || same, "tick {tick}: an allowed action was changed");
            moved += u64::from(!same);
            refused += u64::from(ledger.target_violations.total() > 0);
            braked += u64::from(!status.is_ok() && ledger.rung == Rung::Brake);
        }
        env.step(&out.action);
        env.sim().applied_force(&mut force);
        meter.observe(env.qpos(), env.qvel(), Some(&force));
    }
    let (p, v) = (meter.position(), meter.velocity());
    let t = meter.effort().expect("forces were given");
    let worst = p.excess.max(v.excess).max(t.excess);
    Outcome { broken: [p.states, v.states, t.states], worst, moved, refused, braked }
}

const ON: &str = "constraints.guard=true";

#[test]
fn a_random_direct_network_breaks_no_limit_of_the_panda() {
    for (seed, gain) in [(1, 20.0), (2, 200.0)] {
        let o = run(&direct(seed, gain, &[ON]), seed, ticks(), usize::MAX);
        o.print("torques of a random network");
        assert_eq!((o.broken, o.refused, o.braked), ([0, 0, 0], 0, 0), "seed {seed}: worst {:e}", o.worst);
        assert!(o.moved > 1000, "seed {seed}: {} ticks moved", o.moved);
    }
}

#[test]
fn a_random_learned_inverse_model_breaks_no_limit_of_the_panda() {
    let o = run(&learned(3, &[ON]), 3, ticks(), usize::MAX);
    o.print("torques of a random inverse model");
    assert_eq!((o.broken, o.refused, o.braked), ([0, 0, 0], 0, 0), "worst {:e}", o.worst);
    assert!(o.moved > 1000, "{} ticks moved", o.moved);
}

#[test]
fn without_the_guard_both_break_them() {
    for snapshot in [direct(1, 20.0, &[]), learned(3, &[])] {
        let o = run(&snapshot, 1, 5000, usize::MAX);
        assert!(o.broken[1] > 100, "{:?}: the tests above could not fail", o.broken);
    }
}

/// An arm that begins to fall is within limits that let it: its torques come through (which [`run`] checks), in most ticks.
#[test]
fn what_is_allowed_comes_through_bit_for_bit() {
    let o = run(&direct(4, 0.02, &[ON, "constraints.acceleration={ limit = 200.0 }"]), 4, 4000, 40);
    assert!(o.moved < 2000, "{} of 4000 ticks were moved", o.moved);
}

#[test]
fn a_guard_without_torque_limits_is_refused_in_a_sentence() {
    let refuse = |task: &str, set: &[&str]| {
        let set: Vec<String> = set.iter().map(|s| (*s).to_string()).collect();
        let mut manifest = tasks::load(task, &set).expect("task");
        match nearl_trainer::train::complete(&mut manifest) {
            Err(e) => e.to_string(),
            Ok(_) => {
                let mut snapshot = direct(1, 1.0, &[]);
                snapshot.manifest.task.constraints = manifest.task.constraints;
                Controller::new(&snapshot).map(|_| ()).expect_err("refused").to_string()
            }
        }
    };
    // Geared motors are no reason: their torque is what the description makes of the action.
    let text = refuse("HalfCheetah-v5", &[ON]);
    assert!(text.contains("torque = { scale = 1.0 }") && !text.contains("gear"), "{text}");
    let without = "constraints={ position = {}, acceleration = { limit = 10.0 }, guard = true }";
    let text = refuse("Panda-reach", &[without]);
    assert!(text.contains("torque = { scale = 1.0 }"), "{text}");
}

/// To the learner the guard is a part of the environment: the likelihood is that of what the policy sampled, not of what was executed.
#[test]
fn ppo_trains_through_the_guard() {
    let short = ["train.n_envs=4", "train.n_steps=64", "train.ppo.batch_size=64"];
    let mut training = training("Panda-reach", "ppo", 0, 1, &[&short[..], &[ON]].concat());
    for _ in 0..3 {
        let acting = training.snapshot().clone();
        let mut net = Forward::new(&acting.networks.policy, acting.manifest.activation);
        let log_std = acting.networks.policy_log_std.clone();
        let p = training.iterate();
        assert!(p.tally.raw_violations > 0 && p.tally.moved > 0);
        assert_eq!((p.tally.target_violations, p.tally.reached_violations), (0, 0));
        let mut replaced = 0;
        for s in training.segments() {
            for (row, x) in s.x.chunks_exact(20).enumerate() {
                let (sampled, action) = (&s.sampled[7 * row..][..7], &s.action[7 * row..][..7]);
                replaced += usize::from(sampled != action);
                let terms = net.forward(x).iter().zip(sampled).zip(&log_std).map(|((mean, a), log_std)| {
                    let z = f64::from(a - mean) / f64::from(log_std.exp());
                    -0.5 * z * z - f64::from(*log_std) - 0.5 * std::f64::consts::TAU.ln()
                });
                let (ours, theirs) = (terms.sum::<f64>(), f64::from(s.log_prob[row]));
                assert!((ours - theirs).abs() < 1e-3, "row {row}: {ours} and {theirs}");
            }
        }
        assert!(replaced > 50, "{replaced} executed actions differ from those sampled");
    }
}

fn panda() -> Model {
    Model::from_urdf_text(include_str!("../../../examples/robots/panda/panda.urdf")).expect("robot")
}

/// Forward and back are inverse to each other; back is [`Dynamics::motors`], which shares no code with it where there are no sub-steps.
#[test]
fn forward_dynamics_of_a_period_are_the_inverse_of_its_inverse_dynamics() {
    let (model, mut rng) = (panda(), stream(5, 0));
    let nv = model.nv();
    let dofs: Vec<usize> = (0..nv).collect();
    let mut dynamics = Dynamics::new(&model);
    for sub_steps in [0, 1, 4] {
        let period = Period::new(0.005, sub_steps);
        let mut forward = PeriodDynamics::new(&model, &dofs, period);
        for _ in 0..100 {
            let mut draw = |size: f64| (0..nv).map(|_| rng.random_range(-size..size)).collect::<Vec<f64>>();
            let (q, v, a) = (draw(2.0), draw(2.0), draw(20.0));
            let (mut tau, mut back, mut again) = (vec![0.0; nv], vec![0.0; nv], a.clone());
            dynamics.motors(&period, &q, &v, &a, &mut tau);
            let held: Vec<Held> = tau.iter().map(|t| Held::Force(*t)).collect();
            forward.update(&q, &v, &vec![0.0; nv]);
            forward.accelerate(&held, &mut back);
            let off = a.iter().zip(&back).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < 1e-8, "{sub_steps} sub-steps: {off:e} rad/s^2");
            let mut torque = vec![0.0; nv];
            forward.drive(&mut again, &mut torque);
            let off = tau.iter().zip(&torque).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < 1e-9, "{sub_steps} sub-steps: {off:e} N m");
        }
    }
}

/// A trunk that stands on its feet is none of the joints that a guard by the model makes promises for.
#[test]
fn joints_that_nothing_drives_are_told_of_a_guard_by_the_model() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/tasks/anymal-walk.toml");
    for (guard, is_told) in [("true", true), ("drive", false)] {
        let set = [format!("constraints.guard={guard}"), "constraints.torque={ scale = 1.0 }".into()];
        let mut manifest = tasks::load(&file.display().to_string(), &set).expect("task");
        manifest.policy = PolicyKind::Direct;
        train::complete(&mut manifest).expect("a whole task");
        let told = doctor::told(&manifest).expect("notes");
        let found = told.iter().any(|note| note.contains("joints that nothing drives"));
        assert_eq!(found, is_told, "{guard}: {told:?}");
    }
}

/// The loop's own brake of an arm on a base that floats: it had taken the base for one that stands, and swung.
#[test]
fn a_brake_lets_follow_what_nothing_drives() {
    const LIMIT: f64 = 10.0;
    let folder = tempfile::tempdir().expect("folder");
    let body = |i: usize, inner: &str| {
        format!(
            "<body pos=\"0 0 0.4\"><joint name=\"j{i}\" axis=\"{}\" range=\"-2 2\" armature=\"0.01\"/><geom type=\"capsule\" size=\"0.03\" \
             fromto=\"0 0 0 0.02 0.03 0.4\" mass=\"{}\" contype=\"0\" conaffinity=\"0\"/>{inner}</body>",
            ["0 1 0", "1 0 0"][i % 2],
            [2.0, 1.2, 0.7][i],
        )
    };
    let arm = body(0, &body(1, &body(2, "")));
    let motors: String =
        (0..3).map(|i| format!("<motor name=\"m{i}\" joint=\"j{i}\" ctrlrange=\"-30 30\"/>")).collect();
    let robot = format!(
        "<mujoco><compiler angle=\"radian\"/><option timestep=\"0.004\" gravity=\"0 0 0\"/><worldbody><body name=\"base\"><freejoint name=\"root\"/>\
         <geom type=\"box\" size=\"0.2 0.2 0.1\" mass=\"5\" contype=\"0\" conaffinity=\"0\"/>{arm}</body></worldbody><actuator>{motors}</actuator></mujoco>"
    );
    std::fs::write(folder.path().join("arm.xml"), robot).expect("robot");
    let task = format!(
        "name = \"arm\"\n[model]\nmjcf = \"arm.xml\"\n[time]\ndt = 0.004\nsim_dt = 0.004\n[state]\ncontrollable = [\"j0\", \"j1\", \"j2\"]\n\
         observation = [\"q.j0\", \"q.j1\", \"q.j2\", \"v.j0\", \"v.j1\", \"v.j2\"]\n[reward]\nstill = \"1\"\n[idm]\nkind = \"pinocchio\"\n[constraints]\n\
         position = {{}}\nvelocity = {{ limit = 2.0 }}\nacceleration = {{ limit = {LIMIT:.1} }}\ntorque = {{}}\n"
    );
    let file = folder.path().join("arm.toml");
    std::fs::write(&file, format!("{task}guard = true\n")).expect("task");
    let mut manifest = tasks::load(&file.display().to_string(), &[]).expect("task");
    manifest.policy = PolicyKind::Direct;
    train::complete(&mut manifest).expect("a whole task");
    let mut brake = Brake::new(&manifest).expect("built").expect("a model that knows the action");
    let mut env = nearl_trainer::env::of_task(&manifest, "arm").expect("environment");
    let mut start = vec![0.0; env.qpos().len()];
    start[3] = 1.0;
    let (mut q, mut v) = (start.clone(), vec![0.0; 9]);
    let fast: Vec<f64> = [0.0; 6].into_iter().chain([1.9, -1.5, 1.9]).collect();
    env.set_state(&start, &fast).expect("state");
    for tick in 0..250 {
        env.state(&mut q, &mut v);
        let before = v.clone();
        let action = brake.update(&q, &v).1.to_vec();
        let step = env.step(&action);
        env.state(&mut q, &mut v);
        for i in 6..9 {
            let a = (v[i] - before[i]) / 0.004;
            assert!(a.abs() <= LIMIT + 1e-7, "tick {tick}: {a} rad/s² of dof {i}, {step:?}");
        }
    }
    assert!(v[6..].iter().all(|v| v.abs() < 1e-6), "{v:?}");
}

/// K [N m/rad] of a Panda's joint impedance, and D [N m s/rad] that damps each joint about critically.
const K: [f64; 7] = [600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0];
const D: [f64; 7] = [50.0, 50.0, 30.0, 30.0, 5.0, 3.0, 1.0];

fn drive(i: usize) -> Drive {
    Drive::Pd { stiffness: K[i], damping: D[i] }
}

/// The arm in MuJoCo at 0.1 ms, its drives evaluated in each physics step.
struct Driven {
    sim: mj::Sim,
}

impl Driven {
    fn new() -> Driven {
        let text = include_str!("../../../examples/robots/panda/panda.urdf");
        let options = mj::Options { sim_dt: Some(1e-4), without_contacts: true, ..mj::Options::default() };
        let model = mj::Model::from_text(text, mj::ModelFormat::Urdf, options).expect("plant");
        Driven { sim: mj::Sim::new(&model).expect("simulation") }
    }

    /// Holds the targets for `steps` physics steps; the forces of each are shown to `see`.
    fn hold(&mut self, targets: &[f64], steps: usize, mut see: impl FnMut(&[f64])) {
        for _ in 0..steps {
            let pull = |i: usize| K[i] * (targets[i] - self.sim.qpos()[i]) - D[i] * self.sim.qvel()[i];
            let forces: Vec<f64> = (0..7).map(pull).collect();
            see(&forces);
            self.sim.force_mut().copy_from_slice(&forces);
            self.sim.step(1).expect("a step");
        }
    }
}

fn median(mut x: Vec<f64>) -> f64 {
    x.sort_by(f64::total_cmp);
    x[x.len() / 2]
}

/// Median error of the predicted velocity [rad/s] over random states and targets, by the mean force of the drives and by the force at the start.
fn missed(ticks: usize) -> [f64; 2] {
    let (model, mut rng, mut plant) = (panda(), stream(6, 0), Driven::new());
    let period = Period::new(1e-4 * ticks as f64, ticks as u32);
    let dofs: Vec<usize> = (0..7).collect();
    let (mut mean, mut start) = (PeriodDynamics::new(&model, &dofs, period), Dynamics::new(&model));
    let (mut by_mean, mut by_start) = (Vec::new(), Vec::new());
    let (lower, upper) = (model.lower_position_limit().to_vec(), model.upper_position_limit().to_vec());
    for _ in 0..200 {
        let q: Vec<f64> = (0..7).map(|i| rng.random_range(lower[i] + 0.5..upper[i] - 0.5)).collect();
        let v: Vec<f64> = (0..7).map(|_| rng.random_range(-1.0..1.0)).collect();
        let targets: Vec<f64> = q.iter().map(|q| q + rng.random_range(-0.1..0.1)).collect();
        let held: Vec<Held> = (0..7).map(|i| drive(i).held(&period, q[i], v[i], targets[i])).collect();
        let mut a = [0.0; 7];
        mean.update(&q, &v, &[0.0; 7]);
        mean.accelerate(&held, &mut a);
        let pull: Vec<f64> = (0..7).map(|i| K[i] * (targets[i] - q[i]) - D[i] * v[i]).collect();
        let mut explicit = [0.0; 7];
        start.aba(&q, &v, &pull, &mut explicit);
        plant.sim.set_state(&q, &v).expect("state");
        plant.hold(&targets, ticks, |_| {});
        for i in 0..7 {
            let reached = plant.sim.qvel()[i];
            by_mean.push((v[i] + period.dt * a[i] - reached).abs());
            by_start.push((v[i] + period.dt * explicit[i] - reached).abs());
        }
    }
    [median(by_mean), median(by_start)]
}

#[test]
fn the_mean_force_of_a_drive_foresees_what_the_force_at_the_start_does_not() {
    for (ticks, share) in [(10, 0.2), (200, 0.4)] {
        let [mean, start] = missed(ticks);
        println!(
            "{} ms: velocity missed by {mean:.4} rad/s (median), by the force at the start {start:.4}",
            ticks as f64 * 0.1
        );
        assert!(mean < share * start, "{ticks} steps: {mean} against {start}");
    }
}

/// Forward, then back: the target that was held comes out again.
#[test]
fn the_target_of_a_drive_comes_back() {
    let (model, mut rng) = (panda(), stream(7, 0));
    let dofs: Vec<usize> = (0..7).collect();
    for sub_steps in [0, 1, 10] {
        let period = Period::new(0.002, sub_steps);
        let mut dynamics = PeriodDynamics::new(&model, &dofs, period);
        for _ in 0..50 {
            let mut draw = |size: f64| (0..7).map(|_| rng.random_range(-size..size)).collect::<Vec<f64>>();
            let (q, v, targets) = (draw(2.0), draw(1.0), draw(3.0));
            let held: Vec<Held> = (0..7).map(|i| drive(i).held(&period, q[i], v[i], targets[i])).collect();
            let (mut a, mut tau) = ([0.0; 7], [0.0; 7]);
            dynamics.update(&q, &v, &[0.0; 7]);
            dynamics.accelerate(&held, &mut a);
            dynamics.drive(&mut a, &mut tau);
            for i in 0..7 {
                let to = Arrival { q: 0.0, v: 0.0, a: a[i], tau: tau[i] };
                let back = drive(i).command(&period, q[i], v[i], &to);
                assert!((back - targets[i]).abs() < 1e-9, "{sub_steps} sub-steps: {back} for {}", targets[i]);
            }
        }
    }
}

/// A Panda whose drives are given a random network's targets, far beyond the joints' ranges; the drives run at 10 kHz in MuJoCo, the guard every
/// `hold` of their periods. The most that a position, a velocity or, at any instant, a torque is beyond the robot file's limits, and the states
/// that were; ticks that ask for a broken limit; the largest speed.
fn driven(hold: usize, ticks: usize) -> ([f64; 3], u64, f64) {
    let limits = panda();
    let set = |stiffness: &str| format!("command={{ interface = \"pd\", stiffness = {{ {stiffness} }} }}");
    let table = |values: [f64; 7]| {
        let entries = values.iter().enumerate().map(|(i, k)| format!("panda_joint{} = {k:.1}", i + 1));
        entries.collect::<Vec<_>>().join(", ")
    };
    let command = set(&table(K)).replace(" } }", &format!(" }}, damping = {{ {} }} }}", table(D)));
    let mut snapshot = direct(8, 1.0, &[]);
    let m = &mut snapshot.manifest;
    let period = format!("time.dt={:?}", 1e-4 * hold as f64);
    let every = format!("time.policy_every={}", 200 / hold);
    let set = [command, ON.into(), "time.sim_dt=0.0001".into(), period, every];
    let observation = std::mem::take(&mut m.task.state.observation);
    m.task = tasks::load("Panda-reach", &set).expect("task").task;
    m.task.state.observation = observation;
    (m.action_lower, m.action_upper) = (vec![-10.0; 7], vec![10.0; 7]);
    scramble(&mut snapshot.networks.policy, 8, 2.0);
    let mut controller = Controller::new(&snapshot).expect("controller");
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    let mut plant = Driven::new();
    plant.sim.set_state(&[0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], &[0.0; 7]).expect("state");
    let (mut worst, mut broken, mut fastest, mut raw) = ([f64::NEG_INFINITY; 3], [0; 3], 0.0_f64, 0);
    for _ in 0..ticks {
        state.q.copy_from_slice(plant.sim.qpos());
        state.v.copy_from_slice(plant.sim.qvel());
        state.obs[..7].copy_from_slice(&state.q);
        state.obs[7..14].copy_from_slice(&state.v);
        controller.update(&state, &noise, &mut out);
        raw += u64::from(out.next.ledger.raw_violations.total() > 0);
        let mut here = [f64::NEG_INFINITY; 3];
        plant.hold(&out.action, hold, |forces| {
            let excess = (0..7).map(|i| forces[i].abs() - limits.effort_limit()[i]).fold(f64::MIN, f64::max);
            here[2] = here[2].max(excess);
        });
        for i in 0..7 {
            let (q, v) = (plant.sim.qpos()[i], plant.sim.qvel()[i]);
            let beyond = (q - limits.upper_position_limit()[i]).max(limits.lower_position_limit()[i] - q);
            here[0] = here[0].max(beyond);
            here[1] = here[1].max(v.abs() - limits.velocity_limit()[i]);
            fastest = fastest.max(v.abs());
        }
        for k in 0..3 {
            worst[k] = worst[k].max(here[k]);
            broken[k] += u64::from(here[k] > 0.0);
        }
    }
    let [q, v, tau] = broken;
    let most = worst.iter().copied().fold(f64::MIN, f64::max);
    println!(
        "| targets of drives | {} ms | {ticks} | {raw} | {q} | {v} | {tau} | {most:.1e} |",
        hold as f64 / 10.0
    );
    (worst, raw, fastest)
}

/// The network's targets are held for 20 ms; the guard runs at 1 kHz.
#[test]
fn targets_of_drives_break_no_limit_at_any_instant() {
    let (worst, raw, fastest) = driven(10, ticks() / 2);
    assert!(raw > 1000 && fastest > 0.5, "the attack must be one: {raw} ticks, {fastest} rad/s");
    assert!(worst.iter().all(|w| *w <= 0.0), "{worst:?}");
}

/// The guard itself has the period of 20 ms. It knows the mean force of a drive over the period, not how the arm moves within it: a joint may end
/// a little beyond the file's range, although the task keeps a margin of 0.01 rad.
#[test]
fn targets_of_drives_that_are_held_for_twenty_milliseconds() {
    let (worst, raw, fastest) = driven(200, ticks() / 20);
    assert!(raw > 1000 && fastest > 0.5, "the attack must be one: {raw} ticks, {fastest} rad/s");
    let [q, v, tau] = worst;
    assert!(q < 0.005 && v <= 0.0 && tau <= 0.0, "{worst:?}");
}

fn locomotion(task: &str) -> (Box<dyn Env>, Controller) {
    let snapshot = training(task, "ppo", 1, 1, &[]).snapshot().clone();
    (make_env(&snapshot).expect("environment"), Controller::new(&snapshot).expect("controller"))
}

/// What is foreseen changes nothing of what follows, and the step that takes it over is the step.
#[test]
fn a_foreseen_step_is_the_step_bit_for_bit() {
    for task in ["HalfCheetah-v5", "Ant-v5"] {
        let (mut plain, _) = locomotion(task);
        let mut watched = plain.another().expect("another");
        let (nq, nv, n) = (plain.spec().nq, plain.spec().nv, plain.spec().n_act());
        let (mut q, mut v, mut rng) = (vec![0.0; nq], vec![0.0; nv], stream(3, 1));
        plain.reset(&mut stream(3, 0)).expect("reset");
        watched.reset(&mut stream(3, 0)).expect("reset");
        for tick in 0..300 {
            let action: Vec<f64> = (0..n).map(|_| rng.random_range(-1.0..1.0)).collect();
            assert!(watched.foresee(&vec![0.5; n], &mut q, &mut v));
            if tick % 3 != 0 {
                assert!(watched.foresee(&action, &mut q, &mut v)); // this one is taken over
            }
            let (a, b) = (plain.step(&action), watched.step(&action));
            assert_eq!(a, b, "{task}, tick {tick}");
            let bits = |x: &[f64]| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(plain.qpos()), bits(watched.qpos()), "{task}, tick {tick}");
            if tick % 3 != 0 {
                assert_eq!((bits(&q), bits(&v)), (bits(watched.qpos()), bits(watched.qvel())));
            }
        }
    }
}

/// Ticks of `ticks` random bang-bang actions that end outside the task's limits, without and with the simulator's guard; and how many of the
/// latter the guard had announced.
fn outside(task: &str, ticks: u64) -> [u64; 3] {
    let count = |guarded: bool| {
        let (mut env, controller) = locomotion(task);
        let limits = watched_limits(env.as_ref(), controller.model(), controller.limits());
        let mut foresight = Foresight::new(env.as_ref(), &limits);
        let mut state = controller.state();
        let (mut rng, mut starts) = (stream(5, 1), stream(5, 0));
        env.reset(&mut starts).expect("reset");
        let (mut beyond, mut said) = (0, 0);
        for tick in 0..ticks {
            let n = env.spec().n_act();
            let asked: Vec<f64> = (0..n).map(|_| f64::signum(rng.random_range(-1.0..1.0))).collect();
            let mut action = asked.clone();
            let verdict = match guarded {
                true => foresight.update(env.as_mut(), &mut action),
                false => Verdict::Kept,
            };
            assert!(verdict != Verdict::Kept || action == asked);
            let step = env.step(&action);
            env.state(&mut state.q, &mut state.v);
            let is_outside = controller.excess(&state) != [None; 2];
            assert!(!guarded || is_outside == (verdict == Verdict::Outside), "tick {tick}: {verdict:?}");
            beyond += u64::from(is_outside);
            said += u64::from(verdict == Verdict::Outside);
            if step.terminated || tick % 200 == 199 {
                env.reset(&mut starts).expect("reset");
            }
        }
        [beyond, said]
    };
    let ([without, _], [with, said]) = (count(false), count(true));
    [without, with, said]
}

/// A state that is no number was inside, and an action that the physics gives up at was left as it is.
#[test]
fn what_the_physics_cannot_say_is_not_inside() {
    let new = || Search::new(vec![Bound::velocity(0.3)], &[(-1.0, 1.0)], 0);
    let spoilt = |action: &[f64], values: &mut [f64]| {
        values[0] = if action[0] > 0.5 { f64::NAN } else { action[0] };
        true
    };
    let given_up = |action: &[f64], values: &mut [f64]| {
        values[0] = if action[0] > 0.5 { 0.0 } else { action[0] };
        action[0] <= 0.5
    };
    for (k, foresee) in [&spoilt as &dyn Fn(&[f64], &mut [f64]) -> bool, &given_up].into_iter().enumerate() {
        let mut action = [0.9];
        assert_eq!(new().update(&mut |a, x| foresee(a, x), &mut action), Verdict::Replaced, "{k}");
        assert!(action[0].abs() <= 0.3, "{k}: {action:?}");
    }
    let mut action = [0.9];
    assert_eq!(new().update(&mut |_, _| false, &mut action), Verdict::Outside);
    assert_eq!(action, [0.9], "nothing better was found");
}

/// A speed that falls on the way to the corners, and is within its limit about the middle of the range alone: from a corner slopes lead away, and a draw
/// of 12 numbers does not come there. What is inside costs one step, and a search has an end.
#[test]
fn a_search_begins_anew_where_slopes_lead_away() {
    let steps = std::cell::Cell::new(0);
    let mut foresee = |action: &[f64], values: &mut [f64]| {
        steps.set(steps.get() + 1);
        let away = (action.iter().map(|a| (a - 1.0) * (a - 1.0)).sum::<f64>() / 12.0).sqrt();
        values[0] = if away < 0.5 { 5.0 * away } else { 3.0 - away };
        true
    };
    let new = || Search::new(vec![Bound::velocity(1.0)], &[(0.0, 2.0); 12], 0);
    let corner: [f64; 12] = std::array::from_fn(|k| if k % 3 == 0 { 0.0 } else { 2.0 });
    let (mut found, mut again) = (corner, corner);
    assert_eq!(new().update(&mut foresee, &mut found), Verdict::Replaced);
    assert!(found.iter().all(|a| (a - 1.0).abs() < 0.7), "{found:?}");
    let (mut search, mut inside) = (new(), [1.1; 12]);
    steps.set(0);
    assert_eq!(search.update(&mut foresee, &mut inside), Verdict::Kept);
    assert_eq!((inside, steps.get()), ([1.1; 12], 1));
    search.update(&mut foresee, &mut again);
    assert_eq!(found, again, "the same state and action give another result");

    let mut hopeless = |_: &[f64], values: &mut [f64]| {
        steps.set(steps.get() + 1);
        values[0] = 2.0;
        true
    };
    let mut left = corner;
    steps.set(0);
    assert_eq!(search.update(&mut hopeless, &mut left), Verdict::Outside);
    assert_eq!(left, corner, "nothing better was found");
    assert!(steps.get() <= 470, "{} steps", steps.get());
}

#[test]
fn actions_that_the_simulator_refuses_are_replaced_by_ones_it_allows() {
    let [without, with, said] = outside("HalfCheetah-v5", 3000);
    println!(
        "HalfCheetah, bang-bang: {without} of 3000 ticks outside, with the simulator's guard {with}, all {said} of them announced"
    );
    assert!(without > 300, "{without}: the test could not fail");
    assert!(with <= 15, "{with} of 3000 ticks outside");
}
