//! Faults of processes and of the operating system, over real links.

use std::io::Write;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nearl_runtime::link::*;
use nearl_runtime::rt::*;

use super::flight::plan;
use crate::arm::{File, snapshot, start_with};
use crate::toy::{self, DT, LoopThread, Name, PlantThread, PointMass, SpringBuilder, spring};

const ROLE: &str = "NEARL_FAULT_ROLE";
const NAME: &str = "NEARL_FAULT_NAME";
const STRICT: &str = "NEARL_FAULT_STRICT";
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
        Ok("memory") => memory(&name),
        Ok("filled") => filled(&name),
        Ok("full-disk") => full_disk(&name),
        Ok("start") => {
            let _plant = PlantLink::open(&name, &toy::robot(true)).unwrap();
            let _runtime = RuntimeLink::open(&name).unwrap();
            println!("said started");
        }
        Ok("torn-plant") => torn_plant(&name),
        Ok("torn-driver") => torn_driver(&name),
        Ok("torn-runtime") => {
            let (link, robot) = connect(&name, 20.0).unwrap();
            let (drops, _dropped) = std::sync::mpsc::channel();
            let first = spring(1, &drops);
            let settings = toy::settings();
            let report = run_loop(link, robot, first, SpringBuilder(drops), &settings, &Stop::new()).unwrap();
            println!("said {} {}", report.reason, report.last_mode);
        }
        Ok("stranger") => stranger(&name),
        Ok("no-rights") => no_rights(&name),
        role => panic!("no such role: {role:?}"),
    }
}

/// Opens every end of the links in turn, then pushes more than there is memory for.
fn memory(name: &RobotName) {
    let say = |what: &str, result: Result<(), LinkError>| match result {
        Ok(()) => println!("said {what} opened"),
        Err(error) => println!("said {what} {}", error.code()),
    };
    say("plant", PlantLink::open(name, &toy::robot(false)).map(|_| ()));
    say("runtime", RuntimeLink::open(name).map(|_| ()));
    match TrainerLink::open(name) {
        Ok(mut trainer) => say("push", trainer.push(2, &vec![7; 64 << 20])),
        Err(error) => say("trainer", Err(error)),
    }
}

/// Both ends are open when the memory fills up: what they write from then on was reserved, or the first new page would end the process.
fn filled(name: &RobotName) {
    let plant = PlantLink::open(name, &toy::robot(true)).unwrap();
    let stop = Stop::new();
    let running = std::thread::spawn({
        let stop = stop.clone();
        move || PlantRunner::new(plant, PlantSettings::lockstep(DT)).unwrap().run(&mut body(), &stop)
    });
    let (link, robot) = connect(name, 20.0).unwrap();
    let mut rest = std::fs::File::create("/dev/shm/rest").unwrap();
    while rest.write_all(&[7; 4096]).is_ok() {}
    let (drops, _dropped) = std::sync::mpsc::channel();
    let settings = RunSettings { ticks: Some(3000), ..toy::settings() };
    let report = run_loop(link, robot, spring(1, &drops), SpringBuilder(drops), &settings, &Stop::new());
    stop.request();
    running.join().unwrap();
    let active = report.unwrap().modes["active"];
    println!("said filled {}", active > 1500);
}

/// The disk has room for 60 kB of log: the limit on the size of files stands in for it.
fn full_disk(name: &RobotName) {
    let log = std::env::temp_dir().join(format!("nearl-full-{}.mcap", std::process::id()));
    let (link, robot) = connect(name, 20.0).unwrap();
    let (drops, _dropped) = std::sync::mpsc::channel();
    let limit = libc::rlimit { rlim_cur: 60_000, rlim_max: 60_000 };
    // SAFETY: plain calls; this process ends after the run.
    unsafe {
        // As it is in any process: that the log's thread does not end it is the log's doing.
        libc::signal(libc::SIGXFSZ, libc::SIG_DFL);
        assert_eq!(libc::setrlimit(libc::RLIMIT_FSIZE, &raw const limit), 0);
    }
    let settings = RunSettings { ticks: Some(2000), log: Some(log.clone()), ..toy::settings() };
    let first = spring(1, &drops);
    let report = run_loop(link, robot, first, SpringBuilder(drops), &settings, &Stop::new()).unwrap();
    let _ = std::fs::remove_file(log);
    let said = report.log_error.as_deref().unwrap_or_default();
    assert!(said.contains("nearl-full-") && said.contains("File too large"), "{said}");
    assert!(report.log_drops > 1000, "{}", report.log_drops);
    assert_eq!((report.modes["active"], report.reason, report.counters.stale), (2000, Reason::Stop, 0));
}

