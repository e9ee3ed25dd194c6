//! Tasks of one's own on floating robots with drives: what is measured of them by hand arithmetic, what training sees by the runtime's own
//! controller, and everything that is drawn by its seed.

use crate::leg::{columns_of_a_run_that_resumes_bit_for_bit, env_of, leg, refuses_each};
use nearl_runtime::{Controller, State};
use nearl_tests::training;
use nearl_trainer::env::Env;
use nearl_trainer::rollout::{Worker, make_env, stream};
use rand::RngExt;

/// The leg with the expressions of `observed` as its observation.
fn leg_observing(observed: &[&str], more: &[&str]) -> Box<dyn Env> {
    let list: Vec<String> =
        ["q.hip", "v.hip", "q.knee", "v.knee"].iter().chain(observed).map(|e| format!("\"{e}\"")).collect();
    let observation = format!("state.observation=[{}]", list.join(", "));
    env_of(&leg(), &[&[observation.as_str()], more].concat())
}

fn seen(env: &dyn Env) -> Vec<f64> {
    let mut obs = vec![0.0; env.spec().n_obs()];
    env.observe(&mut obs);
    obs[4..].to_vec()
}

/// Rotation matrix (base to world) of a quaternion `w x y z`, entry by entry.
fn matrix(q: &[f64]) -> [[f64; 3]; 3] {
    let [w, x, y, z] = [q[0], q[1], q[2], q[3]];
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

#[test]
fn velocity_and_gravity_of_a_base_are_in_its_axes() {
    let mut env = leg_observing(
        &["base.vx", "base.vy", "base.vz", "base.wx", "base.wz", "gravity.x", "gravity.y", "gravity.z"],
        &[],
    );
    let mut rng = stream(1, 0);
    for _ in 0..50 {
        let mut q: Vec<f64> = (0..9).map(|_| rng.random_range(-1.0..1.0)).collect();
        let length = q[3..7].iter().map(|x| x * x).sum::<f64>().sqrt();
        q[3..7].iter_mut().for_each(|x| *x /= length);
        let v: Vec<f64> = (0..8).map(|_| rng.random_range(-2.0..2.0)).collect();
        env.set_state(&q, &v).expect("state");
        let r = matrix(&q[3..7]);
        let turned = |k: usize, x: [f64; 3]| (0..3).map(|i| r[i][k] * x[i]).sum::<f64>();
        let (linear, down) = ([v[0], v[1], v[2]], [0.0, 0.0, -1.0]);
        let expected = [
            turned(0, linear),
            turned(1, linear),
            turned(2, linear),
            v[3],
            v[5],
            turned(0, down),
            turned(1, down),
            turned(2, down),
        ];
        for (a, b) in seen(env.as_ref()).iter().zip(expected) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
    }
}

/// Dropped with its leg held stiff, the foot falls for sqrt(2 h / g), then carries the robot.
#[test]
fn a_fall_lasts_as_long_as_gravity_says_and_the_foot_carries_the_robot() {
    let more = [
        "commands={}",
        "pushes={}",
        "termination={}",
        "reward={ alive = 1.0 }",
        "command.stiffness=400.0",
        "command.damping=10.0",
    ];
    let mut env = leg_observing(&["air.foot", "landed.foot", "load.foot", "contact.foot", "z.foot"], &more);
    let mut q = vec![0.0; 9];
    (q[2], q[3]) = (0.6 + 0.05 + 0.1, 1.0);
    env.set_state(&q, &[0.0; 8]).expect("state");
    let (mut landed, mut load) = (Vec::new(), Vec::new());
    for _ in 0..40 {
        env.step(&[0.0, 0.0]);
        let s = seen(env.as_ref());
        landed.push(s[1]);
        load.push(s[2]);
        assert_eq!(s[3], f64::from(u8::from(s[2] > 0.0)));
        assert_eq!(s[0] == 0.0, s[3] == 1.0, "in the air or in contact");
    }
    let first: Vec<f64> = landed.iter().copied().filter(|t| *t > 0.0).collect();
    let expected = (2.0 * 0.1_f64 / 9.81).sqrt();
    assert!((first[0] - expected).abs() < 0.011, "{first:?} {expected}");
    // Momentum: the mean load from the drop on is the weight, less the momentum that the robot has at the end.
    let weight = 5.25 * 9.81;
    let sum: f64 = load.iter().map(|l| l * 0.005).sum();
    let v = env.qvel()[2];
    assert!((sum - (weight * 0.2 + 5.25 * v)).abs() < 1.5, "{sum} {}", weight * 0.2 + 5.25 * v);
}

/// `K (u - q) - D v`, held to the effort of the URDF, at the state in which the tick begins.
#[test]
fn drives_of_a_urdf_are_what_the_command_section_says() {
    let mut env = leg_observing(&[], &["commands={}", "pushes={}", "reward={ alive = 1.0 }"]);
    let mut rng = stream(2, 0);
    env.reset(&mut rng).expect("reset");
    let mut bounded = 0;
    for _ in 0..100 {
        let action = [rng.random_range(-2.0..2.0), rng.random_range(-3.0..1.0)];
        let (q, v) = (env.qpos().to_vec(), env.qvel().to_vec());
        env.step(&action);
        for (i, (k, effort)) in [(40.0, 20.0), (30.0, 15.0_f64)].into_iter().enumerate() {
            let force = k * (action[i] - q[7 + i]) - 1.5 * v[6 + i];
            bounded += usize::from(force.abs() > effort);
            let got = env.sim().applied_force_of(6 + i);
            assert!((got - force.clamp(-effort, effort)).abs() < 1e-9, "{got} {force}");
        }
    }
    assert!(bounded > 10, "the comparison covers the effort");
}

/// The largest and the squares of what the drives did, from the states and forces of the simulation.
#[test]
fn what_drives_did_is_told_by_the_largest_and_by_squares() {
    let reward = "reward={ first = \"dv.max\", second = \"1e-3 * dv.squared\", third = \"torque.max\", fourth = \"power\" }";
    let mut env = leg_observing(&[], &["commands={}", "pushes={}", "termination={}", reward]);
    let mut rng = stream(5, 0);
    env.reset(&mut rng).expect("reset");
    let mut larger = [0, 0];
    for t in 0..100 {
        let action = [rng.random_range(-2.0..2.0), rng.random_range(-3.0..1.0)];
        let before = env.qvel().to_vec();
        let reward = env.step(&action).reward;
        let v = env.qvel();
        let [hip, knee] = [6, 7].map(|i| ((v[i] - before[i]) / 0.005).abs());
        let force = [6, 7].map(|i| env.sim().applied_force_of(i).abs());
        larger[usize::from(knee > hip)] += 1;
        let power = force[0] * v[6].abs() + force[1] * v[7].abs();
        let expected = hip.max(knee) + 1e-3 * (hip * hip + knee * knee) + force[0].max(force[1]) + power;
        assert!((reward - expected).abs() < 1e-9 * expected, "step {t}: {reward} {expected}");
    }
    assert!(larger[0] > 10 && larger[1] > 10, "either joint is the faster one at times");
}

/// The network input of every row is the one that the controller of the same snapshot computes from the states alone, and the likelihood of
/// what was sampled is that of the policy at this input: what training stacks, the runtime stacks.
#[test]
fn training_sees_what_the_runtime_computes() {
    let mut t = training(&leg(), "ppo", 3, 1, &[]);
    t.iterate(); // statistics
    let snapshot = t.snapshot().clone();
    let mut worker =
        Worker::new(make_env(&snapshot).expect("env"), &snapshot, 0.99, stream(4, 0)).expect("worker");
    worker.collect(60).expect("rows");
    let s = &worker.rows.collected.segment;
    let n_seen = 3 + 3 + 3 + 2 + 6 + 4 + 2;
    assert_eq!(s.x.len(), 60 * n_seen);
    let std: Vec<f64> = snapshot.networks.policy_log_std.iter().map(|l| f64::from(*l).exp()).collect();
    let mut controller = Controller::new(&snapshot).expect("controller");
    let mut env = make_env(&snapshot).expect("env");
    let mut rng = stream(4, 0);
    env.reset(&mut rng).expect("reset");
    let (mut state, mut out, mut noise) = (controller.state(), controller.output(), controller.noise());
    let mut before = [0.0; 2];
    for row in 0..30 {
        let x = &s.x[row * n_seen..][..n_seen];
        for tick in 0..4 {
            look(env.as_ref(), &mut state);
            if tick == 0 {
                // The noise that makes the row's sample out of the mean that the runtime computes for this state.
                noise.action.fill(0.0);
                let mut again = Controller::new(&snapshot).expect("controller");
                again.take_memory(&controller.memory());
                again.update(&state, &noise, &mut out);
                let by_hand: f64 = (0..2)
                    .map(|i| {
                        let z = (f64::from(s.sampled[2 * row + i]) - f64::from(out.sampled[i])) / std[i];
                        noise.action[i] = z as f32;
                        -0.5 * z * z - std[i].ln() - 0.5 * std::f64::consts::TAU.ln()
                    })
                    .sum();
                assert!((by_hand - f64::from(s.log_prob[row])).abs() < 1e-4, "row {row}");
            }
            controller.update(&state, &noise, &mut out);
            if tick == 0 {
                let near = |(a, b): (&f32, &f32)| (a - b).abs() < 2e-4 * (1.0 + b.abs());
                assert!(x.iter().zip(&out.x).all(near), "row {row}: {x:?} {:?}", out.x);
                let last = [0, 1].map(|i| {
                    let (mean, std) =
                        (snapshot.networks.normaliser.mean[21 + i], snapshot.networks.normaliser.std[21 + i]);
                    f64::from(x[21 + i]) * std + mean
                });
                assert!(
                    (last[0] - before[0]).abs() < 1e-3 && (last[1] - before[1]).abs() < 1e-3,
                    "row {row}"
                );
                before = [0, 1].map(|i| f64::from(s.sampled[2 * row + i]).clamp(-2.0, 2.0));
            }
            if env.step(&out.action).terminated {
                return;
            }
        }
        if row == 29 {
            break;
        }
    }
}

fn look(env: &dyn Env, state: &mut State) {
    env.observe(&mut state.obs);
    env.state(&mut state.q, &mut state.v);
}

/// History, last action, commands, pushes and whatever else an episode draws.
#[test]
fn a_resumed_training_is_the_whole_one_bit_for_bit() {
    let set = ["train.n_steps=17", "train.n_envs=32", "train.ppo.batch_size=32"];
    let columns = columns_of_a_run_that_resumes_bit_for_bit(&set);
    for column in ["reward/alive", "reward/track", "reward/air", "reward/effort"] {
        assert!(columns.iter().any(|c| c == column), "{column} is not among {columns:?}");
    }
}

/// Each term is a metric of its own; together they are the return.
#[test]
fn terms_of_the_reward_sum_to_the_return() {
    let snapshot = training(&leg(), "ppo", 3, 1, &[]).snapshot().clone();
    let mut worker =
        Worker::new(make_env(&snapshot).expect("env"), &snapshot, 0.99, stream(4, 0)).expect("worker");
    worker.collect(90).expect("rows");
    let tally = &worker.rows.collected.tally;
    assert!(tally.episodes.len() > 1);
    let returns: f64 = tally.episodes.iter().map(|e| e.0).sum();
    let terms: f64 = tally.notes[..4].iter().sum();
    assert!((returns - terms).abs() < 1e-9 * returns.abs().max(1.0), "{returns} {terms}");
}

/// The commands of an episode come from its seed, change when they are due, and an environment elsewhere draws the same.
#[test]
fn commands_and_pushes_repeat_with_their_seed() {
    let mut env = leg_observing(&["command.vx", "command.yaw"], &["termination={}"]);
    let mut other = env.another().expect("another");
    let mut told = Vec::new();
    for env in [&mut env, &mut other] {
        env.reset(&mut stream(9, 2)).expect("reset");
        let mut list = Vec::new();
        for _ in 0..120 {
            env.step(&[0.4, -0.8]);
            list.push((seen(env.as_ref()), env.qvel().to_vec()));
        }
        told.push(list);
    }
    assert!(told[0] == told[1]);
    let changes: Vec<usize> = (1..120).filter(|&t| told[0][t].0 != told[0][t - 1].0).collect();
    assert_eq!(changes, [29, 59, 89, 119], "every 0.15 s");
    let values: Vec<f64> = [10, 40, 70, 100].map(|t| told[0][t].0[0]).to_vec();
    assert!(values.iter().all(|v| v.abs() <= 1.0));
    other.reset(&mut stream(9, 3)).expect("reset");
    assert_ne!(seen(other.as_ref()), told[0][0].0);
}

/// Of two robots alike but for the pushes, the pushed one differs by the push and nothing else at the moment of the first.
#[test]
fn a_push_changes_the_horizontal_velocity_of_the_base_alone() {
    let (mut pushed, mut calm) = (leg_observing(&[], &[]), leg_observing(&[], &["pushes={}"]));
    pushed.reset(&mut stream(9, 2)).expect("reset");
    let (q, v) = (pushed.qpos().to_vec(), pushed.qvel().to_vec());
    calm.set_state(&q, &v).expect("state");
    for t in 0..40 {
        pushed.step(&[0.4, -0.8]);
        calm.step(&[0.4, -0.8]);
        assert_eq!(pushed.qpos(), calm.qpos(), "step {t}");
        let differ: Vec<usize> = (0..8).filter(|&i| pushed.qvel()[i] != calm.qvel()[i]).collect();
        if !differ.is_empty() {
            assert_eq!(differ, [0, 1]);
            assert!((9..30).contains(&t), "the first pause is of 0.05 to 0.15 s: step {t}");
            let by = [0, 1].map(|i| pushed.qvel()[i] - calm.qvel()[i]);
            assert!(by.iter().all(|x| x.abs() <= 0.3));
            return;
        }
    }
    panic!("nobody pushed");
}

const MISTAKES: &[(&str, &[&str])] = &[
    ("scene.floor.friction=-1.0", &["[scene.floor.friction]", "-1 is not a coefficient of friction"]),
    ("scene.feet.bodies=[\"fot\"]", &["fot"]),
    ("scene.flor=1", &["[scene.", "flor", "did you mean 'floor'?"]),
    ("commands.vx=[1]", &["[commands.vx]", "neither a number nor an expression"]),
    ("commands.every=0", &["[commands.every]", "0 is no time of a control period (0.005 s) or more"]),
    ("pushes.bas=1", &["[pushes.bas]", "there are 'every', 'base' and 'joints'"]),
    ("reward.track={ weight = 1.0, off = \"1\" }", &["[reward.track]", "unknown field `off`"]),
    ("reward.track=\"landed.trunkk\"", &["[reward.track]", "did you mean 'landed.trunk'?"]),
    ("command.interface={ hip = \"pd\" }", &["[command.interface]", "'knee' is commanded effort"]),
    ("reset.q.\"root_joint.w\"=1", &["[reset.q", "root_joint"]),
];

#[test]
fn mistakes_are_named_with_their_key() {
    refuses_each(MISTAKES);
}
