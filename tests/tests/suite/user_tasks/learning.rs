//! Trainings of tasks of one's own, and what is said before them.

use nearl_trainer::env::{self, Env};
use nearl_trainer::rollout::stream;
use nearl_trainer::train::{advice, complete};
use nearl_trainer::{evaluate, robot, tasks};

use super::{edited, example, random_action, trained, with_motors};

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
