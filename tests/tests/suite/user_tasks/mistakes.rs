//! What is wrong in a task, or becomes no number, is named.

use nearl_runtime::constraints::{Drive, Model};
use nearl_runtime::motors::Motors;
use nearl_trainer::learn::Algorithm;
use nearl_trainer::mj::{self, ModelFormat};
use nearl_trainer::train::{Request, Training, complete, train};
use nearl_trainer::{robot, tasks};

use super::{ELBOW, edited, example, urdf_arm, with_motors};

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
    (
        "[reward]",
        "[commands]\na = \"uniform\"\nb = \"command.a\"\n[reward]",
        &["[commands.b]", "a draw reads no command; its names are uniform, normal and level"],
    ),
    (
        "[reward]",
        "[curriculum]\nstep = 0.0\nup = \"length > 0.5\"\n[reward]",
        &["[curriculum.step]", "0 leaves the level where it is"],
    ),
    (
        "[reward]",
        "[random]\narmature = \"1 + 0.1 * uniform\"\n[reward]",
        &["[random.armature]", "no joint with a motor has an armature"],
    ),
    (
        "[reward]",
        "[random]\narmature = { push = \"1.5\" }\n[reward]",
        &["[random.armature]", "no joint with a motor has an armature"],
    ),
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

/// Names that stand for two things, a joint that has no name where another is called as it would be, and lists that may not be empty.
#[test]
fn names_that_are_given_twice_are_refused_where_they_are_read() {
    let folder = tempfile::tempdir().expect("folder");
    let file = edited(folder.path(), "-0.01 * u.squared", "-0.01 * u.squared");
    let xml = folder.path().join("cart-pole.xml");
    let text = std::fs::read_to_string(&xml).expect("robot");
    std::fs::write(&xml, text.replace("name=\"push\"", "name=\"squared\"")).expect("robot");
    let message = tasks::load(&file, &[]).map(|_| ()).expect_err("two things").to_string();
    assert!(
        message.contains("'u.squared' stands for two things; give the joint, body or actuator"),
        "{message}"
    );
    let loose = text.replace("<joint name=\"hinge\"", "<joint name=\"joint2\"").replace(
        "</worldbody>",
        "<body pos=\"3 0 0\"><freejoint/><geom size=\".1\" mass=\"1\"/></body></worldbody>",
    );
    let model = mj::Model::from_text(&loose, ModelFormat::Mjcf, mj::Options::default()).expect("model");
    assert_eq!(
        model.joints().iter().map(|joint| joint.name.as_str()).collect::<Vec<_>>(),
        ["slider", "joint2", "joint2_"]
    );
    std::fs::write(&xml, text).expect("robot");
    let message =
        tasks::load(&file, &["state.observation=[]".into()]).map(|_| ()).expect_err("empty").to_string();
    assert!(message.contains("[state.observation]: it is empty; name entries, or leave it out"), "{message}");
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

/// A URDF states no timestep: what is said names the key that does.
#[test]
fn a_period_that_is_no_whole_number_of_a_urdf_s_steps_names_the_key_of_the_step() {
    let folder = tempfile::tempdir().expect("folder");
    let arm = urdf_arm(folder.path(), "");
    let loaded = tasks::load(&arm, &["time.dt=0.005".into(), "time.sim_dt=0.0".into()]);
    let refused = loaded.map(|_| ()).expect_err("2.5 steps").to_string();
    assert!(refused.contains("[time.dt]: 0.005 s") && refused.contains("[scene] timestep"), "{refused}");
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
