//! Plant, runtime and trainer as processes of their own, started as a user starts them, and what happens when one of
//! them dies, is stopped, or sends what it should not.

use std::process::Command;
use std::time::Duration;

use crate::common::*;
use nearl_runtime::Snapshot;
use nearl_runtime::link::{RobotName, TrainerLink, Verdict, remove_files};
use serde_json::Value;

const ROLE: &str = "NEARL_TEST_TRAINER";

/// A robot name of its own, and nothing left of it at the end.
struct Name(RobotName);

impl Name {
    fn new(what: &str) -> Name {
        Name(RobotName::new(&format!("{what}-{}", std::process::id())).expect("name"))
    }

    fn text(&self) -> &str {
        self.0.as_str()
    }

    fn plant(&self, more: &[&str]) -> Process {
        Process::nearl(&[&["plant", "Panda-reach", "--name", self.text(), "--json"], more].concat())
    }

    fn runtime(&self, more: &[&str]) -> Process {
        let panda = panda();
        let file = panda.to_str().expect("UTF-8");
        Process::nearl(&[&["run", file, "--plant", self.text(), "--json"], more].concat())
    }

    fn link(&self) -> TrainerLink {
        let mut link = TrainerLink::open(&self.0).expect("link");
        link.wait_for_runtime(Duration::from_secs(30)).expect("runtime");
        link
    }
}

impl Drop for Name {
    fn drop(&mut self) {
        remove_files(&self.0);
    }
}

fn snapshot() -> Snapshot {
    Snapshot::load(&panda()).expect("bundled snapshot")
}

/// The plant's own count: ticks of the simulator's state outside a limit.
fn assert_no_limit_broken(plant: &Value) {
    for kind in ["position", "velocity", "torque"] {
        assert_eq!(plant["violations"][kind], 0, "{kind}: {plant}");
    }
}

fn number(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("not a count: {value}"))
}

fn speed(v: &[f64]) -> f64 {
    v.iter().fold(0.0, |most, v| v.abs().max(most))
}

/// Not a test of its own: the trainer process that the test below kills. It pushes version after version.
#[test]
#[ignore = "started by another test as a process of its own"]
fn trainer() {
    let Ok(name) = std::env::var(ROLE) else { return };
    let mut link = TrainerLink::open(&RobotName::new(&name).expect("name")).expect("link");
    let mut snapshot = snapshot();
    for version in snapshot.manifest.version + 1.. {
        snapshot.manifest.version = version;
        link.push(version, &snapshot.to_bytes()).expect("push");
        std::thread::yield_now();
    }
}

#[test]
fn two_seconds_of_panda_in_lockstep_break_no_limit() {
    let name = Name::new("lockstep");
    let plant = name.plant(&["--lockstep"]);
    let run = name.runtime(&["--seconds", "2"]).json();
    let plant = plant.end();
    // The ticks that brake to rest at the end come on top.
    assert_eq!(run["modes"]["active"], 2000, "{run}");
    assert_eq!((&run["modes"]["fault"], &run["counters"]["stale"]), (&0.into(), &0.into()), "{run}");
    assert_eq!(run["counters"]["target_violations"], 0, "{run}");
    assert!(number(&run["counters"]["raw_violations"]) > 0, "the policy never left the limits: {run}");
    assert_eq!((&run["log_error"], &run["refused_states"]), (&Value::Null, &Value::from(0)));
    assert!(number(&plant["report"]["fresh"]) >= 2000, "{plant}");
    assert_no_limit_broken(&plant);
    // What the plant counted is in the loop's report too.
    assert_no_limit_broken(&run["plant"]);
}

