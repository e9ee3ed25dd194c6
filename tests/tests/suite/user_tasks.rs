//! Tasks written in TOML: equal to native ones where they say the same, refused with the key where they are wrong, and
//! costs counted as Safety-Gymnasium counts them.

use std::path::{Path, PathBuf};

use nearl_runtime::constraints::{Drive, Model};
use nearl_runtime::motors::Motors;
use nearl_runtime::{Controller, PolicyKind};
use nearl_tests::random_policy;
use nearl_trainer::env::{self, Env};
use nearl_trainer::learn::Algorithm;
use nearl_trainer::rollout::{make_env, stream};
use nearl_trainer::train::{Request, Training, advice, complete, train};
use nearl_trainer::{evaluate, robot, tasks};
use rand::RngExt;

fn fixture(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures").join(name).display().to_string()
}

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/tasks").join(name)
}

/// The cart-pole in `folder` with `from` replaced by `to`, and its robot beside it.
fn edited(folder: &Path, from: &str, to: &str) -> String {
    let text = std::fs::read_to_string(example("cart-pole.toml")).expect("example");
    assert!(text.contains(from), "{from}");
    std::fs::copy(example("cart-pole.xml"), folder.join("cart-pole.xml")).expect("robot");
    let file = folder.join("mine.toml");
    std::fs::write(&file, text.replacen(from, to, 1)).expect("task");
    file.display().to_string()
}

fn random_action(env: &dyn Env, rng: &mut env::ChaCha8Rng) -> Vec<f64> {
    env.spec().action_low().zip(env.spec().action_high()).map(|(l, h)| rng.random_range(l..h)).collect()
}

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

/// Text of the example, its replacement, and what the message must say.
const MISTAKES: &[(&str, &str, &[&str])] = &[
    (
        "\"cos(q.hinge)\"\ncentred",
        "\"cos(q.hingee)\"\ncentred",
        &["[reward.upright]", "unknown name 'q.hingee'", "did you mean 'q.hinge'?"],
    ),
    ("u.squared\"", "u.pusch\"", &["[reward.effort]", "did you mean 'u.push'?"]),
    (
        "abs(q.hinge) > 0.4",
        "abs(q.hinge > 0.4",
        &["[termination.fell]", "')' is missing before the end at character 18"],
    ),
    (
        "\"0.1 * uniform\"",
        "\"0.1 * q.hinge\"",
        &["[reset.q.hinge]", "unknown name 'q.hinge'", "there are uniform, normal"],
    ),
    ("q = { hinge", "q = { hinges", &["[reset.q.hinges]", "did you mean 'hinge'?"]),
    (
        "velocity = \"0.05 * uniform\"",
        "velocities = 1",
        &["[reset.", "velocities", "did you mean 'velocity'?"],
    ),
    ("\"-0.01 * u.squared\"", "[1]", &["[reward.effort]", "neither a number nor an expression"]),
    ("dt = 0.02 ", "dt = 0.025 ", &["[time.sim_dt]", "not a whole number of physics steps"]),
    ("sim_dt = 0.01", "sim_dt = 0.02", &["[time.sim_dt]", "timestep is 0.01 s"]),
    ("\"sin(q.hinge)\"", "\"sin(u.push)\"", &["[state.observation]", "unknown name 'u.push'"]),
    (
        "max_episode_steps = 500",
        "max_episode_steps = 0",
        &["[time.max_episode_steps]", "0 ticks hold no episode"],
    ),
    ("[reward]", "[rewards]", &["unknown field `rewards`", "did you mean 'reward'?"]),
    ("cart-pole.xml", "cart-poll.xml", &["cart-poll.xml", "cannot be read"]),
];

#[test]
fn mistakes_are_named_with_file_and_key() {
    let folder = tempfile::tempdir().expect("folder");
    for (from, to, says) in MISTAKES {
        let message =
            tasks::load(&edited(folder.path(), from, to), &[]).map(|_| ()).expect_err(to).to_string();
        assert!(message.contains("mine.toml") || message.contains("cart-poll"), "{message}");
        says.iter().for_each(|part| assert!(message.contains(part), "'{part}' is not in: {message}"));
    }
    let file = edited(folder.path(), "[reward]", "[termination]");
    let text = std::fs::read_to_string(&file).expect("task");
    std::fs::write(&file, text.replacen("[termination]\nfell", "[cost]\nfell", 1)).expect("task");
    let message = tasks::load(&file, &[]).map(|_| ()).map_err(|e| e.to_string());
    assert!(message.is_err_and(|m| m.contains("[termination]: only a task with its own [reward]")));
}

