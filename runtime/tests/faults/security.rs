//! Files that another user, or another program of the same user, prepared or takes away: see docs/SECURITY.md.

use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::Stdio;

use nearl_runtime::link::*;
use nearl_runtime::log::replay;
use nearl_runtime::rt::*;
use nearl_runtime::{Snapshot, Task};

use super::system::{command_of, skip, until};
use crate::arm::*;
use crate::toy::{self, Name};

fn fifo(path: &Path) {
    let name = std::ffi::CString::new(path.to_str().unwrap()).unwrap();
    // SAFETY: plain call with a path that ends in a zero.
    assert_eq!(unsafe { libc::mkfifo(name.as_ptr(), 0o600) }, 0);
}

/// None of these calls may wait for the other end of a pipe, or read without end.
#[test]
fn fault_40_what_is_no_file_is_refused_at_once_at_every_path_that_is_opened() {
    let folder = Scratch::new("odd-paths");
    let at = |name: &str| folder.0.join(name);
    fifo(&at("fifo"));
    symlink("/dev/zero", at("endless")).unwrap();
    let large = std::fs::File::create(at("large")).unwrap();
    large.set_len(1 << 40).unwrap();
    let manifest = snapshot(1, |_| {}).manifest;
    let odd =
        [at("fifo"), at("endless"), "/dev/zero".into(), "/dev/tty".into(), folder.0.clone(), at("large")];
    for path in &odd {
        let shown = path.display().to_string();
        let model = nearl_constraints::Model::from_urdf(path).map(|_| ()).map_err(|e| e.to_string());
        let said = [
            ("robot", model),
            ("task", Task::read(path, &[]).map(|_| ()).map_err(|e| e.to_string())),
            ("faults", FaultPlan::load(path).map(|_| ()).map_err(|e| e.to_string())),
            ("limits", Pinned::read(path, &manifest).map(|_| ()).map_err(|e| e.to_string())),
            ("snapshot", Snapshot::load(path).map(|_| ()).map_err(|e| e.to_string())),
            ("log", replay(path).map(|_| ()).map_err(|e| e.to_string())),
        ];
        for (what, result) in said {
            let error = result.expect_err(what);
            assert!(error.contains(&shown), "{what}: '{shown}' is not in: {error}");
        }
    }
    // A log is written to a new file only.
    let name = Name::new("odd-log");
    let plant = toy::PlantThread::start(&name, toy::PointMass::default(), PlantSettings::lockstep(toy::DT));
    for path in odd.iter().filter(|p| !p.ends_with("large")) {
        let (link, robot) = connect(&name.0, 20.0).unwrap();
        let (drops, _dropped) = std::sync::mpsc::channel();
        let settings = RunSettings { log: Some(path.clone()), ticks: Some(5), ..toy::settings() };
        let first = toy::spring(1, &drops);
        let build = toy::SpringBuilder(drops.clone());
        let error = run_loop(link, robot, first, build, &settings, &Stop::new()).map(|_| ()).unwrap_err();
        assert!(error.to_string().contains("not a regular file"), "{error}");
    }
    plant.end();
}

/// Boards, roles and locks: what stands in their place is refused by name, or replaced where only this user can have put it.
#[test]
fn fault_40_what_stands_in_the_place_of_boards_and_roles_stops_no_start() {
    let name = Name::new("odd-links");
    let folder = home(&name);
    let hold = TrainerLink::open(&name.0).unwrap(); // nothing is cleared away while somebody is there
    for file in ["newest-state", "newest-state.half"] {
        fifo(&folder.join(file));
    }
    symlink("/etc/passwd", folder.join("newest-action")).unwrap();
    fifo(&folder.join("owner-plant"));
    let error = PlantLink::open(&name.0, &toy::robot(true)).map(|_| ()).unwrap_err();
    assert_eq!(error.code(), "link-foreign", "{error}");
    assert!(error.to_string().contains("owner-plant"), "{error}");
    std::fs::remove_file(folder.join("owner-plant")).unwrap();
    let mut plant = PlantLink::open(&name.0, &toy::robot(true)).unwrap();
    plant.attend();
    assert!(plant.newest_action().is_none(), "a link is not followed");
    let state = std::fs::symlink_metadata(folder.join("newest-state")).unwrap();
    assert!(state.is_file() && state.permissions().mode() & 0o077 == 0);
    drop((plant, hold));
}

fn home(name: &Name) -> PathBuf {
    // SAFETY: plain call.
    let user = unsafe { libc::geteuid() };
    PathBuf::from(format!("/dev/shm/nearl-{user}")).join(name.0.as_str())
}

#[test]
fn fault_41_another_user_can_open_nothing_and_what_another_user_made_is_refused_by_name() {
    // SAFETY: plain call.
    if unsafe { libc::geteuid() } != 0 {
        return skip("only root can become another user");
    }
    let name = Name::new("stranger");
    let _plant = PlantLink::open(&name.0, &toy::robot(true)).unwrap();
    let _runtime = RuntimeLink::open(&name.0).unwrap();
    let theirs = Path::new("/dev/shm/nearl-60123");
    std::fs::create_dir_all(theirs).unwrap();
    std::fs::set_permissions(theirs, PermissionsExt::from_mode(0o777)).unwrap();
    std::fs::create_dir_all(theirs.join("listed")).unwrap();
    std::fs::write(theirs.join("listed/newest-state"), "listed").unwrap();
    let output =
        command_of("stranger", &name).stdout(Stdio::piped()).stderr(Stdio::piped()).output().unwrap();
    std::fs::remove_dir_all(theirs).unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout);
    let said = text.lines().find_map(|l| l.split_once("said ")).unwrap().1;
    for word in ["link-foreign", "/dev/shm/nearl-60123", "belongs to user 0"] {
        assert!(said.contains(word), "'{word}' is not in: {said}");
    }
}

