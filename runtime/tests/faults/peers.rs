//! A peer on the robot's own iceoryx2 services whose messages are not those of this build.

use std::time::Duration;

use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::*;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;

use super::system::until;
use crate::arm::*;
use crate::toy::{Name, settings};

type Ipc = ipc_threadsafe::Service;

/// The place of the trainer, without its manners: any header, any length, any bytes.
struct Rogue {
    port: Publisher<Ipc, [u8], SnapshotHeader>,
    _node: Node<Ipc>,
}

/// A loop with an arm, and one who looks on: what a peer comes to visit.
struct Visited {
    name: Name,
    viewer: TrainerLink,
    loop_and_arm: LoopAndArm,
}

struct LoopAndArm {
    running: Running,
    stop: Stop,
    plant: ArmThread,
    _file: File,
}

fn visited(test: &str, settings: RunSettings) -> Visited {
    let (name, first, stop) = (Name::new(test), snapshot(1, |_| {}), Stop::new());
    let file = File::new(test, &first);
    let plant = start_with(&name, &first, FaultPlan::default(), Duration::from_micros(300));
    let running = execute_with(&name, &file.0, &stop, settings);
    let mut viewer = TrainerLink::open(&name.0).unwrap();
    viewer.wait_for_runtime(Duration::from_secs(30)).unwrap();
    Visited { name, viewer, loop_and_arm: LoopAndArm { running, stop, plant, _file: file } }
}

impl LoopAndArm {
    fn end(self) -> (RunReport, Panda) {
        self.stop.request();
        let report = self.running.join().unwrap().unwrap();
        (report, self.plant.end().0)
    }
}

/// Where the links of a robot lie.
fn folder_of(name: &RobotName) -> std::path::PathBuf {
    // SAFETY: plain call.
    let user = unsafe { libc::geteuid() };
    std::path::Path::new("/dev/shm").join(format!("nearl-{user}")).join(name.as_str())
}

/// A node among those of the robot.
fn join(name: &RobotName) -> Node<Ipc> {
    let folder = folder_of(name);
    let token = std::fs::read_to_string(folder.join("token")).unwrap();
    let mut config = Config::default();
    config.global.set_root_path(&Path::new(folder.to_str().unwrap().as_bytes()).unwrap());
    config.global.prefix = FileName::new(format!("nearl.{name}.{token}.").as_bytes()).unwrap();
    NodeBuilder::new().config(&config).create::<Ipc>().unwrap()
}

impl Rogue {
    fn new(name: &RobotName) -> Rogue {
        let node = join(name);
        let topic = ServiceName::new(&format!("nearl/{name}/snapshot")).unwrap();
        let service = node.service_builder(&topic).publish_subscribe::<[u8]>();
        let service = service.user_header::<SnapshotHeader>().open().unwrap();
        let port = service.publisher_builder().initial_max_slice_len(1 << 20).create().unwrap();
        Rogue { port, _node: node }
    }

    fn send(&self, header: SnapshotHeader, bytes: &[u8]) {
        let mut sample = self.port.loan_slice_uninit(bytes.len()).unwrap();
        *sample.user_header_mut() = header;
        sample.write_from_slice(bytes).send().unwrap();
    }
}

fn header(schema: u64, version: u64, length: u64) -> SnapshotHeader {
    let mut header = SnapshotHeader::zeroed();
    header.header = Header { schema, epoch: 99, seq: version, stamp: 0 };
    (header.version, header.length) = (version, length);
    header
}

