//! A control tick allocates nothing; where Clarabel answers, its own timers take one small block a solve.

use nearl_runtime::Controller;
use nearl_tests::{random_policy, training};
use nearl_trainer::allocations::{Counting, allocations};
use nearl_trainer::rollout::{make_env, stream};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations and Clarabel solves of `ticks` updates in closed loop.
fn count(snapshot: &nearl_runtime::Snapshot, ticks: usize) -> (u64, u64) {
    let (mut env, mut controller) =
        (make_env(snapshot).expect("env"), Controller::new(snapshot).expect("controller"));
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    env.reset(&mut stream(0, 0)).expect("reset");
    let (mut made, mut solves) = (0, 0);
    for _ in 0..ticks {
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        let before = allocations();
        controller.update(&state, &noise, &mut out);
        made += allocations() - before;
        solves += u64::from(out.next.ledger.rung == nearl_constraints::Rung::Clarabel);
        if env.step(&out.action).terminated {
            env.reset(&mut stream(1, 0)).expect("reset");
        }
    }
    (made, solves)
}

#[test]
fn a_step_of_a_user_task_allocates_nothing() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/hopper.toml");
    let mut env = nearl_trainer::tasks::env(file).expect("task");
    let mut obs = vec![0.0; env.spec().n_obs()];
    env.reset(&mut stream(0, 0)).expect("reset");
    let before = allocations();
    for _ in 0..100 {
        env.step(&[0.1, -0.2, 0.3]);
        env.observe(&mut obs);
    }
    assert_eq!(allocations() - before, 0);
}

/// What an action must stay near to is forgotten where an episode begins, and known again after its first tick.
#[test]
fn an_episode_that_begins_allocates_nothing_with_limits_on_actions() {
    drop(std::hint::black_box(Box::new(1)));
    assert!(allocations() > 0, "the counter counts");
    for limit in ["rate={thigh_joint=0.2}", "square=0.1", "power=1.0"] {
        let set = format!("constraints.action.{limit}");
        let mut controller =
            Controller::new(training("Hopper-v5", "ppo", 0, 1, &[&set]).snapshot()).expect("controller");
        let (state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
        let before = allocations();
        for tick in 0..100 {
            if tick % 10 == 0 {
                controller.reset();
            }
            controller.update(&state, &noise, &mut out);
        }
        assert_eq!(allocations() - before, 0, "{limit}");
    }
}

#[test]
fn an_update_allocates_nothing_beyond_clarabel() {
    drop(std::hint::black_box(Box::new(1)));
    assert!(allocations() > 0, "the counter counts");
    for task in ["HalfCheetah-v5", "Hopper-v5", "Ant-v5"] {
        let (made, _) = count(training(task, "pid2-ib", 0, 1, &[]).snapshot(), 3000);
        assert_eq!(made, 0, "{task}");
    }
    let (made, solves) = count(&random_policy("Panda-reach", 3, 3.0), 5000);
    assert!(made <= solves, "Panda-reach: {made} allocations for {solves} Clarabel solves");
}