/// Names that another user gave are in no list, whatever lies under them, and nothing of that user's is touched, not even by root.
#[test]
fn fault_41_what_another_user_made_is_in_no_list_and_stays() {
    // SAFETY: plain call.
    if unsafe { libc::geteuid() } != 0 {
        return skip("only root can give files to another user");
    }
    let (mine, theirs) = (Name::new("mine"), Name::new("theirs"));
    let given = |path: &Path| std::os::unix::fs::chown(path, Some(60_124), Some(60_124)).unwrap();
    let segments = [&mine, &theirs].map(|name| {
        let path = PathBuf::from(format!("/dev/shm/nearl.{}.0123456789abcdef.decoy", name.0));
        std::fs::write(&path, "theirs").unwrap();
        given(&path);
        path
    });
    let folder = home(&theirs);
    drop(TrainerLink::open(&theirs.0).unwrap()); // makes it
    std::fs::write(folder.join("newest-state"), "theirs").unwrap();
    given(&folder.join("newest-state"));
    let listed = |name: &Name| remains().into_iter().find(|r| r.name == name.0.as_str());
    assert!(listed(&theirs).is_none(), "a file of theirs in a folder of ours");
    given(&folder);
    assert!(listed(&theirs).is_none(), "a folder of theirs");
    assert!(listed(&mine).is_none(), "a segment of theirs that is called as ours");
    let plant = PlantLink::open(&mine.0, &toy::robot(true)).unwrap();
    let found = listed(&mine).expect("ours is listed");
    assert!((found.alive, found.dead, found.held) == (1, 0, true), "{found:?}");
    let checks = nearl_runtime::doctor::examine(Path::new("no-such-snapshot"), None);
    assert!(checks.iter().all(|c| !c.text.contains(theirs.0.as_str())), "{checks:?}");
    drop(plant);
    remove_files(&theirs.0);
    for path in segments.iter().chain([&folder.join("newest-state")]) {
        assert_eq!(std::fs::read_to_string(path).unwrap(), "theirs", "{}", path.display());
    }
    segments.iter().for_each(|path| std::fs::remove_file(path).unwrap());
    std::fs::remove_dir_all(folder).unwrap();
}

/// Made shorter while both ends read and write it: a named end and a robot at rest, not a SIGBUS.
#[test]
fn fault_42_files_truncated_in_use_brake_the_plant_and_end_both_by_name() {
    let name = Name::new("truncated");
    let mut hold = TrainerLink::open(&name.0).unwrap();
    let start = |role| command_of(role, &name).stdout(Stdio::piped()).spawn().unwrap();
    let (plant, runtime) = (start("torn-plant"), start("torn-runtime"));
    until("the loop runs", || hold.health().is_some_and(|h| h.tick > 200));
    for file in ["newest-state", "newest-action"] {
        std::fs::File::options().write(true).open(home(&name).join(file)).unwrap().set_len(0).unwrap();
    }
    let said = |child: std::process::Child| {
        let output = child.wait_with_output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{}: {text}", output.status);
        text.lines().find_map(|l| l.split_once("said ")).unwrap_or_else(|| panic!("{text}")).1.to_owned()
    };
    assert_eq!(said(plant), "torn true at rest true braked true");
    let runtime = said(runtime);
    assert!(runtime.starts_with("memory-torn"), "{runtime}");
}

/// The same of a driver that keeps its own time: it had ended by SIGBUS, and nothing braked its robot.
#[test]
fn fault_42_a_driver_whose_files_are_truncated_is_told_to_brake() {
    let name = Name::new("torn-driver");
    let mut hold = TrainerLink::open(&name.0).unwrap();
    let start = |role| command_of(role, &name).stdout(Stdio::piped()).spawn().unwrap();
    let (driver, runtime) = (start("torn-driver"), start("torn-runtime"));
    until("the loop runs", || hold.health().is_some_and(|h| h.tick > 200));
    for file in ["newest-state", "newest-action"] {
        std::fs::File::options().write(true).open(home(&name).join(file)).unwrap().set_len(0).unwrap();
    }
    let output = driver.wait_with_output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        output.status.success() && text.contains("said brake true attached false"),
        "{}: {text}",
        output.status
    );
    let ended = runtime.wait_with_output().unwrap();
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stdout));
}

/// Folders with long names hold nothing of the links: they lie in one place whatever TMPDIR says.
#[test]
fn fault_40_a_long_temporary_folder_changes_nothing() {
    let name = Name::new("long-tmp");
    let plant = toy::PlantThread::start(&name, toy::PointMass::default(), PlantSettings::lockstep(toy::DT));
    let folder = Scratch::new(&"x".repeat(145));
    let mut runtime = command_of("runtime", &name).env("TMPDIR", &folder.0).spawn().unwrap();
    let mut viewer = TrainerLink::open(&name.0).unwrap();
    until("the loop runs", || viewer.health().is_some_and(|h| h.tick > 20));
    runtime.kill().unwrap();
    runtime.wait().unwrap();
    plant.end();
}
