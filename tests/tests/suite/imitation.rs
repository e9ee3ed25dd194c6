//! Learning from demonstrations: where episodes begin, resuming, what is not read, and what is refused.

use nearl_tests::{request, training};
use nearl_trainer::checkpoint::Values;
use nearl_trainer::demos::{Demonstrations, record};
use nearl_trainer::env::Step;
use nearl_trainer::rollout::Scorer;
use nearl_trainer::train::{Experience, Request, TrainError, Training};
use std::path::{Path, PathBuf};

const TASK: &str = "Hopper-v5";

/// Demonstrations of a fresh policy: whatever they are worth, they are states of the task.
fn demos(folder: &Path) -> (PathBuf, Demonstrations) {
    let snapshot = training(TASK, "pid2-ib", 3, 1, &[]).snapshot().clone();
    let (demos, _) = record(&snapshot, 4, 1).expect("episodes");
    let file = folder.join("demos.npz");
    demos.save(&file).expect("saved");
    (file, demos)
}

/// A small training with these demonstrations.
fn asked(algo: &str, file: &Path, more: &[&str]) -> Request {
    asked_of(TASK, algo, file, more)
}

/// The same of another task.
fn asked_of(task: &str, algo: &str, file: &Path, more: &[&str]) -> Request {
    let file = format!("train.demos.file='{}'", file.display());
    let set = [
        "train.n_envs=4",
        "train.n_steps=160",
        "train.ppo.batch_size=320",
        "train.ppo.n_epochs=2",
        "train.demos.epochs=2",
        "train.demos.warmup=640",
        &file,
    ];
    Request { steps: 8 * 640, ..request(task, algo, 5, 1, &[set.as_slice(), more].concat()) }
}

#[test]
fn episodes_begin_in_states_of_the_file_bit_for_bit() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, demos) = demos(folder.path());
    let mut training = Training::new(&asked("soil", &file, &["train.demos.resets=1.0"])).expect("training");
    training.iterate();
    training.iterate();
    let checkpoint = training.checkpoint().expect("checkpoint");
    let of = |name: &str| match &checkpoint.tensors[name] {
        Values::F64(v) => v.clone(),
        Values::F32(_) => panic!("{name} is narrow"),
    };
    let e = &demos.episodes;
    let (nq, nv) = (e[0].qpos.len() / (e[0].length + 1), e[0].qvel.len() / (e[0].length + 1));
    let begun: Vec<usize> = (0..4).filter(|i| of(&format!("env.{i}.from_frame"))[0] == 1.0).collect();
    assert!(begun.len() >= 2, "a fresh policy falls within 320 steps: {begun:?}");
    for i in begun {
        let (qpos, qvel) = (of(&format!("env.{i}.qpos")), of(&format!("env.{i}.qvel")));
        let is_there = e.iter().any(|e| {
            let states = e.qpos.chunks_exact(nq).zip(e.qvel.chunks_exact(nv)).take(e.length);
            states.into_iter().any(|(q, v)| q == qpos && v == qvel)
        });
        assert!(is_there, "environment {i} began in no state of the file");
    }
}

