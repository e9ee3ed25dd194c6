//! Who may connect to what, and what the plant does alone.

use std::time::Duration;

use crate::toy::*;
use nearl_runtime::link::*;

#[test]
fn a_second_owner_is_refused_by_role() {
    let name = Name::new("owner");
    let plant = PlantLink::open(&name.0, &robot(false)).unwrap();
    let runtime = RuntimeLink::open(&name.0).unwrap();
    let error = RuntimeLink::open(&name.0).err().unwrap();
    assert_eq!(error, LinkError::Taken { name: name.0.clone(), role: "runtime" });
    assert_eq!(error.code(), "link-taken");
    let error = PlantLink::open(&name.0, &robot(false)).err().unwrap();
    assert_eq!(error, LinkError::Taken { name: name.0.clone(), role: "plant" });
    drop(runtime);
    RuntimeLink::open(&name.0).unwrap();
    drop(plant);

    let mut first = TrainerLink::open(&name.0).unwrap();
    let mut second = TrainerLink::open(&name.0).unwrap();
    first.push(1, b"a").unwrap();
    assert_eq!(second.push(1, b"b"), Err(LinkError::Taken { name: name.0.clone(), role: "trainer" }));
}

/// What a tick did is told only where somebody reads it; a trainer holds the topic without reading.
#[test]
fn a_loop_knows_whether_somebody_looks_on() {
    let name = Name::new("watched");
    let mut runtime = RuntimeLink::open(&name.0).unwrap();
    let _trainer = TrainerLink::open(&name.0).unwrap();
    assert!(!runtime.is_watched());
    let mut view = ViewLink::open(&name.0).unwrap();
    assert!(runtime.is_watched());
    let mut tick = TickMessage::zeroed();
    tick.tick = 7;
    assert!(runtime.send_tick(&mut tick));
    assert_eq!(view.tick().map(|t| t.tick), Some(7));
    drop(view);
    assert!(!runtime.is_watched());
}

#[test]
fn a_missing_peer_is_named_with_what_to_start() {
    let name = Name::new("alone");
    let error = nearl_runtime::rt::connect(&name.0, 0.05).err().unwrap();
    assert!(error.to_string().contains(&format!("nearl plant TASK --name {}", name.0)), "{error}");
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    let error = trainer.wait_for_runtime(Duration::from_millis(50)).unwrap_err();
    assert!(error.to_string().contains(&format!("nearl run SNAPSHOT --plant {}", name.0)), "{error}");
}

#[test]
fn a_robot_beyond_the_capacity_is_refused_with_the_number() {
    let name = Name::new("large");
    let large = Robot { nv: 65, ..robot(false) };
    let error = PlantLink::open(&name.0, &large).err().unwrap().to_string();
    assert!(error.contains("65 velocity entries") && error.contains("64"), "{error}");
}

#[test]
fn names_do_not_meet() {
    let (a, b) = (Name::new("a"), Name::new("a-b"));
    let mut plant_a = PlantLink::open(&a.0, &robot(false)).unwrap();
    let mut plant_b = PlantLink::open(&b.0, &Robot { dt: 0.5, ..robot(false) }).unwrap();
    let (mut runtime_a, mut runtime_b) = (RuntimeLink::open(&a.0).unwrap(), RuntimeLink::open(&b.0).unwrap());
    assert!(plant_a.announce() && plant_b.announce());
    let patience = Duration::from_secs(5);
    let robot_a = runtime_a.wait_for_plant(patience).unwrap();
    let robot_b = runtime_b.wait_for_plant(patience).unwrap();
    assert_eq!((robot_a.dt, robot_b.dt), (DT, 0.5));
    assert_eq!(robot_a.joint_names(), ["slide"]);
}

#[test]
fn what_hangs_in_its_creation_is_cleared_away() {
    use std::os::unix::fs::PermissionsExt;
    let name = Name::new("hangs");
    let user = std::fs::metadata("/proc/self").map(|m| std::os::unix::fs::MetadataExt::uid(&m)).unwrap();
    let services = std::path::PathBuf::from(format!("/dev/shm/nearl-{user}/{}/services", name.0));
    // While somebody has links of the robot nothing may be begun anew.
    let _plant = PlantLink::open(&name.0, &robot(false)).unwrap();
    let listed = || std::fs::read_dir(&services).unwrap().map(|f| f.unwrap().path()).collect::<Vec<_>>();
    let link = RuntimeLink::open(&name.0).unwrap();
    let mut files = listed();
    drop(link);
    let left = listed();
    files.retain(|file| !left.contains(file));
    assert!(files.len() >= 4 && !left.is_empty(), "{files:?} {left:?}");
    // As a process leaves it that is killed between creating a service and finishing its description.
    std::fs::write(&files[0], "").unwrap();
    std::fs::set_permissions(&files[0], PermissionsExt::from_mode(0o600)).unwrap();
    RuntimeLink::open(&name.0).unwrap();
}

