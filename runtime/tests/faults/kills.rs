//! Processes that die at random moments while the arm moves: `NEARL_KILLS` of each (a few by default), the moments drawn
//! from the seed `NEARL_SEED`. `NEARL_KILLS=250 cargo test --release -p nearl-runtime --test suite fault_17 -- --nocapture`.

use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use nearl_runtime::link::*;
use nearl_runtime::rt::*;

use super::stage::*;
use super::system::{command_of, signal, skip, until};
use crate::arm::*;
use crate::toy::{self, DT};

use super::ROUNDING;

fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).map_or(default, |text| text.parse().expect("a whole number"))
}

/// How often each process is killed.
fn kills(default: u64) -> usize {
    number("NEARL_KILLS", default) as usize
}

/// Moments from the seed of a fault plan, printed so that a failure can be repeated.
fn moments() -> FaultPlan {
    let seed = number("NEARL_SEED", 41);
    println!("NEARL_SEED={seed}");
    FaultPlan { seed, faults: Vec::new() }
}

#[test]
fn fault_14_a_trainer_killed_while_it_publishes_tears_nothing() {
    let (stage, moments) = (Stage::new("kill-trainer"), moments());
    let plant = start_with(&stage.name, &stage.first, FaultPlan::default(), Duration::from_micros(500));
    let stop = Stop::new();
    let running = execute(&stage.name, &stage.file(), &stop);
    let mut viewer = stage.viewer();
    viewer.wait_for_runtime(Duration::from_secs(30)).unwrap();
    let mut swaps = 0;
    for k in 0..kills(3) {
        let trainer = stage.start("trainer");
        let before = swaps;
        until("a snapshot of this trainer is in use", || {
            swaps = viewer.health().map_or(swaps, |h| h.swaps);
            swaps > before
        });
        pause(moments.draw(k, 50));
        kill(trainer);
    }
    let version = 1_000_000_000;
    viewer.push(version, &snapshot(version, |_| {}).to_bytes()).unwrap();
    let receipt = viewer.wait_for_receipt(version, Duration::from_secs(60)).unwrap();
    assert_eq!(receipt.verdict(), Verdict::Accepted, "a new trainer attaches: {}", receipt.text());
    stop.request();
    let report = running.join().unwrap().unwrap();
    let (arm, _) = plant.end();
    println!("{} swaps, versions up to {:?}", report.counters.swaps, report.versions.last());
    assert_eq!(
        (report.refused_snapshots, report.counters.stale, report.modes["fault"]),
        (0, 0, 0),
        "{report}"
    );
    assert_eq!((report.modes["degraded"], report.counters.target_violations), (0, 0), "{report}");
    assert!(arm.worst.iter().all(|e| *e <= ROUNDING), "{:?}", arm.worst);
}

#[test]
fn fault_16_a_killed_runtime_is_braked_in_time_and_its_successor_takes_over() {
    let (stage, moments) = (Stage::new("kill-runtime"), moments());
    let arm = Arm::start(&stage);
    let mut viewer = stage.viewer();
    let mut trips = 0;
    for k in 0..kills(3) {
        let runtime = stage.start("runtime");
        wait_for_motion(&mut viewer);
        pause(moments.draw(k, 100));
        let mut before = 0;
        until("a state", || viewer.state().map(|s| before = s.watchdog).is_some());
        kill(runtime);
        until("the watchdog brakes to rest", || {
            viewer.state().is_some_and(|s| s.watchdog > before && fastest(&s) < 1e-2)
        });
        trips += 1;
    }
    let runtime = stage.start("runtime");
    wait_for_motion(&mut viewer);
    end(runtime);
    let report = stage.report();
    assert_eq!((&report["modes"]["fault"], &report["refused_states"]), (&0.into(), &0.into()), "{report}");
    let counted = arm.end_within_limits();
    assert!(counted.watchdog >= trips, "{counted:?}");
}

/// Keeps the largest excess that the plant has said.
fn hear(viewer: &mut TrainerLink, worst: &mut [f64; 4]) {
    for (i, (_, found)) in viewer.tally().into_iter().flat_map(|t| t.meters()).enumerate() {
        worst[i] = found.map_or(worst[i], |(_, excess)| excess.max(worst[i]));
    }
}

