//! What every task must do, whichever it is; then what single tasks promise.

use std::collections::HashSet;
use std::time::Duration;

use nearl_trainer::env::{
    self, ChaCha8Rng, Env, EnvError, Excess, Fault, LimitError, Limits, Meter, SeedableRng,
};
use nearl_trainer::mj::Inverse;
use nearl_trainer::tasks;
use rand::RngExt;

fn every_task() -> impl Iterator<Item = Box<dyn Env>> {
    env::names().map(|name| env::make(name).expect("a registered task can be made"))
}

/// Who lists the tasks need not compile a robot to know how long an episode is.
#[test]
fn the_registry_knows_how_long_an_episode_is() {
    for entry in env::REGISTRY {
        let spec = env::make(entry.name).expect("a registered task can be made");
        assert_eq!(entry.max_episode_steps, spec.spec().max_episode_steps, "{}", entry.name);
        assert_eq!(tasks::max_episode_steps(entry.name), Some(entry.max_episode_steps), "{}", entry.name);
    }
    assert_eq!(tasks::max_episode_steps("Hopper-velocity"), Some(1000), "the environment it names");
    assert_eq!(tasks::max_episode_steps("cart-pole"), None);
}

fn seeded(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

fn observation(env: &dyn Env) -> Vec<f64> {
    let mut obs = vec![f64::NAN; env.spec().n_obs()];
    env.observe(&mut obs);
    obs
}

fn random_action(env: &dyn Env, rng: &mut ChaCha8Rng) -> Vec<f64> {
    env.spec()
        .action_low()
        .zip(env.spec().action_high())
        .map(|(low, high)| rng.random_range(low..high))
        .collect()
}

/// Observations and rewards of an episode start.
fn episode(env: &mut dyn Env, seed: u64, steps: usize) -> Vec<f64> {
    let mut rng = seeded(seed);
    env.reset(&mut rng).expect("a reset");
    let mut seen = observation(env);
    for _ in 0..steps {
        let action = random_action(env, &mut rng);
        seen.push(env.step(&action).reward);
        seen.extend(observation(env));
    }
    seen
}

#[test]
fn names_sizes_and_ranges_fit_together() {
    for env in every_task() {
        let spec = env.spec();
        let unique: HashSet<_> = spec.obs.iter().collect();
        assert_eq!(unique.len(), spec.n_obs(), "{}: observation names are unique", spec.name);
        assert_eq!((spec.nq, spec.nv), (env.qpos().len(), env.qvel().len()));
        assert!((spec.dt - spec.sim_dt * spec.sub_steps as f64).abs() < 1e-15);
        assert!(spec.action_low().zip(spec.action_high()).all(|(low, high)| low < high && high.is_finite()));
        let joints: HashSet<_> = spec.joints.iter().map(|j| j.name.as_str()).collect();
        assert!(spec.actuators.iter().all(|a| joints.contains(a.joint.as_str()) && a.dof < spec.nv));
    }
    let sizes: Vec<_> = every_task().map(|e| (e.spec().n_obs(), e.spec().n_act())).collect();
    assert_eq!(sizes, [(17, 6), (11, 3), (17, 6), (105, 8), (20, 7)]);
}

#[test]
fn observation_entries_are_what_their_names_say() {
    for mut env in every_task() {
        env.reset(&mut seeded(5)).expect("a reset");
        let obs = observation(env.as_ref());
        for joint in env.spec().joints.iter().filter(|j| j.nv == 1) {
            let entry = |name: String| env.spec().obs.iter().position(|n| *n == name).map(|i| obs[i]);
            if let Some(q) = entry(format!("q.{}", joint.name)) {
                assert_eq!(q, env.qpos()[joint.idx_q], "{} {}", env.spec().name, joint.name);
            }
            let v = entry(format!("v.{}", joint.name)).expect("every joint's velocity is observed");
            assert_eq!(v, env.qvel()[joint.idx_v], "{} {}", env.spec().name, joint.name);
        }
    }
}

#[test]
fn a_seed_gives_an_episode_and_another_seed_another() {
    for mut env in every_task() {
        let first = episode(env.as_mut(), 1, 30);
        assert!(first.iter().all(|x| x.is_finite()));
        let mut other = env.another().expect("one more");
        let bits = |e: &[f64]| e.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&episode(other.as_mut(), 1, 30)), bits(&first), "{}", env.spec().name);
        // An environment with a past gives the same episode as a new one.
        assert_eq!(bits(&episode(env.as_mut(), 1, 30)), bits(&first), "{}", env.spec().name);
        assert_ne!(episode(env.as_mut(), 2, 30), first, "{}", env.spec().name);
    }
}

