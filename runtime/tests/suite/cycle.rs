//! The loop with a toy plant over real links: modes, swaps, refusals, accounting. No test asserts a time.

use std::time::Duration;

use crate::toy::*;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;

const PATIENCE: Duration = Duration::from_secs(20);

fn limited(ticks: u64) -> RunSettings {
    RunSettings { ticks: Some(ticks), ..settings() }
}

#[test]
fn lockstep_gives_each_state_its_own_action() {
    let name = Name::new("lockstep");
    let start = PointMass { q: 1.0, ..PointMass::default() };
    let plant = PlantThread::start(&name, start, PlantSettings::lockstep(DT));
    let report = LoopThread::start(&name, limited(2000), |_| {}).join();
    let (plant, counted) = plant.end();
    // The same recursion without any link: an action computed from any other state would leave it.
    let (mut q, mut v) = (1.0_f64, 0.0_f64);
    for (tick, action) in plant.applied.iter().take(2000).enumerate() {
        assert_eq!(action.to_bits(), (-q).to_bits(), "tick {tick}");
        v += action * DT;
        q += v * DT;
    }
    assert!(plant.applied.len() >= 2000);
    assert_eq!((counted.late, counted.watchdog), (0, 0));
    assert_eq!((report.counters.lost_states, report.counters.stale, report.counters.overruns), (0, 0, 0));
    assert_eq!(report.counters.raw_violations, 2000);
    assert_eq!(report.modes["active"], 2000);
    assert_eq!(report.last_mode, Mode::Braking);
    assert_eq!(report.reason, Reason::Stop);
}

#[test]
fn a_stop_brakes_to_zero_velocity() {
    let name = Name::new("stop");
    let start = PointMass { q: 0.5, v: 3.0, ..PointMass::default() };
    let plant = PlantThread::start(&name, start, PlantSettings::lockstep(DT));
    let report = LoopThread::start(&name, limited(50), |_| {}).join();
    let (plant, _) = plant.end();
    assert_eq!(report.last_mode, Mode::Braking);
    // The runtime's own braking action, not the plant's: v - (v/dt) dt.
    assert!(plant.applied.len() > 50);
    assert!(plant.v.abs() < 1e-9, "v = {}", plant.v);
}

#[test]
fn own_clock_accounts_for_every_slot() {
    let name = Name::new("clock");
    let plant =
        PlantThread::start(&name, PointMass { q: 1.0, ..PointMass::default() }, PlantSettings::real_time(DT));
    let report = LoopThread::start(&name, RunSettings { sync: Sync::Clock, ..limited(300) }, |_| {}).join();
    plant.end();
    let ticks: u64 = report.modes.values().sum();
    assert_eq!(ticks, report.ticks);
    assert!(report.counters.skipped >= report.counters.overruns);
    // Slots used and skipped cover the time of the run: the grid did not drift.
    let slots = (report.ticks + report.counters.skipped) as f64;
    assert!(slots * DT <= report.seconds + DT, "{slots} slots in {} s", report.seconds);
}

#[test]
fn each_episode_begins_with_a_reset() {
    let name = Name::new("episodes");
    let start = PointMass { q: 1.0, episode_ticks: 100, ..PointMass::default() };
    let plant = PlantThread::start(&name, start, PlantSettings::lockstep(DT));
    let mut resets = Default::default();
    let running = LoopThread::start(&name, limited(450), |spring| resets = spring.resets.clone());
    running.join();
    plant.end();
    assert_eq!(resets.load(std::sync::atomic::Ordering::Relaxed), 5, "the first state and four new episodes");
}

#[test]
fn a_silent_plant_makes_the_loop_brake_and_come_back() {
    let name = Name::new("stale");
    let frozen =
        PointMass { q: 1.0, freeze: Some((100, Duration::from_millis(300))), ..PointMass::default() };
    let plant = PlantThread::start(&name, frozen, PlantSettings::lockstep(DT));
    let settings = RunSettings { age_limit: Some(0.02), ..limited(400) };
    let report = LoopThread::start(&name, settings, |_| {}).join();
    plant.end();
    assert!(report.counters.stale >= 1, "{:?}", report.counters);
    assert!(report.modes["braking"] >= 1);
    // 10 good ticks later it is Active again, and at least 100 ticks came before the silence.
    assert!(report.modes["active"] > 110, "{:?}", report.modes);
}