/// A body that takes a while to come to rest, and says how it ended.
fn torn_plant(name: &RobotName) {
    struct Body(PointMass);
    impl Plant for Body {
        fn observe(&mut self, state: &mut StateMessage) {
            self.0.observe(state);
        }
        fn apply(&mut self, _: &ActionMessage) {
            self.0.v = 1.0;
        }
        fn brake(&mut self) {
            (self.0.braked, self.0.v) = (self.0.braked + 1, 0.9 * self.0.v);
        }
    }
    let link = PlantLink::open(name, &toy::robot(false)).unwrap();
    let mut plant = Body(PointMass { q: 1.0, ..PointMass::default() });
    let runner = PlantRunner::new(link, PlantSettings::simulator(DT)).unwrap();
    let report = runner.run(&mut plant, &Stop::new());
    println!(
        "said torn {} at rest {} braked {}",
        report.memory_torn,
        plant.0.v.abs() < 1e-2,
        plant.0.braked > 0
    );
}

/// A driver that keeps its own time: whether it was told to act, and what it is told once the memory is gone.
fn torn_driver(name: &RobotName) {
    let mut exchange = Exchange::open(name, &toy::robot(false), 0.02).unwrap();
    let mut state = [1.0, 0.0];
    let mut next = |exchange: &mut Exchange| {
        let turn = exchange.exchange(&state[..1], &state[1..], &state[..1], 2.0 * DT);
        let told = if matches!(turn, Turn::Brake) { "brake" } else { "act" };
        state[1] *= 0.9;
        state[0] += DT * state[1];
        std::thread::sleep(Duration::from_secs_f64(DT));
        told
    };
    let mut until_told = |what| while next(&mut exchange) != what {};
    until_told("act");
    until_told("brake");
    let last = (0..50).all(|_| next(&mut exchange) == "brake");
    println!("said brake {last} attached {}", exchange.is_attached());
}

/// As another user: nothing of root's links can be opened, and a folder that somebody else made is refused by name.
fn stranger(name: &RobotName) {
    const USER: libc::uid_t = 60_123;
    let root = std::path::Path::new("/dev/shm/nearl-0").join(name.as_str());
    // SAFETY: plain calls; this process is a stranger from here on.
    unsafe {
        assert_eq!(libc::setgroups(0, std::ptr::null()), 0);
        assert_eq!(libc::setresgid(USER, USER, USER), 0);
        assert_eq!(libc::setresuid(USER, USER, USER), 0);
    }
    for file in ["newest-state", "newest-action", "owner-plant", "alive", "token"] {
        let error = std::fs::File::open(root.join(file)).unwrap_err();
        assert_eq!(error.kind(), std::io::ErrorKind::PermissionDenied, "{file}: {error}");
    }
    let prefix = format!("nearl.{name}.");
    let segments = std::fs::read_dir("/dev/shm").unwrap().flatten();
    let segments: Vec<_> =
        segments.filter(|e| e.file_name().to_string_lossy().starts_with(&prefix)).collect();
    assert!(segments.len() > 2, "{segments:?}");
    for segment in segments {
        for write in [false, true] {
            let opened = std::fs::OpenOptions::new().read(!write).write(write).open(segment.path());
            assert_eq!(opened.unwrap_err().kind(), std::io::ErrorKind::PermissionDenied, "{segment:?}");
        }
    }
    // The folder of this user was made by root before, with what looks like a robot in it.
    let listed = remains();
    assert!(listed.is_empty(), "{listed:?}");
    let error = PlantLink::open(name, &toy::robot(true)).map(|_| ()).unwrap_err();
    println!("said {} {error}", error.code());
}

