//! A peer that speaks iceoryx2 on the robot's own services, but not this build's language.

use std::time::Duration;

use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::*;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;

use crate::arm::*;
use crate::system::until;
use crate::toy::Name;

type Ipc = ipc_threadsafe::Service;

/// The place of the trainer, without its manners: any header, any length, any bytes.
struct Rogue {
    port: Publisher<Ipc, [u8], SnapshotHeader>,
    _node: Node<Ipc>,
}

impl Rogue {
    fn new(name: &RobotName) -> Rogue {
        // SAFETY: plain call.
        let user = unsafe { libc::geteuid() };
        let folder = std::path::Path::new("/dev/shm").join(format!("nearl-{user}")).join(name.as_str());
        let token = std::fs::read_to_string(folder.join("token")).unwrap();
        let mut config = Config::default();
        config.global.set_root_path(&Path::new(folder.to_str().unwrap().as_bytes()).unwrap());
        config.global.prefix = FileName::new(format!("nearl.{name}.{token}.").as_bytes()).unwrap();
        let node = NodeBuilder::new().config(&config).create::<Ipc>().unwrap();
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
    let name = Name::new("rogue");
    let first = snapshot(1, |_| {});
    let file = File::new("rogue", &first);
    let plant = start_with(&name, &first, FaultPlan::default(), Duration::from_micros(300));
    let stop = Stop::new();
    let running = execute(&name, &file.0, &stop);
    let mut viewer = TrainerLink::open(&name.0).unwrap();
    viewer.wait_for_runtime(Duration::from_secs(30)).unwrap();
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
    stop.request();
    let report = running.join().unwrap().unwrap();
    let (arm, _) = plant.end();
    assert_eq!((report.counters.swaps, report.counters.stale), (0, 0), "{report}");
    assert_eq!((report.modes["degraded"], report.modes["fault"]), (0, 0), "{report}");
    let said = report.refusals.join("\n");
    for words in ["NaN at index 3", "came after version 5", "safetensors"] {
        assert!(said.contains(words), "'{words}' is not in: {said}");
    }
    assert!(arm.worst.iter().all(|e| *e <= 1e-9), "position, velocity, torque: {:?}", arm.worst);
}