#[test]
fn a_trainer_killed_while_it_pushes_leaves_the_loop_running() {
    let name = Name::new("kill-trainer");
    let plant = name.plant(&["--lockstep"]);
    let runtime = name.runtime(&[]);
    let mut link = name.link();
    for _ in 0..3 {
        let swaps = until("health", || link.health()).swaps;
        let mut command = Command::new(std::env::current_exe().expect("path of the test program"));
        let trainer = Process::start(
            command.args(["--exact", "processes::trainer", "--ignored"]).env(ROLE, name.text()),
        );
        until("snapshots of the trainer are in use", || link.health().filter(|h| h.swaps > swaps + 1));
        trainer.kill();
    }
    let before = until("health", || link.health()).tick;
    until("the loop goes on without a trainer", || link.health().filter(|h| h.tick > before + 500));
    // A new trainer is let in, and what it sends arrives whole.
    let mut next = snapshot();
    next.manifest.version = 1_000_000;
    link.push(1_000_000, &next.to_bytes()).expect("push");
    let receipt = link.wait_for_receipt(1_000_000, Duration::from_secs(30)).expect("receipt");
    assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    let run = runtime.end();
    let plant = plant.end();
    assert!(number(&run["ticks"]) > before + 500, "{run}");
    // Superseded is the one verdict a torrent of whole snapshots may get; nothing torn ever came through.
    for text in run["refusals"].as_array().expect("refusals") {
        let text = text.as_str().expect("text");
        assert!(!text.contains("digest") && !text.contains("safetensors"), "a torn snapshot: {text}");
    }
    assert_no_limit_broken(&plant);
}

/// What a trainer might send that must not be used: version, bytes, verdict, what the sentence says.
fn unusable(good: &Snapshot) -> Vec<(Vec<u8>, Verdict, &'static str)> {
    let bytes = good.to_bytes();
    let mut flipped = bytes.clone();
    let last = flipped.len() - 1;
    flipped[last] ^= 1;
    let cheetah = nearl_tests::training("HalfCheetah-v5", "pid2-ib", 0, 1, &[]).snapshot().clone();
    let mut slow = good.clone();
    slow.manifest.task.time.dt *= 2.0;
    let mut strong = good.clone();
    strong.manifest.action_upper[3] *= 2.0;
    let mut diverged = good.clone();
    diverged.networks.policy.layers[0].weight[5] = f32::NAN;
    let mut infinite = good.clone();
    infinite.networks.normaliser.std[2] = 0.0;
    vec![
        (flipped, Verdict::Corrupt, "digest mismatch"),
        (bytes[..bytes.len() / 2].to_vec(), Verdict::Corrupt, "cut short"),
        (b"not a snapshot".to_vec(), Verdict::Corrupt, "not a safetensors file"),
        (cheetah.to_bytes(), Verdict::ForeignRobot, "`panda_joint1` on the plant"),
        (slow.to_bytes(), Verdict::ForeignPeriod, "control period is 0.002 s"),
        (strong.to_bytes(), Verdict::ForeignRobot, "actuator ranges differ"),
        (diverged.to_bytes(), Verdict::NotFinite, "NaN at index 5"),
        (infinite.to_bytes(), Verdict::NotFinite, "normaliser.std"),
    ]
}

#[test]
fn snapshots_that_do_not_fit_are_refused_with_their_reason_and_a_good_one_is_swapped_in() {
    let name = Name::new("refuse");
    let plant = name.plant(&["--lockstep"]);
    let runtime = name.runtime(&[]);
    let mut link = name.link();
    let mut good = snapshot();
    let first = good.manifest.version;
    let bad = unusable(&good);
    let mut version = first;
    for (bytes, verdict, says) in &bad {
        version += 1;
        let before = until("health", || link.health()).tick;
        link.push(version, bytes).expect("push");
        let receipt = link.wait_for_receipt(version, Duration::from_secs(30)).expect("receipt");
        assert_eq!(receipt.verdict(), *verdict, "{}", receipt.text());
        assert!(receipt.text().contains(says), "'{says}' is not in '{}'", receipt.text());
        until("the loop goes on", || link.health().filter(|h| h.tick > before));
    }
    version += 1;
    good.manifest.version = version;
    link.push(version, &good.to_bytes()).expect("push");
    let receipt = link.wait_for_receipt(version, Duration::from_secs(30)).expect("receipt");
    assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    until("ticks of the new policy", || {
        std::iter::from_fn(|| link.transition()).find(|t| t.policy_version == version)
    });
    link.push(first, &good.to_bytes()).expect("push");
    let receipt = link.wait_for_receipt(first, Duration::from_secs(30)).expect("receipt");
    assert_eq!(receipt.verdict(), Verdict::Outdated, "{}", receipt.text());

    let run = runtime.end();
    let versions: Vec<u64> =
        run["versions"].as_array().expect("versions").iter().map(|v| number(&v[1])).collect();
    assert_eq!(versions, [first, version], "{run}");
    assert_eq!(run["counters"]["swaps"], 1, "{run}");
    assert_eq!(number(&run["refused_snapshots"]), bad.len() as u64 + 1, "{run}");
    let refusals = run["refusals"].to_string();
    for (_, _, says) in &bad[..3] {
        assert!(refusals.contains(says), "'{says}' is not in the report: {refusals}");
    }
    assert_no_limit_broken(&plant.end());
}