#[test]
fn state_and_goal_repeat_an_episode() {
    for mut env in every_task() {
        env.reset(&mut seeded(3)).expect("a reset");
        let (qpos, qvel, goal) = (env.qpos().to_vec(), env.qvel().to_vec(), env.goal().to_vec());
        let run = |env: &mut dyn Env| {
            let mut rng = seeded(9);
            (0..20).map(|_| env.step(&random_action(env, &mut rng)).reward.to_bits()).collect::<Vec<_>>()
        };
        let first = run(env.as_mut());
        let mut other = env::make(&env.spec().name).expect("a task");
        if !goal.is_empty() {
            other.set_goal(&goal).expect("a goal");
        }
        other.set_state(&qpos, &qvel).expect("a state");
        assert_eq!(run(other.as_mut()), first, "{}", env.spec().name);
    }
}

#[test]
fn bad_input_is_a_fault_or_an_error_and_never_simulated() {
    for mut env in every_task() {
        env.reset(&mut seeded(0)).expect("a reset");
        let before = (env.qpos().to_vec(), env.sim().time());
        let step = env.step(&vec![f64::NAN; env.spec().n_act()]);
        assert_eq!((step.fault, step.terminated, step.reward), (Fault::Action, true, 0.0));
        assert_eq!((env.qpos().to_vec(), env.sim().time()), before);
        assert_eq!(env.counters().faults, 1);

        let (nq, nv) = (env.spec().nq, env.spec().nv);
        assert!(env.set_state(&vec![0.0; nq + 1], &vec![0.0; nv]).is_err());
        assert!(env.set_state(&vec![0.0; nq], &vec![f64::INFINITY; nv]).is_err());
        assert!(matches!(env.set_goal(&[0.0; 2]), Err(EnvError::Goal { got: 2, .. })));
        assert_eq!(env.qpos(), before.0);
    }
}

#[test]
fn an_explosion_is_a_fault() {
    for mut env in every_task() {
        let (qpos, nv) = (env.qpos().to_vec(), env.spec().nv);
        env.set_state(&qpos, &vec![1e9; nv]).expect("a finite state");
        let action = vec![0.0; env.spec().n_act()];
        let faulty = (0..50).map(|_| env.step(&action)).find(|step| step.fault != Fault::None);
        assert_eq!(
            faulty.map(|s| (s.fault, s.terminated)),
            Some((Fault::Unstable, true)),
            "{}",
            env.spec().name
        );
        env.reset(&mut seeded(0)).expect("a reset");
        assert_eq!(env.step(&action).fault, Fault::None);
    }
}

#[test]
fn actions_outside_the_range_are_counted_and_clamped() {
    for mut env in every_task() {
        env.reset(&mut seeded(4)).expect("a reset");
        let mut other = env.another().expect("one more");
        other.set_state(env.qpos(), env.qvel()).expect("a state");
        let highest: Vec<_> = env.spec().action_high().collect();
        env.step(&highest);
        other.step(&highest.iter().map(|a| 3.0 * a).collect::<Vec<_>>());
        assert_eq!(env.qpos(), other.qpos(), "{}", env.spec().name);
        assert_eq!(env.counters().saturations, 0);
        assert_eq!(other.counters().saturations, highest.len() as u64);

        // What acted is the clamped action through its gear.
        let mut force = vec![0.0; env.spec().nv];
        other.sim().applied_force(&mut force);
        for (a, highest) in env.spec().actuators.iter().zip(&highest) {
            assert!((force[a.dof] - a.gear * highest).abs() <= 1e-12 * force[a.dof].abs(), "{}", a.name);
        }
    }
}

