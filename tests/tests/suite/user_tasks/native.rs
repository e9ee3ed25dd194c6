//! A bundled task, written as a file, is the bundled one.

use nearl_trainer::env::{self, Env};
use nearl_trainer::rollout::stream;
use nearl_trainer::tasks;

use super::{example, fixture, random_action};

/// Rewards, terminations and observations over `steps` of the same states and actions; terminations seen.
fn assert_equal(own: &str, native: &str, steps: usize) -> usize {
    let (mut own, mut native) =
        (tasks::env(&fixture(own)).expect("user task"), env::make(native).expect("task"));
    let mut rng = stream(3, 0);
    let (mut seen, mut expected) = (vec![0.0; own.spec().n_obs()], vec![0.0; native.spec().n_obs()]);
    assert_eq!(own.spec().actuators, native.spec().actuators);
    assert_eq!(own.spec().dt, native.spec().dt);
    let restart = |own: &mut dyn Env, native: &mut dyn Env, rng: &mut env::ChaCha8Rng| {
        native.reset(rng).expect("reset");
        own.set_state(native.qpos(), native.qvel()).expect("state");
    };
    restart(own.as_mut(), native.as_mut(), &mut rng);
    let mut ends = 0;
    for t in 0..steps {
        let action = random_action(native.as_ref(), &mut rng);
        let (a, b) = (own.step(&action), native.step(&action));
        assert!((a.reward - b.reward).abs() < 1e-12, "step {t}: {} {}", a.reward, b.reward);
        assert_eq!((a.terminated, a.fault), (b.terminated, b.fault), "step {t}");
        assert_eq!((own.qpos(), own.qvel()), (native.qpos(), native.qvel()), "step {t}");
        own.observe(&mut seen);
        native.observe(&mut expected);
        assert_eq!(seen, expected, "step {t}");
        if b.terminated {
            ends += 1;
            restart(own.as_mut(), native.as_mut(), &mut rng);
        }
    }
    ends
}

#[test]
fn a_half_cheetah_of_ones_own_is_the_native_one() {
    assert_equal("half_cheetah.toml", "HalfCheetah-v5", 1000);
}

#[test]
fn a_hopper_of_ones_own_ends_its_episodes_as_the_native_one() {
    assert!(assert_equal("hopper.toml", "Hopper-v5", 1000) > 10, "the comparison covers terminations");
}

#[test]
fn starts_are_drawn_as_written_and_repeat_with_their_seed() {
    let mut env = tasks::env(&example("cart-pole.toml").display().to_string()).expect("example");
    let mut drawn = Vec::new();
    for i in 0..200 {
        env.reset(&mut stream(0, i)).expect("reset");
        drawn.push((env.qpos().to_vec(), env.qvel().to_vec()));
    }
    let hinge: Vec<f64> = drawn.iter().map(|(q, _)| q[1]).collect();
    let spread = hinge.iter().map(|h| h * h).sum::<f64>() / 200.0;
    assert!(hinge.iter().all(|h| h.abs() <= 0.1) && (spread - 0.01 / 3.0).abs() < 1e-3, "{spread}");
    assert!(drawn.iter().all(|(q, v)| q[0] == 0.0 && v.iter().all(|v| v.abs() <= 0.05) && v[0] != v[1]));
    let mut other = env.another().expect("another");
    other.reset(&mut stream(0, 199)).expect("reset");
    assert_eq!((other.qpos(), other.qvel()), (env.qpos(), env.qvel()));
}
