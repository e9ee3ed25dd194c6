//! The arm, its plant and its runtime as processes that tests start and kill.

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use nearl_runtime::Snapshot;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;
use serde_json::Value;

use super::ROUNDING;
use super::system::{signal, until};
use crate::arm::*;
use crate::toy::{self, DT, Name};

const ROLE: &str = "NEARL_KILL_ROLE";
const NAME: &str = "NEARL_KILL_NAME";
const FOLDER: &str = "NEARL_KILL_FOLDER";

/// The arm with its own drive: without the runtime it brakes by its own torques, not by magic.
pub struct DrivenArm {
    panda: Panda,
    drive: Brake,
    last: (u64, u64),
    held: u64,
    /// Ticks in a row that one action was applied.
    longest_hold: u64,
}

impl DrivenArm {
    pub fn new(snapshot: &Snapshot) -> DrivenArm {
        let drive = Brake::new(&snapshot.manifest).unwrap().unwrap();
        DrivenArm { panda: Panda::new(), drive, last: (0, 0), held: 0, longest_hold: 0 }
    }
}

impl Plant for DrivenArm {
    fn observe(&mut self, state: &mut StateMessage) {
        self.panda.observe(state);
    }
    fn tally(&self, tally: &mut TallyMessage) {
        for (i, worst) in [0, 1, 3].into_iter().zip(self.panda.worst) {
            tally.measure(i, u64::from(worst > ROUNDING), worst);
        }
    }
    fn apply(&mut self, action: &ActionMessage) {
        let now = (action.state_epoch, action.state_seq);
        self.held = if now == self.last { self.held + 1 } else { 0 };
        self.longest_hold = self.longest_hold.max(self.held);
        self.last = now;
        self.panda.apply(action);
    }
    fn brake(&mut self) {
        self.held = 0;
        let mut action = ActionMessage::zeroed();
        let (_, torque) = self.drive.update(&self.panda.q, &self.panda.v);
        action.nu = torque.len() as u32;
        action.action[..torque.len()].copy_from_slice(torque);
        self.panda.apply(&action);
    }
}

/// Not a test of its own: the body of the processes the tests below start and kill.
#[test]
#[ignore = "started by the other tests as a process of its own"]
fn child() {
    let Ok(name) = std::env::var(NAME) else { return };
    let name = RobotName::new(&name).unwrap();
    let folder = PathBuf::from(std::env::var(FOLDER).unwrap());
    let file = folder.join("first.safetensors");
    let stop = Stop::on_signals().unwrap();
    match std::env::var(ROLE).as_deref() {
        Ok("plant") => {
            let snapshot = Snapshot::load(&file).unwrap();
            let link = PlantLink::open(&name, &describe(&snapshot.manifest, false).unwrap()).unwrap();
            let runner = PlantRunner::new(link, PlantSettings::simulator(DT)).unwrap();
            runner.run(&mut DrivenArm::new(&snapshot), &stop);
        }
        Ok(role @ ("runtime" | "patient")) => {
            let age_limit = (role == "patient").then_some(120.0);
            let settings = RunSettings { patience: 30.0, age_limit, ..toy::settings() };
            let report = run(&settings, &file, &name, &stop).unwrap();
            std::fs::write(folder.join("report.json"), serde_json::to_string(&report).unwrap()).unwrap();
        }
        Ok("trainer") => {
            let mut trainer = TrainerLink::open(&name).unwrap();
            // 1 MB each, so that many a kill falls into the writing.
            let mut snapshot = snapshot(2, |_| {});
            let layers = &mut snapshot.networks.policy.layers;
            let hidden = 9000;
            (layers[0].n_out, layers[1].n_in) = (hidden, hidden);
            layers[0].weight = weights(1, hidden * layers[0].n_in);
            layers[0].bias = weights(2, hidden);
            layers[1].weight = weights(3, hidden * layers[1].n_out).iter().map(|w| 0.05 * w).collect();
            for version in 2.. {
                snapshot.manifest.version = version;
                trainer.push(version, &snapshot.to_bytes()).unwrap();
            }
        }
        Ok("proposer") => super::proposers::propose(&name),
        role => panic!("no such role: {role:?}"),
    }
}