/// So does a cost, where the learner keeps to a limit on it; where it is only counted the training goes on.
#[test]
fn a_cost_that_is_no_number_ends_the_training_that_reads_it() {
    let folder = tempfile::tempdir().expect("folder");
    let odd = "[cost]\nodd = \"0.0 * log(q.slider + 0.5)\"\n\n[reward]";
    let file = edited(folder.path(), "[reward]", odd);
    let trained = |set: &[&str], run: &str| {
        let set: Vec<String> = set.iter().map(|s| (*s).to_string()).collect();
        let mut manifest = tasks::load(&file, &set).expect("task");
        complete(&mut manifest).expect("environment");
        let request = Request { manifest, algo: Algorithm::Ppo, steps: 100_000, seed: 0, threads: 1 };
        train(&request, &folder.path().join(run), |_, _| true).map_err(|e| e.to_string())
    };
    let error = trained(&["train.cost.limit=5.0"], "limited").expect_err("a cost of NaN");
    assert!(
        error.contains("a cost of 'cart-pole' came out as NaN after") && error.contains("in [cost]"),
        "{error}"
    );
    trained(&[], "counted").expect("only counted");
}

/// A reward that leaves its domain ends the training instead of spoiling it, and what was learned stays.
#[test]
fn a_reward_that_is_no_number_ends_the_training() {
    let folder = tempfile::tempdir().expect("folder");
    let run = folder.path().join("run");
    let odd = "[reward]\nodd = \"0.0 * log(q.slider + 0.5)\"";
    let mut manifest = tasks::load(&edited(folder.path(), "[reward]", odd), &[]).expect("task");
    complete(&mut manifest).expect("environment");
    let request = Request { manifest, algo: Algorithm::Ppo, steps: 100_000, seed: 0, threads: 1 };
    let error = train(&request, &run, |_, _| true).expect_err("a reward of NaN").to_string();
    assert!(error.contains("a reward of 'cart-pole' came out as NaN after"), "{error}");
    assert!(run.join("checkpoints/latest.safetensors").is_file());
    let again = tasks::load(&run.join("task.toml").display().to_string(), &[]).expect("the run's own file");
    assert!(
        again.task.reward.contains_key("odd"),
        "the task file of a run, its robot beside it, is a task file"
    );
}

#[test]
fn a_start_that_is_undefined_for_some_draws_ends_the_training_and_keeps_what_was_learned() {
    let folder = tempfile::tempdir().expect("folder");
    let task = edited(folder.path(), "0.1 * uniform", "0.2 * sqrt(0.99 + uniform)");
    let mut manifest = tasks::load(&task, &[]).expect("task");
    complete(&mut manifest).expect("manifest");
    let request = Request { manifest, algo: Algorithm::Ppo, steps: 1_000_000, seed: 0, threads: 2 };
    let out = folder.path().join("run");
    let error = train(&request, &out, |_, _| true).expect_err("a root of what is negative").to_string();
    assert!(error.contains("task 'cart-pole' [reset]: qpos[1] came out as NaN"), "{error}");
    assert!(out.join("checkpoints/resume.safetensors").is_file());
}

