//! What a flight log says is confirmed from the log alone, and a log that was changed is found out.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use nearl_verify::{Report, verify};
use serde_json::Value;

use crate::arm::Scratch;
use crate::attack::Attack;
use crate::toy::Name;

const PANDA: &str = include_str!("../../../examples/robots/panda/panda.urdf");

/// Joints, torque, and what ties joints together.
const LIMITS: &str = "position = { margin = 0.01 }\nvelocity = { scale = 0.5 }\nacceleration = { limit = 10.0 }\n\
     torque = { scale = 0.8 }\nbraking = \"stored\"";

fn attack(constraints: &str, dt: f64, sub_steps: u32, policy_every: usize) -> Attack {
    Attack {
        urdf: PANDA.into(),
        start: vec![0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8],
        constraints: constraints.into(),
        dt,
        sub_steps,
        policy_every,
        seed: 5,
        ticks: 1500,
        pause: Duration::ZERO,
    }
}

fn record(test: &str, attack: &Attack) -> (Scratch, PathBuf) {
    let folder = Scratch::new(test);
    let (log, summary) = attack.fly(&folder.0);
    assert_eq!((summary.dropped, summary.brief, summary.error), (0, 0, None));
    (folder, log)
}

/// Changes a message of a topic; false leaves it out.
type Change<'a> = &'a dyn Fn(&str, &mut Value) -> bool;

/// Copies a log with messages, snapshots and metadata changed; digests are made anew, so that the copy is a sound file.
fn copy(
    from: &Path,
    to: &Path,
    change: Change<'_>,
    snapshot: &dyn Fn(Vec<u8>) -> Vec<u8>,
    facts: &dyn Fn(&mut BTreeMap<String, String>),
) {
    use mcap::records::{MessageHeader, Record as Part};
    let bytes = std::fs::read(from).unwrap();
    let file = std::io::BufWriter::new(std::fs::File::create(to).unwrap());
    let mut writer = mcap::WriteOptions::new().compression(None).create(file).unwrap();
    let (mut channels, mut digests) = (BTreeMap::<u16, (u16, String)>::new(), BTreeMap::new());
    let mut is_over = false;
    for part in mcap::read::ChunkFlattener::new(&bytes).unwrap() {
        match part.unwrap() {
            Part::DataEnd(_) => is_over = true,
            _ if is_over => {}
            Part::Metadata(mut m) => {
                facts(&mut m.metadata);
                writer.write_metadata(&m).unwrap();
            }
            Part::Attachment { header, data, .. } => {
                let data = snapshot(data.into_owned());
                let digest = blake3::hash(&data).to_hex().to_string();
                digests.insert(header.name.trim_end_matches(".safetensors").to_owned(), digest.clone());
                let name = format!("{digest}.safetensors");
                let attachment = mcap::Attachment {
                    log_time: 0,
                    create_time: 0,
                    name,
                    media_type: header.media_type,
                    data: Cow::Owned(data),
                };
                writer.attach(&attachment).unwrap();
            }
            Part::Channel(c) => {
                let schema = writer.add_schema(&c.topic, "jsonschema", b"{}").unwrap();
                let id = writer.add_channel(schema, &c.topic, "json", &BTreeMap::new()).unwrap();
                channels.insert(c.id, (id, c.topic));
            }
            Part::Message { header, data } => {
                let (channel_id, topic) = &channels[&header.channel_id];
                let mut value: Value = serde_json::from_slice(&data).unwrap();
                if topic == "snapshot" {
                    let digest = value["digest"].as_str().unwrap();
                    value["digest"] = digests[digest].clone().into();
                }
                let header = MessageHeader { channel_id: *channel_id, ..header };
                if change(topic, &mut value) {
                    writer.write_to_known_channel(&header, value.to_string().as_bytes()).unwrap();
                }
            }
            _ => {}
        }
    }
    writer.finish().unwrap();
}

/// Everything that was claimed holds, and most of it was claimed.
fn holds(report: &Report, ticks: u64) {
    println!("{report}");
    assert_eq!(report.found, 0, "{report}");
    assert!(report.is_whole(), "{report}");
    assert_eq!(report.ticks, ticks, "{report}");
    assert!(report.verified + report.idle == ticks && report.verified > ticks - 20, "{report}");
    assert!(report.stoppable == report.verified && report.optimal > ticks / 4, "{report}");
}

#[test]
fn a_flight_under_attack_is_verified_tick_by_tick() {
    let (_folder, log) = record("verify", &attack(LIMITS, 0.001, 1, 20));
    holds(&verify(&log).unwrap(), 1500);
}

#[test]
fn a_flight_of_a_real_loop_is_verified_to_its_stop() {
    let folder = Scratch::new("verify-loop");
    let slow = Attack { pause: Duration::from_micros(300), ticks: 600, ..attack(LIMITS, 0.001, 1, 20) };
    let (log, report) = slow.record(&Name::new("verify-loop").0, &folder.0);
    assert_eq!((report.log_drops, report.log_error.as_deref()), (0, None), "{report}");
    let found = verify(&log).unwrap();
    println!("{found}");
    assert_eq!((found.found, found.ticks), (0, report.ticks), "{found}");
    assert!(found.verified > 500 && found.optimal > 200, "{found}");
}

