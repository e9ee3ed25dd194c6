//! What commands print about limits and returns, read as a user reads it.

use crate::common::*;
use nearl_runtime::link::{RobotName, remove_files};
use serde_json::Value;

fn text(process: Process) -> String {
    let output = process.output();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("text")
}

/// The line about limits and the JSON of two short runs of an untrained PPO policy of `task`, in MuJoCo.
fn runs(task: &str, test: &str) -> (String, Value) {
    let name = format!("{test}-{}", std::process::id());
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("policy.safetensors");
    nearl_tests::training(task, "ppo", 1, 1, &[]).snapshot().save(&file).expect("a snapshot");
    let file = file.to_str().expect("UTF-8");
    let plant = Process::nearl(&["plant", task, "--name", &name, "--lockstep"]);
    let printed = text(Process::nearl(&["run", file, "--plant", &name, "--seconds", "0.5"]));
    plant.signal(libc::SIGTERM);
    plant.output();
    let again = Process::nearl(&["plant", task, "--name", &name, "--lockstep", "--json"]);
    let json = Process::nearl(&["run", file, "--plant", &name, "--seconds", "0.5", "--json"]).json();
    again.end();
    remove_files(&RobotName::new(&name).expect("a name"));
    let line = printed.lines().find(|line| line.contains("limits broken")).expect("a line about limits");
    (line.to_owned(), json)
}

/// A policy of actions breaks no limit of a projection that there is not: the run says so in place of "0 broken".
#[test]
fn a_run_without_a_projection_says_that_nothing_was_projected() {
    let (line, json) = runs("Hopper-v5", "unprojected");
    assert!(line.contains("nothing was projected") && !line.contains("projected 0"), "{line}");
    assert!(line.contains("no limit was looked at"), "{line}");
    assert_eq!(json["counters"]["unprojected"], json["modes"]["active"], "{json}");
    assert_eq!(json["counters"]["bounded_actions"], Value::Null, "{json}");
}

/// Under `guard = "drive"` nothing is projected either, but forces are kept: the run says both.
#[test]
fn a_run_under_the_guard_of_drives_says_what_was_kept() {
    let (line, json) = runs(concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/leg.toml"), "drives");
    assert!(
        line.contains("nothing was projected") && line.contains("the forces of their drives were kept"),
        "{line}"
    );
    assert!(!line.contains("no limit was looked at"), "{line}");
    assert!(json["modes"]["active"].as_u64() > Some(0), "{json}");
    assert_eq!(json["counters"]["bounded_actions"], json["modes"]["active"], "{json}");
}

/// The table of `nearl eval` has the mean and the spread of the returns that its JSON lists.
#[test]
fn an_evaluation_prints_mean_and_spread() {
    let panda = panda();
    let arguments = ["eval", panda.to_str().expect("UTF-8"), "--episodes", "3", "--compare", "raw"];
    let printed = text(Process::nearl(&arguments));
    let json: Value =
        serde_json::from_str(&text(Process::nearl(&[&arguments[..], &["--json"]].concat()))).expect("JSON");
    let returns: Vec<f64> =
        json[0]["returns"].as_array().expect("returns").iter().filter_map(Value::as_f64).collect();
    let mean = returns.iter().sum::<f64>() / 3.0;
    let spread = (returns.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / 2.0).sqrt();
    let row = printed.lines().find(|line| line.starts_with("raw ")).expect("a row");
    let words: Vec<&str> = row.split_whitespace().collect();
    let is_rounded = |word: &str, x: f64| word.parse::<f64>().is_ok_and(|told| (told - x).abs() <= 0.051);
    assert!(is_rounded(words[1], mean) && words[2] == "±" && is_rounded(words[3], spread), "{row}");
    assert!(row.contains("not projected"), "a proposal that is followed as it is has no target: {row}");
}

/// `--json` is JSON to the last line, whatever ends the training.
#[test]
fn a_training_stopped_by_a_signal_prints_json_to_the_end() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = folder.path().join("run");
    let out = run.to_str().expect("UTF-8");
    let process =
        Process::nearl(&["train", "Hopper-v5", "--steps", "1e9", "--json", "--threads", "1", "--out", out]);
    until("the run folder", || run.join("metrics.csv").is_file().then_some(()));
    std::thread::sleep(std::time::Duration::from_millis(200));
    process.signal(libc::SIGTERM);
    let printed = text(process);
    let rows: Vec<Value> = printed
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}")))
        .collect();
    let last = rows.last().expect("a last line");
    assert_eq!((&last["stopped"], &last["run"]), (&Value::Bool(true), &Value::from(out)), "{last}");
}
