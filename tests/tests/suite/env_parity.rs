//! The locomotion tasks against Gymnasium 1.4.0 on MuJoCo 3.17.0: what `fixtures/record_gymnasium.py` recorded.
//!
//! States must be equal to the last bit, so must observations (they are copied or clamped from states and forces);
//! rewards may differ by the order of a sum.

use std::path::Path;

use nearl_trainer::env::{self, Env, Fault};
use serde_json::Value;

fn recorded() -> Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/gymnasium.json");
    serde_json::from_str(&std::fs::read_to_string(&path).expect("the fixture is readable"))
        .expect("the fixture is JSON")
}

fn numbers(digits: &Value) -> Vec<f64> {
    let digits = digits.as_str().expect("hexadecimal digits");
    let parse =
        |at| f64::from_bits(u64::from_str_radix(&digits[at..at + 16], 16).expect("hexadecimal digits"));
    (0..digits.len()).step_by(16).map(parse).collect()
}

fn bits(values: &[f64]) -> Vec<u64> {
    values.iter().map(|v| v.to_bits()).collect()
}

/// Compares state and observation, bit for bit.
fn assert_same(env: &dyn Env, expected: &Value, at: &str) {
    let mut obs = vec![0.0; env.spec().n_obs()];
    env.observe(&mut obs);
    assert_eq!(bits(env.qpos()), bits(&numbers(&expected["qpos"])), "qpos, {at}");
    assert_eq!(bits(env.qvel()), bits(&numbers(&expected["qvel"])), "qvel, {at}");
    assert_eq!(bits(&obs), bits(&numbers(&expected["obs"])), "obs, {at}");
}

fn compare(episode: &Value) -> (usize, usize) {
    let task = episode["task"].as_str().expect("a task");
    let mut env = env::make(task).expect("a task of ours");
    env.set_state(&numbers(&episode["qpos"]), &numbers(&episode["qvel"])).expect("a state");
    assert_same(env.as_ref(), episode, &format!("{task}, start"));

    let mut steps = episode["steps"].as_array().expect("steps").iter().peekable();
    let (mut compared, mut terminations) = (0, 0);
    for (i, action) in episode["actions"].as_array().expect("actions").iter().enumerate() {
        let step = env.step(&numbers(action));
        assert_eq!(step.fault, Fault::None);
        let Some(expected) = steps.next_if(|s| s["index"] == i) else { continue };
        let at = format!("{task}, step {i}");
        assert_same(env.as_ref(), expected, &at);
        let reward = numbers(&expected["reward"])[0];
        assert!((step.reward - reward).abs() <= 1e-12, "{at}: reward {} instead of {reward}", step.reward);
        assert_eq!(step.terminated, expected["terminated"].as_bool().expect("a truth value"), "{at}");
        compared += 1;
        terminations += usize::from(step.terminated);
    }
    assert!(steps.next().is_none(), "{task}: a recorded step was not reached");
    (compared, terminations)
}

#[test]
fn tasks_equal_gymnasium_step_for_step() {
    let recorded = recorded();
    assert_eq!(
        (recorded["gymnasium"].as_str(), recorded["mujoco"].as_str()),
        (Some("1.4.0"), Some("3.17.0"))
    );
    let episodes = recorded["episodes"].as_array().expect("episodes");
    let counts: Vec<_> = episodes.iter().map(compare).collect();
    assert_eq!(episodes.len(), 8);
    assert!(counts.iter().all(|(compared, _)| *compared >= 20));
    // Falling robots are among them, so the flag was compared in both positions.
    let terminations: usize = counts.iter().map(|(_, terminations)| terminations).sum();
    assert!(terminations > 0 && terminations < counts.iter().map(|(c, _)| c).sum());
}

#[test]
fn a_different_start_gives_different_states() {
    let recorded = recorded();
    let episode = &recorded["episodes"][0];
    let mut env = env::make("HalfCheetah-v5").expect("a task of ours");
    let mut qpos = numbers(&episode["qpos"]);
    qpos[3] += 1e-9;
    env.set_state(&qpos, &numbers(&episode["qvel"])).expect("a state");
    env.step(&numbers(&episode["actions"][0]));
    assert_ne!(bits(env.qpos()), bits(&numbers(&episode["steps"][0]["qpos"])));
}
