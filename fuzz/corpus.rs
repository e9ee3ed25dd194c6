//! The files that are damaged, and how they were made.

use std::path::PathBuf;
use std::time::Duration;

use nearl_runtime::constraints::limit::REGISTRY;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;
use nearl_trainer::rollout_protocol::{Constraints, ReplyMessage, Request, Training};

use crate::arm::*;
use crate::messages::bytes_of;
use crate::toy::{self, Name};

fn folder() -> PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus")
}

/// The contents of `corpus/<target>`, by name; for task files the bundled ones too.
pub fn files(target: &str) -> Vec<Vec<u8>> {
    let mut folders = vec![folder().join(target)];
    if target == "task" {
        folders.push(folder().join("../../examples/tasks"));
    }
    let entries =
        folders.iter().flat_map(|f| std::fs::read_dir(f).unwrap_or_else(|e| panic!("{}: {e}", f.display())));
    let mut paths: Vec<PathBuf> = entries.map(|e| e.expect("entry").path()).collect();
    paths.sort();
    assert!(!paths.is_empty(), "corpus/{target} is empty");
    paths.iter().map(|p| std::fs::read(p).expect("corpus file")).collect()
}

fn write(target: &str, name: &str, bytes: &[u8]) {
    let folder = folder().join(target);
    std::fs::create_dir_all(&folder).expect("folder");
    std::fs::write(folder.join(name), bytes).expect("corpus file");
}

/// Every folder has files; with `NEARL_WRITE` they are made anew.
#[test]
fn corpus_is_there() {
    if std::env::var_os("NEARL_WRITE").is_some() {
        write_all();
    }
    for target in ["snapshot", "task", "plan", "message", "state", "robot", "rollout", "log", "verified"] {
        assert!(!files(target).is_empty());
    }
}

/// What is damaged is sound and of the present format, or the fuzzing ends at the first byte: a snapshot is what is written today, and the
/// log is of a schema that replays.
#[test]
fn corpus_is_of_the_present_format() {
    for bytes in files("snapshot") {
        let snapshot = nearl_runtime::Snapshot::from_bytes(&bytes).expect("a snapshot");
        assert!(snapshot.to_bytes() == bytes, "write the corpus anew: see fuzz/README.md");
    }
    nearl_runtime::log::replay(&folder().join("log/flight.mcap")).expect("a log of the present schema");
    let report =
        nearl_verify::verify(&folder().join("verified/flight.mcap")).expect("a log of the present schema");
    assert!(report.is_whole() && report.verified > 30, "a log that is verified\n{report}");
}

/// Where the limits of a task file begin.
const SECTION: &str = "[constraints]\n";

/// The arm's task with the example of every kind of limit that it does not have.
fn all_limits() -> String {
    let stated = constraints_of(TASK.as_bytes());
    let more = REGISTRY.iter().filter(|kind| !stated.contains_key(kind.name)).map(|kind| kind.about.example);
    TASK.replace(SECTION, &format!("{SECTION}{}\n", more.collect::<Vec<_>>().join("\n")))
}

fn constraints_of(file: &[u8]) -> toml::Table {
    let text = std::str::from_utf8(file).expect("UTF-8");
    let mut task: toml::Table = text.parse().unwrap_or_else(|e| panic!("{text}: {e}"));
    task.remove("constraints").and_then(|section| section.try_into().ok()).unwrap_or_default()
}

/// No kind of limit is left out of what is damaged.
#[test]
fn corpus_has_every_kind_of_limit() {
    let file = std::fs::read(folder().join("task/all-limits.toml")).expect("a task of the corpus");
    let stated = constraints_of(&file);
    for kind in REGISTRY {
        let name = kind.name;
        assert!(
            stated.contains_key(name),
            "all-limits.toml lacks '{name}': write the corpus anew, see fuzz/README.md"
        );
    }
}