/// Without any right: first strict, then not.
fn no_rights(name: &RobotName) {
    let (link, robot) = connect(name, 20.0).unwrap();
    let none = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: plain calls; this process ends after the runs.
    unsafe {
        assert_eq!(libc::setrlimit(libc::RLIMIT_RTPRIO, &raw const none), 0);
        assert_eq!(libc::setrlimit(libc::RLIMIT_MEMLOCK, &raw const none), 0);
        if libc::geteuid() == 0 {
            assert_eq!(libc::setresuid(65534, 65534, 65534), 0);
        }
    }
    let strict = std::env::var(STRICT).is_ok();
    let thread = ThreadSettings { priority: Some(PRIORITY), cpu: None, lock_memory: true };
    let settings = RunSettings { thread, strict, ticks: Some(50), ..toy::settings() };
    let (drops, _dropped) = std::sync::mpsc::channel();
    let first = spring(1, &drops);
    let result = run_loop(link, robot, first, SpringBuilder(drops), &settings, &Stop::new());
    let said = match result {
        Ok(report) if !strict => {
            assert_eq!(report.modes["active"], 50);
            report.warnings.join("; ")
        }
        Err(error @ RunError::Strict(_)) if strict => error.to_string(),
        other => panic!("{other:?}"),
    };
    let priority = format!("no real-time priority {PRIORITY}");
    assert!(said.contains("memory is not locked") && said.contains(&priority), "{said}");
}

/// Says what is not tested here, past the harness that keeps what a test prints; with `NEARL_NO_SKIPS`, as where every means is at hand,
/// that is a failure.
pub fn skip(reason: &str) {
    assert!(std::env::var_os("NEARL_NO_SKIPS").is_none(), "not tested: {reason}");
    let _ = writeln!(std::io::stderr(), "SKIPPED, not tested: {reason}");
}

/// A process of these tests in a role of [`child`].
pub fn command_of(role: &str, name: &Name) -> Command {
    command(role, name)
}

fn command(role: &str, name: &Name) -> Command {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "faults::system::child", "--ignored", "--nocapture"]);
    command.env(ROLE, role).env(NAME, name.0.as_str()).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