/// A torque written to an actuator that makes something else of it would break every limit.
#[test]
fn analytic_inverse_dynamics_wants_motors_of_the_controllable_joints() {
    let folder = tempfile::tempdir().expect("folder");
    let refusal = |from: &str, to: &str| {
        let task = with_motors(folder.path(), from, to);
        let mut manifest = tasks::load(&task, &[]).expect("task");
        complete(&mut manifest).err().map(|e| e.to_string()).unwrap_or_default()
    };
    for (from, to, says) in [
        (ELBOW, ELBOW, ""),
        (ELBOW, "<motor joint=\"elbow\" gear=\"30\" ctrlrange=\"-1 1\"/>", ""),
        (
            ELBOW,
            "<velocity joint=\"elbow\" kv=\"5\" ctrlrange=\"-30 30\" forcerange=\"-30 30\"/>",
            "actuator 'elbow' on joint 'elbow' is asked for, but it depends on position or velocity",
        ),
        (
            ELBOW,
            "<general joint=\"elbow\" dyntype=\"filter\" dynprm=\"0.1\" ctrlrange=\"-30 30\"/>",
            "it has dynamics of its own; take a <motor> in its place, or use idm.kind = \"learned\"",
        ),
        (
            ELBOW,
            "<motor joint=\"elbow\" gear=\"0\" ctrlrange=\"-30 30\"/>",
            "motor 'elbow' on joint 'elbow' has gear 0 and gives none; write another number into the robot file",
        ),
        (
            ELBOW,
            "<motor name=\"e\" joint=\"elbow\" ctrlrange=\"1 5\"/>",
            "the ctrlrange of motor 'e' on joint 'elbow' is 1 to 5, which gives no torque one way; write a range that begins below 0",
        ),
        ("<actuator>", &format!("<actuator>{ELBOW}"), "but the actuators drive elbow, shoulder, elbow;"),
    ] {
        let message = refusal(from, to);
        assert!(if says.is_empty() { message.is_empty() } else { message.contains(says) }, "{to}: {message}");
    }
    // Without a torque limit, where the torque is turned into a control.
    with_motors(folder.path(), ELBOW, "<motor name=\"e\" joint=\"elbow\" gear=\"0\" ctrlrange=\"-30 30\"/>");
    let described = robot::read_mjcf(&folder.path().join("two_link.xml")).expect("described");
    let model = Model::from_description(described).expect("a robot");
    let message = Motors::new(&model, &[0, 1], &[Drive::Effort; 2]).expect_err("no torque");
    assert!(
        message.ends_with(
            "it has gear 0; write another number into the robot file, or use idm.kind = \"learned\""
        ),
        "{message}"
    );
}

/// Keyframes and ranges do not say where an episode begins: the file's initial positions do, or `[reset]`.
#[test]
fn where_episodes_begin_is_told_until_the_task_says_it() {
    let folder = tempfile::tempdir().expect("folder");
    let range = "range=\"-2.2 2.2\"";
    let task = with_motors(folder.path(), range, "range=\"0.25 2.2\"");
    let file = folder.path().join("two_link.xml");
    let robot = std::fs::read_to_string(&file).expect("robot");
    let keys = "<keyframe><key qpos=\"0 0\"/><key name=\"home\" qpos=\"0 1.25\"/></keyframe></mujoco>";
    let robot = robot.replace("</mujoco>", keys);
    std::fs::write(&file, &robot).expect("robot");
    let notes = |set: &[&str]| {
        let set: Vec<String> = set.iter().map(|s| (*s).to_string()).collect();
        tasks::load(&task, &set).expect("task").robot.notes.join("; ")
    };
    let keyframe = "keyframes are not read ('number 0', 'home'): episodes begin at the robot file's initial positions; to begin at 'home', write \
                    q = { elbow = 1.25 } in [reset]";
    let outside = "episodes begin outside of the range of 'elbow' (0 rad, 0.25 to 2.2); write positions inside in [reset], such as q = { elbow = 0.25 }";
    assert_eq!(notes(&[]), format!("{keyframe}; {outside}"));
    assert_eq!(notes(&["reset.q={ shoulder = 0.1 }"]), outside);
    assert_eq!(notes(&["reset.q={ elbow = 1.25 }"]), "");
    // As they say, so it is.
    let begins = |set: &[String]| {
        let manifest = tasks::load(&task, set).expect("task");
        let mut env = env::of_task(&manifest, "mine").expect("environment");
        env.reset(&mut stream(1, 0)).expect("reset");
        env.qpos()[1]
    };
    assert_eq!(begins(&[]), 0.0);
    assert_eq!(begins(&["reset.q={ elbow = 1.25 }".to_string()]), 1.25);
    // A model without a task begins nowhere.
    assert!(robot::read_mjcf_text(&robot).expect("described").notes.is_empty());
    let told = robot::simulated_alone(&file).expect("told").join("; ");
    assert!(told.contains(keyframe) && told.contains(outside), "{told}");
}

const ELBOW: &str = "<motor joint=\"elbow\" ctrlrange=\"-30 30\"/>";

/// The two-link arm's task with another actuator.
fn with_motors(folder: &Path, from: &str, to: &str) -> String {
    let robot = std::fs::read_to_string(fixture("two_link.xml")).expect("robot");
    assert!(robot.contains(from));
    std::fs::write(folder.join("two_link.xml"), robot.replace(from, to)).expect("robot");
    let task = folder.join("two_link.toml");
    std::fs::copy(fixture("two_link.toml"), &task).expect("task");
    task.display().to_string()
}

