//! A point mass as plant and a trivial controller, shared by the loop tests.
#![allow(dead_code, unreachable_pub)] // each test binary uses a part of it

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::{JoinHandle, ThreadId};
use std::time::Duration;

use nearl_constraints::Moved;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;

pub const DT: f64 = 1e-3;
/// Version of the spring that does not reach its targets.
pub const MISSES: u64 = 1000;

/// q' = q + v dt, v' = v + action dt.
#[derive(Default)]
pub struct PointMass {
    pub q: f64,
    pub v: f64,
    pub applied: Vec<f64>,
    pub versions: Vec<u64>,
    pub braked: u64,
    /// Sleeps so long in every tick: a loop in lockstep outruns its log otherwise.
    pub pause: Duration,
    /// Ticks of an episode; 0 is one without end.
    pub episode_ticks: u64,
    /// Observes NaN from this tick on, for that many ticks.
    pub nan: Option<(u64, u64)>,
    /// Stops publishing new numbers and sleeps this long at this tick.
    pub freeze: Option<(u64, std::time::Duration)>,
    pub tick: u64,
}

impl Plant for PointMass {
    fn observe(&mut self, state: &mut StateMessage) {
        if let Some((tick, time)) = self.freeze
            && tick == self.tick
        {
            self.freeze = None;
            std::thread::sleep(time);
        }
        (state.nq, state.nv, state.nu, state.n_obs) = (1, 1, 1, 1);
        state.time = self.tick as f64 * DT;
        if self.episode_ticks > 0 && self.tick > 0 && self.tick.is_multiple_of(self.episode_ticks) {
            (self.q, self.v) = (1.0, 0.0);
        }
        state.episode = self.tick.checked_div(self.episode_ticks).unwrap_or(0);
        state.q[0] = self.q;
        state.v[0] = self.v;
        state.obs[0] = self.q;
        if let Some((from, count)) = self.nan
            && (from..from + count).contains(&self.tick)
        {
            state.q[0] = f64::NAN;
        }
        self.tick += 1;
    }

    fn apply(&mut self, action: &ActionMessage) {
        std::thread::sleep(self.pause);
        self.applied.push(action.action()[0]);
        self.versions.push(action.policy_version);
        self.v += action.action()[0] * DT;
        self.q += self.v * DT;
    }

    fn brake(&mut self) {
        self.braked += 1;
        self.v = 0.0;
    }
}

/// Pulls towards the origin with a gain per version; reports the thread that dropped it.
pub struct Spring {
    pub version: u64,
    pub drops: Sender<(u64, ThreadId)>,
    pub panics_at: Option<u64>,
    pub ticks: u64,
    pub resets: Arc<AtomicU64>,
}

impl LoopController for Spring {
    fn version(&self) -> u64 {
        self.version
    }

    fn tick(&mut self, state: &StateMessage, output: &mut TickOutput) -> Outcome {
        self.ticks += 1;
        if self.panics_at == Some(self.ticks) {
            panic!("scripted panic of the test controller");
        }
        output.nu = 1;
        output.proposal_q[0] = 0.0;
        output.action[0] = -(self.version as f64) * state.q()[0];
        let miss = if self.version == MISSES { 1.0 } else { 0.0 };
        output.target_v[0] = state.v()[0] + output.action[0] * DT + miss;
        output.target_q[0] = state.q()[0] + output.target_v[0] * DT;
        output.ledger.raw_violations = 1;
        Outcome::Acted
    }

    fn brake(&mut self, state: &StateMessage, output: &mut TickOutput) -> Outcome {
        output.nu = 1;
        output.action[0] = -state.v()[0] / DT;
        Outcome::Acted
    }

    fn reset(&mut self) {
        self.resets.fetch_add(1, Ordering::Relaxed);
    }
}

impl Drop for Spring {
    fn drop(&mut self) {
        let _ = self.drops.send((self.version, std::thread::current().id()));
    }
}

/// Accepts the bytes `spring`, and `missing` for one that misses its targets whatever its version; with limits moved, which it has none of, as well.
pub struct SpringBuilder(pub Sender<(u64, ThreadId)>);

