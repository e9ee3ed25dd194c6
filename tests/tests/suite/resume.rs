//! Stop and resume equals uninterrupted: weights and metrics, bit for bit, whatever the threads.

use nearl_tests::request;
use nearl_trainer::checkpoint::path_in;
use nearl_trainer::run_folder::RunFolder;
use nearl_trainer::train::{Request, Training, resume, train};
use std::path::Path;
use std::sync::Barrier;

const BATCH: u64 = 4 * 160;
const ITERATIONS: u64 = 8;

/// 160 policy steps in each of 4 environments: segments end in the middle of episodes.
fn asked(task: &str, algo: &str, threads: usize, more: &[&str]) -> Request {
    let set = ["train.n_envs=4", "train.n_steps=160", "train.ppo.batch_size=320", "train.ppo.n_epochs=2"];
    let set = [set.as_slice(), more].concat();
    Request { steps: ITERATIONS * BATCH, ..request(task, algo, 5, threads, &set) }
}

/// The rows of `metrics.csv` without the columns of time.
fn rows(run: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(run.join("metrics.csv")).expect("metrics");
    let timeless = |line: &str| {
        let mut cells: Vec<&str> = line.split(',').collect();
        cells.drain(1..3);
        cells.join(",")
    };
    assert!(text.starts_with("time/total_timesteps,time/seconds,time/fps,"));
    text.lines().map(timeless).collect()
}

/// Trains, stopping after `n` iterations.
fn stopped(request: &Request, run: &Path, n: u64) {
    let mut left = n;
    let go_on = |_: &_, _| {
        left -= 1;
        left > 0
    };
    train(request, run, go_on).expect("training");
}

fn final_of(run: &Path) -> Vec<u8> {
    std::fs::read(run.join("checkpoints/final.safetensors")).expect("final snapshot")
}

fn check(task: &str, algo: &str, more: &[&str]) {
    let folder = tempfile::tempdir().expect("folder");
    let (whole, parts) = (folder.path().join("whole"), folder.path().join("parts"));
    train(&asked(task, algo, 1, more), &whole, |_, _| true).expect("uninterrupted");
    stopped(&asked(task, algo, 2, more), &parts, 3);
    assert!(!parts.join("checkpoints/final.safetensors").exists(), "{algo}: nothing is final yet");
    let mut seen = 0;
    let two_more = |_: &_, _| {
        seen += 1;
        seen < 2
    };
    resume(&parts, None, 1, two_more).expect("resume");
    resume(&parts, None, 2, |_, _| true).expect("resume again");
    assert!(final_of(&whole) == final_of(&parts), "{task} {algo}: other weights after resuming");
    assert_eq!(rows(&whole), rows(&parts), "{task} {algo}");
    assert!(rows(&whole).len() as u64 > ITERATIONS);
}

/// Killed before its first batch a run leaves its folder free, and after it there is something to go on from.
#[test]
fn a_run_that_is_killed_early_has_a_way_on() {
    let folder = tempfile::tempdir().expect("folder");
    let (whole, killed) = (folder.path().join("whole"), folder.path().join("killed"));
    let request = asked("Hopper-v5", "ppo", 1, &[]);
    train(&request, &whole, |_, _| true).expect("uninterrupted");
    for batches in [0, 1] {
        let mut training = Training::new(&request).expect("training");
        let manifest = training.snapshot().manifest.clone();
        let mut run =
            RunFolder::create(&killed, &manifest, request.seed, &training.columns(), None).expect("free");
        (0..batches).for_each(|_| drop(training.iterate_in(&mut run).expect("a batch")));
    }
    let again = Training::new(&request).expect("training");
    let taken = RunFolder::create(&killed, &again.snapshot().manifest, request.seed, &again.columns(), None);
    assert!(taken.is_err(), "it holds a run");
    resume(&killed, None, 1, |_, _| true).expect("resume");
    assert!(final_of(&whole) == final_of(&killed));
    assert_eq!(rows(&whole), rows(&killed));
}