fn write_all() {
    write("snapshot", "deterministic", &snapshot(1, |_| {}).to_bytes());
    write("snapshot", "stochastic", &stochastic(2).to_bytes());
    let learned = nearl_tests::training("Hopper-v5", "pid2-ib", 3, 1, &[]).snapshot().clone();
    write("snapshot", "learned-inverse", &learned.to_bytes());
    let soft =
        "frame_speed = [{ frame = \"panda_hand\", limit = 0.25, soft = { linear = 1.0, quadratic = 10.0 } }]";
    write("task", "soft.toml", TASK.replace(SECTION, &format!("{SECTION}{soft}\n")).as_bytes());
    write("task", "all-limits.toml", all_limits().as_bytes());
    let kind = |kind| Fault { tick: 100, count: 3, kind };
    let faults = vec![
        kind(FaultKind::State { number: Odd::Nan }),
        kind(FaultKind::Jump { by: 0.5 }),
        kind(FaultKind::Freeze),
        kind(FaultKind::Late { age: 0.1 }),
        kind(FaultKind::Overrun { periods: 2.5 }),
    ];
    let plan = FaultPlan { seed: 3, faults };
    write("plan", "several.json", serde_json::to_string(&plan).expect("JSON").as_bytes());
    let manifest = snapshot(1, |_| {}).manifest;
    let robot = describe(&manifest, true).expect("robot").message(&RobotName::new("a").expect("name"));
    write("robot", "panda", bytes_of(&robot.expect("message")));
    let mut state = StateMessage::zeroed();
    Panda::new().observe(&mut state);
    write("state", "panda", bytes_of(&state));
    write("message", "state", bytes_of(&state));
    let mut receipt = ReceiptMessage::zeroed();
    receipt.set(Verdict::Corrupt, "the digest does not match");
    write("message", "receipt", bytes_of(&receipt));
    let asked = Request { version: Some(3), constraints: Constraints::Off, ..Request::new(7, 100) };
    let mut request = asked.message(5);
    request.header.schema = nearl_trainer::rollout_protocol::RequestMessage::SCHEMA;
    write("rollout", "request", bytes_of(&request));
    let training = Training { n_envs: 8, begins: true, stream: 16, gamma: 0.99, moved_penalty: 0.1 };
    let mut request = Request { training: Some(training), ..Request::new(7, 256) }.message(6);
    request.header.schema = nearl_trainer::rollout_protocol::RequestMessage::SCHEMA;
    write("rollout", "training", bytes_of(&request));
    let mut reply = ReplyMessage::zeroed();
    (reply.n_obs, reply.n_state, reply.n_act, reply.rows) = (14, 14, 7, 30);
    write("rollout", "reply", bytes_of(&reply));
    write("log", "flight.mcap", &flight());
    let folder = Scratch::new("fuzz-attack");
    let (log, summary) = crate::verified::flight().fly(&folder.0);
    assert_eq!((summary.dropped, summary.brief, summary.error), (0, 0, None));
    write("verified", "flight.mcap", &std::fs::read(log).expect("log"));
}

/// Eight ticks and more of the arm, with a swap.
fn flight() -> Vec<u8> {
    let (name, first) = (Name::new("fuzz-log"), snapshot(1, |_| {}));
    let folder = Scratch::new("fuzz-flight");
    let (file, log) = (File::new("fuzz-log", &first), folder.0.join("flight.mcap"));
    let plant = start_with(&name, &first, FaultPlan::default(), Duration::from_millis(5));
    let faults = FaultPlan { seed: 1, faults: vec![Fault { tick: 4, count: 1, kind: FaultKind::Panic }] };
    let settings = RunSettings { ticks: Some(8), log: Some(log.clone()), faults, ..toy::settings() };
    let report = execute_with(&name, &file.0, &Stop::new(), settings).join().expect("loop").expect("run");
    plant.end();
    assert_eq!((report.log_drops, report.log_error), (0, None));
    std::fs::read(log).expect("log")
}