/// A robot name with a folder for its snapshot and reports.
pub struct Stage {
    pub name: Name,
    folder: Scratch,
    pub first: Snapshot,
}

impl Stage {
    pub fn new(test: &str) -> Stage {
        let (folder, first) = (Scratch::new(test), snapshot(1, |_| {}));
        first.save(&folder.0.join("first.safetensors")).unwrap();
        Stage { name: Name::new(test), folder, first }
    }

    pub fn file(&self) -> PathBuf {
        self.folder.0.join("first.safetensors")
    }

    /// Where a flight log may lie.
    pub fn log(&self) -> PathBuf {
        self.folder.0.join("run.mcap")
    }

    pub fn start(&self, role: &str) -> Child {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "faults::stage::child", "--ignored", "--nocapture"]);
        command.env(ROLE, role).env(NAME, self.name.0.as_str()).env(FOLDER, &self.folder.0);
        command.stdout(Stdio::null()).spawn().unwrap()
    }

    /// What the runtime that ended last reported.
    pub fn report(&self) -> Value {
        let text = std::fs::read_to_string(self.folder.0.join("report.json")).unwrap();
        serde_json::from_str(&text).unwrap()
    }

    pub fn viewer(&self) -> TrainerLink {
        TrainerLink::open(&self.name.0).unwrap()
    }
}

pub fn kill(mut child: Child) {
    child.kill().unwrap();
    let status = child.wait().unwrap();
    assert!(status.code().is_none(), "it had ended by itself ({status})");
}

pub fn fastest(state: &StateMessage) -> f64 {
    state.v().iter().fold(0.0, |m, v| f64::max(m, v.abs()))
}

pub fn wait_for_motion(viewer: &mut TrainerLink) {
    until("the arm moves", || viewer.state().is_some_and(|s| fastest(&s) > 0.1));
}

pub fn pause(milliseconds: usize) {
    std::thread::sleep(Duration::from_millis(milliseconds as u64));
}

/// A plant that keeps real time, in this process.
pub struct Arm {
    stop: Stop,
    thread: std::thread::JoinHandle<(DrivenArm, PlantReport)>,
}

impl Arm {
    pub fn start(stage: &Stage) -> Arm {
        let link = PlantLink::open(&stage.name.0, &describe(&stage.first.manifest, false).unwrap()).unwrap();
        let (stop, mut arm) = (Stop::new(), DrivenArm::new(&stage.first));
        let thread = std::thread::spawn({
            let stop = stop.clone();
            move || {
                let runner = PlantRunner::new(link, PlantSettings::simulator(DT)).unwrap();
                let report = runner.run(&mut arm, &stop);
                (arm, report)
            }
        });
        Arm { stop, thread }
    }

    /// Ends it; the arm never left the robot file's limits, and no action was held longer than the watchdog allows.
    pub fn end_within_limits(self) -> PlantReport {
        self.stop.request();
        let (arm, report) = self.thread.join().unwrap();
        assert!(
            arm.panda.worst.iter().all(|e| *e <= ROUNDING),
            "position, velocity, torque: {:?}",
            arm.panda.worst
        );
        let PlantSettings { watchdog, deadline, dt, .. } = PlantSettings::simulator(DT);
        let most = (watchdog / (deadline * dt)).ceil() as u64 + 1;
        assert!(
            arm.longest_hold <= most,
            "{} ticks without a fresh action, {most} at most",
            arm.longest_hold
        );
        report
    }
}

/// SIGTERM, and a good end.
pub fn end(mut runtime: Child) {
    signal(&runtime, libc::SIGTERM);
    assert!(runtime.wait().unwrap().success());
}