#[test]
fn ppo() {
    check("Hopper-v5", "ppo", &[]);
}

#[test]
fn pid2_ib() {
    check("HalfCheetah-v5", "pid2-ib", &["train.pid2.idm_threshold=0.01", "train.moved_penalty=0.1"]);
}

/// Stopped in the warm-up and after it.
#[test]
fn pid2_that_warms_up() {
    check("Hopper-v5", "pid2-ib", &["train.pid2.warmup=1900"]);
}

#[test]
fn a_warm_up_is_refused_where_the_policy_does_not_learn_through_the_inverse_model() {
    for (task, more) in [("Hopper-v5", &["train.exploration=proposal"][..]), ("Panda-reach", &[])] {
        let overrides = [&["train.pid2.warmup=4096"], more].concat();
        let error = Training::new(&asked(task, "pid2-ib", 1, &overrides)).err().expect("refused").to_string();
        assert!(
            error.starts_with("[train.pid2.warmup]: 4096 steps, but here the policy explores"),
            "{error}"
        );
    }
    assert!(Training::new(&asked("Panda-reach", "nearl", 1, &["train.pid2.warmup=4096"])).is_ok());
}

/// The multiplier, the network that values the cost, its optimiser and the statistics of the cost go on too.
#[test]
fn a_limit_on_the_cost() {
    let more = ["train.cost.limit=5.0", "train.cost.multiplier=0.5"];
    check("HalfCheetah-velocity", "pid2-ib", &[more.as_slice(), &["train.pid2.warmup=640"]].concat());
    check("Hopper-velocity", "ppo", &[more.as_slice(), &["train.ppo.target_kl=0.01"]].concat());
}

#[test]
fn a_limit_on_a_cost_is_refused_where_it_means_nothing() {
    let refused = |task: &str, algo: &str| {
        let error = Training::new(&asked(task, algo, 1, &["train.cost.limit=25.0"])).err().expect("refused");
        error.to_string()
    };
    assert!(
        refused("Hopper-v5", "ppo")
            .contains("[train.cost.limit]: 25 an episode, but 'Hopper-v5' has no cost")
    );
    let imitating = refused("Hopper-velocity", "dapg");
    assert!(imitating.starts_with("[train.cost.limit]: 'dapg' learns from demonstrations"), "{imitating}");
}

/// A stochastic meta policy, a free joint, ReLU.
#[test]
fn nearl_on_ant() {
    check("Ant-v5", "nearl", &["train.exploration=proposal", "train.nets.activation=relu"]);
}

/// Analytic inverse dynamics, many ticks a policy step, a goal, limits as the scale of change.
#[test]
fn pid2_gan_on_the_arm() {
    check("Panda-reach", "pid2-gan", &["train.n_steps=40", "train.ppo.batch_size=160"]);
}

/// Limits that remember the tick before, and a stored brake.
#[test]
fn limits_with_a_memory() {
    let more = ["train.n_steps=40", "train.ppo.batch_size=160", "constraints.jerk.limit=800.0"];
    check("Panda-reach", "pid2-ib", &[more.as_slice(), &["constraints.braking=stored"]].concat());
}

#[test]
fn of_trainings_that_begin_in_one_folder_at_once_one_has_it() {
    for _ in 0..20 {
        let out = tempfile::tempdir().expect("folder");
        let manifest = &asked("Hopper-v5", "ppo", 1, &[]).manifest;
        let begin = Barrier::new(4);
        let create = || {
            begin.wait();
            let folder = RunFolder::create(&out.path().join("run"), manifest, 0, &["steps"], None);
            begin.wait();
            folder.map(drop).map_err(|e| e.to_string())
        };
        let all = std::thread::scope(|s| {
            let threads = [(); 4].map(|()| s.spawn(create));
            threads.map(|t| t.join().expect("a thread"))
        });
        assert_eq!(all.iter().filter(|r| r.is_ok()).count(), 1, "{all:?}");
        let is_refusal = |e: &String| e.contains("another training is at work");
        assert!(all.iter().filter_map(|r| r.as_ref().err()).all(is_refusal), "{all:?}");
    }
}