/// The same arm with motors of gear, gain and bias, and in another order: the state reached is the one that was projected, to rounding, and
/// the limits hold as they do with plain motors.
#[test]
fn motors_with_gear_gain_and_bias_in_any_order_reach_what_was_projected() {
    let folder = tempfile::tempdir().expect("folder");
    let both =
        "<motor joint=\"shoulder\" ctrlrange=\"-80 80\"/>\n    <motor joint=\"elbow\" ctrlrange=\"-30 30\"/>";
    let odd = "<general name=\"e\" joint=\"elbow\" gear=\"-6\" gainprm=\"2.5\" biastype=\"affine\" biasprm=\"0.5 0 0\" ctrlrange=\"-2.2 1.8\"/>\n\
               <motor name=\"s\" joint=\"shoulder\" gear=\"80\" ctrlrange=\"-1 1\"/>";
    let swings = [both, odd].map(|motors| {
        let snapshot = random_policy(&with_motors(folder.path(), both, motors), 5, 3.0);
        let mut env = make_env(&snapshot).expect("environment");
        let mut controller = Controller::new(&snapshot).expect("controller");
        let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
        env.reset(&mut stream(5, 0)).expect("reset");
        let mut path = Vec::new();
        for _ in 0..3000 {
            env.observe(&mut state.obs);
            env.state(&mut state.q, &mut state.v);
            assert!(controller.update(&state, &noise, &mut out).is_ok());
            env.step(&out.action);
            let missed =
                env.qvel().iter().zip(&out.next.v).map(|(v, target)| (v - target).abs()).fold(0.0, f64::max);
            assert!(missed < 1e-9, "{motors}: a velocity missed by {missed} rad/s");
            path.extend_from_slice(env.qvel());
        }
        assert_eq!(env.counters().saturations, 0, "{motors}");
        path
    });
    let fastest = swings[0].iter().fold(0.0f64, |most, v| most.max(v.abs()));
    assert!(
        (3.9..4.0 + 1e-9).contains(&fastest),
        "{fastest} rad/s of 4: the limit was not reached, or broken"
    );
    let apart = swings[0].iter().zip(&swings[1]).take(200).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(apart < 1e-6, "the same policy moved the two arms {apart} rad/s apart");
}

/// Where the file says nothing of exploration, the one that the inverse model can have is taken.
#[test]
fn exploration_that_is_not_stated_fits_the_inverse_model() {
    let folder = tempfile::tempdir().expect("folder");
    for (kind, stated, policy) in [
        ("pinocchio", "", Ok(PolicyKind::Stochastic)),
        ("pinocchio", "exploration = \"action\"", Err("needs a learned inverse model")),
        ("learned", "", Ok(PolicyKind::Deterministic)),
        ("learned", "exploration = \"proposal\"", Ok(PolicyKind::Stochastic)),
    ] {
        let text = std::fs::read_to_string(fixture("two_link.toml")).expect("task");
        let text = text.replace("kind = \"pinocchio\"", &format!("kind = \"{kind}\""));
        let text = text.replace("exploration = \"proposal\"", stated);
        let text = match kind {
            "learned" => text.replace("\"kinematic\"", "\"free\"").replace("torque = {}", ""),
            _ => text,
        };
        std::fs::write(folder.path().join("two_link.toml"), text).expect("task");
        std::fs::copy(fixture("two_link.xml"), folder.path().join("two_link.xml")).expect("robot");
        let mut manifest =
            tasks::load(&folder.path().join("two_link.toml").display().to_string(), &[]).expect("task");
        complete(&mut manifest).expect("manifest");
        let request = Request { manifest, algo: Algorithm::Pid2Ib, steps: 1024, seed: 0, threads: 1 };
        let made = Training::new(&request);
        match (policy, made) {
            (Ok(policy), Ok(training)) => {
                assert_eq!(training.snapshot().manifest.policy, policy, "{kind}, {stated}")
            }
            (Err(says), Err(e)) => assert!(e.to_string().contains(says), "{e}"),
            (expected, made) => {
                panic!("{kind}, {stated}: {expected:?}, {:?}", made.err().map(|e| e.to_string()))
            }
        }
    }
}

#[test]
fn more_outputs_than_can_be_learned_are_refused_by_number() {
    let folder = tempfile::tempdir().expect("folder");
    let more: String = (0..300).map(|k| format!(", \"sin({k} * q.slider)\"")).collect();
    let task = edited(folder.path(), "\"v.hinge\"]", &format!("\"v.hinge\"{more}]"));
    let mut manifest = tasks::load(&task, &["train.exploration=proposal".into()]).expect("task");
    complete(&mut manifest).expect("manifest");
    let request = Request { manifest, algo: Algorithm::Pid2Ib, steps: 1024, seed: 0, threads: 1 };
    let error = Training::new(&request).map(|_| ()).expect_err("305 entries").to_string();
    assert!(error.contains("'cart-pole' has 305 proposed entries, and"), "{error}");
}