#[test]
fn a_plant_killed_in_motion_is_missed_by_its_reason_and_its_successor_is_taken_up() {
    let (stage, moments) = (Stage::new("kill-plant"), moments());
    let mut plant = stage.start("plant");
    let stop = Stop::new();
    // A machine with other work is late; that is not the fault here.
    let never = u32::MAX;
    let modes = ModeLimits {
        recover_after: 1,
        degrade_overruns: never,
        overruns: never,
        starved: Some(never),
        ..ModeLimits::default()
    };
    let settings = RunSettings { patience: 30.0, modes, ..toy::settings() };
    let running = execute_with(&stage.name, &stage.file(), &stop, settings);
    let mut viewer = stage.viewer();
    let mut worst = [f64::NEG_INFINITY; 4];
    for k in 0..kills(3) {
        let mut moved = false;
        until("the arm moves", || {
            hear(&mut viewer, &mut worst);
            viewer.state().is_some_and(|s| {
                moved |= fastest(&s) > 0.1;
                moved
            })
        });
        pause(moments.draw(k, 100));
        hear(&mut viewer, &mut worst);
        kill(plant);
        until("the loop brakes by its reason", || {
            let seen = viewer.health().map(|h| (h.mode, h.reason));
            seen == Some((Mode::Braking.code(), Reason::StaleState.code()))
        });
        plant = stage.start("plant");
        until("the loop is back", || viewer.health().is_some_and(|h| h.mode == Mode::Active.code()));
    }
    stop.request();
    let report = running.join().unwrap().unwrap();
    kill(plant);
    assert_eq!((report.modes["fault"], report.refused_snapshots), (0, 0), "{report}");
    // A killed plant says nothing more: what is looked at here is a tenth of a second old at most.
    let kept = |i: &usize| worst[*i].is_finite() && worst[*i] <= ROUNDING;
    assert!([0, 1, 3].iter().all(kept), "position, velocity, torque: {worst:?}");
}

#[test]
fn fault_17_a_storm_of_restarts_ends_with_a_runtime_that_runs() {
    let (stage, moments) = (Stage::new("storm"), moments());
    let arm = Arm::start(&stage);
    let mut viewer = stage.viewer();
    let begin = std::time::Instant::now();
    let runtime = stage.start("runtime");
    let pid = runtime.id();
    until("the first one runs", || viewer.health().is_some_and(|h| h.pid == pid));
    let startup = begin.elapsed().as_millis() as usize;
    let one = left_by(&stage);
    kill(runtime);
    for k in 0..kills(20) {
        let runtime = stage.start("runtime");
        pause(moments.draw(k, startup + startup / 4));
        kill(runtime);
    }
    let runtime = stage.start("runtime");
    let pid = runtime.id();
    until("the last one runs", || viewer.health().is_some_and(|h| h.pid == pid && h.tick > 100));
    let left = left_by(&stage);
    println!("shared memory with one runtime: {one:?}; after the storm: {left:?}");
    end(runtime);
    let report = stage.report();
    assert!(report["modes"]["active"].as_u64().unwrap() > 0 && report["modes"]["fault"] == 0, "{report}");
    // One that was killed while it cleaned up after another may leave that undone; `nearl doctor` names what is left.
    let most = 5 + kills(20) / 20;
    assert!(left.alive == one.alive && left.dead <= most, "{most} at most: {one:?}, then {left:?}");
    arm.end_within_limits();
}

fn left_by(stage: &Stage) -> Remains {
    remains().into_iter().find(|r| r.name == stage.name.0.as_str()).unwrap()
}

#[test]
fn fault_31_a_signal_at_any_moment_brakes_to_rest_and_a_second_one_ends_at_once() {
    // `nohup` has it ignored, for what is started here too.
    // SAFETY: a plain call; the test waits for no such signal itself.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_DFL) };
    for (k, number) in
        [libc::SIGTERM, libc::SIGINT, libc::SIGHUP].into_iter().cycle().take(kills(4)).enumerate()
    {
        let (stage, moments) = (Stage::new(&format!("signal{k}")), moments());
        let arm = Arm::start(&stage);
        let mut viewer = stage.viewer();
        let mut runtime = stage.start("runtime");
        let pid = runtime.id();
        until("it runs", || viewer.health().is_some_and(|h| h.pid == pid));
        pause(moments.draw(k, 400));
        signal(&runtime, number);
        assert!(runtime.wait().unwrap().success(), "signal {number}");
        let report = stage.report();
        assert_eq!(
            (&report["last_mode"], &report["reason"]),
            (&"braking".into(), &"stop".into()),
            "{report}"
        );
        until("the arm stands still", || viewer.state().is_some_and(|s| fastest(&s) < 1e-2));
        arm.end_within_limits();
    }
    a_second_signal_is_immediate();
}