#[test]
fn reset_noise_is_gymnasiums() {
    // HalfCheetah: positions uniform in +-0.1, velocities Gaussian of standard deviation 0.1; Hopper: both uniform in +-0.005.
    let spread = |name: &str| {
        let (mut env, mut rng) = (env::make(name).expect("a task"), seeded(11));
        let (mut positions, mut velocities) = (Vec::new(), Vec::new());
        for _ in 0..2000 {
            env.reset(&mut rng).expect("a reset");
            positions.push(env.qpos()[2]);
            velocities.extend_from_slice(env.qvel());
        }
        let deviation = |xs: &[f64]| (xs.iter().map(|x| x * x).sum::<f64>() / xs.len() as f64).sqrt();
        let largest = |xs: &[f64]| xs.iter().fold(0.0f64, |m, x| m.max(x.abs()));
        (largest(&positions), deviation(&positions), largest(&velocities), deviation(&velocities))
    };
    let (largest_q, deviation_q, largest_v, deviation_v) = spread("HalfCheetah-v5");
    assert!(largest_q <= 0.1 && (deviation_q - 0.1 / 3f64.sqrt()).abs() < 3e-3);
    assert!(largest_v > 0.3 && (deviation_v - 0.1).abs() < 3e-3);
    let (largest_q, deviation_q, largest_v, deviation_v) = spread("Hopper-v5");
    assert!(largest_q <= 5e-3 && (deviation_q - 5e-3 / 3f64.sqrt()).abs() < 2e-4);
    assert!(largest_v <= 5e-3 && (deviation_v - 5e-3 / 3f64.sqrt()).abs() < 2e-4);
}

#[test]
fn hopper_and_walker_observe_speeds_up_to_ten_as_gymnasium_does() {
    for (name, seen) in [("HalfCheetah-v5", 25.0), ("Hopper-v5", 10.0), ("Walker2d-v5", 10.0)] {
        let mut env = env::make(name).expect("a task");
        let (qpos, mut qvel) = (env.qpos().to_vec(), env.qvel().to_vec());
        (qvel[3], qvel[4]) = (25.0, -25.0);
        env.set_state(&qpos, &qvel).expect("a state");
        let velocities = observation(env.as_ref()).split_off(env.spec().nq - 1);
        assert_eq!((velocities[3], velocities[4]), (seen, -seen), "{name}");
    }
}

#[test]
fn unknown_tasks_are_named_with_what_they_might_have_been() {
    let message = |name: &str| env::make(name).err().expect("no such task").to_string();
    assert_eq!(message("halfcheetah"), "there is no task 'halfcheetah': did you mean 'HalfCheetah-v5'?");
    assert_eq!(message("Hopper-v4"), "there is no task 'Hopper-v4': did you mean 'Hopper-v5'?");
    assert!(
        message("zzz").ends_with("it is one of HalfCheetah-v5, Hopper-v5, Walker2d-v5, Ant-v5, Panda-reach")
    );
}

#[test]
fn a_free_joint_is_given_in_pinocchios_convention() {
    let mut env = env::make("Ant-v5").expect("a task");
    let (mut qpos, mut qvel) = (env.qpos().to_vec(), env.qvel().to_vec());
    // A quarter turn about the vertical axis, given with twice the length; one metre per second along the world's x.
    let half = std::f64::consts::FRAC_PI_4;
    qpos[3..7].copy_from_slice(&[2.0 * half.cos(), 0.0, 0.0, 2.0 * half.sin()]);
    qvel[..6].copy_from_slice(&[1.0, 0.0, 0.5, 0.1, 0.2, 0.3]);
    env.set_state(&qpos, &qvel).expect("a state");
    let (mut q, mut v) = (vec![0.0; 15], vec![0.0; 14]);
    env.state(&mut q, &mut v);
    let close = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-15);
    assert!(close(&q[3..7], &[0.0, 0.0, half.sin(), half.cos()]), "{:?}", &q[3..7]);
    // The body's own x axis points along the world's y: world x is the body's -y.
    assert!(close(&v[..6], &[0.0, -1.0, 0.5, 0.1, 0.2, 0.3]), "{:?}", &v[..6]);
    assert_eq!((&q[..3], &q[7..], &v[6..]), (&qpos[..3], &qpos[7..], &qvel[6..]));
}

#[test]
fn the_pandas_hand_is_where_its_drawing_says() {
    let mut env = env::make("Panda-reach").expect("a task");
    env.set_goal(&[0.0; 3]).expect("a goal");
    env.set_state(&[0.0; 7], &[0.0; 7]).expect("a state");
    let obs = observation(env.as_ref());
    // Straight up: 0.333 + 0.316 + 0.384 high, the flange 0.088 forward and 0.107 down.
    let hand = [0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107];
    assert!((0..3).all(|k| (obs[17 + k] + hand[k]).abs() < 1e-12), "{:?}", &obs[17..]);
}

#[test]
fn the_pandas_error_is_that_of_the_state_it_is_observed_with() {
    let (mut env, mut rng) = (env::make("Panda-reach").expect("a task"), seeded(6));
    env.reset(&mut rng).expect("a reset");
    for _ in 0..50 {
        env.step(&random_action(env.as_ref(), &mut rng));
        let mut same = env.another().expect("one more");
        same.set_goal(env.goal()).expect("a goal");
        same.set_state(env.qpos(), env.qvel()).expect("a state");
        assert_eq!(observation(env.as_ref()), observation(same.as_ref()));
    }
}

