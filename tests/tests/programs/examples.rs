//! The examples in Rust, as a user starts them: each runs, prints something, and is a page long.

use crate::common::*;
use std::process::Command;

fn run(name: &str, arguments: &[&str]) -> String {
    let source = repository().join(format!("examples/rust/{name}.rs"));
    let lines = std::fs::read_to_string(&source).expect("a source file").lines().count();
    assert!(lines < 60, "{name}: {lines} lines");
    let mut command = Command::new(program(&format!("examples/{name}")));
    let output = Process::start(command.args(arguments).current_dir(repository())).output();
    assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("text")
}

#[test]
fn projections() {
    assert!(run("project_state", &[]).contains("Clamped"));
    assert!(run("own_limit", &[]).contains("= 1.0000 rad, allowed 1"));
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