/// A run that was killed has rows behind its checkpoint, the last of them cut: they come again, once.
#[test]
fn rows_behind_the_checkpoint_come_again() {
    let folder = tempfile::tempdir().expect("folder");
    let (whole, killed) = (folder.path().join("whole"), folder.path().join("killed"));
    let asked = asked("Hopper-v5", "ppo", 1, &[]);
    train(&asked, &whole, |_, _| true).expect("uninterrupted");
    stopped(&asked, &killed, 3);
    let (file, text) = (killed.join("metrics.csv"), std::fs::read_to_string(whole.join("metrics.csv")));
    let text = text.expect("metrics");
    let five: Vec<&str> = text.split_inclusive('\n').take(6).collect();
    let cut = five.concat();
    std::fs::write(&file, &cut[..cut.len() - 20]).expect("write");
    resume(&killed, None, 1, |_, _| true).expect("resume");
    assert_eq!(rows(&whole), rows(&killed));
}

/// A finished run has nothing left; with more steps it goes on.
#[test]
fn a_finished_run_goes_on_with_more_steps() {
    let folder = tempfile::tempdir().expect("folder");
    let run = folder.path().join("run");
    train(&asked("Hopper-v5", "ppo", 1, &[]), &run, |_, _| true).expect("training");
    let before = (final_of(&run), rows(&run));
    resume(&run, None, 1, |_, _| panic!("there is nothing left to do")).expect("nothing");
    assert!(before == (final_of(&run), rows(&run)));
    resume(&run, Some((ITERATIONS + 2) * BATCH), 1, |_, _| true).expect("more");
    assert_eq!(rows(&run).len() as u64, 1 + ITERATIONS + 2);
    assert_eq!(rows(&run)[..before.1.len()], before.1);
}

#[test]
fn damaged_and_foreign_checkpoints_are_refused_in_a_sentence() {
    let folder = tempfile::tempdir().expect("folder");
    let run = folder.path().join("run");
    let file = path_in(&run);
    stopped(&asked("Hopper-v5", "ppo", 1, &[]), &run, 2);
    let good = std::fs::read(&file).expect("checkpoint");
    let metrics = std::fs::read_to_string(run.join("metrics.csv")).expect("metrics");
    let refused = |what: &str, words: &[&str]| {
        let error = resume(&run, None, 1, |_, _| panic!("{what}: it trained")).map(|_| ());
        let error = error.expect_err(what).to_string();
        assert!(words.iter().all(|w| error.contains(w)), "{what}: {error}");
        assert!(
            !error.contains('\n') && error.contains(';'),
            "{what}: one sentence with a next step: {error}"
        );
    };
    for at in [good.len() - 1, good.len() / 2, 400] {
        let mut bytes = good.clone();
        bytes[at] ^= 0x10;
        std::fs::write(&file, &bytes).expect("write");
        refused("a changed bit", &["checkpoint", "resume.safetensors"]);
    }
    for n in [0, 7, 100, good.len() - 1] {
        std::fs::write(&file, &good[..n]).expect("write");
        refused("a cut file", &["damaged"]);
    }
    let snapshot = std::fs::read(run.join("checkpoints/latest.safetensors")).expect("snapshot");
    std::fs::write(&file, snapshot).expect("write");
    refused("a snapshot", &["not of this training", "nearl-checkpoint"]);
    std::fs::remove_file(&file).expect("remove");
    refused("no file", &["resume.safetensors", "--resume"]);
    std::fs::write(&file, &good).expect("write");
    std::fs::write(run.join("metrics.csv"), &metrics[..metrics.find('\n').expect("header") + 1])
        .expect("write");
    refused("lost rows", &["metrics.csv", "0 rows", "not 2"]);
    std::fs::write(run.join("metrics.csv"), metrics).expect("write");
    resume(&run, None, 1, |_, _| true).expect("the undamaged run goes on");
}