/// A policy that sees the time sees that of the demonstration, also after a stop.
#[test]
fn an_episode_that_begins_in_a_state_goes_on_at_its_time() {
    let folder = tempfile::tempdir().expect("folder");
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/tasks");
    let text = std::fs::read_to_string(example.join("cart-pole.toml")).expect("example");
    let task = folder.path().join("timed.toml");
    std::fs::copy(example.join("cart-pole.xml"), folder.path().join("cart-pole.xml")).expect("robot");
    std::fs::write(&task, text.replacen("\"v.hinge\"]", "\"v.hinge\", \"time\"]", 1)).expect("task");
    let task = task.display().to_string();
    let snapshot = training(&task, "pid2-ib", 3, 1, &[]).snapshot().clone();
    let (demos, _) = record(&snapshot, 4, 1).expect("episodes");
    let file = folder.path().join("demos.npz");
    demos.save(&file).expect("saved");
    let request =
        asked_of(&task, "pid2-il", &file, &["train.demos.resets=1.0", "train.demos.reward='tracking'"]);
    let run = |training: &mut Training, n: usize| (0..n).for_each(|_| drop(training.iterate()));
    let mut whole = Training::new(&request).expect("training");
    run(&mut whole, 3);
    let checkpoint = whole.checkpoint().expect("checkpoint");
    let of = |name: String| match &checkpoint.tensors[&name] {
        Values::F64(v) => v.clone(),
        Values::F32(_) => panic!("{name} is narrow"),
    };
    let mut late = 0;
    for i in 0..4 {
        let (began, obs) = (of(format!("env.{i}.from_frame"))[1], of(format!("env.{i}.obs")));
        let since = of(format!("env.{i}.actions")).len() as f64 * 0.02;
        assert!((obs[5] - began - since).abs() < 1e-9, "{obs:?}: began at {began} s, {since} s ago");
        let qpos = of(format!("env.{i}.qpos"));
        let frame = (began / 0.02).round() as usize;
        assert!(
            demos.episodes.iter().any(|e| e.qpos.chunks_exact(2).nth(frame) == Some(&qpos[..])),
            "frame {frame}"
        );
        late += usize::from(frame > 0);
    }
    assert!(late > 0, "some episode begins in the middle of a demonstration");
    let mut second = Training::resume(checkpoint, Path::new("run"), None, 2).expect("resumed");
    run(&mut whole, 2);
    run(&mut second, 2);
    assert!(bits(&mut whole) == bits(&mut second), "other bits after a stop");
}

/// Weights, statistics and what was reported, without the clock.
fn bits(training: &mut Training) -> Vec<u64> {
    let tensors = training.checkpoint().expect("checkpoint").tensors;
    let timeless = tensors.into_iter().filter(|(name, _)| name != "seconds");
    timeless
        .flat_map(|(_, values)| match values {
            Values::F32(v) => v.into_iter().map(|x| u64::from(x.to_bits())).collect::<Vec<_>>(),
            Values::F64(v) => v.into_iter().map(f64::to_bits).collect(),
        })
        .collect()
}

/// Stopped in the warm-up and after it: the pre-training comes once, and everything is as without a stop.
#[test]
fn resuming_gives_the_same_bits() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, _) = demos(folder.path());
    let task = ["bc", "soil", "dapg", "pid2-il", "bco", "gaifo"].map(|algo| (algo, "task"));
    for (algo, reward) in task.into_iter().chain([("pid2-il", "likeness"), ("pid2-il", "tracking")]) {
        let request = asked(algo, &file, &[&format!("train.demos.reward='{reward}'")]);
        let mut whole = Training::new(&request).expect("training");
        (0..5).for_each(|_| drop(whole.iterate()));
        for stop in [1, 2, 4] {
            let mut first = Training::new(&request).expect("training");
            (0..stop).for_each(|_| drop(first.iterate()));
            let checkpoint = first.checkpoint().expect("checkpoint");
            let mut second = Training::resume(checkpoint, Path::new("run"), None, 2).expect("resumed");
            (stop..5).for_each(|_| drop(second.iterate()));
            assert!(
                bits(&mut whole) == bits(&mut second),
                "{algo}, {reward}: other bits after a stop at {stop}"
            );
        }
    }
}