#[test]
fn panda_goals_are_reachable_and_differ() {
    let (mut env, mut rng) = (env::make("Panda-reach").expect("a task"), seeded(2));
    let mut goals = Vec::new();
    for _ in 0..200 {
        env.reset(&mut rng).expect("a reset");
        let goal = [env.goal()[0], env.goal()[1], env.goal()[2]];
        let from_shoulder = (goal[0].powi(2) + goal[1].powi(2) + (goal[2] - 0.333).powi(2)).sqrt();
        assert!(goal[2] > 0.05 && from_shoulder < 0.855 + 0.107, "{goal:?}");
        goals.push(goal.map(f64::to_bits));
    }
    goals.sort_unstable();
    goals.dedup();
    assert_eq!(goals.len(), 200);
}

#[test]
fn the_panda_moves_exactly_as_its_acceleration_says() {
    let (mut env, mut rng) = (env::make("Panda-reach").expect("a task"), seeded(8));
    env.reset(&mut rng).expect("a reset");
    let (dt, nv, mut compared) = (env.spec().dt, env.spec().nv, 0);
    for _ in 0..1000 {
        let action: Vec<f64> = random_action(env.as_ref(), &mut rng).iter().map(|a| 0.2 * a).collect();
        let (q, v) = (env.qpos().to_vec(), env.qvel().to_vec());
        if env.spec().joints.iter().zip(&q).any(|(joint, q)| *q <= joint.range[0] || *q >= joint.range[1]) {
            env.reset(&mut rng).expect("a reset"); // A joint stop adds a force of its own.
            continue;
        }
        compared += 1;
        // M a = action - nle + passive, solved by hand from MuJoCo's own terms at the state before.
        let mut before = env.another().expect("one more");
        before.set_state(&q, &v).expect("a state");
        let mut mass = vec![0.0; nv * nv];
        before.sim().mass(&mut mass).expect("a mass matrix");
        let (nle, passive) = (before.sim().nle().to_vec(), before.sim().passive().to_vec());
        env.step(&action);
        let a: Vec<f64> = (0..nv).map(|i| (env.qvel()[i] - v[i]) / dt).collect();
        for i in 0..nv {
            let ma: f64 = (0..nv).map(|j| mass[i * nv + j] * a[j]).sum();
            assert!((ma - (action[i] - nle[i] + passive[i])).abs() < 1e-8, "joint {i}");
            assert!((env.qpos()[i] - (q[i] + dt * env.qvel()[i])).abs() < 1e-14, "joint {i}");
        }
    }
    assert!(compared > 900, "{compared}");
}

#[test]
fn a_held_pose_earns_more_near_the_goal() {
    let mut env = env::make("Panda-reach").expect("a task");
    let ready = {
        env.reset(&mut seeded(0)).expect("a reset");
        env.qpos().to_vec()
    };
    env.set_goal(&[0.0; 3]).expect("a goal");
    env.set_state(&ready, &[0.0; 7]).expect("a state");
    let hand: Vec<f64> = observation(env.as_ref())[17..].iter().map(|e| -e).collect();
    let mut reward_at = |offset: f64| {
        env.set_goal(&[hand[0] + offset, hand[1], hand[2]]).expect("a goal");
        env.set_state(&ready, &[0.0; 7]).expect("a state");
        let gravity = env.sim().nle().to_vec();
        env.step(&gravity).reward
    };
    let rewards: Vec<_> = [0.0, 0.02, 0.05, 0.2, 0.5].map(&mut reward_at).to_vec();
    assert!(rewards.windows(2).all(|pair| pair[0] > pair[1]), "{rewards:?}");
    assert!((rewards[0] - 1e-3 * 10.0).abs() < 1e-6, "{rewards:?}");
    assert!((rewards[4] + 1e-3 * 5.0).abs() < 1e-6, "{rewards:?}");
}

fn limits() -> Limits {
    Limits {
        lower_position: vec![-1.0, f64::NEG_INFINITY],
        upper_position: vec![2.0, f64::INFINITY],
        velocity: vec![3.0, f64::INFINITY],
        acceleration: vec![40.0, f64::INFINITY],
        effort: vec![10.0, 5.0],
    }
}

