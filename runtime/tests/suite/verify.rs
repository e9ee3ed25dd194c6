//! What a flight log says is confirmed from the log alone, and a log that was changed is found out.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use nearl_constraints::description::{JointDescription, JointKind, Payload};
use nearl_constraints::limit::{HalfSpace, Pose};
use nearl_constraints::{Kinematics, Moved, PerJoint};
use nearl_runtime::Snapshot;
use nearl_runtime::cli::{UNVERIFIED, VerifyCommand, exit_code};
use nearl_runtime::log::replay;
use nearl_verify::{Report, Violation, verify};
use serde_json::{Value, json};

use crate::arm::Scratch;
use crate::attack::Attack;
use crate::toy::Name;

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
        (1, 0.002, LIMITS.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0")),
        (0, 0.002, LIMITS.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0")),
    ] {
        let (_folder, log) = record("verify-steps", &attack(&limits, dt, sub_steps, 5));
        holds(&verify(&log).unwrap(), 1500);
    }
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

/// In front of a position limit the steps of a period give a joint less acceleration than the nearest target has: another one is projected, which says
/// that it is not the nearest (`slowed`), and to which the action leads.
#[test]
fn limits_of_several_joints_are_verified_over_several_steps() {
    for kinds in COUPLED[..3].iter().map(|kind| (*kind).to_owned()).chain([COUPLED[..4].join("\n")]) {
        let flight = attack(&format!("{LIMITS}\n{kinds}"), 0.01, 5, 5);
        let (_folder, log) = record("verify-kinds-steps", &flight);
        let report = verify(&log).unwrap();
        println!("{kinds}\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{kinds}\n{report}");
        assert!(report.verified + report.idle == 1500 && report.optimal > 200, "{kinds}\n{report}");
        // Solved for, and not on the way to a stored brake.
        let is_another = |t: &&Value| t["ledger"]["status"] == 4 && t["ledger"]["rung"].as_u64() < Some(3);
        let others = ticks(&log).iter().filter(is_another).count();
        assert!(others > 500, "{kinds}: {others} ticks were projected once more");
    }
}

/// A motor's line bounds the force at the speed of a period's start and end, where the steps of the period are reckoned with one by one.
#[test]
fn a_motor_s_line_is_verified_over_several_steps() {
    let line = COUPLED.iter().find(|kind| kind.starts_with("torque_speed")).expect("a motor's line");
    let (_folder, log) = record("verify-line-steps", &attack(&format!("{LIMITS}\n{line}"), 0.004, 4, 5));
    let report = verify(&log).unwrap();
    assert_eq!((report.found, report.is_whole()), (0, true), "{report}");
    assert!(report.verified + report.idle == 1500 && report.optimal > 200, "{report}");
}

/// What is done to something of a log.
type Alter<'a, T> = &'a dyn Fn(&mut T);

/// Orders of an operator every 0.2 s, and back: speeds, positions, how fast a joint may speed up where jerk is soft, and what ties joints
/// together.
/// A plant that moves in next to no steps is what the period makes of it to second order. A brake that was verified a tick before may then end up
/// within the margin, and no further; with no margin to take it up, it ends beyond the limit, and is found. One that moves in several steps is
/// foreseen, and keeps what it has no margin for.
#[test]
fn a_flight_on_a_plant_that_differs_to_second_order_is_verified_within_its_margins() {
    let limits = LIMITS.replace("25.0", "8.0");
    for (sub_steps, plant_steps, dt, foreseen) in
        [(4, 4, 0.004, true), (0, 80, 0.02, false), (5, 5, 0.01, true)]
    {
        let mut braked = 0;
        for (margin, is_kept) in [("0.01", true), ("0.0", foreseen)] {
            let limits = limits.replace("margin = 0.01", &format!("margin = {margin}"));
            let flight = Attack { plant_steps, ticks: 3000, ..attack(&limits, dt, sub_steps, 20) };
            let (_folder, log) = record("verify-second-order", &flight);
            let report = verify(&log).unwrap();
            println!("{sub_steps} {plant_steps} {margin}: {report}");
            assert_eq!(report.found == 0, is_kept, "{report}");
            assert!(report.verified + report.found + report.idle == 3000, "{report}");
            let is_braked = |tick: &Value| (10..=13).contains(&tick["ledger"]["status"].as_u64().unwrap());
            braked += ticks(&log).iter().filter(|tick| is_braked(tick)).count();
        }
        assert!(braked > 20, "{braked}");
    }
}

/// Positions go on from what was sent, though the robot is measured 20 ms behind, every seventh state is lost, and every fifth and the next answer
/// come too late, in whose periods the driver holds: by differences of what the robot is sent, no acceleration is above its limit.
#[test]
fn set_points_of_a_robot_that_lags_keep_their_limits_over_states_and_answers_that_are_lost() {
    let positions = format!("{LIMITS}\n[command]\ninterface = \"position\"");
    for (lost, late) in [(0, 0), (7, 0), (0, 5), (7, 5)] {
        let flight = Attack { lost, late, lag: 0.02, ..attack(&positions, 0.004, 1, 20) };
        let (_folder, log) = record("verify-sent", &flight);
        let report = verify(&log).unwrap();
        println!("{lost}, {late}: {report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{report}");
        let (mut q, mut v, mut most, mut fastest) = (flight.start.clone(), vec![0.0; 7], 0.0f64, 0.0f64);
        for pair in ticks(&log).windows(2) {
            let between = |what: &str| {
                pair[1]["state"][what].as_u64().unwrap() - pair[0]["state"][what].as_u64().unwrap()
            };
            // the answer, unless the next state says that one more than those to lost states came too late; else the driver goes on slower
            let (periods, is_heard) = (between("seq"), between("late") < between("seq"));
            for period in 0..periods {
                for i in 0..7 {
                    let to = pair[0]["action"][i].as_f64().unwrap();
                    let speed = match period == 0 && is_heard {
                        true => (to - q[i]) / 0.004,
                        false => v[i] - f64::signum(v[i]) * (25.0 * 0.004_f64).min(v[i].abs()),
                    };
                    most = most.max((speed - v[i]).abs() / 0.004);
                    fastest = fastest.max(speed.abs());
                    (q[i], v[i]) = (q[i] + 0.004 * speed, speed);
                }
            }
        }
        assert!(most < 25.0 + 1e-6, "{lost}, {late}: {most} rad/s^2");
        assert!(fastest > 0.3, "{lost}, {late}: {fastest} rad/s prove nothing");
    }
}

/// Every seventh state is lost, every fifth answer and the next come too late, and the driver holds the forces of before. They then lead where nobody
/// foresaw: by as much faster as a period's acceleration makes, for each period. No force is above its limit all the same, on the way back neither, and
/// the change of a force, or of an acceleration, is that from what was sent before: it was reckoned from answers that nobody had applied.
#[test]
fn forces_keep_their_limits_and_rates_over_states_and_answers_that_are_lost() {
    let numbers = |value: &Value| -> Vec<f64> {
        value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
    };
    let largest =
        |a: &[f64], b: &[f64]| a.iter().zip(b).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs()));
    for rates in ["", "torque_rate = { limit = 2000.0 }", "jerk = { limit = 600.0, hard = true }"] {
        for (lost, late, periods) in [(0, 0, 0.0), (7, 0, 1.0), (0, 5, 2.0), (7, 5, 3.0)] {
            let flight = Attack { lost, late, ..attack(&format!("{LIMITS}\n{rates}"), 0.004, 1, 20) };
            let (_folder, log) = record("verify-rate", &flight);
            let (mut before, mut compared) = (None::<[Vec<f64>; 2]>, 0);
            let [mut force_change, mut change, mut force, mut fastest] = [0.0f64; 4];
            for pair in ticks(&log).windows(2) {
                let tick = &pair[0];
                let between = |what: &str| {
                    pair[1]["state"][what].as_u64().unwrap() - tick["state"][what].as_u64().unwrap()
                };
                let (v, target, action) =
                    (numbers(&tick["state"]["v"]), numbers(&tick["target_v"]), numbers(&tick["action"]));
                fastest = fastest.max(largest(&v, &[0.0; 7]));
                let strength = |i: usize| if i < 4 { 0.8 * 87.0 } else { 0.8 * 12.0 };
                force = action.iter().enumerate().fold(force, |most, (i, f)| most.max(f.abs() / strength(i)));
                if between("late") >= between("seq") {
                    continue; // it came too late
                }
                let acceleration: Vec<f64> =
                    target.iter().zip(&v).map(|(to, from)| (to - from) / 0.004).collect();
                if let Some([before_force, before]) = &before {
                    let (status, slack) = (&tick["ledger"]["status"], &tick["ledger"]["slack"]);
                    let status = status.as_u64().unwrap();
                    // a brake that asks for more than the motors have gives way to them
                    if status < 10 {
                        change = change.max(largest(&acceleration, before));
                    }
                    // a soft rate gives way where something hard asks for it, and says so
                    if status <= 1 && slack.as_f64().unwrap() < 1e-9 {
                        force_change = force_change.max(largest(&action, before_force));
                        compared += 1;
                    }
                }
                before = Some([action, acceleration]);
            }
            let told = format!(
                "{rates} {lost}, {late}: {fastest} rad/s, {force} of the force, changes {force_change}, {change}"
            );
            println!("{told} of {compared}");
            assert!(force < 1.0 + 1e-6 && fastest > 1.0, "{told}");
            match rates.split(' ').next() {
                Some("torque_rate") => assert!(force_change < 8.0 + 1e-6 && compared > 100, "{told}"),
                Some("jerk") => assert!(change < 2.4 + 1e-6, "{told}"),
                _ => assert!(fastest < 1.305 + 0.1 * periods + 0.01, "{told}"),
            }
        }
    }
}