#[test]
fn fault_33_a_peer_with_lies_and_a_flood_is_refused_and_counted() {
    let Visited { name, mut viewer, loop_and_arm } = visited("rogue", settings());
    let rogue = Rogue::new(&name.0);
    let refused = |viewer: &mut TrainerLink, more: u64, send: &dyn Fn()| {
        let mut before = None;
        until("health", || viewer.health().map(|h| before = Some(h.refused_snapshots)).is_some());
        send();
        until("the refusal is counted", || {
            viewer.health().is_some_and(|h| h.refused_snapshots >= before.unwrap() + more)
        });
    };
    let ours = SnapshotHeader::SCHEMA;
    let mut diverged = snapshot(5, |_| {});
    diverged.networks.policy.layers[0].weight[3] = f32::NAN;
    let (good, nan) = (snapshot(4, |_| {}).to_bytes(), diverged.to_bytes());
    let length = good.len() as u64;
    // Another schema; lengths that lie; nothing at all; a payload of NaN; then an old version of a sender known by now.
    refused(&mut viewer, 1, &|| rogue.send(header(ours ^ 1, 2, length), &good));
    for lie in [0, 1, length - 1, length + 1, u64::MAX] {
        refused(&mut viewer, 1, &|| rogue.send(header(ours, 3, lie), &good));
    }
    refused(&mut viewer, 1, &|| rogue.send(header(ours, 4, 1), &[0]));
    refused(&mut viewer, 1, &|| rogue.send(header(ours, 5, nan.len() as u64), &nan));
    refused(&mut viewer, 1, &|| rogue.send(header(ours, 5, length), &good));
    // A flood: the newest counts, the others are superseded or never seen.
    let damaged: Vec<u8> = good.iter().map(|b| b ^ 0x40).collect();
    refused(&mut viewer, 1, &|| {
        for version in 6..3006 {
            rogue.send(header(ours, version, length), &damaged);
        }
    });
    let mut then = 0;
    until("health", || viewer.health().map(|h| then = h.tick).is_some());
    until("the loop goes on", || viewer.health().is_some_and(|h| h.tick > then + 100));
    let (report, arm) = loop_and_arm.end();
    assert_eq!((report.counters.swaps, report.counters.stale), (0, 0), "{report}");
    assert_eq!((report.modes["degraded"], report.modes["fault"]), (0, 0), "{report}");
    let said = report.refusals.join("\n");
    for words in ["NaN at index 3", "came after version 5", "safetensors"] {
        assert!(said.contains(words), "'{words}' is not in: {said}");
    }
    assert!(arm.worst.iter().all(|e| *e <= 1e-9), "position, velocity, torque: {:?}", arm.worst);
}

/// Words that lengths, numbers and texts lie with.
const WORDS: [u64; 9] = [
    0,
    1,
    u64::MAX,
    u32::MAX as u64,
    1 << 63,
    0x7ff8_0000_0000_0000, // NaN
    0x7ff0_0000_0000_0000, // infinity
    0x7fef_ffff_ffff_ffff, // the largest number
    0x0000_0000_0000_0001, // the smallest
];

/// Messages of one kind on their own topic: every word the same lie, or others by turns; with the right schema and with another.
fn lie<M: Queued>(node: &Node<Ipc>, name: &RobotName) {
    let topic = ServiceName::new(&format!("nearl/{name}/{}", M::TOPIC)).unwrap();
    let service = node.service_builder(&topic).publish_subscribe::<M>().open().unwrap();
    let port = service.publisher_builder().max_loaned_samples(1).create().unwrap();
    let words = size_of::<M>() / 8;
    for k in 0..20 * WORDS.len() {
        let mut message = M::zeroed();
        let into = std::ptr::from_mut(&mut message).cast::<u64>();
        for at in 0..words {
            let word = if k < WORDS.len() { WORDS[k] } else { WORDS[(at * 7 + k * k) % WORDS.len()] };
            // SAFETY: a message is words for its whole size, and every bit pattern is a value.
            unsafe { into.add(at).write_unaligned(word) };
        }
        let schema = if k % 5 == 4 { M::SCHEMA ^ 1 } else { M::SCHEMA };
        *message.header_mut() =
            Header { schema, epoch: 99 + k as u64 % 2, seq: WORDS[k % WORDS.len()], stamp: 0 };
        port.loan_uninit().unwrap().write_payload(message).send().unwrap();
        std::thread::sleep(Duration::from_micros(300));
    }
}

/// Whether the trainer's end reads any of a few transitions with this schema that are right otherwise.
fn hears(node: &Node<Ipc>, name: &RobotName, viewer: &mut TrainerLink, schema: u64) -> bool {
    let topic = ServiceName::new(&format!("nearl/{name}/{}", TransitionMessage::TOPIC)).unwrap();
    let service = node.service_builder(&topic).publish_subscribe::<TransitionMessage>().open().unwrap();
    let port = service.publisher_builder().create().unwrap();
    let epoch = schema | 1 << 63;
    let mut heard = false;
    for seq in 1..=20 {
        let mut message = TransitionMessage::zeroed();
        *message.header_mut() = Header { schema, epoch, seq, stamp: 0 };
        port.loan_uninit().unwrap().write_payload(message).send().unwrap();
        heard |= std::iter::from_fn(|| viewer.transition()).any(|t| t.header.epoch == epoch);
    }
    heard
}