/// Simulated in real time: between the kill and the watchdog the plant holds the last torque for a few ticks, so the
/// robot file's velocity limit is asked for (a tenth above the task's), and the margin of the position limit.
#[test]
fn a_killed_runtime_trips_the_watchdog_and_the_plant_stands_still() {
    let name = Name::new("kill-runtime");
    let plant = name.plant(&["--endless"]);
    let runtime = name.runtime(&[]);
    let mut viewer = name.link();
    // A starved machine may trip it before; what counts is that the kill does.
    let before = until("the robot moves", || viewer.state().filter(|s| speed(s.v()) > 0.1)).watchdog;
    runtime.kill();
    until("the watchdog brakes to rest", || {
        viewer.state().filter(|s| s.watchdog > before && speed(s.v()) < 1e-3)
    });
    // A successor takes over at once.
    let run = name.runtime(&["--seconds", "0.3"]).json();
    assert!(number(&run["modes"]["active"]) > 0 && run["modes"]["fault"] == 0, "{run}");
    let plant = plant.end();
    assert!(number(&plant["report"]["watchdog"]) > before, "{plant}");
    assert!(number(&plant["report"]["braked"]) > 0, "{plant}");
    let worst = |kind: &str| plant["worst"][kind].as_f64().expect("number");
    assert!(worst("position") < 0.01 && worst("velocity") < 0.1 * 2.175, "{plant}");
    assert_eq!(plant["violations"]["torque"], 0, "{plant}");
}

#[test]
fn a_signal_ends_the_runtime_braked_and_with_success() {
    // `nohup` has it ignored, for what is started here too.
    // SAFETY: a plain call; the test waits for no such signal itself.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_DFL) };
    for signal in [libc::SIGTERM, libc::SIGINT, libc::SIGHUP] {
        let name = Name::new(&format!("signal{signal}"));
        let plant = name.plant(&["--endless"]);
        let runtime = name.runtime(&[]);
        let mut viewer = name.link();
        until("the robot moves", || viewer.state().filter(|s| speed(s.v()) > 0.1));
        runtime.signal(signal);
        let run = runtime.json();
        assert_eq!((&run["last_mode"], &run["reason"]), (&"braking".into(), &"stop".into()), "{run}");
        until("the robot stands still", || viewer.state().filter(|s| speed(s.v()) < 1e-3));
        let plant = plant.end();
        let (told, counted) = (&run["plant"]["watchdog"], &plant["report"]["watchdog"]);
        assert_eq!(told, counted, "the runtime left without a farewell: {plant}");
    }
}

#[test]
fn a_second_plant_or_runtime_of_the_same_name_is_refused() {
    let name = Name::new("twice");
    let plant = name.plant(&["--lockstep"]);
    let runtime = name.runtime(&[]);
    let mut link = name.link();
    for (second, role) in [(name.plant(&[]), "plant"), (name.runtime(&[]), "runtime")] {
        let output = second.output();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success());
        assert!(text.contains(&format!("already has a {role}")), "{text}");
    }
    let before = until("health", || link.health()).tick;
    until("the first ones go on", || link.health().filter(|h| h.tick > before));
    assert_eq!(runtime.end()["reason"], "stop");
    assert_no_limit_broken(&plant.end());
}

/// Nobody reads what it prints, and the reader of its log has gone: the loop moves the robot to the end.
#[test]
fn a_run_whose_readers_are_gone_moves_on_and_ends_well() {
    let name = Name::new("no-readers");
    let plant = name.plant(&["--lockstep"]);
    let panda = panda();
    let mut command = Command::new(program("nearl"));
    command.arg("run").arg(&panda).args(["--plant", name.text(), "--seconds", "2"]);
    let piped = std::process::Stdio::piped;
    let mut child = command.stdout(piped()).stderr(piped()).spawn().expect("start");
    drop((child.stdout.take(), child.stderr.take()));
    let status = child.wait().expect("wait");
    assert_eq!(status.code(), Some(0), "neither a panic nor SIGPIPE ends it: {status}");
    // A log into a pipe that is closed on the other side: refused by name, or counted while the loop runs on.
    let mut command = Command::new(program("nearl"));
    command.arg("run").arg(&panda).args(["--plant", name.text(), "--seconds", "1", "--log", "/dev/stdout"]);
    let mut child = command.stdout(piped()).stderr(piped()).spawn().expect("start");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("output");
    let error = String::from_utf8_lossy(&output.stderr);
    let is_refused = output.status.code() == Some(1) && error.contains("flight log /dev/stdout");
    assert!(output.status.code() == Some(0) || is_refused, "{}: {error}", output.status);
    let plant = plant.end();
    assert!(number(&plant["report"]["fresh"]) >= 2000, "{plant}");
    assert_eq!(plant["report"]["watchdog"], 0, "it left with a farewell: {plant}");
    assert_no_limit_broken(&plant);
}

