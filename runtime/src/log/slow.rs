//! Tests of a disk that stands still for a while: what is left out of the log, and that replay goes on after the gap.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Result, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::queue::{LogQueue, LogSummary};
use super::{Gap, facts, replay_with};
use crate::link::{Message, RobotMessage, SnapshotBytes, StateMessage};
use crate::rt::{Build, Core, CoreSettings, FaultPlan, Inputs, Loaded, ModeLimits, Outcome};
use crate::rt::{LoopController, Record, Refusal, Sync, TickOutput};

const PERIOD: u64 = 1_000_000;

/// Acts on the sum of all it has seen: without its memory nothing comes out right.
struct Summing(f64);

impl LoopController for Summing {
    fn version(&self) -> u64 {
        1
    }
    fn tick(&mut self, state: &StateMessage, output: &mut TickOutput) -> Outcome {
        self.0 += state.q()[0];
        output.nu = 1;
        (output.action[0], output.target_q[0]) = (self.0, state.q()[0]);
        Outcome::Acted
    }
    fn brake(&mut self, _: &StateMessage, _: &mut TickOutput) -> Outcome {
        Outcome::Refused
    }
    fn reset(&mut self) {
        self.0 = 0.0;
    }
    fn save_memory(&self, memory: &mut Vec<f64>) {
        memory.clear();
        memory.push(self.0);
    }
    fn load_memory(&mut self, memory: &[f64]) {
        self.0 = memory.first().copied().unwrap_or(0.0);
    }
    fn is_memory_whole(&self) -> bool {
        true
    }
}

struct Always;

impl Build for Always {
    type Controller = Summing;
    fn build(&mut self, _: &SnapshotBytes, _: &RobotMessage) -> std::result::Result<Summing, Refusal> {
        Ok(Summing(0.0))
    }
}

/// A file that takes nothing while it stands still.
struct Disk {
    file: File,
    stands: Arc<AtomicBool>,
}

impl Write for Disk {
    fn write(&mut self, bytes: &[u8]) -> Result<usize> {
        while self.stands.load(Ordering::Acquire) {
            std::thread::sleep(Duration::from_millis(1));
        }
        self.file.write(bytes)
    }
    fn flush(&mut self) -> Result<()> {
        self.file.flush()
    }
}

impl Seek for Disk {
    fn seek(&mut self, to: SeekFrom) -> Result<u64> {
        self.file.seek(to)
    }
}

/// The loop and its log.
struct Bench {
    core: Core<Summing>,
    log: LogQueue,
    stands: Arc<AtomicBool>,
    path: PathBuf,
}

impl Bench {
    fn new(test: &str) -> Bench {
        let path = std::env::temp_dir().join(format!("nearl-slow-{}-{test}.mcap", std::process::id()));
        let settings = CoreSettings {
            period: PERIOD,
            sync: Sync::Plant,
            age_limit: 20 * PERIOD,
            real_time: false,
            stop_speed: 1e-2,
            jump: 0.0,
            ramp: 0,
            modes: ModeLimits::default(),
            explore: None,
            proposer: None,
        };
        let plan = FaultPlan::default();
        let stands = Arc::new(AtomicBool::new(false));
        let disk = Disk { file: File::create(&path).unwrap(), stands: Arc::clone(&stands) };
        let mut robot = RobotMessage::zeroed();
        (robot.nq, robot.nv, robot.nu, robot.n_obs) = (1, 1, 1, 128);
        let facts = facts(&robot, &settings, &plan);
        let mut log = LogQueue::start(Box::new(disk), &facts, 7).unwrap();
        log.push_snapshot(0, 1, b"any".to_vec(), Vec::new());
        let first = Box::new(Loaded { id: 0, controller: Summing(0.0) });
        Bench { core: Core::new(settings, first, 0, plan), log, stands, path }
    }

