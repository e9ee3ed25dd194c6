//! `nearl sweep` as a user starts it: finished runs are left alone, broken ones done again, and a run is what `nearl train`
//! would have made.

use std::path::Path;
use std::process::{Command, Output};

use crate::common::*;
use nearl_runtime::Snapshot;

const STEPS: &str = "4096";

fn sweep(out: &Path, more: &[&str]) -> Output {
    sweep_of(STEPS, out, more)
}

fn sweep_of(steps: &str, out: &Path, more: &[&str]) -> Output {
    let cart_pole = repository().join("examples/tasks/cart-pole.toml");
    let tasks = format!("{},Hopper-v5", cart_pole.display());
    let mut command = Command::new(program("nearl"));
    command.args([
        "sweep",
        "--tasks",
        &tasks,
        "--algos",
        "ppo,pid2-ib",
        "--seeds",
        "0-1",
        "--steps",
        steps,
        "--jobs",
        "3",
    ]);
    command.arg("--out").arg(out).args(more);
    command.output().expect("nearl sweep")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn digest(run: &Path) -> String {
    Snapshot::load(&run.join("checkpoints/final.safetensors")).expect("snapshot").digest()
}

#[test]
fn a_sweep_finishes_what_is_not_finished() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().join("sweep");
    let first = sweep(&out, &["--json"]);
    assert!(first.status.success(), "{}", text(&first.stderr));
    let result: serde_json::Value = serde_json::from_slice(&first.stdout).expect("JSON");
    assert_eq!((result["runs"].as_array().map(Vec::len), result["failed"].as_u64()), (Some(8), Some(0)));
    let summary = result["summary"].as_array().expect("summary");
    assert_eq!(summary.len(), 4);
    let of =
        |task: &str| summary.iter().find(|s| s["task"] == task && s["algo"] == "pid2-ib").expect("summary");
    let (low, mean, high) = (
        of("Hopper-v5")["lowest"].as_f64(),
        of("Hopper-v5")["return"].as_f64(),
        of("Hopper-v5")["highest"].as_f64(),
    );
    assert!(
        low <= mean && mean <= high && of("cart-pole")["idm_loss"].is_f64() && of("cart-pole")["seeds"] == 2
    );

    let single = folder.path().join("single");
    let mut train = Command::new(program("nearl"));
    train.args([
        "train",
        "Hopper-v5",
        "--algo",
        "pid2-ib",
        "--steps",
        STEPS,
        "--seed",
        "1",
        "--threads",
        "2",
        "--json",
        "--out",
    ]);
    assert!(train.arg(&single).output().expect("nearl train").status.success());
    assert_eq!(digest(&out.join("Hopper-v5/pid2-ib_1")), digest(&single), "a run of a sweep is a run");

    let broken = out.join("cart-pole/ppo_0/checkpoints/final.safetensors");
    let (kept, before) = (out.join("cart-pole/ppo_1/metrics.csv"), digest(&out.join("cart-pole/ppo_0")));
    let written = kept.metadata().and_then(|m| m.modified()).expect("metrics");
    std::fs::remove_file(&broken).expect("break a run");
    let second = sweep(&out, &[]);
    let words = text(&second.stdout);
    assert!(second.status.success(), "{}", text(&second.stderr));
    assert_eq!(words.matches("finished before").count(), 7, "{words}");
    assert!(
        words.contains("cart-pole ppo seed 0: was broken off, goes on")
            && words.contains("cart-pole ppo seed 0: done"),
        "{words}"
    );
    assert!(words.contains("algorithm") && words.contains("pid2-ib"), "a table: {words}");
    assert_eq!(
        kept.metadata().and_then(|m| m.modified()).expect("metrics"),
        written,
        "a finished run is not touched"
    );
    assert_eq!(digest(&out.join("cart-pole/ppo_0")), before);

    let other = sweep(&out, &["--set", "train.gamma=0.9"]);
    assert_eq!(other.status.code(), Some(1));
    assert!(text(&other.stderr).contains("holds a run of another task file"), "{}", text(&other.stderr));
    let misspelt = text(&sweep(&out, &["--set", "train.n_env=3"]).stderr);
    assert!(misspelt.contains("n_envs") && !misspelt.contains("another task file"), "{misspelt}");
    let longer = sweep_of("20000", &out, &[]);
    let words = text(&longer.stderr);
    assert_eq!(longer.status.code(), Some(1));
    assert!(words.contains("of them done, where 20000 are asked for"), "{words}");
    assert_eq!(digest(&out.join("cart-pole/ppo_0")), before, "nothing is removed");

    let strange = out.join("cart-pole/ppo_1");
    std::fs::rename(&strange, out.join("kept")).expect("move");
    std::fs::create_dir(&strange).expect("folder");
    std::fs::write(strange.join("notes.md"), "mine").expect("notes");
    let refused = sweep(&out, &[]);
    let words = text(&refused.stderr);
    assert!(words.contains("ppo_1' holds no run: it has no task.toml"), "{words}");
    assert_eq!(std::fs::read_to_string(strange.join("notes.md")).ok().as_deref(), Some("mine"));

    std::fs::remove_dir_all(&strange).expect("remove");
    std::fs::rename(out.join("kept"), &strange).expect("move back");
    let held = std::fs::File::open(strange.join("env.json")).expect("file");
    held.lock().expect("lock");
    let busy = sweep(&out, &[]);
    assert!(text(&busy.stderr).contains("another training is at work in"), "{}", text(&busy.stderr));
}

