//! What a flight log says is confirmed from the log alone, and a log that was changed is found out.

mod corrupted;
mod drives;
mod edited;
mod gaps;
mod kinds;
mod moved;

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use nearl_runtime::Snapshot;
use nearl_verify::Report;
use serde_json::Value;

use crate::arm::Scratch;
use crate::attack::Attack;

const PANDA: &str = include_str!("../../../examples/robots/panda/panda.urdf");

/// Joints, torque, and what ties joints together.
const LIMITS: &str = "position = { margin = 0.01 }\nvelocity = { scale = 0.5 }\nacceleration = { limit = 25.0 }\n\
     torque = { scale = 0.8 }\nbraking = \"stored\"";

fn attack(constraints: &str, dt: f64, sub_steps: u32, policy_every: usize) -> Attack {
    Attack {
        urdf: PANDA.into(),
        start: vec![0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8],
        constraints: constraints.into(),
        dt,
        sub_steps,
        plant_steps: 0,
        policy_every,
        seed: 5,
        ticks: 1500,
        moves: Vec::new(),
        pause: Duration::ZERO,
        lost: 0,
        late: 0,
        lag: 0.0,
        drive_damping: 0.0,
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

/// Every message of the ticks.
fn ticks(log: &Path) -> Vec<Value> {
    let bytes = std::fs::read(log).unwrap();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    messages.filter(|m| m.channel.topic == "tick").map(|m| serde_json::from_slice(&m.data).unwrap()).collect()
}

/// Everything that was claimed holds, and most of it was claimed.
fn holds(report: &Report, ticks: u64) {
    println!("{report}");
    assert_eq!(report.found, 0, "{report}");
    assert!(report.is_whole(), "{report}");
    assert_eq!(report.ticks, ticks, "{report}");
    assert!(report.verified + report.idle == ticks && report.verified > ticks - 20, "{report}");
    let outside = report.not_compared.get("the robot was outside its limits").copied().unwrap_or(0);
    assert!(report.stoppable + outside == report.verified && report.optimal > ticks / 4, "{report}");
    assert!(outside < ticks / 100, "{report}");
}

/// What ties joints together: planes, the speed of the hand, energy, bodies, a motor's line, a user's rows, soft rates.
const COUPLED: [&str; 7] = [
    "frame = [{ frame = \"panda_hand\", half_space = { normal = [0, 0, -1], through = [0, 0, 0.4] }, braking = 2.0 }]",
    "frame_speed = [{ name = \"tip\", frame = \"panda_hand\", limit = 0.3 }]",
    "energy = { limit = 0.5 }",
    "collision = { shapes = [{ frame = \"panda_hand\", shape = { sphere = { radius = 0.1 } } }, \
     { name = \"floor\", shape = \"half_space\", position = [0, 0, 0.3] }, \
     { name = \"post\", shape = { box = { size = [0.1, 0.1, 1.0] } }, position = [0.5, 0.3, 0.5] }], braking = 0.8 }",
    "torque_speed = { stall = 80.0, no_load = 3.0 }",
    "rows = [{ name = \"elbow\", terms = { \"q.panda_joint4\" = 1.0, \"q.panda_joint2\" = 0.5 }, upper = -1.9, braking = 2.0 }, \
     { name = \"together\", terms = { \"v.panda_joint1\" = 1.0, \"v.panda_joint3\" = -1.0 }, upper = 0.3, lower = -0.3 }]",
    "jerk = { limit = 500.0 }\ntorque_rate = { limit = 2000.0 }",
];

/// What is done to something of a log.
type Alter<'a, T> = &'a dyn Fn(&mut T);

fn add(value: &mut Value, by: f64) {
    *value = (value.as_f64().unwrap() + by).into();
}

/// Place of the first active row whose number is at least `from`.
fn first(m: &Value, from: u64) -> usize {
    let rows = m["ledger"]["active_rows"].as_array().unwrap();
    rows.iter().position(|row| row["row"].as_u64().unwrap() >= from).unwrap()
}

/// The bytes of a snapshot with another limit, its own digest right.
fn with_limit(bytes: Vec<u8>, change: &dyn Fn(&mut Value)) -> Vec<u8> {
    let mut snapshot = Snapshot::from_bytes(&bytes).unwrap();
    let mut constraints = serde_json::to_value(&snapshot.manifest.task.constraints).unwrap();
    change(&mut constraints);
    snapshot.manifest.task.constraints = serde_json::from_value(constraints).unwrap();
    snapshot.to_bytes()
}

/// Changes the limits that a log says the loop pinned.
fn limits_in(facts: &mut BTreeMap<String, String>, change: &dyn Fn(&mut Value)) {
    let mut limits: Value = serde_json::from_str(&facts["limits"]).unwrap();
    change(&mut limits);
    facts.insert("limits".into(), limits.to_string());
}