#[test]
fn late_subscribers_still_get_the_last_snapshot() {
    let name = Name::new("late");
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.push(7, b"weights").unwrap();
    let mut runtime = RuntimeLink::open(&name.0).unwrap();
    let mut reader = runtime.take_snapshots().unwrap();
    trainer.attend();
    let snapshot = reader.next().unwrap();
    assert_eq!((snapshot.header.version, snapshot.bytes.as_slice()), (7, &b"weights"[..]));
}

#[test]
fn a_plant_alone_brakes_from_the_start() {
    let name = Name::new("unattended");
    let settings = PlantSettings { ticks: Some(20), ..PlantSettings::real_time(DT) };
    let link = PlantLink::open(&name.0, &robot(false)).unwrap();
    let mut body = PointMass { v: 2.0, ..PointMass::default() };
    let stop = nearl_runtime::rt::Stop::new();
    let report = PlantRunner::new(link, settings).unwrap().run(&mut body, &stop);
    assert_eq!((report.ticks, report.braked, report.fresh), (20, 20, 0));
    assert_eq!((body.braked, body.v), (20, 0.0));
    assert_eq!(report.watchdog, 0, "nothing was lost: there never was a runtime");
}

#[test]
fn the_watchdog_takes_over_when_actions_stop() {
    let name = Name::new("watchdog");
    let settings = PlantSettings { watchdog: 1.0, ..PlantSettings::real_time(DT) }; // longer than a starved machine pauses
    let plant = PlantThread::start(&name, PointMass { q: 1.0, ..PointMass::default() }, settings);
    // A runtime that answers until its 20th action and then falls silent, as a killed one would.
    let (mut link, _) = nearl_runtime::rt::connect(&name.0, 5.0).unwrap();
    let mut action = ActionMessage::zeroed();
    let mut answers = 0;
    while answers < 20 {
        let Some(state) = link.newest_state() else { continue };
        (action.state_epoch, action.state_seq) = (state.header.epoch, state.header.seq);
        (action.nu, action.action[0]) = (1, 0.5);
        link.send_action(&mut action);
        answers += 1;
    }
    let (body, report) = loop {
        if body_is_still(&mut link) {
            break plant.end();
        }
    };
    assert_eq!(report.watchdog, 1);
    assert!(report.late > 0, "the last action is held first");
    assert_eq!(body.v, 0.0);
    assert!(body.braked > 0);
}

fn body_is_still(link: &mut RuntimeLink) -> bool {
    std::thread::sleep(Duration::from_millis(5));
    link.newest_state().is_some_and(|state| state.watchdog > 0 && state.v()[0] == 0.0)
}

/// A driver holds what it has applied, and nothing else; its states say what it did.
#[test]
fn a_driver_holds_no_answer_that_it_has_not_applied() {
    let name = Name::new("held");
    let mut plant = Exchange::open(&name.0, &robot(false), 5.0).unwrap();
    let mut link = RuntimeLink::open(&name.0).unwrap();
    let newest = |link: &mut RuntimeLink| *link.newest_state().expect("a state");
    let answer = |link: &mut RuntimeLink, state: &StateMessage| {
        let mut action = ActionMessage::zeroed();
        (action.state_epoch, action.state_seq) = (state.header.epoch, state.header.seq);
        (action.nu, action.action[0]) = (1, 0.5);
        link.send_action(&mut action);
    };
    assert_eq!(plant.tick(0.0), Turn::Brake);
    let state = newest(&mut link);
    answer(&mut link, &state);
    assert_eq!(plant.tick(0.0), Turn::Brake, "there is a loop, but its answer came too late");
    assert!(plant.is_attached());
    let state = newest(&mut link);
    assert_eq!((state.bits & STATE_BRAKED, state.late), (STATE_BRAKED, 0));

    std::thread::scope(|scope| {
        scope.spawn(|| {
            let next = loop {
                match link.newest_state() {
                    Some(next) => break *next,
                    None => std::thread::yield_now(),
                }
            };
            answer(&mut link, &next);
        });
        assert_eq!(plant.tick(5.0), Turn::Act(&[0.5]));
    });
    assert_eq!(plant.tick(0.0), Turn::Hold(&[0.5]));
    let state = newest(&mut link);
    assert_eq!((state.bits & STATE_BRAKED, state.late), (0, 0));
    plant.state().bits = STATE_RESET | STATE_BRAKED;
    assert_eq!(plant.tick(0.0), Turn::Hold(&[0.5]));
    let state = newest(&mut link);
    assert_eq!((state.bits, state.late), (STATE_RESET, 1));
}