pub fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(60);
    while !condition() {
        assert!(Instant::now() < end, "within 60 s: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

pub fn signal(child: &Child, signal: i32) {
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
    let settings = RunSettings { snapshot_age: Some(0.2), ..toy::settings() };
    let running = LoopThread::start(&name, settings, |_| {});
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
    until("the age of the snapshot is said", || viewer.health().is_some_and(|h| h.aged == 1));
    signal(&trainer, libc::SIGCONT);
    until("the trainer is back", || viewer.health().is_some_and(|h| h.swaps > still.swaps && h.aged == 0));
    trainer.kill().unwrap();
    trainer.wait().unwrap();
    let report = running.end();
    plant.end();
    assert_eq!((report.counters.stale, report.modes["fault"]), (0, 0));
    assert!(report.aged > 0, "{report}");
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

/// Memory of a process [bytes], all but what it maps from files and shared memory.
fn memory_of(child: &Child) -> u64 {
    let text = std::fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap();
    let line = text.lines().find(|l| l.starts_with("RssAnon:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() << 10
}

/// 20000 transitions that nobody reads would be 90 MB.
#[test]
fn fault_18_what_a_consumer_never_reads_takes_no_more_memory() {
    let name = Name::new("bounded");
    let plant = PlantThread::start(&name, body(), PlantSettings::lockstep(DT));
    let consumer = TrainerLink::open(&name.0).unwrap();
    let mut viewer = TrainerLink::open(&name.0).unwrap();
    let mut runtime = command("runtime", &name).spawn().unwrap();
    let mut taken = [(0, 0); 2];
    for (taken, ticks) in taken.iter_mut().zip([3000, 23_000]) {
        until("the loop goes on", || viewer.health().is_some_and(|h| h.tick > ticks));
        let shared = remains().into_iter().find(|r| r.name == name.0.as_str()).map_or(0, |r| r.bytes);
        *taken = (memory_of(&runtime), shared);
    }
    signal(&runtime, libc::SIGTERM);
    assert!(runtime.wait().unwrap().success());
    plant.end();
    drop(consumer);
    let [(before, shared), (after, shared_after)] = taken;
    assert!(after < before + (4 << 20), "own memory {before} B after 3000 ticks, {after} B after 23000");
    assert_eq!(shared_after, shared, "shared memory");
}

/// What the ends of the links say in a private `/dev/shm`, which needs user namespaces.
fn with_memory(options: &str, name: &Name) -> Option<Vec<String>> {
    in_memory("memory", options, name)
}

fn in_memory(role: &str, options: &str, name: &Name) -> Option<Vec<String>> {
    let script = format!("mount -t tmpfs -o {options} tmpfs /dev/shm || exit 77; exec \"$0\" \"$@\"");
    let inner = command(role, name);
    let run = |namespace: &str| {
        let mut outer = Command::new("unshare");
        outer.args([namespace, "sh", "-c", &script]).arg(inner.get_program()).args(inner.get_args());
        outer.env(ROLE, role).env(NAME, name.0.as_str()).output().ok()
    };
    let is_made = |output: &std::process::Output| output.status.code() != Some(1);
    let output = run("-rm").filter(is_made).or_else(|| run("-m"))?;
    if output.status.code().is_none() {
        panic!("killed instead of refused: {output:?}");
    }
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let said: Vec<String> = text.lines().filter_map(|l| l.split_once("said ")).map(|s| s.1.into()).collect();
    (!said.is_empty()).then_some(said)
}

#[test]
fn fault_20_shared_memory_that_is_tiny_or_read_only_is_refused_before_any_motion() {
    let name = Name::new("memory");
    let Some(enough) = with_memory("size=400M", &name) else {
        return skip("no private mount namespace (`unshare -rm`, or `unshare -m` as root) is permitted here");
    };
    assert_eq!(enough, ["plant opened", "runtime opened", "push opened"]);
    assert_eq!(
        with_memory("size=64M", &name).unwrap(),
        ["plant opened", "runtime opened", "push link-memory"],
        "a snapshot beyond the memory is refused, not written"
    );
    let all = |code: &str| ["plant", "runtime", "trainer"].map(|role| format!("{role} {code}"));
    assert_eq!(with_memory("size=1M", &name).unwrap(), all("link-memory"));
    assert_eq!(with_memory("size=64M,ro", &name).unwrap(), all("link-memory-missing"));
    let filled = in_memory("filled", "size=64M", &name).expect("memory that fills up later ends nobody");
    assert_eq!(filled, ["filled true"]);
}

#[test]
fn fault_29_a_disk_that_fills_up_costs_records_and_no_tick() {
    let name = Name::new("full-disk");
    let plant = PlantThread::start(&name, body(), PlantSettings::lockstep(DT));
    let output = command("full-disk", &name).stderr(Stdio::piped()).output().unwrap();
    let (body, counted) = plant.end();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // The same recursion without a log.
    let (mut q, mut v) = (1.0_f64, 0.0_f64);
    for action in body.applied.iter().take(2000) {
        assert_eq!(action.to_bits(), (-q).to_bits());
        v += action * DT;
        q += v * DT;
    }
    assert!(body.applied.len() >= 2000 && counted.watchdog == 0, "{counted:?}");
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
    for folder in ["src", "controller/src"] {
        sources(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(folder), &mut files);
    }
    assert!(files.len() > 40);
    // The command reads it once, before the loop starts, for the times of day in the flight log.
    for file in files.into_iter().filter(|file| !file.ends_with("src/cli.rs")) {
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

#[test]
fn fault_32_without_rights_strict_refuses_and_best_effort_warns() {
    for strict in [true, false] {
        let name = Name::new("no-rights");
        let plant = PlantThread::start(&name, body(), PlantSettings::lockstep(DT));
        let mut command = command("no-rights", &name);
        if strict {
            command.env(STRICT, "1");
        }
        let output = command.stderr(Stdio::piped()).output().unwrap();
        let (body, counted) = plant.end();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert_eq!(body.applied.is_empty(), strict, "a strict refusal comes before any motion");
        assert_eq!(counted.watchdog, 0);
    }
}

/// The program itself: what it says, and the code it ends with.
#[test]
fn a_run_that_ends_in_fault_says_when_and_why_and_ends_with_its_own_code() {
    let first = snapshot(1, |_| {});
    for (test, faults, code, says) in [
        ("ends-in-fault", plan(&[(100, 20, FaultKind::State { number: Odd::Nan })]), Some(6), true),
        ("ends-well", plan(&[]), Some(0), false),
        // Bridged, and the robot has not been there.
        ("jumps-once", plan(&[(100, 1, FaultKind::Jump { by: 100.0 })]), Some(0), false),
    ] {
        let (name, file) = (Name::new(test), File::new(test, &first));
        let plant = start_with(&name, &first, faults, Duration::from_micros(300));
        let mut command = Command::new(env!("CARGO_BIN_EXE_nearl-runtime"));
        command.arg("run").arg(&file.0).args([
            "--plant",
            name.0.as_str(),
            "--priority",
            "0",
            "--seconds",
            "0.4",
        ]);
        let out = command.output().unwrap();
        let (stdout, stderr) = (String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr));
        plant.end();
        assert_eq!(out.status.code(), code, "{stdout}{stderr}");
        assert_eq!(stderr.contains(": fault (bad-states): More states in a row"), says, "{stderr}");
        assert_eq!(
            stderr.lines().filter(|line| line.starts_with("tick ")).count(),
            usize::from(says),
            "{stderr}"
        );
        assert_eq!(stdout.contains("ended in fault (bad-states)"), says, "{stdout}");
        assert_eq!(stdout.contains("implausible 1"), test == "jumps-once", "{stdout}");
        assert!(!stdout.contains("found outside"), "{stdout}");
    }
}

/// A plant that leaves a loop in Fault does not hide it: who starts the plant again must not start the loop again unseen.
#[test]
fn a_run_in_fault_whose_plant_leaves_ends_with_the_code_of_fault() {
    let first = snapshot(1, |_| {});
    let nan = FaultKind::State { number: Odd::Nan };
    for (test, faults, code) in [("left-in-fault", plan(&[(100, 20, nan)]), 6), ("left-well", plan(&[]), 3)] {
        let (name, file) = (Name::new(test), File::new(test, &first));
        let plant = start_with(&name, &first, faults, Duration::from_micros(300));
        let mut command = Command::new(env!("CARGO_BIN_EXE_nearl-runtime"));
        command.arg("run").arg(&file.0).args(["--plant", name.0.as_str(), "--priority", "0"]);
        command.args(["--seconds", "60", "--plant-patience", "0.5"]);
        let running = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut viewer = TrainerLink::open(&name.0).unwrap();
        let begin = Instant::now();
        while viewer.health().is_none_or(|h| h.tick <= 200) {
            assert!(begin.elapsed() < PATIENCE, "the loop does not run");
            std::thread::sleep(Duration::from_millis(5));
        }
        plant.end();
        let out = running.wait_with_output().unwrap();
        let (stdout, stderr) = (String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr));
        assert_eq!(out.status.code(), Some(code), "{stdout}{stderr}");
        assert!(stdout.contains("(plant-gone)"), "{stdout}");
    }
}