/// Falls silent after 20 ticks until it is released.
struct Silent {
    panda: Panda,
    ticks: u64,
    released: Stop,
}

impl Plant for Silent {
    fn observe(&mut self, state: &mut StateMessage) {
        self.ticks += 1;
        while self.ticks > 20 && !self.released.is_requested() {
            std::thread::sleep(Duration::from_millis(2));
        }
        self.panda.observe(state);
    }
    fn apply(&mut self, action: &ActionMessage) {
        self.panda.apply(action);
    }
    fn brake(&mut self) {
        self.panda.brake();
    }
}

/// The plant is silent, so that the loop cannot brake to rest; it would wait for two minutes.
fn a_second_signal_is_immediate() {
    let stage = Stage::new("signals");
    let link = PlantLink::open(&stage.name.0, &describe(&stage.first.manifest, true).unwrap()).unwrap();
    let released = Stop::new();
    let plant = std::thread::spawn({
        let released = released.clone();
        move || {
            let mut plant = Silent { panda: Panda::new(), ticks: 0, released: released.clone() };
            PlantRunner::new(link, PlantSettings::lockstep(DT)).unwrap().run(&mut plant, &released);
        }
    });
    let mut runtime = stage.start("patient");
    let mut viewer = stage.viewer();
    until("the plant has fallen silent", || viewer.health().is_some_and(|h| h.tick == 20));
    signal(&runtime, libc::SIGTERM);
    let status = Path::new("/proc").join(runtime.id().to_string()).join("status");
    until("the first signal has been taken", || {
        let text = std::fs::read_to_string(&status).unwrap();
        text.lines().any(|line| line == "ShdPnd:\t0000000000000000")
    });
    // A shell sends Ctrl-C to a whole group, and `timeout` passes it on: what comes at once is one wish.
    for again in [libc::SIGTERM, libc::SIGINT] {
        signal(&runtime, again);
        pause(25);
    }
    assert!(runtime.try_wait().unwrap().is_none(), "the first signal waits for the plant");
    pause(250);
    assert!(runtime.try_wait().unwrap().is_none(), "the first signal waits for the plant");
    signal(&runtime, libc::SIGINT);
    assert_eq!(runtime.wait().unwrap().code(), Some(130));
    released.request();
    plant.join().unwrap();
}

/// System calls that change what lies in shared memory, at any of which a start may be killed.
const CALLS: [&str; 9] = [
    "openat",
    "mkdir",
    "ftruncate",
    "fallocate",
    "mmap",
    "write",
    "fchmod",
    "rename,renameat,renameat2",
    "unlink,unlinkat",
];

/// What kills a start at a chosen call.
enum Killer {
    Strace,
    /// A library that is preloaded, built of `kill_at.c`.
    Library(Scratch),
}

impl Killer {
    fn strace() -> Option<Killer> {
        let mut traced = std::process::Command::new("strace");
        let status = traced.args(["-qq", "true"]).stderr(Stdio::null()).status();
        status.is_ok_and(|status| status.success()).then_some(Killer::Strace)
    }

    fn library(test: &str) -> Option<Killer> {
        let folder = Scratch::new(test);
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/faults/kill_at.c");
        let mut cc = std::process::Command::new("cc");
        cc.args(["-shared", "-fPIC", "-o"]).arg(folder.0.join("kill_at.so")).arg(source).arg("-ldl");
        cc.status().is_ok_and(|status| status.success()).then_some(Killer::Library(folder))
    }

