//! Faults of processes and of the operating system, over real links.

use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nearl_runtime::link::*;
use nearl_runtime::rt::*;

use crate::toy::{self, DT, LoopThread, Name, PlantThread, PointMass, SpringBuilder, spring};

const ROLE: &str = "NEARL_FAULT_ROLE";
const NAME: &str = "NEARL_FAULT_NAME";
const PATIENCE: Duration = Duration::from_secs(20);

/// Not a test of its own: the body of the processes the tests below start.
#[test]
#[ignore = "started by the other tests as a process of its own"]
fn child() {
    let Ok(name) = std::env::var(NAME) else { return };
    let name = RobotName::new(&name).unwrap();
    match std::env::var(ROLE).as_deref() {
        Ok("trainer") => {
            let mut trainer = TrainerLink::open(&name).unwrap();
            for version in 2.. {
                trainer.push(version, b"spring").unwrap();
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        Ok("runtime") => {
            let (link, robot) = connect(&name, 20.0).unwrap();
            let (drops, _dropped) = std::sync::mpsc::channel();
            let stop = Stop::on_signals().unwrap();
            let build = SpringBuilder(drops.clone());
            run_loop(link, robot, spring(1, &drops), build, &toy::settings(), &stop).unwrap();
        }
        Ok("memory") => match TrainerLink::open(&name) {
            Ok(_) => println!("opened"),
            Err(error) => println!("refused {}", error.code()),
        },
        role => panic!("no such role: {role:?}"),
    }
}

fn command(role: &str, name: &Name) -> Command {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "system::child", "--ignored", "--nocapture"]);
    command.env(ROLE, role).env(NAME, name.0.as_str()).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(60);
    while !condition() {
        assert!(Instant::now() < end, "within 60 s: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn signal(child: &Child, signal: i32) {
    // SAFETY: plain call on a child that has not been waited for.
    assert_eq!(unsafe { libc::kill(child.id() as i32, signal) }, 0);
}

fn body() -> PointMass {
    PointMass { q: 1.0, ..PointMass::default() }
}

#[test]
fn fault_15_a_stopped_trainer_stops_nothing_else() {
    let name = Name::new("sigstop");
    let plant = PlantThread::start(&name, body(), PlantSettings::lockstep(DT));
    let running = LoopThread::start(&name, toy::settings(), |_| {});
    let mut viewer = TrainerLink::open(&name.0).unwrap();
    viewer.wait_for_runtime(PATIENCE).unwrap();
    let mut trainer = command("trainer", &name).spawn().unwrap();
    until("a swap", || viewer.health().is_some_and(|h| h.swaps > 2));
    signal(&trainer, libc::SIGSTOP);
    std::thread::sleep(Duration::from_millis(300));
    let mut still = HealthMessage::zeroed();
    until("health", || viewer.health().map(|h| still = h).is_some());
    until("the loop goes on", || {
        viewer.health().is_some_and(|h| h.tick > still.tick + 500 && h.swaps == still.swaps)
    });
    signal(&trainer, libc::SIGCONT);
    until("the trainer is back", || viewer.health().is_some_and(|h| h.swaps > still.swaps));
    trainer.kill().unwrap();
    trainer.wait().unwrap();
    let report = running.end();
    plant.end();
    assert_eq!((report.counters.stale, report.modes["fault"]), (0, 0));
}

#[test]
fn fault_17_a_storm_of_restarts_ends_with_a_runtime_that_runs() {
    let name = Name::new("storm");
    let plant = PlantThread::start(&name, body(), PlantSettings::lockstep(DT));
    let mut viewer = TrainerLink::open(&name.0).unwrap();
    for n in 0..40_u64 {
        let mut runtime = command("runtime", &name).spawn().unwrap();
        std::thread::sleep(Duration::from_micros((n * 7919 % 40) * 1000));
        runtime.kill().unwrap();
        runtime.wait().unwrap();
    }
    let mut runtime = command("runtime", &name).spawn().unwrap();
    let pid = runtime.id();
    until("the last one runs", || viewer.health().is_some_and(|h| h.pid == pid && h.tick > 100));
    signal(&runtime, libc::SIGTERM);
    assert!(runtime.wait().unwrap().success());
    plant.end();
}

#[test]
fn fault_18_a_consumer_that_never_reads_loses_the_oldest_and_slows_nothing() {
    let name = Name::new("slow");
    let plant = PlantThread::start(&name, body(), PlantSettings::lockstep(DT));
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    let running = LoopThread::start(&name, RunSettings { ticks: Some(4000), ..toy::settings() }, |_| {});
    until("the first transition", || trainer.transition().is_some());
    let report = running.join();
    let read = std::iter::from_fn(|| trainer.transition()).count() as u64;
    plant.end();
    assert!(read > 0 && read < 4000, "{read}");
    assert!(trainer.lost_transitions() > 0, "{}", trainer.lost_transitions());
    assert_eq!((report.modes["active"], report.counters.stale), (4000, 0));
}

/// A private `/dev/shm`, which needs user namespaces.
fn with_memory(options: &str, name: &Name) -> Option<String> {
    let script = format!("mount -t tmpfs -o {options} tmpfs /dev/shm || exit 77; exec \"$0\" \"$@\"");
    let inner = command("memory", name);
    let mut outer = Command::new("unshare");
    outer.args(["-rm", "sh", "-c", &script]).arg(inner.get_program()).args(inner.get_args());
    outer.env(ROLE, "memory").env(NAME, name.0.as_str());
    let output = outer.output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let said = text.lines().find(|l| l.starts_with("refused ") || *l == "opened").map(str::to_owned);
    assert!(said.is_some() || !output.status.success(), "killed or silent: {output:?}");
    said
}

#[test]
fn fault_20_shared_memory_that_is_tiny_or_read_only_is_refused_before_any_motion() {
    let name = Name::new("memory");
    if with_memory("size=64M", &name).as_deref() != Some("opened") {
        println!("not tested: no private mount namespace (`unshare -rm`) is permitted here");
        return;
    }
    assert_eq!(with_memory("size=1M", &name).as_deref(), Some("refused link-memory"));
    assert_eq!(with_memory("size=64M,ro", &name).as_deref(), Some("refused link-memory-missing"));
}

/// No clock but the monotonic one is read, so a jump of the wall clock can have no effect.
#[test]
fn fault_21_the_wall_clock_is_never_read() {
    fn sources(folder: &std::path::Path, found: &mut Vec<std::path::PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()) {
            match entry.is_dir() {
                true => sources(&entry, found),
                false => found.push(entry),
            }
        }
    }
    let mut files = Vec::new();
    sources(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut files);
    assert!(files.len() > 40);
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap();
        for clock in ["SystemTime", "ClockId::Realtime", "CLOCK_REALTIME", "gettimeofday"] {
            assert!(!text.contains(clock), "{} reads {clock}", file.display());
        }
    }
}

#[test]
fn fault_32_a_refused_wish_is_an_error_if_strict_and_a_warning_if_not() {
    let name = Name::new("strict");
    let plant = PlantThread::start(&name, body(), PlantSettings::lockstep(DT));
    let thread = ThreadSettings { priority: None, cpu: Some(100_000), lock_memory: false };
    let wish = RunSettings { thread, ticks: Some(50), ..toy::settings() };
    let (link, robot) = connect(&name.0, 10.0).unwrap();
    let (drops, _dropped) = std::sync::mpsc::channel();
    let build = SpringBuilder(drops.clone());
    let strict = RunSettings { strict: true, ..wish.clone() };
    let error = run_loop(link, robot, spring(1, &drops), build, &strict, &Stop::new()).err().unwrap();
    assert!(matches!(error, RunError::Strict(_)) && error.to_string().contains("core 100000"), "{error}");
    let report = LoopThread::start(&name, wish, |_| {}).join();
    assert!(report.warnings[0].contains("core 100000"), "{:?}", report.warnings);
    assert_eq!(report.modes["active"], 50);
    plant.end();
}
