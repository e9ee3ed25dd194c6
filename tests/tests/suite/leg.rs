//! The robot of the tests of tasks of one's own: a leg with a floating base, and what is asked of every such task.

use std::path::{Path, PathBuf};

use nearl_tests::request;
use nearl_trainer::env::{self, Env};
use nearl_trainer::tasks;
use nearl_trainer::train::{resume, train};

/// A file of `tests/fixtures`.
pub(crate) fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures").join(name)
}

/// The task file of the leg.
pub(crate) fn leg() -> String {
    fixture("leg.toml").display().to_string()
}

/// The environment of a task file of the leg, with overrides.
pub(crate) fn env_of(task: &str, set: &[&str]) -> Box<dyn Env> {
    let set: Vec<String> = set.iter().map(|s| (*s).to_string()).collect();
    let manifest = tasks::load(task, &set).unwrap_or_else(|e| panic!("{e}"));
    env::of_task(&manifest, "leg").unwrap_or_else(|e| panic!("{e}"))
}

/// Each override is refused, in a message with all its parts.
pub(crate) fn refuses_each(mistakes: &[(&str, &[&str])]) {
    for (set, says) in mistakes {
        let message = match tasks::load(&leg(), &[(*set).to_string()]) {
            Ok(_) => panic!("{set} is taken"),
            Err(e) => e.to_string(),
        };
        says.iter().for_each(|part| assert!(message.contains(part), "'{part}' is not in: {message}"));
    }
}

/// Trains five iterations in one go on one thread, and in two parts on two threads and on one: the last snapshots must be the same
/// bytes. Returns the columns of the metrics.
pub(crate) fn columns_of_a_run_that_resumes_bit_for_bit(set: &[&str]) -> Vec<String> {
    let folder = tempfile::tempdir().expect("folder");
    let (whole, parts) = (folder.path().join("whole"), folder.path().join("parts"));
    let mut asked = request(&leg(), "ppo", 5, 1, set);
    asked.steps = 5 * 17 * 32;
    train(&asked, &whole, |_, _| true).expect("uninterrupted");
    let mut left = 3;
    asked.threads = 2;
    train(&asked, &parts, |_, _| {
        left -= 1;
        left > 0
    })
    .expect("first part");
    resume(&parts, None, 1, |_, _| true).expect("resume");
    let last = |run: &Path| std::fs::read(run.join("checkpoints/final.safetensors")).expect("final");
    assert!(last(&whole) == last(&parts), "other weights after resuming");
    let text = std::fs::read_to_string(parts.join("metrics.csv")).expect("metrics");
    text.lines().next().expect("header").split(',').map(str::to_owned).collect()
}