    /// So many ticks; waits after each for the disk if `patient`.
    fn run(&mut self, ticks: u64, patient: bool) {
        for _ in 0..ticks {
            let mut state = StateMessage::zeroed();
            let n = self.core.record.tick + 1;
            (state.header.seq, state.header.stamp, state.header.epoch) = (n, n * PERIOD, 1);
            (state.tick, state.nq, state.nv, state.nu, state.n_obs) = (n, 1, 1, 1, 128);
            state.q[0] = (n as f64).sin();
            state.obs.fill(state.q[0]);
            self.core.swap(false);
            self.core.update(&Inputs {
                due: 0,
                begin: n * PERIOD,
                stop: false,
                fresh: Some(&state),
                proposal: None,
            });
            self.core.close(n * PERIOD + 1000);
            self.log.push(&self.core.record);
            while patient && self.log.waiting() > 0 {
                std::thread::sleep(Duration::from_micros(100));
            }
        }
    }

    fn stand(&self, stands: bool) {
        self.stands.store(stands, Ordering::Release);
    }

    fn end(self) -> (LogSummary, PathBuf) {
        (self.log.finish(), self.path)
    }
}

fn topics(path: &Path) -> BTreeMap<String, u64> {
    let bytes = std::fs::read(path).unwrap();
    let mut count = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        *count.entry(message.unwrap().channel.topic.clone()).or_default() += 1;
    }
    count
}

#[test]
fn a_slow_disk_costs_bulk_first_and_every_tick_replays() {
    let mut bench = Bench::new("bulk");
    bench.run(50, true);
    bench.stand(true);
    bench.run(800, false);
    bench.stand(false);
    bench.run(600, true);
    let (summary, path) = bench.end();
    assert_eq!((summary.written, summary.dropped, &summary.error), (1450, 0, &None));
    assert!(summary.brief >= 300, "{summary:?}");
    let count = topics(&path);
    assert_eq!(count["tick"] + count["brief"], 1450, "{count:?}");
    let found = replay_with(&path, Always).unwrap();
    assert_eq!((found.ticks, &found.difference, &found.gaps[..]), (1450, &None, &[][..]));
    assert_eq!(found.brief, count["brief"]);
    std::fs::remove_file(path).unwrap();
}

#[test]
fn after_ticks_were_lost_replay_goes_on_from_the_next_memory() {
    let mut bench = Bench::new("gap");
    bench.run(50, true);
    bench.stand(true);
    bench.run(3000, false); // more than wait in the queue
    bench.stand(false);
    while bench.log.waiting() > 0 {
        std::thread::sleep(Duration::from_millis(1));
    }
    bench.run(500, true);
    let (summary, path) = bench.end();
    assert!(summary.dropped > 1000 && summary.error.is_none(), "{summary:?}");
    let found = replay_with(&path, Always).unwrap();
    assert_eq!(found.difference, None);
    let [Gap { lost, from, to }] = found.gaps[..] else { panic!("one gap: {:?}", found.gaps) };
    assert_eq!(lost, summary.dropped);
    // The memory is written with the first tick after the gap, so that this tick alone is not computed.
    assert_eq!(to - from, lost);
    assert_eq!(found.ticks, 3550 - lost - 1);
    std::fs::remove_file(path).unwrap();
}

/// A digest that is not the tick's is found out.
#[test]
fn a_tick_in_brief_is_compared_whole() {
    let mut record = Record::new();
    (record.tick, record.output.nu) = (3, 1);
    let (mut whole, mut brief) = (Vec::new(), Vec::new());
    super::tick::encode(&record, &mut whole).unwrap();
    super::brief::encode_brief(&record, &whole, &mut brief).unwrap();
    let text = String::from_utf8(brief.clone()).unwrap();
    assert!(text.contains(&super::brief::digest(&whole)) && brief.len() < whole.len() / 2, "{text}");
    record.output.action[0] = f64::from_bits(1);
    super::tick::encode(&record, &mut whole).unwrap();
    assert!(!text.contains(&super::brief::digest(&whole)));
}
