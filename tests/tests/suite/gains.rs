//! Drives whose gains are not what the task says: limits hold as far as the doctor tells, and are lost beyond.

use nearl_runtime::controller::Parts;
use nearl_runtime::doctor::advice;
use nearl_runtime::gains::tolerances;
use nearl_runtime::{Controller, Snapshot};
use nearl_tests::training;
use nearl_trainer::rollout::{make_env, stream};
use rand::RngExt;

fn arm() -> String {
    concat!(env!("CARGO_MANIFEST_DIR"), "/../results/transfer/xarm7.toml").to_string()
}

/// A policy that swings its targets from end to end, on an arm whose dampings are all `factor` of what the task says.
fn wild(factor: f64) -> Snapshot {
    let random = format!("random={{ damping = {factor:?} }}");
    let mut snapshot = training(&arm(), "ppo", 1, 1, &[&random]).snapshot().clone();
    let mut rng = stream(3, 9);
    for layer in &mut snapshot.networks.policy.layers {
        layer
            .weight
            .iter_mut()
            .chain(&mut layer.bias)
            .for_each(|w| *w = 2.0 * (2.0 * rng.random::<f32>() - 1.0));
    }
    snapshot
}

/// How far a joint comes beyond its speed limit, as a share of it, in twenty episodes of a second.
fn excess(factor: f64) -> f64 {
    let snapshot = wild(factor);
    let (mut env, mut controller) =
        (make_env(&snapshot).expect("env"), Controller::new(&snapshot).expect("controller"));
    let limit = controller.limits().velocity.clone();
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    let (mut rng, mut worst) = (stream(5, 0), 0.0_f64);
    for tick in 0..4000 {
        if tick % 200 == 0 {
            env.reset(&mut rng).expect("reset");
            controller.reset();
        }
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        let _ = controller.update(&state, &noise, &mut out);
        env.step(&out.action);
        let beyond = env.qvel().iter().zip(&limit).map(|(v, limit)| v.abs() / limit - 1.0);
        worst = beyond.fold(worst, f64::max);
    }
    worst
}

#[test]
fn a_joint_runs_away_where_gains_are_off_by_more_than_the_doctor_tells() {
    let snapshot = wild(1.0);
    let m = &snapshot.manifest;
    let parts = Parts::new(m).expect("parts");
    let controllable = parts.layout.controllable();
    let drives = Parts::drives(m, &parts.model, controllable).expect("drives");
    let all = tolerances(&parts.model, parts.projector.limits(), controllable, &drives);
    let share = all.iter().map(|t| t.share).fold(f64::INFINITY, f64::min);
    assert!((0.04..0.08).contains(&share), "{all:?}");
    let said = advice(m).expect("advice").join("\n");
    assert!(said.contains("doctor-gains") && said.contains("'joint7' to 6 %"), "{said}");

    let exact = excess(1.0);
    assert!(exact < 1e-9, "{exact}");
    let known = excess(1.0 - 0.5 * share);
    assert!(known < 0.1, "off by half of what may be: {known}");
    let unknown = excess(1.0 - 4.0 * share);
    assert!(unknown > 1.0, "off by four times what may be: {unknown}");
}