#[test]
fn the_meter_counts_what_is_outside() {
    let mut meter = Meter::new(limits(), 1e-9, 0.1).expect("limits");
    assert_eq!(meter.records()[3], None, "no force was given yet");
    meter.begin(&[-3.0, 0.0]);
    assert_eq!(meter.observe(&[2.0, 1e9], &[-3.0, 1e9], Some(&[10.0, -5.0])), Excess::default());
    assert_eq!(meter.observe(&[2.0 + 1e-12, 0.0], &[0.0; 2], Some(&[0.0; 2])).position, 2.0 + 1e-12 - 2.0);
    assert!(meter.records().iter().all(|found| found.is_some_and(|w| w.states == 0)));
    // From rest to 5.5 rad/s in 0.1 s are 55 rad/s^2.
    assert_eq!(
        meter.observe(&[-1.5, 0.0], &[5.5, 0.0], Some(&[0.0, 7.0])),
        Excess { position: 0.5, velocity: 2.5, acceleration: 15.0, effort: 2.0 }
    );
    meter.begin(&[0.0; 2]);
    meter.observe(&[-1.25, 0.0], &[0.0; 2], None);
    let (position, acceleration) = (meter.position(), meter.acceleration());
    let effort = meter.effort().expect("forces were given");
    assert_eq!((position.states, position.excess, position.index, position.at), (2, 0.5, 0, 2));
    assert_eq!((acceleration.states, acceleration.excess, acceleration.index), (1, 15.0, 0));
    assert_eq!((effort.states, effort.excess, effort.index, effort.at), (1, 2.0, 1, 2));
    assert_eq!(meter.states(), 4);
}

/// MuJoCo's inverse dynamics gives back what drove the robot, from its motion alone.
#[test]
fn the_inverse_finds_the_force_in_the_motion() {
    let mut found = 0;
    for mut env in every_task() {
        let Some(mut inverse) = Inverse::new(env.sim()).expect("memory") else { continue };
        env.reset(&mut seeded(3)).expect("reset");
        let (n_act, nv) = (env.spec().n_act(), env.spec().nv);
        let (mut told, mut force) = (vec![0.0; nv], vec![0.0; nv]);
        for k in 0..200 {
            let share = |i: usize| 0.5 * (0.1 * k as f64 + i as f64).sin();
            let action: Vec<f64> = (0..n_act).map(|i| share(i) * env.spec().actuators[i].high).collect();
            env.step(&action);
            env.sim().applied_force(&mut told);
            inverse.force(env.sim(), &mut force).expect("an inverse");
            for (i, (a, b)) in force.iter().zip(&told).enumerate() {
                let name = &env.spec().name;
                assert!(
                    (a - b).abs() < 1e-6 * (1.0 + b.abs()),
                    "{name}, tick {k}, dof {i}: {a} instead of {b}"
                );
            }
        }
        found += 1;
    }
    assert!(found > 0, "no task has an integrator with an inverse");
}

#[test]
fn the_meter_takes_nothing_unbelievable_for_inside() {
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for entry in 0..2 {
            let mut meter = Meter::new(limits(), 1e-9, 0.1).expect("limits");
            let mut q = [0.0; 2];
            q[entry] = bad;
            assert_eq!(meter.observe(&q, &[0.0; 2], None).position, f64::INFINITY);
            assert_eq!(meter.observe(&[0.0; 2], &q, None).velocity, f64::INFINITY);
            assert_eq!((meter.position().states, meter.velocity().states), (1, 1));
        }
    }
}

#[test]
fn limits_that_make_no_sense_are_refused() {
    let crossed = Limits { lower_position: vec![3.0, 0.0], ..limits() };
    assert!(matches!(
        Meter::new(crossed, 0.0, 0.1),
        Err(LimitError::Empty { what: "position", index: 0, .. })
    ));
    let negative = Limits { velocity: vec![3.0, -1.0], ..limits() };
    assert!(matches!(
        Meter::new(negative, 0.0, 0.1),
        Err(LimitError::Empty { what: "velocity", index: 1, .. })
    ));
    let short = Limits { effort: vec![1.0], ..limits() };
    assert!(matches!(Meter::new(short, 0.0, 0.1), Err(LimitError::Lengths { effort: 1, .. })));
}

#[test]
fn the_physics_benchmark_steps_every_task() {
    for env in every_task() {
        let (name, duration) = (&env.spec().name, Duration::from_millis(20));
        let measured = env::bench::physics(env.as_ref(), 2, duration).expect("a registered task");
        assert!(measured.steps >= 2 * 8 && measured.seconds > 0.0, "{name}: {measured:?}");
    }
}