#[test]
fn a_robot_without_a_usable_actuator_is_refused() {
    let robot = std::fs::read_to_string(example("cart-pole.xml")).expect("robot");
    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("mine.toml");
    std::fs::copy(example("cart-pole.toml"), &file).expect("task");
    for (from, to, says) in [
        (" ctrllimited=\"true\" ctrlrange=\"-1 1\"", "", "actuator 'push' has no ctrlrange"),
        ("joint=\"slider\" gear=\"10\"", "body=\"cart\" gear=\"10\"", "MuJoCo cannot load"),
    ] {
        std::fs::write(folder.path().join("cart-pole.xml"), robot.replacen(from, to, 1)).expect("robot");
        let message = tasks::load(&file.display().to_string(), &[]).map(|_| ()).expect_err(to).to_string();
        assert!(message.contains(says), "{message}");
    }
}

/// The thresholds of Safety-Gymnasium, on speeds computed here from the states.
#[test]
fn velocity_tasks_cost_one_for_each_step_over_the_threshold() {
    for (task, threshold) in
        [("HalfCheetah", 3.2096), ("Hopper", 0.7402), ("Walker2d", 2.3415), ("Ant", 2.6222)]
    {
        let mut env = tasks::env(&format!("{task}-velocity")).expect("task");
        let mut native = env::make(&format!("{task}-v5")).expect("task");
        let mut rng = stream(1, 0);
        let (mut over, mut steps) = (0, 0);
        for start in 0..60 {
            native.reset(&mut rng).expect("reset");
            let (qpos, mut qvel) = (native.qpos().to_vec(), native.qvel().to_vec());
            (qvel[0], qvel[1]) =
                (threshold * (f64::from(start % 3) - 0.6), if task == "Ant" { 1.5 } else { qvel[1] });
            native.set_state(&qpos, &qvel).expect("state");
            env.set_state(&qpos, &qvel).expect("state");
            for _ in 0..5 {
                let place =
                    |e: &dyn Env| if task == "Ant" { e.sim().position(1) } else { [e.qpos()[0], 0.0, 0.0] };
                let before = place(native.as_ref());
                let action = random_action(native.as_ref(), &mut rng);
                let (expected, step) = (native.step(&action), env.step(&action));
                let after = place(native.as_ref());
                let per_second = |k: usize| (after[k] - before[k]) / native.spec().dt;
                let speed = if task == "Ant" { per_second(0).hypot(per_second(1)) } else { per_second(0) };
                assert_eq!(step.cost, f64::from(u8::from(speed > threshold)), "{task} at {speed} m/s");
                assert_eq!((step.reward, step.terminated), (expected.reward, expected.terminated), "{task}");
                (over, steps) = (over + usize::from(speed > threshold), steps + 1);
            }
        }
        assert!(over > 20 && over < steps - 20, "{task}: {over} of {steps} over the threshold");
    }
}

fn trained(task: &str, algo: &str, steps: u64, set: &[&str]) -> (Training, Vec<f64>) {
    let set: Vec<String> = set.iter().map(|s| (*s).to_string()).collect();
    let mut manifest = tasks::load(task, &set).unwrap_or_else(|e| panic!("{e}"));
    complete(&mut manifest).expect("manifest");
    let mut training = Training::new(&Request {
        manifest,
        algo: algo.parse().expect("algorithm"),
        steps,
        seed: 0,
        threads: 2,
    })
    .expect("training");
    let mut returns = Vec::new();
    while !training.is_done() {
        returns.push(training.iterate().return_mean);
    }
    (training, returns)
}

#[test]
fn the_example_learns_to_balance() {
    let file = example("cart-pole.toml").display().to_string();
    for algo in ["ppo", "pid2-ib"] {
        let (training, returns) = trained(&file, algo, 80_000, &[]);
        let (first, last) = (returns[1], returns[returns.len() - 1]);
        assert!(first < 150.0 && last > 300.0, "{algo}: from {first} to {last} of 500");
        let e = evaluate::evaluate(training.snapshot(), 5, 1, true).expect("evaluation");
        assert!(e.mean_return() > 400.0, "{algo}: {}", e.mean_return());
    }
}