impl Build for SpringBuilder {
    type Controller = Spring;
    fn build(&mut self, snapshot: &SnapshotBytes, robot: &RobotMessage) -> Result<Spring, Refusal> {
        if snapshot.bytes == b"other robot" {
            let text = format!("made for joint `elbow`, the robot has `{}`", robot.joint_names().join(", "));
            return Err(Refusal { verdict: Verdict::ForeignRobot, text });
        }
        if snapshot.bytes == b"panic" {
            panic!("scripted panic of the test builder");
        }
        if snapshot.bytes == b"missing" {
            return Ok(spring(MISSES, &self.0));
        }
        if snapshot.bytes != b"spring" {
            return Err(Refusal { verdict: Verdict::Corrupt, text: "the digest does not match".into() });
        }
        Ok(spring(snapshot.header.version, &self.0))
    }

    fn with_limits(&mut self, bytes: &[u8], _: &Moved) -> Result<Vec<u8>, Refusal> {
        Ok(bytes.to_vec())
    }
}

pub fn spring(version: u64, drops: &Sender<(u64, ThreadId)>) -> Spring {
    Spring { version, drops: drops.clone(), panics_at: None, ticks: 0, resets: Arc::default() }
}

pub fn robot(lockstep: bool) -> Robot {
    Robot {
        joints: vec!["slide".into()],
        observation: vec!["q.slide".into()],
        limits: 0,
        stated: None,
        nq: 1,
        nv: 1,
        nu: 1,
        dt: DT,
        lockstep,
    }
}

/// What no other call has, of this process or of another: tests run side by side, and two of them may say the same words.
pub fn of_its_own(words: &str) -> String {
    static CALLS: AtomicUsize = AtomicUsize::new(0);
    format!("{}-{}-{words}", std::process::id(), CALLS.fetch_add(1, Ordering::Relaxed))
}

/// A name of its own for each test; its files are removed at the end.
pub struct Name(pub RobotName);

impl Name {
    pub fn new(test: &str) -> Name {
        Name(RobotName::new(&format!("t{}", of_its_own(test))).unwrap())
    }
}

impl Drop for Name {
    fn drop(&mut self) {
        remove_files(&self.0);
    }
}

/// A plant on a thread of its own.
pub struct PlantThread {
    pub stop: Stop,
    thread: JoinHandle<(PointMass, PlantReport)>,
}

impl PlantThread {
    pub fn start(name: &Name, mut plant: PointMass, settings: PlantSettings) -> PlantThread {
        let link = PlantLink::open(&name.0, &robot(settings.pace == Pace::Lockstep)).unwrap();
        let stop = Stop::new();
        let thread = std::thread::spawn({
            let stop = stop.clone();
            move || {
                let report = PlantRunner::new(link, settings).unwrap().run(&mut plant, &stop);
                (plant, report)
            }
        });
        PlantThread { stop, thread }
    }

    pub fn end(self) -> (PointMass, PlantReport) {
        self.stop.request();
        self.thread.join().unwrap()
    }
}

/// Settings that need no rights.
pub fn settings() -> RunSettings {
    RunSettings {
        thread: ThreadSettings { priority: None, cpu: None, lock_memory: false },
        ..RunSettings::default()
    }
}

/// A loop on a thread of its own.
pub struct LoopThread {
    pub stop: Stop,
    pub drops: Receiver<(u64, ThreadId)>,
    thread: JoinHandle<Result<RunReport, RunError>>,
}

impl LoopThread {
    pub fn start(name: &Name, settings: RunSettings, change: impl FnOnce(&mut Spring)) -> LoopThread {
        let (link, robot) = connect(&name.0, 5.0).unwrap();
        let (drops, dropped) = channel();
        let mut first = spring(1, &drops);
        change(&mut first);
        let stop = Stop::new();
        let thread = std::thread::spawn({
            let stop = stop.clone();
            move || run_loop(link, robot, first, SpringBuilder(drops), &settings, &stop)
        });
        LoopThread { stop, drops: dropped, thread }
    }

    pub fn join(self) -> RunReport {
        self.thread.join().unwrap().unwrap()
    }

    pub fn end(self) -> RunReport {
        self.stop.request();
        self.join()
    }
}