/// What learns without the reward of the task has the same networks whatever that is.
#[test]
fn without_the_reward_of_the_task_another_one_changes_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, _) = demos(folder.path());
    let other = Scorer::new(true, |obs, _, _, step| Step { reward: 3.0 - obs[0] * step.reward, ..step });
    let learned = |request: &Request, experience: &Experience| {
        let mut training = Training::on(request, experience).expect("training");
        (0..5).for_each(|_| drop(training.iterate()));
        training.snapshot().networks.clone()
    };
    let differs = |algo: &str, reward: &str| {
        let request = asked(algo, &file, &[&format!("train.demos.reward='{reward}'")]);
        learned(&request, &Experience::Here) != learned(&request, &Experience::Scored(other.clone()))
    };
    assert!(differs("pid2-il", "task"), "with the reward of the task another one matters");
    assert!(!differs("pid2-il", "likeness"), "it read the reward of the task");
    assert!(!differs("pid2-il", "tracking"), "it read the reward of the task");
    assert!(!differs("gaifo", "task"), "it has no reward but likeness");
    let likeness = "train.demos.reward='likeness'";
    let mut training = Training::new(&asked("pid2-il", &file, &[likeness])).expect("training");
    let told: Vec<_> = (0..4).flat_map(|_| training.iterate().metrics).collect();
    let rewards: Vec<f64> = told.iter().filter(|m| m.0 == "likeness/reward").map(|m| m.1).collect();
    assert!(rewards.len() == 2 && rewards.iter().all(|r| *r > 0.0), "{rewards:?}");
}

/// Actions are read by `dapg` alone.
#[test]
fn other_actions_change_nothing_where_states_alone_are_learned_from() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, mut demos) = demos(folder.path());
    let learned = |algo: &str| {
        let mut training = Training::new(&asked(algo, &file, &[])).expect("training");
        (0..4).for_each(|_| drop(training.iterate()));
        bits(&mut training)
    };
    let algos = ["bc", "soil", "pid2-il", "bco", "gaifo", "dapg"];
    let before = algos.map(learned);
    demos.episodes.iter_mut().flat_map(|e| &mut e.actions).for_each(|a| *a = 0.3 - *a);
    demos.save(&file).expect("saved");
    let after = algos.map(learned);
    assert_eq!([0, 1, 2, 3, 4].map(|k| before[k] == after[k]), [true; 5], "a state-only run read actions");
    assert!(before[5] != after[5], "dapg reads them");
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, demos) = demos(folder.path());
    let refused = |request: &Request, words: &[&str]| {
        let error = match Training::new(request) {
            Err(e @ (TrainError::Settings(_) | TrainError::Demos(_))) => e.to_string(),
            Err(e) => panic!("refused elsewhere: {e}"),
            Ok(_) => panic!("it was taken; {words:?}"),
        };
        assert!(words.iter().all(|w| error.contains(w)) && !error.contains('\n'), "{error}");
    };
    refused(
        &asked("ppo", &file, &[]),
        &["'ppo' takes no demonstrations", "bc, soil, dapg, pid2-il, bco, gaifo"],
    );
    refused(&asked("soil", Path::new(""), &[]), &["'soil' learns from demonstrations", "--demos"]);
    refused(&asked("bc", &folder.path().join("none.npz"), &[]), &["none.npz", "cannot be read"]);
    let other =
        |task: &str| request(task, "pid2-il", 1, 1, &[&format!("train.demos.file='{}'", file.display())]);
    refused(&other("HalfCheetah-v5"), &["demos.npz", "its period is 0.008 s, that of the task 0.05 s"]);
    refused(&other("Walker2d-v5"), &["demos.npz", "it has no column"]);
    refused(
        &asked("bc", &file, &["train.demos.episodes=99"]),
        &["demos.npz", "train.demos.episodes asks for 99 episodes, and the file has 4; give at most 4, or 0"],
    );
    refused(
        &asked("soil", &file, &["train.demos.reward='likeness'"]),
        &["[train.demos.reward]: \"likeness\" is for pid2-il and gaifo, and 'soil'"],
    );
    refused(
        &asked("bc", &file, &["train.demos.reward='tracking'"]),
        &["[train.demos.reward]: \"tracking\" is for soil, dapg and pid2-il, and 'bc'"],
    );
    let mut other = demos.clone();
    other.episodes[0].actions[0] = -other.episodes[0].actions[0];
    for (algo, is_other) in [("dapg", true), ("soil", false)] {
        demos.save(&file).expect("saved");
        let mut stopped = Training::new(&asked(algo, &file, &[])).expect("training");
        stopped.iterate();
        let checkpoint = stopped.checkpoint().expect("checkpoint");
        other.save(&file).expect("saved");
        let error = Training::resume(checkpoint, Path::new("run"), None, 1).map(drop).err();
        let error = error.map(|e| e.to_string()).unwrap_or_default();
        assert_eq!(error.contains("it learned from other demonstrations than"), is_other, "{algo}: {error}");
    }
    let mut bare = demos;
    bare.episodes.iter_mut().for_each(|e| e.actions.clear());
    bare.save(&file).expect("saved");
    refused(&asked("dapg", &file, &[]), &["demos.npz", "episode 0 has no 'actions'", "soil or pid2-il"]);
    assert!(Training::new(&asked("soil", &file, &[])).is_ok(), "it needs none");
    let mut stopped = Training::new(&asked("bc", &file, &[])).expect("training");
    stopped.iterate();
    let checkpoint = stopped.checkpoint().expect("checkpoint");
    bare.episodes.truncate(2);
    bare.save(&file).expect("saved");
    let error = Training::resume(checkpoint, Path::new("run"), None, 1).map(drop).expect_err("other file");
    assert!(error.to_string().contains("it learned from other demonstrations than"), "{error}");
}