#[test]
fn bad_states_brake_and_then_latch() {
    let name = Name::new("nan");
    let plant = PointMass { q: 1.0, nan: Some((50, 5)), ..PointMass::default() };
    let plant = PlantThread::start(&name, plant, PlantSettings::lockstep(DT));
    let report = LoopThread::start(&name, limited(200), |_| {}).join();
    let (body, _) = plant.end();
    assert_eq!((report.counters.bad_states, report.counters.held), (5, 3));
    // Three are bridged, two are not, and then it takes ten good ones to come back.
    assert_eq!((report.modes["degraded"], report.modes["fault"]), (3, 0));
    assert!(report.modes["braking"] >= 2 + 9, "{:?}", report.modes);
    assert!(report.modes["active"] > 150, "{:?}", report.modes);
    assert!(body.applied.iter().all(|a| a.is_finite()));
    assert!(body.braked >= 2, "the plant brakes itself while the state is unusable");

    let name = Name::new("nan-latched");
    let plant = PointMass { q: 1.0, nan: Some((50, 9)), ..PointMass::default() };
    let plant = PlantThread::start(&name, plant, PlantSettings::lockstep(DT));
    let report = LoopThread::start(&name, limited(200), |_| {}).join();
    plant.end();
    assert_eq!((report.last_mode, report.reason), (Mode::Fault, Reason::BadStates));
}

#[test]
fn a_panic_in_the_controller_is_a_latched_fault() {
    let name = Name::new("panic");
    let start = PointMass { q: 1.0, ..PointMass::default() };
    let plant = PlantThread::start(&name, start, PlantSettings::lockstep(DT));
    let report = LoopThread::start(&name, limited(100), |spring| spring.panics_at = Some(30)).join();
    let (body, _) = plant.end();
    assert_eq!((report.last_mode, report.reason), (Mode::Fault, Reason::Panic));
    // 29 actions of the controller, then braking, which does not depend on what panicked.
    assert!(body.applied.len() > 29);
    assert_eq!(body.v, 0.0);
}

#[test]
fn hot_swap_changes_the_version_between_two_ticks() {
    let name = Name::new("swap");
    let start = PointMass { q: 1.0, ..PointMass::default() };
    let plant = PlantThread::start(&name, start, PlantSettings::lockstep(DT));
    let running = LoopThread::start(&name, settings(), |_| {});
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(PATIENCE).unwrap();
    for version in 2..=6 {
        trainer.push(version, b"spring").unwrap();
        let receipt = trainer.wait_for_receipt(version, PATIENCE).unwrap();
        assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    }
    let drops: Vec<_> = (0..4).map(|_| running.drops.recv_timeout(PATIENCE).unwrap()).collect();
    let versions: Vec<_> = drops.iter().map(|d| d.0).collect();
    assert_eq!(versions, [1, 2, 3, 4], "the one before is kept, the one before that is dropped");
    assert!(running.drops.try_recv().is_err(), "the one before is kept");
    let builder = drops[0].1;
    assert!(drops.iter().all(|d| d.1 == builder), "all by the one thread that has the time");
    let report = running.end();
    let (plant, _) = plant.end();
    assert_eq!(report.counters.swaps, 5);
    assert_eq!(report.versions.iter().map(|v| v.1).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6]);
    assert!(plant.versions.is_sorted(), "no tick mixes versions, none goes back");
    // Each action belongs to the version it names: action = -version q in Active.
    let (mut q, mut v) = (1.0_f64, 0.0_f64);
    let active = report.modes["active"] as usize;
    for (action, version) in plant.applied.iter().zip(&plant.versions).take(active) {
        assert_eq!(*action, -(*version as f64) * q);
        v += action * DT;
        q += v * DT;
    }
}

/// A trainer that comes before the first tick counts on from the version in use.
#[test]
fn the_version_is_told_before_the_first_tick() {
    let name = Name::new("early");
    let mut plant = PlantLink::open(&name.0, &robot(true)).unwrap();
    let over = Stop::new();
    let waits = std::thread::spawn({
        let over = over.clone();
        move || {
            while !over.is_requested() {
                plant.announce();
                std::thread::sleep(Duration::from_millis(1));
            }
        }
    });
    let running = LoopThread::start(&name, settings(), |spring| spring.version = 7);
    let health = TrainerLink::open(&name.0).unwrap().wait_for_runtime(PATIENCE).unwrap();
    assert_eq!((health.tick, health.policy_version), (0, 7));
    running.end();
    over.request();
    waits.join().unwrap();
}