#[test]
fn every_convention_of_sub_steps_and_every_way_to_brake_is_verified() {
    for (sub_steps, dt, limits) in [
        (0, 0.001, LIMITS.to_owned()),
        (5, 0.01, LIMITS.to_owned()),
        (1, 0.02, LIMITS.to_owned()),
        (1, 0.002, LIMITS.replace("stored", "certified").replace("10.0", "3.0").replace("0.8", "1.0")),
        (0, 0.002, LIMITS.replace("stored", "certified").replace("10.0", "3.0").replace("0.8", "1.0")),
    ] {
        let (_folder, log) = record("verify-steps", &attack(&limits, dt, sub_steps, 5));
        holds(&verify(&log).unwrap(), 1500);
    }
}

/// What ties joints together: planes, the speed of the hand, energy, bodies, a motor's line, a user's rows, soft rates.
const COUPLED: [&str; 7] = [
    "frame = [{ frame = \"panda_hand\", half_space = { normal = [0, 0, -1], through = [0, 0, 0.4] }, braking = 2.0 }]",
    "frame_speed = [{ frame = \"panda_hand\", limit = 0.3 }]",
    "energy = { limit = 0.5 }",
    "collision = { shapes = [{ frame = \"panda_hand\", shape = { sphere = { radius = 0.1 } } }, \
     { name = \"floor\", shape = \"half_space\", position = [0, 0, 0.3] }, \
     { name = \"post\", shape = { box = { size = [0.1, 0.1, 1.0] } }, position = [0.5, 0.3, 0.5] }], braking = 0.8 }",
    "torque_speed = { stall = 80.0, no_load = 3.0 }",
    "rows = [{ name = \"elbow\", terms = { \"q.panda_joint4\" = 1.0, \"q.panda_joint2\" = 0.5 }, upper = -1.9, braking = 2.0 }, \
     { name = \"together\", terms = { \"v.panda_joint1\" = 1.0, \"v.panda_joint3\" = -1.0 }, upper = 0.3, lower = -0.3 }]",
    "jerk = { limit = 500.0 }\ntorque_rate = { limit = 2000.0 }",
];

#[test]
fn every_kind_of_limit_is_verified_alone_and_together() {
    for kinds in COUPLED.iter().map(|kind| (*kind).to_owned()).chain([COUPLED[..3].join("\n")]) {
        let (_folder, log) = record("verify-kinds", &attack(&format!("{LIMITS}\n{kinds}"), 0.002, 1, 5));
        let report = verify(&log).unwrap();
        println!("{kinds}\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{kinds}\n{report}");
        assert!(report.verified + report.idle == 1500 && report.optimal > 200, "{kinds}\n{report}");
    }
}

#[test]
fn what_a_log_does_not_have_is_not_verified_and_a_damaged_one_is_refused_by_name() {
    let (folder, log) = record("verify-gaps", &attack(LIMITS, 0.001, 1, 20));
    let other = folder.0.join("copy.mcap");
    let edit =
        |topic: &str, m: &mut Value| topic != "tick" || !(600..650).contains(&m["tick"].as_u64().unwrap());
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    let report = verify(&other).unwrap();
    assert_eq!((report.found, report.unverified(), report.is_whole()), (0, 50, false), "{report}");
    assert!(
        report.ticks == 1450 && report.to_string().contains("50 ticks, the log does not have them"),
        "{report}"
    );

    let refused = |what: &str| {
        let text = verify(&other).unwrap_err().to_string();
        assert!(text.contains(what) && text.contains("copy.mcap"), "{what}: {text}");
    };
    copy(&log, &other, &|_, _| true, &|bytes| bytes, &|facts| _ = facts.insert("schema".into(), "4".into()));
    refused("its schema is 4, this build reads 5");
    copy(&log, &other, &|topic, _| topic != "snapshot", &|bytes| bytes, &|_| {});
    refused("snapshot number 0 is not in it");
    copy(
        &log,
        &other,
        &|topic, m| {
            if topic == "snapshot" {
                m["digest"] = "00".into();
            }
            true
        },
        &|bytes| bytes,
        &|_| {},
    );
    refused("snapshot number 0 is not in it");
    copy(
        &log,
        &other,
        &|topic, m| {
            if topic == "tick" && m["tick"] == 9 {
                m["state"] = 3.into();
            }
            true
        },
        &|bytes| bytes,
        &|_| {},
    );
    refused("a message of topic `tick` is damaged");
    std::fs::write(&other, b"no log at all, but long enough for a header").unwrap();
    refused("");
    std::fs::write(&other, b"").unwrap();
    refused("it is empty");
    std::fs::remove_file(&other).unwrap();
    std::fs::create_dir(&other).unwrap();
    refused("it is not a regular file");

    let whole = std::fs::read(&log).unwrap();
    let cut = folder.0.join("cut.mcap");
    std::fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    let report = verify(&cut).unwrap();
    assert!(report.found == 0 && !report.complete && !report.is_whole() && report.verified > 100, "{report}");
}