/// Another robot has other limits: what was demonstrated beyond them is told by joint, place and share, and is counted anew here.
#[test]
fn states_that_were_demonstrated_beyond_the_limits_are_told() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, demos) = demos(folder.path());
    let said = |more: &[&str]| {
        let request = asked("bc", &file, more);
        let mut manifest = request.manifest.clone();
        nearl_trainer::train::complete(&mut manifest).expect("an environment");
        let lines = nearl_trainer::train::advice(request.algo, &manifest).expect("advice");
        lines.into_iter().find(|line| line.contains("demonstrated states have joint 'foot_joint'"))
    };
    let fast = demos.names.iter().position(|name| name == "v.foot_joint").expect("a column");
    let speeds = demos
        .episodes
        .iter()
        .flat_map(|e| e.observations.chunks_exact(demos.names.len()))
        .map(|row| row[fast]);
    let (speeds, most) =
        (speeds.clone().collect::<Vec<f64>>(), speeds.fold(0.0, |most: f64, v| most.max(v.abs())));
    // Hopper's own observation cuts speeds at 10.
    let limit = 0.5 * most.min(10.0);
    let line = said(&[&format!("constraints.velocity={{limit={limit}}}")]).expect("some are faster");
    let count = speeds.iter().filter(|v| v.abs() > limit).count();
    assert!(
        line.starts_with(&format!("{count} of {} demonstrated states have joint 'foot_joint'", speeds.len())),
        "{line}"
    );
    assert!(line.contains("constraints.velocity more room"), "{line}");
    assert_eq!(said(&["constraints.velocity={limit=1000.0}"]), None);
}

/// A training that is told how long it is after it has been made, as one from Python is, decays its demonstrations as one that knew.
#[test]
fn demonstrations_decay_over_the_steps_that_are_asked_for_later() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, _) = demos(folder.path());
    let known = asked("dapg", &file, &["train.demos.decay_over_run=true"]);
    let weights = |request: &Request, later: u64| -> Vec<f64> {
        let mut training = Training::new(request).expect("training");
        training.extend(later);
        training.iterate();
        let weight =
            |metrics: Vec<(&str, f64)>| metrics.iter().find(|m| m.0 == "demos/weight").expect("a weight").1;
        (0..2).map(|_| weight(training.iterate().metrics)).collect()
    };
    let later = weights(&Request { steps: 0, ..known.clone() }, known.steps);
    assert_eq!(later, weights(&known, known.steps));
    assert!(later[1] > 1e-3, "{later:?}");
}