    /// Starts plant and runtime in a process that is killed at the `when`-th call of a kind; true if it got through before that.
    fn start(&self, name: &toy::Name, call: &str, when: usize) -> bool {
        let inner = command_of("start", name);
        let mut outer = match self {
            Killer::Strace => std::process::Command::new("strace"),
            Killer::Library(_) => std::process::Command::new(inner.get_program()),
        };
        match self {
            Killer::Strace => {
                outer.args(["-f", "-qq", "-o", "/dev/null", "-e", &format!("trace={call}")]);
                outer.args(["-e", &format!("inject={call}:signal=SIGKILL:when={when}")]);
                outer.arg(inner.get_program());
            }
            Killer::Library(folder) => {
                let kind = call.split(',').next().unwrap();
                outer.env("LD_PRELOAD", folder.0.join("kill_at.so"));
                outer.env("NEARL_KILL_AT", format!("{kind}:{when}"));
            }
        }
        outer.args(inner.get_args());
        inner.get_envs().for_each(|(key, value)| {
            outer.env(key, value.unwrap());
        });
        outer.stdout(Stdio::null()).stderr(Stdio::null()).status().unwrap().success()
    }
}

/// How long a start takes.
fn timed_start(name: &toy::Name) -> Duration {
    let begin = std::time::Instant::now();
    let mut next = command_of("start", name).spawn().unwrap();
    let mut ended = None;
    until("a start ends", || {
        ended = next.try_wait().unwrap();
        ended.is_some()
    });
    assert!(ended.unwrap().success(), "a start failed");
    begin.elapsed()
}

/// Kills a start at every `stride`-th call of each kind, and looks at the start after it.
fn kill_starts(killer: &Killer, test: &str, stride: usize, survivors: &[bool]) -> usize {
    let clean = toy::Name::new(&format!("{test}-clean"));
    let usual = (0..3).map(|_| timed_start(&clean)).max().unwrap();
    let (mut points, mut slowest) = (0, Duration::ZERO);
    for survivor in survivors {
        for call in CALLS {
            let mut when = 1 + call.len() % stride;
            loop {
                let name = toy::Name::new(&format!("{test}{points}"));
                let mut stays = survivor.then(|| TrainerLink::open(&name.0).unwrap());
                if killer.start(&name, call, when) {
                    break;
                }
                let left = remains().into_iter().find(|r| r.name == name.0.as_str());
                assert!(
                    *survivor || left.is_none_or(|r| r.is_stale()),
                    "what only the dead left is named so"
                );
                println!("killed at {call} number {when}, survivor {survivor}");
                slowest = slowest.max(timed_start(&name));
                if let Some(stays) = &mut stays {
                    let _ = stays.health();
                } else {
                    let left = remains().into_iter().find(|r| r.name == name.0.as_str());
                    assert!(left.is_none(), "the next one cleared up: {left:?}");
                }
                (points, when) = (points + 1, when + stride);
            }
        }
    }
    println!("{points} points, the slowest start after one took {slowest:?}, one after none {usual:?}");
    // What is half made is left alone for a second and looked at in pauses of a tenth: two seconds, and more on a machine with other work.
    let most = Duration::from_secs(2) + 10 * usual;
    assert!(slowest < most, "a start after a kill took {slowest:?}, {most:?} is the most");
    points
}

/// Every `NEARL_KILL_STRIDE`-th point (13 by default, 1 for all of them), alone and beside a process that stays.
#[test]
fn fault_43_a_start_killed_at_any_system_call_stands_in_the_way_of_none_after_it() {
    let Some(killer) = Killer::strace().or_else(|| Killer::library("kill-at")) else {
        return skip("strace is missing, or may not trace here, and there is no cc to do without");
    };
    let stride = number("NEARL_KILL_STRIDE", 13) as usize;
    let points = kill_starts(&killer, "point", stride, &[false, true]);
    assert!(points > 10, "{points}");
}

/// What stands in for strace, wherever both may be had.
#[test]
fn fault_43_a_start_killed_by_a_preloaded_library_stands_in_the_way_of_none_after_it() {
    let Some(killer) = Killer::library("preloaded") else { return skip("no cc builds a library to preload") };
    let stride = 4 * number("NEARL_KILL_STRIDE", 13) as usize;
    let points = kill_starts(&killer, "preload", stride, &[false]);
    assert!(points > 3, "{points}");
}