/// A peer on every topic at once, beside those who belong there.
#[test]
fn fault_33_lies_on_every_topic_end_nothing_and_move_nothing() {
    let Visited { name, mut viewer, loop_and_arm } = visited("liar", settings());
    let mut ticks = ViewLink::open(&name.0).unwrap();
    let node = join(&name.0);
    lie::<RobotMessage>(&node, &name.0);
    lie::<TallyMessage>(&node, &name.0);
    lie::<LimitsMessage>(&node, &name.0);
    for round in 0..3 {
        lie::<TransitionMessage>(&node, &name.0);
        lie::<ReceiptMessage>(&node, &name.0);
        lie::<HealthMessage>(&node, &name.0);
        lie::<TickMessage>(&node, &name.0);
        lie::<RowsMessage>(&node, &name.0);
        // Whoever reads them is told nonsense at the worst.
        while let Some(t) = viewer.transition() {
            assert!(t.q().len() <= MAX_JOINTS && t.action().len() <= MAX_JOINTS, "round {round}");
        }
        while let Some(receipt) = viewer.receipt() {
            assert!(receipt.text().len() <= 3 * MAX_TEXT, "round {round}");
        }
        let _ = (viewer.health(), viewer.tally(), viewer.robot());
        while let Some(tick) = ticks.tick() {
            assert!(tick.q().len() <= MAX_JOINTS && tick.multipliers().len() <= MAX_ACTIVE, "round {round}");
        }
        let _ = ticks.rows().map(|rows| (rows.row_kinds(), rows.row_names(), rows.task_name()));
    }
    assert!(
        !hears(&node, &name.0, &mut viewer, TransitionMessage::SCHEMA ^ 1),
        "another build's message was read"
    );
    assert!(
        hears(&node, &name.0, &mut viewer, TransitionMessage::SCHEMA),
        "the same with the right schema is"
    );
    // The true words are heard after all that.
    let version = 1 << 40;
    viewer.push(version, &snapshot(version, |_| {}).to_bytes()).unwrap();
    until("the push is in use", || {
        viewer.receipt().is_some_and(|r| r.version == version && r.verdict() == Verdict::Accepted)
    });
    let (report, arm) = loop_and_arm.end();
    assert_eq!(
        (report.modes["fault"], report.modes["degraded"], report.counters.swaps),
        (0, 0, 1),
        "{report}"
    );
    assert!(
        report.refused_snapshots > 0 && report.refusals.join(" ").contains("limits that cannot be read"),
        "{report}"
    );
    assert!(arm.worst.iter().all(|e| *e <= 1e-9), "position, velocity, torque: {:?}", arm.worst);
}

/// Random words in the live boards of state and action: nothing dies, no motor gets more than it takes, and all is well again after it.
#[test]
fn fault_33_random_words_in_live_boards_end_nothing() {
    use std::os::unix::fs::FileExt;
    let modes = ModeLimits { recover_after: 1, ..ModeLimits::default() };
    let Visited { name, mut viewer, loop_and_arm } =
        visited("scribbled", RunSettings { modes, ..settings() });
    let mut seed = 1_u64;
    let mut next = || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        seed >> 16
    };
    for board in ["newest-state", "newest-action"] {
        let board = std::fs::File::options().write(true).open(folder_of(&name.0).join(board)).unwrap();
        let words = board.metadata().unwrap().len() / 8;
        for k in 0..2000 {
            let word = if k % 2 == 0 { WORDS[(next() % 9) as usize] } else { next() << 8 };
            board.write_all_at(&word.to_le_bytes(), 8 * (next() % words)).unwrap();
            if k % 20 == 0 {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
    }
    let mut then = 0;
    until("health", || viewer.health().map(|h| then = h.tick).is_some());
    until("the loop goes on", || viewer.health().is_some_and(|h| h.tick > then + 100));
    let (report, arm) = loop_and_arm.end();
    assert!(arm.worst[2] <= 1e-9, "torque: {:?}", arm.worst);
    assert!(!report.warnings.iter().any(|w| w.contains("panic")), "{report}");
}