/// The speed of the root is projected in every target, and the evaluation counts what it costs.
#[test]
fn a_velocity_prior_holds_in_every_target() {
    let (training, _) =
        trained("HalfCheetah-velocity", "pid2-ib", 16_384, &["constraints.velocity.limit.rootx=0.01"]);
    let e = evaluate::evaluate(training.snapshot(), 2, 0, true).expect("evaluation");
    assert!(e.raw_violations > e.ticks / 2, "proposals are faster than a centimetre a second");
    assert_eq!(e.target_violations, 0);
    assert!(e.reached_violations > 0, "no motor holds the root: what is reached is another matter");
    let worst = e.worst.iter().find(|w| w.limit == "velocity").expect("the root is too fast");
    assert!(worst.joint == "rootx" && worst.by > 0.01, "{worst:?}");
    assert_eq!(e.costs.len(), 2);
}

/// The task file of an arm whose robot is a URDF, with another section.
fn urdf_arm(folder: &Path, section: &str) -> String {
    let link = |name: &str, z: f64| {
        format!(
            r#"<link name="{name}"><inertial><origin xyz="0 0 {z}"/><mass value="1"/><inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/>
            </inertial></link>"#
        )
    };
    let joint = |name: &str, kind: &str, ends: [&str; 2], limit: &str| {
        format!(
            r#"<joint name="{name}" type="{kind}"><parent link="{}"/><child link="{}"/><origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/>
            <limit {limit} effort="40" velocity="4"/><dynamics damping="0.5" friction="0"/></joint>"#,
            ends[0], ends[1]
        )
    };
    let text = format!(
        r#"<robot name="arm"><link name="base"/>{}{}{}{}</robot>"#,
        link("upper", -0.2),
        link("lower", -0.15),
        // in an order that is not that of the names
        joint("z_shoulder", "revolute", ["base", "upper"], r#"lower="-2" upper="2""#),
        joint("a_elbow", "continuous", ["upper", "lower"], ""),
    );
    std::fs::write(folder.join("arm.urdf"), &text).expect("robot");
    let task = std::fs::read_to_string(fixture("two_link.toml")).expect("task");
    let task = task
        .replace("mjcf = \"two_link.xml\"", "urdf = \"arm.urdf\"")
        .replace("-v.elbow^2", "-v.a_elbow^2")
        .replace("dt = 0.01\nsim_dt = 0.01", "dt = 0.002\nsim_dt = 0.002")
        .replace("[state]\n", "[state]\ncontrollable = [\"z_shoulder\", \"a_elbow\"]\n");
    let file = folder.join("arm.toml");
    std::fs::write(&file, task + section).expect("task");
    file.display().to_string()
}

/// A URDF robot with a task of its own: MuJoCo compiles it, motors and limits are the file's.
#[test]
fn a_urdf_robot_has_a_task_of_its_own() {
    let folder = tempfile::tempdir().expect("folder");
    let snapshot = random_policy(&urdf_arm(folder.path(), ""), 3, 3.0);
    let robot = &snapshot.manifest.robot;
    assert_eq!(robot.motors.iter().map(|m| m.joint.as_str()).collect::<Vec<_>>(), ["z_shoulder", "a_elbow"]);
    let (mut env, mut controller) =
        (make_env(&snapshot).expect("environment"), Controller::new(&snapshot).expect("controller"));
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    env.reset(&mut stream(5, 0)).expect("reset");
    let mut fastest = 0.0f64;
    for _ in 0..5000 {
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        assert!(controller.update(&state, &noise, &mut out).is_ok());
        env.step(&out.action);
        let missed = env.qvel().iter().zip(&out.next.v).map(|(v, t)| (v - t).abs()).fold(0.0, f64::max);
        assert!(missed < 1e-9, "a velocity missed by {missed} rad/s");
        assert!(env.qpos()[0].abs() < 1.98 + 1e-9, "{} rad", env.qpos()[0]);
        fastest = env.qvel().iter().fold(fastest, |most, v| most.max(v.abs()));
    }
    assert!(
        (3.9..4.0 + 1e-9).contains(&fastest),
        "{fastest} rad/s of 4: the limit was not reached, or broken"
    );
}

/// A URDF's joints that are sent positions are servos with the gains of the section, which follow what is projected; without gains nothing could
/// be simulated.
#[test]
fn servos_of_a_urdf_follow_positions() {
    let folder = tempfile::tempdir().expect("folder");
    let servo = "\n[command]\ninterface = \"position\"\nstiffness = { z_shoulder = 4e4, a_elbow = 4e3 }\n\
                 damping = { z_shoulder = 80.0, a_elbow = 8.0 }\n";
    let snapshot = random_policy(&urdf_arm(folder.path(), servo), 3, 3.0);
    let (mut env, mut controller) =
        (make_env(&snapshot).expect("environment"), Controller::new(&snapshot).expect("controller"));
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    env.reset(&mut stream(5, 0)).expect("reset");
    let (mut missed, mut least, mut most) = (0.0f64, 0.0f64, 0.0f64);
    for _ in 0..5000 {
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        assert!(controller.update(&state, &noise, &mut out).is_ok());
        assert_eq!(out.action, out.next.q, "what is sent is the projected position");
        env.step(&out.action);
        missed = env.qpos().iter().zip(&out.next.q).map(|(q, t)| (q - t).abs()).fold(missed, f64::max);
        (least, most) = (least.min(env.qpos()[0]), most.max(env.qpos()[0]));
    }
    println!("missed {missed} rad, from {least} to {most} rad");
    assert!(missed < 0.1 && most - least > 0.3, "missed {missed} rad, from {least} to {most} rad");
    let bare = urdf_arm(folder.path(), "\n[command]\ninterface = \"position\"\n");
    let refused = tasks::load(&bare, &[]).map(|_| ()).expect_err("no servo").to_string();
    assert!(
        refused.contains("'z_shoulder' is sent 'position' commands") && refused.contains("stiffness"),
        "{refused}"
    );
}

/// A URDF states no timestep: what is said names the key that does.
#[test]
fn a_period_that_is_no_whole_number_of_a_urdf_s_steps_names_the_key_of_the_step() {
    let folder = tempfile::tempdir().expect("folder");
    let arm = urdf_arm(folder.path(), "");
    let loaded = tasks::load(&arm, &["time.dt=0.005".into(), "time.sim_dt=0.0".into()]);
    let refused = loaded.map(|_| ()).expect_err("2.5 steps").to_string();
    assert!(refused.contains("[time.dt]: 0.005 s") && refused.contains("[scene] timestep"), "{refused}");
}

/// A range of 1.4 m less the margin of the task, and a start drawn from 1.5 times it: the joint, the number and what is allowed are said, and
/// nothing where episodes begin inside.
#[test]
fn episodes_that_begin_outside_the_limits_are_named_before_training() {
    let folder = tempfile::tempdir().expect("folder");
    let lines = |from: &str, to: &str| {
        let mut manifest = tasks::load(&edited(folder.path(), from, to), &[]).expect("task");
        complete(&mut manifest).expect("environment");
        let lines = advice("ppo".parse().expect("an algorithm"), &manifest).expect("advice");
        lines.into_iter().filter(|line| line.contains("begin with")).collect::<Vec<_>>()
    };
    assert_eq!(lines("q = { hinge", "q = { hinge"), [] as [&str; 0]);
    let found = lines("q = { hinge", "q = { slider = \"3.0\", hinge");
    assert_eq!(found.len(), 1, "{found:?}");
    for part in [
        "64 of 64 episodes",
        "'slider'",
        "at 3.0000 rad or m",
        "is allowed",
        "[reset]",
        "constraints.position",
    ] {
        assert!(found[0].contains(part), "{part}: {}", found[0]);
    }
    let fast = lines("velocity = \"0.05 * uniform\"", "velocity = \"4.5 * uniform\"");
    assert!(fast.len() == 1 && fast[0].contains("'slider'") && fast[0].contains("-3 to 3"), "{fast:?}");
}

/// What the robot file lacks is said before a training, not only by the doctor.
#[test]
fn a_limit_that_looks_like_degrees_is_said_before_training() {
    let folder = tempfile::tempdir().expect("folder");
    let file = edited(folder.path(), "velocity = { limit = 3.0 }", "velocity = { limit = 160.0 }");
    let mut manifest = tasks::load(&file, &[]).expect("task");
    complete(&mut manifest).expect("environment");
    let lines = advice("ppo".parse().expect("an algorithm"), &manifest).expect("advice");
    assert!(
        lines.iter().any(|l| l.contains("'slider' is 160 rad/s or m/s") && l.contains("doctor-model")),
        "{lines:?}"
    );
}

/// Two motors of gear 3 and -2 turn one hinge: 2 N m, and what is summed over driven joints counts it once.
#[test]
fn a_joint_with_two_motors_is_summed_once() {
    const ROBOT: &str = "<mujoco><option timestep=\"0.01\"/><worldbody><body name=\"b\"><joint name=\"j\" axis=\"0 1 0\" damping=\".1\"/>\
        <geom type=\"capsule\" fromto=\"0 0 0 0 0 -.3\" size=\".03\" mass=\"1\"/></body></worldbody><actuator>\
        <motor name=\"a\" joint=\"j\" gear=\"3\" ctrlrange=\"-1 1\"/><motor name=\"b\" joint=\"j\" gear=\"-2\" ctrlrange=\"-1 1\"/></actuator></mujoco>";
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("two.xml"), ROBOT).expect("robot");
    let file = folder.path().join("two.toml");
    let env_of = |reward: &str| {
        let text = format!(
            "name = \"two\"\n[model]\nmjcf = \"two.xml\"\n[time]\ndt = 0.01\nsim_dt = 0.01\n[state]\ncontrollable = []\n[reward]\nr = \"{reward}\"\n\
             [constraints]\n[idm]\nkind = \"learned\"\n"
        );
        std::fs::write(&file, text).expect("task");
        tasks::env(file.to_str().expect("UTF-8")).expect("task")
    };
    type Expected = fn(f64, f64) -> f64;
    let of: [(&str, Expected); 3] = [
        ("power", |_, v| (2.0 * v).abs()),
        ("torque.squared", |_, _| 4.0),
        ("dv.squared", |before, v| ((v - before) / 0.01).powi(2)),
    ];
    for (name, expected) in of {
        let mut env = env_of(name);
        env.reset(&mut stream(1, 0)).expect("reset");
        for _ in 0..3 {
            let before = env.qvel()[0];
            let reward = env.step(&[1.0, 0.5]).reward;
            let expected = expected(before, env.qvel()[0]);
            assert!((reward - expected).abs() < 1e-9 * (1.0 + expected), "{name}: {reward} {expected}");
        }
    }
}

