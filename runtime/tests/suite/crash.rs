//! Processes that are killed: the others go on, and a successor can start at once.

use std::process::{Child, Command, Stdio};
use std::time::Duration;

use crate::toy::*;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;

const ROLE: &str = "NEARL_TEST_ROLE";
const NAME: &str = "NEARL_TEST_NAME";

/// Not a test of its own: the body of the processes the tests below start.
#[test]
#[ignore = "started by the other tests as a process of its own"]
fn child() {
    let Ok(name) = std::env::var(NAME) else { return };
    let name = RobotName::new(&name).unwrap();
    match std::env::var(ROLE).as_deref() {
        Ok("runtime") => {
            let (link, robot) = connect(&name, 10.0).unwrap();
            let (drops, _dropped) = std::sync::mpsc::channel();
            let first = spring(1, &drops);
            let stop = Stop::on_signals().unwrap();
            let report = run_loop(link, robot, first, SpringBuilder(drops), &settings(), &stop).unwrap();
            assert_eq!((report.last_mode, report.reason), (Mode::Braking, Reason::Stop));
        }
        Ok("trainer") => {
            let mut trainer = TrainerLink::open(&name).unwrap();
            for version in 2.. {
                trainer.push(version, b"spring").unwrap();
                std::thread::yield_now();
            }
        }
        role => panic!("no such role: {role:?}"),
    }
}

fn start(role: &str, name: &Name) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "crash::child", "--ignored"])
        .env(ROLE, role)
        .env(NAME, name.0.as_str())
        .stdout(Stdio::null())
        .spawn()
        .unwrap()
}

fn until(mut condition: impl FnMut() -> bool) {
    let end = std::time::Instant::now() + Duration::from_secs(30);
    while !condition() {
        assert!(std::time::Instant::now() < end, "nothing happened within 30 s");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_killed_runtime_trips_the_watchdog_and_its_successor_takes_over() {
    let name = Name::new("kill-runtime");
    let body = PointMass { q: 1.0, v: 1.0, ..PointMass::default() };
    let plant = PlantThread::start(&name, body, PlantSettings::real_time(DT));
    let mut viewer = TrainerLink::open(&name.0).unwrap();
    for _ in 0..3 {
        let (mut runtime, mut tripped) = (start("runtime", &name), 0);
        // A loop that waits for a core trips it too: only what comes after the kill counts.
        until(|| {
            viewer.state().is_some_and(|s| {
                tripped = s.watchdog;
                s.v()[0] != 0.0
            })
        });
        runtime.kill().unwrap();
        runtime.wait().unwrap();
        until(|| viewer.state().is_some_and(|s| s.watchdog > tripped && s.v()[0] == 0.0));
    }
    let (_, report) = plant.end();
    assert!(report.watchdog >= 3, "{report:?}");
}

#[test]
fn a_trainer_killed_while_it_publishes_leaves_the_loop_running() {
    let name = Name::new("kill-trainer");
    let body = PointMass { q: 1.0, ..PointMass::default() };
    let plant = PlantThread::start(&name, body, PlantSettings::lockstep(DT));
    let running = LoopThread::start(&name, settings(), |_| {});
    let mut viewer = TrainerLink::open(&name.0).unwrap();
    viewer.wait_for_runtime(Duration::from_secs(10)).unwrap();
    for _ in 0..3 {
        let mut swaps = viewer.health().map_or(0, |h| h.swaps);
        let mut trainer = start("trainer", &name);
        let before = swaps;
        until(|| {
            swaps = viewer.health().map_or(swaps, |h| h.swaps);
            swaps > before + 2
        });
        trainer.kill().unwrap();
        trainer.wait().unwrap();
    }
    // A new trainer attaches, and what it sends arrives whole.
    viewer.push(1_000_000, b"spring").unwrap();
    let receipt = viewer.wait_for_receipt(1_000_000, Duration::from_secs(10)).unwrap();
    assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    let report = running.end();
    plant.end();
    assert_eq!((report.counters.stale, report.refused_snapshots), (0, 0), "{:?}", report.refusals);
}

#[test]
fn sigterm_brakes_and_ends_with_success() {
    // `nohup` has it ignored, for what is started here too.
    // SAFETY: a plain call; the test waits for no such signal itself.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_DFL) };
    for signal in [libc::SIGTERM, libc::SIGINT, libc::SIGHUP] {
        let name = Name::new(&format!("signal{signal}"));
        let body = PointMass { q: 1.0, v: 1.0, ..PointMass::default() };
        let plant = PlantThread::start(&name, body, PlantSettings::real_time(DT));
        let mut viewer = TrainerLink::open(&name.0).unwrap();
        let mut runtime = start("runtime", &name);
        until(|| viewer.state().is_some_and(|s| s.v()[0] != 0.0));
        // SAFETY: plain call on the process started above.
        assert_eq!(unsafe { libc::kill(runtime.id() as i32, signal) }, 0);
        // The child asserts that it ended in Braking because of the stop; a failed assertion is a failed exit.
        assert!(runtime.wait().unwrap().success());
        until(|| viewer.state().is_some_and(|s| s.v()[0] == 0.0));
        plant.end();
    }
}