/// What a joint went on from in the first tick after a gap is not in the log, so that its acceleration there, of which the jerk of the next tick speaks,
/// is not known either: it was taken from the measured state, and honest logs were accused.
#[test]
fn a_jerk_after_a_gap_is_not_told_from_a_measured_state() {
    let limits =
        format!("{LIMITS}\njerk = {{ limit = 600.0, hard = true }}\n[command]\ninterface = \"position\"");
    let (folder, log) = record("verify-gap-jerk", &Attack { lag: 0.02, ..attack(&limits, 0.004, 1, 20) });
    let whole = verify(&log).unwrap();
    assert_eq!((whole.found, whole.is_whole()), (0, true), "{whole}");
    let other = folder.0.join("copy.mcap");
    for left_out in [300, 517, 733, 901, 1204] {
        let edit = |topic: &str, m: &mut Value| topic != "tick" || m["tick"] != left_out;
        copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
        let report = verify(&other).unwrap();
        assert_eq!(report.found, 0, "{left_out}: {report}");
        assert!((1..8).contains(&report.unverified()), "{left_out}: {report}");
    }
    // The set point that takes the place of a measured position does not hide one that is no number.
    let edit = |topic: &str, m: &mut Value| {
        if topic == "tick" && m["tick"] == 700 {
            m["state"]["q"][2] = Value::Null;
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    let report = verify(&other).unwrap();
    assert!(report.found > 0 && report.violations[0].what.contains("state.q[2]"), "{report}");
}

/// Targets are kept within the range of their drives. Where nothing keeps them, as under a soft torque limit, a drive that is sent less far than its
/// target asks for leads elsewhere: the log claims a target that nothing leads to.
#[test]
fn targets_of_drives_that_are_cut_at_their_range_are_found() {
    let drives = format!("{LIMITS}\n[command]\ninterface = \"pd\"\nstiffness = 100.0\ndamping = 5.0");
    let soft = drives.replace("torque = { scale = 0.8 }", "torque = { scale = 0.8, soft = {} }");
    for sub_steps in [1, 0] {
        let fly = |limits: &str, far: f64| {
            let attack = attack(limits, 0.001, sub_steps, 20);
            let (mut snapshot, model) = (attack.snapshot(1), attack.model());
            let reach = |i: usize| (model.effort_limit()[i] + 5.0 * model.velocity_limit()[i]) / 100.0 + 0.01;
            let ends = |of: &[f64], far: f64| (0..7).map(|i| of[i] + far * reach(i)).collect::<Vec<_>>();
            snapshot.manifest.action_lower = ends(model.lower_position_limit(), -far);
            snapshot.manifest.action_upper = ends(model.upper_position_limit(), far);
            let folder = Scratch::new(&format!("verify-cut-{sub_steps}-{far}-{}", limits.len()));
            let (log, summary) = attack.fly_with(&snapshot, &folder.0);
            assert_eq!((summary.dropped, summary.brief, summary.error), (0, 0, None));
            let at_end = ticks(&log).into_iter().filter(|tick| {
                let action = (0..7).map(|i| tick["action"][i].as_f64().unwrap());
                let range = snapshot.manifest.action_lower.iter().zip(&snapshot.manifest.action_upper);
                action.zip(range).any(|(x, (low, high))| (x - low).min(high - x) < 1e-6)
            });
            (verify(&log).unwrap(), at_end.count())
        };
        holds(&fly(&drives, 1.0).0, 1500);
        let (report, at_end) = fly(&drives, 0.0);
        println!("{sub_steps}: {report}, {at_end} ticks at an end");
        holds(&report, 1500);
        assert!(sub_steps == 0 || at_end > 0, "no target came to its end");
        let (mut found, mut told) = (false, false);
        for limit in ["limit = 25.0", "limit = 60.0", "limit = 100.0"] {
            let (report, at_end) = fly(&soft.replace("limit = 25.0", limit), 0.0);
            println!("{sub_steps}, {limit}: {report}, {at_end} ticks at an end");
            let is_cut = |violation: &Violation| violation.what.contains("is cut at its range");
            found |= report.found > 0 && report.violations.iter().any(is_cut);
            told |= report.not_verified.keys().any(|why| why.contains("is cut at its range"));
            assert_eq!(report.verified + report.found + report.unverified() + report.idle, 1500, "{report}");
        }
        assert!(found && told, "{found} {told}");
    }
}

/// Targets that are held over the steps of a period lead through them to what the log claims, and those that are another's do not; whether the steps
/// take the damping of the drives implicitly or not. Stiff drives come to their largest force at the ends of periods.
#[test]
fn targets_of_drives_are_verified_over_several_steps() {
    let cases = [
        (2, 0.002, 0.0, 100.0),
        (5, 0.005, 0.0, 100.0),
        (1, 0.002, 5.0, 100.0),
        (5, 0.005, 5.0, 100.0),
        (2, 0.002, 0.0, 4000.0),
        (5, 0.005, 5.0, 2000.0),
    ];
    for (sub_steps, dt, drive_damping, stiffness) in cases {
        let drives =
            format!("{LIMITS}\n[command]\ninterface = \"pd\"\nstiffness = {stiffness:?}\ndamping = 5.0")
                .replace("25.0", "8.0")
                .replace("scale = 0.8", if stiffness > 1000.0 { "scale = 0.5" } else { "scale = 0.8" });
        let flight = Attack { drive_damping, ..attack(&drives, dt, sub_steps, 20) };
        let mut snapshot = flight.snapshot(1);
        (snapshot.manifest.action_lower, snapshot.manifest.action_upper) = (vec![-9.0; 7], vec![9.0; 7]);
        let folder = Scratch::new(&format!("verify-targets-{sub_steps}-{drive_damping}-{stiffness}"));
        let (log, summary) = flight.fly_with(&snapshot, &folder.0);
        assert_eq!((summary.dropped, summary.brief, summary.error), (0, 0, None));
        holds(&verify(&log).unwrap(), 1500);
        // of seven joints, then their mean forces, then the forces at the ends
        let is_of_an_end = |row: &Value| row["row"].as_u64().unwrap() >= 14;
        let is_bound =
            |tick: &Value| tick["ledger"]["active_rows"].as_array().unwrap().iter().any(is_of_an_end);
        let bound = ticks(&log).iter().filter(|tick| is_bound(tick)).count();
        assert!(stiffness < 1000.0 || bound > 10, "{bound} ticks at the end of a force");
        let other = folder.0.join("copy.mcap");
        let edit = |topic: &str, m: &mut Value| {
            if topic == "tick" && m["tick"] == 700 {
                m["action"][3] = (m["action"][3].as_f64().unwrap() + 1e-4).into();
            }
            true
        };
        copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
        let report = verify(&other).unwrap();
        assert!(report.found == 1 && report.violations[0].tick == 700, "{report}");
    }
}

/// Speeds with accelerations of another joint, and sums of positions and of speeds that stay where they are.
#[test]
fn rows_of_several_joints_are_verified_with_what_a_brake_keeps_of_them() {
    let rows = [
        "{ name = \"mix\", terms = { \"v.panda_joint4\" = 1.0, \"a.panda_joint2\" = 0.05 }, lower = -0.8, upper = 0.8 }",
        "{ name = \"mimic\", terms = { \"q.panda_joint6\" = 1.0, \"q.panda_joint4\" = 0.8 }, equals = 0.0 }",
        "{ name = \"geared\", terms = { \"v.panda_joint1\" = 1.0, \"v.panda_joint3\" = -0.5 }, equals = 0.0 }",
    ];
    for (test, dt, sub_steps, rows) in [
        ("verify-rows-a", 0.001, 1, rows.join(", ")),
        ("verify-rows-b", 0.004, 1, rows[..1].join(", ")),
        ("verify-rows-c", 0.004, 1, rows[1..].join(", ")),
    ] {
        let limits = format!("{LIMITS}\nrows = [{rows}]");
        let (_folder, log) = record(test, &attack(&limits, dt, sub_steps, 20));
        holds(&verify(&log).unwrap(), 1500);
    }
}

fn orders(dt: f64, kinds: &str) -> Vec<(u64, Moved)> {
    let named = |joint: &str, x: f64| Some(PerJoint::Joints([(joint.to_owned(), x)].into()));
    let mut all = vec![
        Moved::speed(0.3),
        Moved::default(),
        Moved {
            upper: named("panda_joint4", -2.0),
            lower: named("panda_joint1", -0.1),
            acceleration: if kinds.contains("hard = true") { None } else { named("panda_joint2", 2.0) },
            ..Moved::default()
        },
        Moved { velocity: named("panda_joint6", 0.1), ..Moved::speed(0.6) },
        Moved::default(),
        Moved::speed(0.02),
        Moved::default(),
    ];
    let only = |name: &str, x: f64| [(name.to_owned(), x)].into();
    for moved in &mut all {
        if *moved == Moved::default() {
            continue;
        }
        if kinds.contains("\nframe = [") {
            moved.frame = only("panda_hand", 0.05);
        }
        if kinds.contains("frame_speed") {
            moved.frame_speed = only("tip", 0.1);
        }
        if kinds.contains("energy = ") {
            moved.energy = Some(0.1);
        }
    }
    let every = (0.2 / dt) as u64;
    all.into_iter().enumerate().map(|(k, moved)| ((k as u64 + 1) * every, moved)).collect()
}

#[test]
fn limits_that_an_operator_moves_are_verified_on_the_way_and_where_they_lead() {
    let certified = LIMITS.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0");
    let tied = |kinds: &[&str]| format!("{LIMITS}\n{}", kinds.join("\n"));
    for (limits, dt, sub_steps) in [
        (LIMITS.to_owned(), 0.001, 1),
        (certified.clone(), 0.002, 1),
        (certified, 0.002, 0),
        (LIMITS.to_owned(), 0.01, 5),
        (tied(&COUPLED[..1]), 0.002, 1),
        (tied(&COUPLED[1..2]), 0.002, 0),
        (tied(&COUPLED[2..3]), 0.002, 1),
        (tied(&COUPLED[..4]), 0.002, 1),
    ] {
        let flight = Attack { moves: orders(dt, &limits), ..attack(&limits, dt, sub_steps, 5) };
        let (_folder, log) = record("verify-moved", &flight);
        let report = verify(&log).unwrap();
        println!("{limits}, {sub_steps} steps of {dt} s\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{limits} {dt}\n{report}");
        let on_the_way = report.not_compared.iter().find(|(why, _)| why.contains("on its way"));
        assert!(
            on_the_way.is_some_and(|(_, ticks)| *ticks > 5),
            "{limits} {dt}: nothing was on its way\n{report}"
        );
        assert!(report.verified + report.idle == 1500 && report.optimal > 150, "{limits} {dt}\n{report}");
    }
}

/// A hand below a plane and clear of a ball that are both carried about, and a load that it takes up and sets down.
fn carried(dt: f64) -> Vec<(u64, Moved)> {
    let named = |name: &str| name.to_owned();
    let plane = |normal, through| [(named("panda_hand"), HalfSpace { normal, through })].into();
    let ball = |position| [(named("ball"), Pose { position, rpy: [0.0; 3] })].into();
    let load = |mass| {
        Some(Payload {
            frame: named("panda_hand"),
            mass,
            com: [0.01, 0.0, 0.05],
            inertia: [0.002, 0.0, 0.0, 0.002, 0.0, 0.001],
        })
    };
    let all = [
        Moved { plane: plane([0.3, 0.0, -1.0], [0.4, 0.0, 0.5]), ..Moved::default() },
        Moved { body: ball([0.55, 0.1, 0.6]), ..Moved::default() },
        Moved { payload: load(1.0), ..Moved::speed(0.5) },
        Moved { payload: load(1.6), plane: plane([0.0, 0.4, -1.0], [0.4, 0.0, 0.45]), ..Moved::default() },
        Moved { payload: load(0.4), body: ball([0.5, -0.15, 0.5]), ..Moved::default() },
        Moved::default(),
    ];
    let every = (0.2 / dt) as u64;
    all.into_iter().enumerate().map(|(k, moved)| ((k as u64 + 1) * every, moved)).collect()
}

#[test]
fn what_is_put_elsewhere_and_what_is_taken_up_is_verified() {
    let ball = "collision = { shapes = [{ frame = \"panda_hand\", shape = { sphere = { radius = 0.08 } } }, \
         { name = \"ball\", shape = { sphere = { radius = 0.08 } }, position = [0.9, 0.5, 0.5] }], braking = 0.8 }";
    let limits = format!("{LIMITS}\n{}\n{ball}", COUPLED[0].replace("0.4]", "0.2]"));
    let jerk = format!("{limits}\njerk = {{ limit = 600.0, hard = true }}");
    for (limits, dt, sub_steps) in
        [(&limits, 0.001, 1), (&limits, 0.002, 0), (&limits, 0.01, 5), (&jerk, 0.002, 1)]
    {
        let flight = Attack { moves: carried(dt), ..attack(limits, dt, sub_steps, 5) };
        let (_folder, log) = record("verify-carried", &flight);
        let report = verify(&log).unwrap();
        println!("{limits}, {sub_steps} steps of {dt} s\n{report}");
        assert_eq!((report.found, report.complete), (0, true), "{limits} {dt}\n{report}");
        // A brake that was stored for another load is nothing that the log can confirm.
        let another_load =
            |why: &String| why == "the robot braked as was verified before it carried what it carries now";
        assert!(report.not_verified.keys().all(another_load), "{limits} {dt}\n{report}");
        assert!(report.verified + report.idle > 1400 && report.optimal > 100, "{limits} {dt}\n{report}");
        assert_eq!(replay(&log).unwrap().difference, None, "{limits} {dt}");
        // As if the plane, or the ball, had been put where the hand was, and as if the load had been another.
        let seen = ticks(&log);
        let hand = |orders: f64| {
            let tick = &seen[((orders * 0.2) / dt) as usize];
            let q: Vec<f64> = serde_json::from_value(tick["target_q"].clone()).unwrap();
            let mut kinematics = Kinematics::new(&flight.model());
            kinematics.update(&q, &[0.0; 7], &[0.0; 7]);
            kinematics.point(flight.model().frame("panda_hand").unwrap(), [0.0; 3]).position
        };
        let (under, there) = (hand(1.5), hand(2.5));
        let other = log.with_file_name("copy.mcap");
        let cases: [(&str, Alter<Moved>); 3] = [
            ("a plane", &|moved| {
                for plane in moved.plane.values_mut() {
                    plane.through = std::array::from_fn(|k| under[k] - 0.1 * plane.normal[k]);
                }
            }),
            ("a ball", &|moved| moved.body.values_mut().for_each(|body| body.position = there)),
            ("a load", &|moved| moved.payload.iter_mut().for_each(|load| load.mass *= 3.0)),
        ];
        for (word, change) in cases {
            let edit = |bytes: Vec<u8>| {
                let mut snapshot = Snapshot::from_bytes(&bytes).unwrap();
                snapshot.manifest.moved.iter_mut().for_each(change);
                snapshot.to_bytes()
            };
            copy(&log, &other, &|_, _| true, &edit, &|_| {});
            let report = verify(&other).unwrap();
            assert!(report.found > 0, "{word} {dt}\n{report}");
        }
    }
}

/// Speeds and positions that move while jerk is hard.
#[test]
fn limits_that_move_are_verified_where_jerk_is_hard() {
    let jerk = format!("{LIMITS}\njerk = {{ limit = 600.0, hard = true }}");
    let certified = jerk.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0");
    for (limits, dt, sub_steps) in [(&jerk, 0.001, 1), (&certified, 0.002, 0), (&jerk, 0.01, 5)] {
        let flight = Attack { moves: orders(dt, limits), ..attack(limits, dt, sub_steps, 5) };
        let (_folder, log) = record("verify-moved-jerk", &flight);
        let report = verify(&log).unwrap();
        println!("{limits}, {sub_steps} steps of {dt} s\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{limits} {dt}\n{report}");
        let on_the_way = report.not_compared.iter().find(|(why, _)| why.contains("on its way"));
        assert!(on_the_way.is_some_and(|(_, ticks)| *ticks > 5), "{limits} {dt}\n{report}");
        assert!(report.verified + report.idle == 1500 && report.optimal > 100, "{limits} {dt}\n{report}");
    }
}

#[test]
fn a_tick_beyond_the_way_to_moved_limits_is_named() {
    let flight = Attack { moves: orders(0.001, ""), ..attack(LIMITS, 0.001, 1, 20) };
    let (folder, log) = record("verify-moved-edited", &flight);
    let other = folder.0.join("copy.mcap");
    // As if the operator had asked for less than the loop was built with.
    let tighter = |bytes: Vec<u8>, change: &dyn Fn(&mut Moved)| {
        let mut snapshot = Snapshot::from_bytes(&bytes).unwrap();
        snapshot.manifest.moved.iter_mut().filter(|moved| **moved != Moved::default()).for_each(change);
        snapshot.to_bytes()
    };
    let cases: [(&str, Alter<Moved>); 4] = [
        ("speed of joint", &|moved| moved.speed *= 0.9),
        ("gain of speed of joint", &|moved| moved.acceleration = Some(PerJoint::All(1.5))),
        ("position of joint 'panda_joint2'", &|moved| {
            moved.upper = Some(PerJoint::Joints([("panda_joint2".to_owned(), -1.0)].into()));
        }),
        ("position of joint 'panda_joint4'", &|moved| {
            moved.lower = Some(PerJoint::Joints([("panda_joint4".to_owned(), -1.9)].into()));
        }),
    ];
    for (word, change) in cases {
        copy(&log, &other, &|_, _| true, &|bytes| tighter(bytes, change), &|_| {});
        let report = verify(&other).unwrap();
        println!("{word}: {report}");
        assert!(
            report.found > 0 && report.violations.iter().any(|v| v.what.contains(word)),
            "{word}\n{report}"
        );
    }
    // A tick that says it is on the way to limits that nobody moved.
    let (folder, log) = record("verify-not-moved", &Attack { ticks: 300, ..attack(LIMITS, 0.001, 1, 20) });
    let other = folder.0.join("copy.mcap");
    let edit = |topic: &str, m: &mut Value| {
        if topic == "tick" && m["tick"] == 200 {
            m["ledger"]["status"] = 6.into();
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    let report = verify(&other).unwrap();
    assert!(report.found == 1 && report.violations[0].tick == 200, "{report}");
}

#[test]
fn hard_jerk_is_verified_alone_and_with_what_ties_joints_together() {
    let jerk = format!("{LIMITS}\njerk = {{ limit = 600.0, hard = true }}");
    let certified = jerk.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0");
    for (limits, dt, sub_steps) in [
        (jerk.clone(), 0.001, 1),
        (certified.clone(), 0.001, 1),
        (certified, 0.01, 1),
        (jerk.clone(), 0.01, 5),
        (jerk.clone() + "\nlocked = [\"panda_joint3\"]", 0.002, 1),
        (format!("{jerk}\n{}", COUPLED[0]), 0.002, 1),
        (format!("{jerk}\n{}", COUPLED[1]), 0.002, 0),
    ] {
        let (_folder, log) = record("verify-jerk", &attack(&limits, dt, sub_steps, 5));
        let report = verify(&log).unwrap();
        println!("{limits}, {sub_steps} steps of {dt} s\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{limits} {dt}\n{report}");
        // Over several steps a joint may be a little outside of what its brake counts on, as its jerk bounds how much slower it may become for it.
        let outside = if sub_steps > 1 { report.verified / 100 } else { 0 };
        assert!(
            report.stoppable + outside >= report.verified && report.optimal > 150,
            "{limits} {dt}\n{report}"
        );
    }
    // Another jerk than the loop was built with is found out, looser or tighter.
    let (folder, log) = record("verify-jerk-edited", &attack(&jerk, 0.002, 1, 5));
    let other = folder.0.join("copy.mcap");
    for jerk in [550.0, 650.0] {
        let change = |constraints: &mut Value| constraints["jerk"]["limit"] = jerk.into();
        let facts = |facts: &mut _| limits_in(facts, &change);
        copy(&log, &other, &|_, _| true, &|bytes| with_limit(bytes, &change), &facts);
        let report = verify(&other).unwrap();
        assert!(report.found > 0, "jerk {jerk}\n{report}");
    }
}

#[test]
fn positions_and_velocities_that_are_clamped_apart_are_verified() {
    let free = "consistency = \"free\"\nposition = { margin = 0.01 }\nvelocity = { scale = 0.5 }\nacceleration = { limit = 3.0 }\n\
         braking = \"certified\"";
    let (folder, log) = record("verify-free", &attack(free, 0.002, 1, 5));
    let report = verify(&log).unwrap();
    println!("{report}");
    assert_eq!((report.found, report.is_whole()), (0, true), "{report}");
    assert!(report.optimal > 1400, "{report}");
    let at = ticks(&log)
        .iter()
        .rfind(|m| !m["ledger"]["active_rows"].as_array().unwrap().is_empty())
        .unwrap()["tick"]
        .as_u64()
        .unwrap();
    let other = folder.0.join("copy.mcap");
    let cases: [(&str, Alter<Value>); 4] = [
        ("target", &|m| add(&mut m["target_q"][0], 1e-5)),
        ("target", &|m| add(&mut m["target_v"][0], 1e-4)),
        ("multiplier", &|m| add(&mut m["ledger"]["active_rows"][0]["multiplier"], 0.1)),
        ("no active row", &|m| {
            m["ledger"]["active_rows"].as_array_mut().unwrap().remove(0);
            m["ledger"]["active"] = (m["ledger"]["active"].as_u64().unwrap() - 1).into();
        }),
    ];
    for (word, change) in cases {
        let edit = |topic: &str, m: &mut Value| {
            if topic == "tick" && m["tick"] == at {
                change(m);
            }
            true
        };
        copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
        let report = verify(&other).unwrap();
        println!("{word}: {:?}", report.violations.first());
        assert!(report.found > 0 && report.violations[0].tick == at, "{word}\n{report}");
    }
}

/// What is done to the message of one tick.
type Edit = Box<dyn Fn(&mut Value)>;

fn add(value: &mut Value, by: f64) {
    *value = (value.as_f64().unwrap() + by).into();
}

/// Place of the first active row whose number is at least `from`.
fn first(m: &Value, from: u64) -> usize {
    let rows = m["ledger"]["active_rows"].as_array().unwrap();
    rows.iter().position(|row| row["row"].as_u64().unwrap() >= from).unwrap()
}

/// A tick in the middle in which rows of torque and of joints are active, and its joint of each.
fn busy(all: &[Value]) -> (u64, usize, usize) {
    let has = |tick: &Value, from: u64, to: u64| {
        let rows = tick["ledger"]["active_rows"].as_array().unwrap();
        let strong = |row: &&Value| {
            (from..to).contains(&row["row"].as_u64().unwrap()) && row["multiplier"].as_f64().unwrap() > 1e-3
        };
        rows.iter().find(strong).map(|row| row["row"].as_u64().unwrap() as usize)
    };
    let found = all.iter().find_map(|tick| {
        let (joint, torque) = (has(tick, 0, 7)?, has(tick, 7, 14)?);
        let number = tick["tick"].as_u64().unwrap();
        (number > 400 && tick["ledger"]["status"] == 2).then_some((number, joint, torque - 7))
    });
    found.expect("a tick in which a joint and a motor are at their limits")
}

#[test]
fn every_seeded_corruption_is_named_at_its_tick() {
    let (folder, log) = record("verify-edited", &attack(LIMITS, 0.001, 1, 20));
    let (at, joint, _) = busy(&ticks(&log));
    let other = folder.0.join("copy.mcap");
    let found = |change: &dyn Fn(&mut Value)| {
        let edit = |topic: &str, value: &mut Value| {
            if topic == "tick" && value["tick"] == at {
                change(value);
            }
            true
        };
        copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
        verify(&other).unwrap()
    };
    assert_eq!(found(&|_| {}).found, 0);
    let cases: Vec<(&str, &str, Edit)> = vec![
        ("target_q", "position", Box::new(move |m: &mut Value| add(&mut m["target_q"][joint], 1e-7))),
        ("target_v", "joint", Box::new(move |m: &mut Value| add(&mut m["target_v"][joint], 1e-5))),
        ("action", "action for joint", Box::new(move |m: &mut Value| add(&mut m["action"][3], 1e-3))),
        (
            "action sign",
            "action for joint",
            Box::new(move |m: &mut Value| m["action"][1] = (-m["action"][1].as_f64().unwrap()).into()),
        ),
        ("state q", "joint", Box::new(move |m: &mut Value| add(&mut m["state"]["q"][1], 1e-4))),
        ("state v", "joint", Box::new(move |m: &mut Value| add(&mut m["state"]["v"][1], 1e-4))),
        (
            "multiplier",
            "no active row balances",
            Box::new(move |m: &mut Value| add(&mut m["ledger"]["active_rows"][0]["multiplier"], 1e-4)),
        ),
        (
            "multiplier below zero",
            "multiplier",
            Box::new(move |m: &mut Value| m["ledger"]["active_rows"][0]["multiplier"] = (-1.0).into()),
        ),
        (
            "row left out",
            "no active row balances",
            Box::new(move |m: &mut Value| {
                m["ledger"]["active_rows"].as_array_mut().unwrap().remove(0);
                m["ledger"]["active"] = (m["ledger"]["active"].as_u64().unwrap() - 1).into();
            }),
        ),
        (
            "row of another motor",
            "row",
            Box::new(move |m: &mut Value| {
                let k = first(m, 7);
                let row = m["ledger"]["active_rows"][k]["row"].as_u64().unwrap();
                m["ledger"]["active_rows"][k]["row"] = (7 + (row - 6) % 7).into();
            }),
        ),
        (
            "side of a row",
            "",
            Box::new(move |m: &mut Value| {
                let k = first(m, 7);
                let side = if m["ledger"]["active_rows"][k]["side"] == "upper" { "lower" } else { "upper" };
                m["ledger"]["active_rows"][k]["side"] = side.into();
            }),
        ),
        (
            "kind of a row",
            "number of the active",
            Box::new(move |m: &mut Value| {
                let k = first(m, 7);
                m["ledger"]["active_rows"][k]["kind"] = "frame".into();
            }),
        ),
        (
            "slack of a row",
            "slack",
            Box::new(move |m: &mut Value| m["ledger"]["active_rows"][0]["slack"] = 0.1.into()),
        ),
        (
            "rows gone",
            "ledger.active is",
            Box::new(move |m: &mut Value| m["ledger"]["active_rows"] = json!([])),
        ),
        (
            "said to be unchanged",
            "said to be unchanged",
            Box::new(move |m: &mut Value| m["ledger"]["status"] = 0.into()),
        ),
        (
            "said to be clamped",
            "said to be clamped joint by joint",
            Box::new(move |m: &mut Value| m["ledger"]["status"] = 1.into()),
        ),
        (
            "said to be unchanged, and no row",
            "no active row balances",
            Box::new(move |m: &mut Value| {
                m["ledger"]["status"] = 0.into();
                m["ledger"]["active"] = 0.into();
                m["ledger"]["active_rows"] = json!([]);
            }),
        ),
        ("slack", "ledger.slack", Box::new(move |m: &mut Value| m["ledger"]["slack"] = 0.9.into())),
        ("slack below", "ledger.slack", Box::new(move |m: &mut Value| m["ledger"]["slack"] = (-0.9).into())),
        ("outside", "ledger.outside", Box::new(move |m: &mut Value| m["ledger"]["outside"] = 1.into())),
        ("moved", "moved", Box::new(move |m: &mut Value| add(&mut m["ledger"]["moved"], 0.1))),
        ("status", "status", Box::new(move |m: &mut Value| m["ledger"]["status"] = 77.into())),
        ("recovering", "recovering", Box::new(move |m: &mut Value| m["ledger"]["status"] = 3.into())),
        (
            "violations",
            "target_violations",
            Box::new(move |m: &mut Value| m["ledger"]["target_violations"] = 3.into()),
        ),
        ("brake left out", "stored decelerations", Box::new(move |m: &mut Value| m["brake"] = json!([]))),
        (
            "brake beyond the motors",
            "stored deceleration",
            Box::new(move |m: &mut Value| m["brake"][0] = 25.1.into()),
        ),
        ("brake too weak", "way to stop", Box::new(move |m: &mut Value| m["brake"] = json!(vec![2e-2; 7]))),
        ("not a number", "target_v[2]", Box::new(move |m: &mut Value| m["target_v"][2] = Value::Null)),
        ("left out", "action", Box::new(move |m: &mut Value| m["action"] = json!([]))),
        (
            "a number too many",
            "length of action",
            Box::new(move |m: &mut Value| m["action"].as_array_mut().unwrap().push(json!(0.0))),
        ),
        ("cut", "length of target_q", Box::new(move |m: &mut Value| m["target_q"] = json!([0.0]))),
        ("speeds cut", "length of target_v", Box::new(move |m: &mut Value| m["target_v"] = json!([0.0]))),
        ("state cut", "length of state.v", Box::new(move |m: &mut Value| m["state"]["v"] = json!([0.0]))),
    ];
    for (name, word, change) in &cases {
        let report = found(&**change);
        let told: Vec<String> = report.violations.iter().map(ToString::to_string).collect();
        println!("{name}: {}", told.first().map_or("", String::as_str));
        assert!(report.found > 0, "{name} was not seen\n{report}");
        let is_named = |v: &String| v.starts_with(&format!("tick {at}: ")) && v.contains(word);
        assert!(told.iter().any(is_named), "{name}: {told:?}");
    }
    // A proposal is that of the tick in which the policy ran, for all of its period.
    let all = ticks(&log);
    let started =
        all.iter().rfind(|m| m["tick"].as_u64().unwrap() <= at && m["period_tick"] == 0).unwrap()["tick"]
            .clone();
    let edit = |topic: &str, value: &mut Value| {
        if topic == "tick" && value["tick"] == started {
            add(&mut value["proposal_v"][joint], 1e-3);
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    assert!(verify(&other).unwrap().found > 0, "a proposal was changed");
}

/// A record that is full may have fewer rows than were active; any other has them all.
#[test]
fn a_record_has_room_for_as_many_rows_as_the_loop_writes() {
    assert_eq!(nearl_verify::ROOM, nearl_runtime::rt::MAX_ROWS);
}

/// What the metadata says of robot, period, rows and snapshot is what the snapshot in the log says.
#[test]
fn metadata_that_was_edited_or_emptied_is_named() {
    let folder = Scratch::new("verify-facts");
    let slow = Attack { pause: Duration::from_micros(300), ticks: 200, ..attack(LIMITS, 0.001, 1, 20) };
    let (log, _) = slow.record(&Name::new("verify-facts").0, &folder.0);
    let other = folder.0.join("copy.mcap");
    let with = |change: Alter<BTreeMap<String, String>>| {
        copy(&log, &other, &|_, _| true, &|bytes| bytes, &|facts| change(facts));
        verify(&other).unwrap()
    };
    assert_eq!(with(&|_| {}).found, 0);
    for (key, edited) in [
        ("dt", "0.002"),
        ("joints", "panda_joint2,panda_joint1"),
        ("rows", "[\"panda_joint1\"]"),
        ("statuses", "{\"0\":\"solved\"}"),
        ("modes", "[\"active\"]"),
        ("rungs", "brake"),
        ("digest", "0123456789abcdef"),
        ("version", "77"),
        ("task", "another"),
    ] {
        for value in [edited, ""] {
            let report = with(&|facts| {
                assert!(facts.insert(key.into(), value.into()).is_some(), "{key} is in every log");
            });
            let told = &report.violations[0];
            assert!(report.found == 1 && told.to_string().starts_with("metadata"), "{key}\n{report}");
            assert!(told.what.contains(&format!("`{key}`")) && !report.is_whole(), "{key}\n{report}");
        }
    }
    for key in ["dt", "joints", "rows", "statuses", "modes", "rungs"] {
        let report = with(&|facts| _ = facts.remove(key));
        assert!(report.found == 1 && report.to_string().contains(&format!("`{key}`")), "{key}\n{report}");
    }
    let refused = |change: Alter<BTreeMap<String, String>>| {
        copy(&log, &other, &|_, _| true, &|bytes| bytes, &|facts| change(facts));
        verify(&other).unwrap_err().to_string()
    };
    let text = refused(&|facts| _ = facts.insert("limits".into(), String::new()));
    assert!(text.contains("`limits` is damaged"), "{text}");
}

/// What a change cannot be seen in: nothing of it is claimed by the projection, or it says less than before.
#[test]
fn what_cannot_be_seen_is_what_is_written_in_the_page() {
    let (folder, log) = record("verify-unseen", &attack(LIMITS, 0.001, 1, 20));
    let (at, ..) = busy(&ticks(&log));
    let other = folder.0.join("copy.mcap");
    let edit = |topic: &str, m: &mut Value| {
        if topic == "tick" && m["tick"] == at {
            for time in ["due_ns", "begin_ns", "end_ns", "overruns", "stale", "lost_states", "policy_version"]
            {
                m[time] = (m[time].as_u64().unwrap() + 1).into();
            }
            m["reason"] = "stale-state".into();
            m["state"]["obs"][0] = 9.0.into();
            m["state"]["applied"][0] = 9.0.into();
            m["ledger"]["residual"] = 1.0.into();
            m["ledger"]["iterations"] = 99.into();
            m["ledger"]["duration_ns"] = 1.into();
            m["ledger"]["raw_violations"] = 40.into();
            m["log_prob_proposal"] = 3.0.into();
            m["noise"] = 1.0.into();
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    holds(&verify(&other).unwrap(), 1500);
    // A tick that says less is not found out, and is not counted as more than it says.
    let edit = |topic: &str, m: &mut Value| {
        if topic == "tick" && m["tick"] == at {
            m["ledger"]["status"] = 4.into();
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    let (before, after) = (verify(&log).unwrap(), verify(&other).unwrap());
    assert_eq!((after.found, after.optimal), (0, before.optimal - 1), "{after}");
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

#[test]
fn a_limit_that_was_changed_in_the_log_is_found_out_looser_or_tighter() {
    let (folder, log) = record("verify-limits", &attack(LIMITS, 0.001, 1, 20));
    let other = folder.0.join("copy.mcap");
    for (section, key, values) in [
        ("velocity", "scale", [0.45, 0.55]),
        ("acceleration", "limit", [22.0, 28.0]),
        ("torque", "scale", [0.7, 0.9]),
        ("position", "margin", [1.5, 1.4]),
    ] {
        for value in values {
            let change = |constraints: &mut Value| constraints[section][key] = value.into();
            let facts = |facts: &mut _| limits_in(facts, &change);
            copy(&log, &other, &|_, _| true, &|bytes| with_limit(bytes, &change), &facts);
            let report = verify(&other).unwrap();
            assert!(report.found > 0, "{section}.{key} = {value}\n{report}");
        }
    }
    // What the loop pinned holds too, whatever its snapshot says.
    let slower = |limits: &mut Value| limits["velocity"]["scale"] = 0.3.into();
    let facts = |facts: &mut _| limits_in(facts, &slower);
    copy(&log, &other, &|_, _| true, &|bytes| bytes, &facts);
    assert!(verify(&other).unwrap().violations[0].what.contains("speed of joint"));
}

/// A log that is sound and made to cost much: it is refused or its ticks are not verified, by a reason, in bounded time.
#[test]
fn a_log_that_is_made_to_cost_much_ends_with_a_reason() {
    let (folder, log) = record("verify-hostile", &Attack { ticks: 200, ..attack(LIMITS, 0.001, 1, 20) });
    let other = folder.0.join("copy.mcap");
    let braked = |log: &Path, brake: &dyn Fn(f64) -> f64| {
        let edit = |topic: &str, m: &mut Value| {
            if topic == "tick" {
                let speeds = m["target_v"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap().abs());
                m["brake"] = json!(speeds.map(brake).collect::<Vec<_>>());
            }
            true
        };
        copy(log, &other, &edit, &|bytes| bytes, &|_| {});
        verify(&other).unwrap()
    };
    // Brakes of minutes in every tick.
    let report = braked(&log, &|_| 1e-3);
    assert!(report.found > 100 && report.to_string().contains("comes to rest"), "{report}");
    // Just short enough to be looked at, and nothing that they break: steps of work run out.
    let roomy = "velocity = { scale = 0.5 }\nacceleration = { limit = 25.0 }\ntorque = { scale = 1.0 }\nbraking = \"stored\"";
    let (_folder, slow) = record("verify-slow", &Attack { ticks: 150, ..attack(roomy, 0.001, 1, 20) });
    let report = braked(&slow, &|speed| (speed / 90.0).max(1e-9));
    println!("{report}");
    assert!(report.not_stopped.values().sum::<u64>() > 50, "{report}");
    assert!(report.to_string().contains("takes longer than a log of this length is given"), "{report}");
    // More joints than are verified, and one with several degrees of freedom.
    let refused = |change: &dyn Fn(&mut Snapshot), word: &str| {
        let changed = |bytes: Vec<u8>| {
            let mut snapshot = Snapshot::from_bytes(&bytes).unwrap();
            change(&mut snapshot);
            snapshot.to_bytes()
        };
        copy(&log, &other, &|_, _| true, &changed, &|_| {});
        let text = verify(&other).unwrap_err().to_string();
        assert!(text.contains(word), "{text}");
    };
    let many = |snapshot: &mut Snapshot| {
        let joints = (0..300).map(|k| JointDescription::new(&format!("more {k}"), JointKind::Hinge));
        snapshot.manifest.robot.bodies.last_mut().unwrap().joints.extend(joints);
    };
    refused(&many, "joints, more than the 256 that are verified");
    let ball = |snapshot: &mut Snapshot| {
        let joint = snapshot.manifest.robot.bodies.iter_mut().find_map(|body| body.joints.first_mut());
        joint.unwrap().kind = JointKind::Ball;
    };
    refused(&ball, "joint 'panda_joint1' has several degrees of freedom");
    let text = verify(&other).unwrap_err().to_string();
    assert!(text.contains("nearl replay") && !text.contains("of this build"), "{text}");
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
    refused(&format!("its schema is 4, this build reads {}", nearl_runtime::log::SCHEMA_VERSION));
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
    let ends: [&[u8]; 4] = [
        &whole[..whole.len() - 1],
        &whole[..whole.len() - 50],
        &[&whole[..], &whole[..]].concat(),
        &[&whole[..], b"more"].concat(),
    ];
    for other in ends {
        std::fs::write(&cut, other).unwrap();
        let report = verify(&cut).unwrap();
        assert!(report.found == 0 && report.complete && !report.intact && !report.is_whole(), "{report}");
        assert!(
            report.to_string().contains("the end of the file behind the last tick, which was cut off"),
            "{report}"
        );
        let failure = VerifyCommand { file: cut.clone(), json: true }.run().expect_err("not whole");
        assert_eq!(exit_code(&failure), UNVERIFIED);
        assert!(failure.to_string().contains("not all of it could be: the end of the file;"), "{failure}");
    }
    let violation = |what: &str, value: f64, unit: &str| {
        Violation { tick: 5, what: what.into(), value, limit: 2.0, unit: unit.into() }.to_string()
    };
    assert_eq!(violation("action[1]", f64::NAN, "a number"), "tick 5: action[1] is NaN, which is no number");
    assert_eq!(violation("row 're'", 2.5, ""), "tick 5: row 're' is 2.5, and 2 is what holds there");
}