/// Encoder counts are an observation like others; what is no number of a robot is named by its entry before a snapshot is written.
#[test]
fn observations_in_large_units_are_learned_from_and_those_beyond_any_are_named() {
    let first = "\"q.slider\"";
    for (unit, is_taken) in [("1e7 * q.slider", true), ("1e40 * q.slider", false)] {
        let folder = tempfile::tempdir().expect("folder");
        let task = edited(folder.path(), first, &format!("\"{unit}\""));
        let mut manifest =
            tasks::load(&task, &["train.n_envs=2".into(), "train.n_steps=64".into()]).expect("task");
        complete(&mut manifest).expect("complete");
        let request = Request { manifest, algo: Algorithm::Ppo, steps: 256, seed: 1, threads: 1 };
        let out = folder.path().join("run");
        let trained = train(&request, &out, |_, _| true);
        match trained {
            Ok(file) => {
                assert!(is_taken, "{unit}");
                let snapshot =
                    nearl_runtime::Snapshot::load(&file).expect("a snapshot that was trained is read");
                assert!(snapshot.networks.normaliser.std.iter().any(|std| *std > 1e4));
            }
            Err(error) => {
                let said = error.to_string();
                assert!(
                    !is_taken
                        && said.contains("the observation '1e40 * q.slider' has")
                        && said.contains("scale that entry"),
                    "{said}"
                );
            }
        }
    }
}

/// An evaluation names what its policy saw that is no number, as a training does.
#[test]
fn an_observation_that_is_no_number_ends_the_evaluation() {
    let folder = tempfile::tempdir().expect("folder");
    let task = edited(folder.path(), "0.1 * uniform", "0.2 * uniform");
    let mut manifest =
        tasks::load(&task, &["train.n_envs=2".into(), "train.n_steps=64".into()]).expect("task");
    complete(&mut manifest).expect("complete");
    let request = Request { manifest, algo: Algorithm::Ppo, steps: 256, seed: 1, threads: 1 };
    let file = train(&request, &folder.path().join("run"), |_, _| true).expect("a run");
    let mut snapshot = nearl_runtime::Snapshot::load(&file).expect("its snapshot");
    let evaluated = |snapshot: &_| nearl_trainer::evaluate::evaluate(snapshot, 3, 0, true);
    evaluated(&snapshot).expect("numbers");
    snapshot.manifest.task.state.observation[0] = "0 * log(q.slider)".into();
    let said = evaluated(&snapshot).expect_err("NaN on one side").to_string();
    assert!(said.contains("observation '0 * log(q.slider)' of 'cart-pole' came out as NaN"), "{said}");
}