/// A second of the soak: it loads, swaps, logs and replays, and finds every promise that does not depend on the machine kept.
#[test]
fn a_short_soak_keeps_what_does_not_depend_on_the_machine() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().to_str().expect("UTF-8");
    let soak =
        ["bench", "soak", "--seconds", "1", "--hogs", "1", "--swap-every", "0.05", "--out", out, "--json"];
    let report = Process::nearl(&soak).json();
    let (soak, kept) = (&report["soak"], &report["kept"]);
    // The command itself fails for a broken limit, unless the plant missed an action and held an old one.
    for promise in ["no allocation", "every tick has one mode", "no snapshot refused"] {
        assert_eq!(kept[promise], true, "{promise}: {report}");
    }
    assert!(number(&soak["run"]["counters"]["swaps"]) >= number(&soak["swaps"]["accepted"]), "{report}");
    assert!(
        number(&soak["swaps"]["pushed"]) > 0 && number(&soak["empty_loop_wake_ns"]["count"]) == 1000,
        "{report}"
    );
    // A log that a starved machine could not write in time ends its replay early, and says so.
    if soak["run"]["log_drops"] == 0 && soak["run"]["counters"]["dropped_records"] == 0 {
        assert_eq!(kept["replay bit-equal"], true, "{report}");
    }
}

/// `nearl limits` against plant and loop as processes: the plant's own count stays clean, the loop goes on.
#[test]
fn limits_are_moved_from_the_command_line() {
    let name = Name::new("move-limits");
    let plant = name.plant(&["--lockstep"]);
    let runtime = name.runtime(&[]);
    let mut link = name.link();
    let limits = |more: &[&str]| {
        let output = Command::new(program("nearl"))
            .args(["limits", name.text()])
            .args(more)
            .output()
            .expect("nearl limits");
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (output.status.success(), text(&output.stdout) + &text(&output.stderr))
    };
    let (moved, text) = limits(&["--speed", "0.1"]);
    assert!(moved && text.contains("in force at tick"), "{text}");
    let built = nearl_runtime::controller::Controller::new(&snapshot())
        .expect("controller")
        .limits()
        .velocity
        .clone();
    // what it says itself: the loop's health may be of a tick before
    let said = text.split("in force at tick ").nth(1).expect("a tick");
    let digits: String = said.chars().take_while(char::is_ascii_digit).collect();
    let from: u64 = digits.parse().expect("a number");
    // The Panda's fastest joint stops from full speed in 2.61 / 10 s.
    let mut slow = 0;
    while slow < 500 {
        let Some(t) = link.transition() else { continue };
        if t.tick > from + 300 {
            let over = t.target_v().iter().zip(&built).any(|(v, limit)| v.abs() > 0.1 * limit * (1.0 + 1e-9));
            assert!(!over, "{:?} at tick {}", t.target_v(), t.tick);
            slow += 1;
        }
    }
    for (more, says) in [
        (&["--speed", "2"][..], "speed"),
        (&["--set", "upper = { panda_joint9 = 1.0 }"], "panda_joint9"),
        (&["--set", "upper = { panda_joint2 = 9.0 }"], "upper 9 rad or m of joint 'panda_joint2'"),
        (&["--set", "uper = 1.0"], "uper"),
    ] {
        let (moved, text) = limits(more);
        assert!(!moved && text.contains(says), "{says}: {text}");
    }
    let (moved, text) = limits(&["--reset"]);
    assert!(moved, "{text}");
    let run = runtime.end();
    assert_eq!(
        (&run["counters"]["swaps"], &run["counters"]["target_violations"]),
        (&2.into(), &0.into()),
        "{run}"
    );
    assert_no_limit_broken(&plant.end());
}