#[test]
fn a_sweep_that_is_stopped_saves_and_goes_on_later() {
    let folder = tempfile::tempdir().expect("folder");
    let mut command = Command::new(program("nearl"));
    command.args([
        "sweep",
        "--tasks",
        "Hopper-v5",
        "--algos",
        "ppo",
        "--seeds",
        "0-2",
        "--steps",
        "1e9",
        "--jobs",
        "2",
    ]);
    command.arg("--out").arg(folder.path());
    let process = Process::start(&mut command);
    let metrics = |seed: u32| folder.path().join(format!("Hopper-v5/ppo_{seed}/metrics.csv"));
    let learning = |seed| std::fs::read_to_string(metrics(seed)).is_ok_and(|t| t.lines().count() > 3);
    until("two runs learn", || (learning(0) && learning(1)).then_some(()));

    let mut rival = Command::new(program("nearl"));
    rival.args(["sweep", "--tasks", "Hopper-v5", "--out"]).arg(folder.path());
    let refused = rival.output().expect("nearl sweep");
    assert!(text(&refused.stderr).contains("another sweep is at work"), "{}", text(&refused.stderr));

    process.signal(libc::SIGINT);
    let output = process.output();
    assert_eq!(output.status.code(), Some(1));
    assert!(
        text(&output.stderr).contains("interrupted with 3 of 3 runs to go; the same command goes on"),
        "{}",
        text(&output.stderr)
    );
    for seed in [0, 1] {
        let saved = metrics(seed).with_file_name("checkpoints/latest.safetensors");
        assert!(Snapshot::load(&saved).expect("what was learned").manifest.steps > 0);
    }
    assert!(!metrics(2).exists(), "nothing starts after a stop");
}

/// Both runs are stopped; one goes on from its checkpoint, one has lost it.
#[test]
fn a_sweep_goes_on_exactly_where_it_stopped() {
    let folder = tempfile::tempdir().expect("folder");
    let cart_pole = repository().join("examples/tasks/cart-pole.toml").display().to_string();
    let (steps, out) = ("200000", folder.path().join("sweep"));
    let sweep = || {
        let mut command = Command::new(program("nearl"));
        command.args(["sweep", "--tasks", &cart_pole, "--algos", "pid2-ib", "--seeds", "0-1", "--jobs", "2"]);
        command.args(["--steps", steps, "--out"]).arg(&out);
        command
    };
    let run = |seed: u32| out.join(format!("cart-pole/pid2-ib_{seed}"));
    let process = Process::start(&mut sweep());
    let learning =
        |s| std::fs::read_to_string(run(s).join("metrics.csv")).is_ok_and(|t| t.lines().count() > 5);
    until("two runs learn", || (learning(0) && learning(1)).then_some(()));
    process.signal(libc::SIGINT);
    assert_eq!(process.output().status.code(), Some(1), "stopped before the end");
    std::fs::remove_dir_all(run(1).join("checkpoints")).expect("lose a checkpoint");

    let again = sweep().output().expect("nearl sweep");
    let words = text(&again.stdout);
    assert!(again.status.success(), "{}", text(&again.stderr));
    assert!(words.contains("seed 0: was broken off, goes on"), "{words}");
    assert!(words.contains("seed 1: was broken off, begins anew"), "{words}");
    for seed in [0, 1] {
        let single = folder.path().join(format!("single_{seed}"));
        let mut train = Command::new(program("nearl"));
        train.args(["train", &cart_pole, "--steps", steps, "--seed", &seed.to_string(), "--json", "--out"]);
        assert!(train.arg(&single).output().expect("nearl train").status.success());
        assert_eq!(digest(&run(seed)), digest(&single), "seed {seed}");
    }
}

/// Not "goes on": it would end there again.
#[test]
fn a_sweep_whose_runs_fail_says_what_to_do() {
    let folder = tempfile::tempdir().expect("folder");
    let cart_pole = repository().join("examples/tasks/cart-pole.toml").display().to_string();
    let odd = "reward.odd=\"0.0 * log(q.slider + 0.5)\"";
    let mut command = Command::new(program("nearl"));
    command.args(["sweep", "--tasks", &cart_pole, "--algos", "ppo", "--seeds", "0", "--set", odd, "--out"]);
    let output = command.arg(folder.path()).output().expect("nearl sweep");
    let (words, error) = (text(&output.stdout), text(&output.stderr));
    assert!(words.contains("a reward of 'cart-pole' came out as NaN"), "{words}");
    assert!(error.contains("1 of 1 runs ended with the errors above; mend what they name"), "{error}");
    command.arg("--json");
    let error = text(&command.output().expect("nearl sweep").stderr);
    assert!(error.contains("seed 0: ") && error.contains("came out as NaN"), "{error}");
}

#[test]
fn mistakes_are_found_before_anything_runs() {
    let folder = tempfile::tempdir().expect("folder");
    for (arguments, says) in [
        (["--tasks", "Hoper-v5", "--algos", "ppo", "--seeds", "0"], "did you mean 'Hopper-v5'"),
        (["--tasks", "Hopper-v5", "--algos", "sac", "--seeds", "0"], "no algorithm 'sac'"),
        (["--tasks", "Hopper-v5", "--algos", "ppo", "--seeds", "0,0"], "seed 0 is asked for twice"),
        (["--tasks", "Hopper-v5", "--algos", "ppo", "--seeds", "3-1"], "are no seeds"),
    ] {
        let mut command = Command::new(program("nearl"));
        let output = command
            .arg("sweep")
            .args(arguments)
            .arg("--out")
            .arg(folder.path().join("runs"))
            .output()
            .expect("nearl sweep");
        assert!(!output.status.success() && text(&output.stderr).contains(says), "{}", text(&output.stderr));
        assert!(!folder.path().join("runs").exists());
    }
}
