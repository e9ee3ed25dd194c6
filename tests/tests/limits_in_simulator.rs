//! The promise: a torque-controlled arm never breaks a limit in the simulator's own state, whatever the policy proposes;
//! without the projection the same run does.

use nearl_runtime::Controller;
use nearl_runtime::constraints::Rung;
use nearl_tests::random_policy;
use nearl_trainer::env::{Env, Meter};
use nearl_trainer::plant::{TOLERANCE, watched_limits};
use nearl_trainer::rollout::{make_env, stream};

/// Ticks of 1 ms.
const TICKS: usize = 100_000;

struct Outcome {
    position: u64,
    velocity: u64,
    torque: u64,
    worst: f64,
    /// Ticks whose target the independent checker refused.
    refused: u64,
    braked: u64,
}

fn run(seed: u64, projection: bool, ticks: usize) -> Outcome {
    run_at(seed, projection, ticks, 0.001)
}

/// With a control period of `dt` [s].
fn run_at(seed: u64, projection: bool, ticks: usize, dt: f64) -> Outcome {
    let mut snapshot = random_policy("Panda-reach", seed, 3.0);
    let time = &mut snapshot.manifest.task.time;
    (time.dt, time.sim_dt) = (dt, dt);
    let mut env = make_env(&snapshot).expect("environment");
    let mut controller = Controller::new(&snapshot).expect("controller");
    controller.set_projection(projection);
    let limits = watched_limits(env.as_ref(), controller.model(), controller.limits());
    let mut meter = Meter::new(limits, TOLERANCE).expect("limits");
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    let mut force = vec![0.0; env.spec().nv];
    env.reset(&mut stream(seed, 0)).expect("reset");
    let (mut refused, mut braked) = (0, 0);
    for _ in 0..ticks {
        observe(env.as_ref(), &mut state);
        let status = controller.update(&state, &noise, &mut out);
        // The stored brake is a checked way to stop; only the joints' own brakes are not.
        braked += u64::from(!status.is_ok() && out.next.ledger.rung == Rung::Brake);
        refused += u64::from(out.next.ledger.violations.total() > 0);
        env.step(&out.action);
        env.sim().applied_force(&mut force);
        meter.observe(env.qpos(), env.qvel(), &force);
    }
    let (p, v, t) = (meter.position(), meter.velocity(), meter.effort());
    let worst = p.excess.max(v.excess).max(t.excess);
    Outcome { position: p.states, velocity: v.states, torque: t.states, worst, refused, braked }
}

fn observe(env: &dyn Env, state: &mut nearl_runtime::State) {
    env.observe(&mut state.obs);
    env.state(&mut state.q, &mut state.v);
}

#[test]
fn a_random_network_breaks_no_limit_of_the_panda() {
    for seed in [1, 2] {
        let o = run(seed, true, TICKS / 2);
        let broken = (o.position, o.velocity, o.torque);
        assert_eq!(
            broken,
            (0, 0, 0),
            "seed {seed}: worst excess {:e}, targets refused {}",
            o.worst,
            o.refused
        );
        assert_eq!(
            (o.refused, o.braked),
            (0, 0),
            "seed {seed}: every target is certified and none needed the joints' own brakes"
        );
    }
}

/// What is simulated has the period that the constraints reckon with.
#[test]
fn another_rate_breaks_none_either() {
    for dt in [0.002, 0.0005, 0.0001] {
        let o = run_at(3, true, TICKS / 5, dt);
        assert_eq!((o.position, o.velocity, o.torque), (0, 0, 0), "{dt} s: worst excess {:e}", o.worst);
    }
}

#[test]
fn without_projection_the_same_network_breaks_them() {
    let o = run(1, false, TICKS / 10);
    assert!(
        o.position + o.velocity > 100,
        "position {}, velocity {}: the test above could not fail",
        o.position,
        o.velocity
    );
}
