//! The examples in Rust, as a user starts them: each runs, prints something, and is a page long.

use crate::common::*;
use std::process::Command;

fn run(name: &str, arguments: &[&str]) -> String {
    let source = repository().join(format!("examples/rust/{name}.rs"));
    let lines = std::fs::read_to_string(&source).expect("a source file").lines().count();
    let most = if name == "power_limit" { 110 } else { 60 }; // one is the program of a page
    assert!(lines < most, "{name}: {lines} lines");
    let mut command = Command::new(program(&format!("examples/{name}")));
    let output = Process::start(command.args(arguments).current_dir(repository())).output();
    assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("text")
}

#[test]
fn projections() {
    assert!(run("project_state", &[]).contains("Clamped"));
    assert!(run("own_limit", &[]).contains("= 1.0000 rad, allowed 1"));
    assert!(run("power_limit", &[]).contains("allowed 30 W, most 30.00 W"));
    assert!(
        run("wrong_prior", &[]).contains("0.1 kg, not told, with a margin: 0 targets and 0 states too fast")
    );
}

#[test]
fn policies() {
    let panda = panda();
    assert!(run("control_loop", &[panda.to_str().expect("UTF-8")]).contains("torque of joint 2"));
    assert!(run("import_policy", &[]).contains("behind its limits"));
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("pole.npz");
    assert!(run("imitate", &[file.to_str().expect("UTF-8")]).contains("stood for 500 periods of 500"));
}

/// The snapshot was once left behind when commands went to motors by name: it fell in every episode, and nothing said so.
#[test]
fn the_snapshots_do_what_they_were_trained_for() {
    let folder = tempfile::tempdir().expect("a folder");
    let eval = |file: &str, set: &str| {
        let snapshot = repository().join("examples/snapshots").join(file);
        let mut command = Command::new(program("nearl"));
        command.arg("eval").arg(snapshot).args(["--episodes", "4", "--seed", "3", "--json", "--set", set]);
        Process::start(command.current_dir(folder.path())).json()[0].clone()
    };
    let walk = eval("anymal-walk.safetensors", "pushes.base=\"0\"");
    let lengths: Vec<u64> =
        walk["lengths"].as_array().expect("lengths").iter().filter_map(|n| n.as_u64()).collect();
    assert_eq!(lengths, [1000; 4], "it fell");
    let told = |name: &str| {
        let of = walk["told"].as_array().expect("told").iter().find(|t| t["name"] == name);
        of.unwrap_or_else(|| panic!("{name}"))["mean"].as_f64().expect("a number")
    };
    let errors = [told("metrics/speed_error"), told("metrics/turn_error")];
    assert!(errors[0] < 0.2 && errors[1] < 0.2, "{errors:?} m/s, rad/s");
}

#[test]
fn environments_and_training() {
    assert!(run("wrap_env", &[]).contains(" 0 targets"));
    assert!(run("train", &[]).contains("the pole stood for"));
}

#[test]
fn processes() {
    assert!(run("server_client", &[]).contains("1000 steps"));
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("arm.mcap");
    assert!(run("flight_log", &[log.to_str().expect("UTF-8")]).contains("the same, bit for bit"));
}