#[test]
fn bad_snapshots_get_a_reason_and_the_loop_keeps_running() {
    let name = Name::new("refuse");
    let plant = PlantThread::start(&name, PointMass::default(), PlantSettings::lockstep(DT));
    let running = LoopThread::start(&name, settings(), |_| {});
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    let before = trainer.wait_for_runtime(PATIENCE).unwrap();
    let cases: [(u64, &[u8], Verdict, &str); 4] = [
        (2, b"garbage", Verdict::Corrupt, "digest"),
        (3, b"other robot", Verdict::ForeignRobot, "`slide`"),
        (4, b"panic", Verdict::Other, "validation"),
        (1, b"spring", Verdict::Outdated, "higher version"),
    ];
    for (version, bytes, verdict, word) in cases {
        trainer.push(version, bytes).unwrap();
        let receipt = trainer.wait_for_receipt(version, PATIENCE).unwrap();
        assert_eq!(receipt.verdict(), verdict, "{}", receipt.text());
        assert!(receipt.text().contains(word), "{}", receipt.text());
    }
    trainer.push(5, &vec![7; 3 << 20]).unwrap(); // grows the segment
    assert_eq!(trainer.wait_for_receipt(5, PATIENCE).unwrap().verdict(), Verdict::Corrupt);
    let transition = std::iter::from_fn(|| trainer.transition()).last().unwrap();
    assert_eq!((transition.policy_version, transition.nq), (1, 1));
    assert_eq!(transition.next_state_seq, transition.state_seq + 1);
    let report = running.end();
    plant.end();
    assert!(report.ticks > before.tick);
    assert_eq!((report.counters.swaps, report.refused_snapshots), (0, 5));
    assert_eq!(report.counters.stale, 0);
    assert_eq!(report.refusals.len(), 5);
}

#[test]
fn a_runtime_that_ends_in_order_does_not_trip_the_watchdog() {
    let name = Name::new("farewell");
    let start = PointMass { q: 1.0, v: 1.0, ..PointMass::default() };
    // A watchdog of an hour: only the farewell can make the plant brake by itself.
    let settings = PlantSettings { watchdog: 3600.0, ..PlantSettings::real_time(DT) };
    let plant = PlantThread::start(&name, start, settings);
    let report = LoopThread::start(&name, limited(50), |_| {}).join();
    let mut viewer = TrainerLink::open(&name.0).unwrap();
    let state = |viewer: &mut TrainerLink| loop {
        if let Some(state) = viewer.state() {
            return state;
        }
    };
    let first = state(&mut viewer).tick;
    while state(&mut viewer).tick < first + 20 {}
    let (body, counted) = plant.end();
    assert_eq!(report.last_mode, Mode::Braking);
    assert_eq!((counted.watchdog, body.v), (0, 0.0));
    assert!(counted.braked > 0);
}

#[test]
fn states_of_the_wrong_size_are_refused_and_counted() {
    struct Liar(PointMass);
    impl Plant for Liar {
        fn observe(&mut self, state: &mut StateMessage) {
            self.0.observe(state);
            if self.0.tick > 10 {
                state.nq = 4_000_000_000;
            }
        }
        fn apply(&mut self, action: &ActionMessage) {
            self.0.apply(action);
        }
        fn brake(&mut self) {
            self.0.brake();
        }
    }
    let name = Name::new("liar");
    let link = PlantLink::open(&name.0, &robot(false)).unwrap();
    let stop = Stop::new();
    let plant = std::thread::spawn({
        let stop = stop.clone();
        move || {
            let runner = PlantRunner::new(link, PlantSettings::real_time(DT)).unwrap();
            runner.run(&mut Liar(PointMass::default()), &stop)
        }
    });
    let running = LoopThread::start(&name, settings(), |_| {});
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    while trainer.health().is_none_or(|health| health.refused_states == 0) {
        std::thread::sleep(Duration::from_millis(5));
    }
    let report = running.end();
    stop.request();
    plant.join().unwrap();
    assert!(report.refused_states > 0);
    assert_ne!(report.last_mode, Mode::Active);
}

/// Its states are none, and the report says what is otherwise.
#[test]
fn a_plant_that_comes_back_as_another_robot_is_named() {
    let name = Name::new("other-robot");
    let first = PlantLink::open(&name.0, &robot(false)).unwrap();
    let runs = |link, stop: &Stop| {
        let stop = stop.clone();
        std::thread::spawn(move || {
            PlantRunner::new(link, PlantSettings::real_time(DT))
                .unwrap()
                .run(&mut PointMass::default(), &stop)
        })
    };
    let stop = Stop::new();
    let plant = runs(first, &stop);
    let running = LoopThread::start(&name, RunSettings { plant_patience: 60.0, ..settings() }, |_| {});
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    let mut until = |what: &str, is: &dyn Fn(&HealthMessage) -> bool| {
        let begin = std::time::Instant::now();
        while !trainer.health().is_some_and(|health| is(&health)) {
            assert!(begin.elapsed() < Duration::from_secs(20), "{what}");
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    until("the loop runs", &|health| health.tick > 20);
    stop.request();
    plant.join().unwrap();
    let slower = Robot { dt: 2.0 * DT, ..robot(false) };
    let stop = Stop::new();
    let plant = runs(PlantLink::open(&name.0, &slower).unwrap(), &stop);
    until("its states are refused", &|health| health.refused_states > 5);
    let report = running.end();
    stop.request();
    plant.join().unwrap();
    let said =
        format!("another robot, its control period is {} s, and was {DT} s, and got no action", 2.0 * DT);
    assert!(report.warnings.iter().any(|warning| warning.contains(&said)), "{report}");
}
