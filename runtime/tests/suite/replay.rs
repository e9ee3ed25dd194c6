//! record = replay(record), and an edited record is found out.

use crate::toy;
use std::borrow::Cow;
use std::cell::Cell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::arm::*;
use crate::toy::Name;
use nearl_constraints::Moved;
use nearl_runtime::PolicyKind;
use nearl_runtime::cli::{ReplayCommand, UNVERIFIED, exit_code};
use nearl_runtime::link::*;
use nearl_runtime::log::{Gap, replay};
use nearl_runtime::rt::*;
use serde_json::Value;

fn fault(tick: u64, count: u64, kind: FaultKind) -> Fault {
    Fault { tick, count, kind }
}

/// Sensor faults of every kind that heals, a proposal of NaN, and at the end a panic.
fn plan() -> FaultPlan {
    FaultPlan {
        seed: 3,
        faults: vec![
            fault(300, 2, FaultKind::State { number: Odd::Nan }),
            fault(400, 1, FaultKind::Jump { by: 0.5 }),
            fault(500, 3, FaultKind::Freeze),
            fault(600, 6, FaultKind::State { number: Odd::Infinity }),
            fault(700, 20, FaultKind::Proposal { number: Odd::Nan }),
            fault(1500, 1, FaultKind::Panic),
        ],
    }
}

/// A run with three hot swaps and the plan above; returns the log.
fn record(test: &str, folder: &Path) -> (PathBuf, RunReport) {
    let name = Name::new(test);
    let first = stochastic(1);
    let file = folder.join(format!("{test}.safetensors"));
    first.save(&file).unwrap();
    let log = folder.join(format!("{test}.mcap"));
    let plant = start_with(&name, &first, plan(), Duration::from_micros(500));
    let stop = Stop::new();
    let settings =
        RunSettings { log: Some(log.clone()), faults: plan(), ticks: Some(1600), ..toy::settings() };
    let running = execute_with(&name, &file, &stop, settings);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    if let Err(error) = trainer.wait_for_runtime(PATIENCE) {
        panic!("{error}; {:?}", running.join());
    }
    for version in 2..=4 {
        trainer.push(version, &stochastic(version).to_bytes()).unwrap();
        let receipt = trainer.wait_for_receipt(version, PATIENCE).unwrap();
        assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    }
    let report = running.join().unwrap().unwrap();
    plant.end();
    (log, report)
}

#[test]
fn a_run_with_swaps_and_faults_replays_bit_for_bit() {
    let folder = Scratch::new("replay");
    let (log, report) = record("replay", &folder.0);
    let c = &report.counters;
    assert_eq!((report.log_drops, c.dropped_records, report.log_error.as_deref()), (0, 0, None));
    assert_eq!(c.swaps, 3, "{report}");
    assert!(c.bad_states >= 8 && c.implausible_states >= 1 && c.frozen_states >= 3, "{c:?}");
    assert!(c.held >= 6 && c.braked >= 5, "{c:?}");
    assert_eq!((report.last_mode, report.reason), (Mode::Fault, Reason::Panic), "{report}");
    let found = replay(&log).unwrap();
    assert_eq!(found.difference, None);
    assert_eq!((found.ticks, found.swaps, found.complete), (report.ticks, 3, true));
}

/// Margins that are learned on the way (`constraints.reached`) are the loop's own: a hot swap keeps them, and the log replays with them.
#[test]
fn a_run_that_learns_margins_replays_bit_for_bit() {
    let (name, folder) = (Name::new("replay-dial"), Scratch::new("replay-dial"));
    let pushing = |version| {
        let mut snapshot = snapshot(version, |m| {
            m.policy = PolicyKind::Direct;
            let limits = "{\"position\": {\"margin\": 1.0}, \"velocity\": {\"scale\": 1.0}, \"acceleration\": {\"limit\": 10.0}, \"reached\": 0.05}";
            m.task.constraints = serde_json::from_str(limits).unwrap();
        });
        let policy = &mut snapshot.networks.policy;
        let last = policy.layers.last_mut().unwrap();
        (last.n_out, last.weight) = (N, weights(version + 3, 16 * N).iter().map(|w| 20.0 * w).collect());
        last.bias = weights(version + 4, N);
        snapshot.networks.policy_log_std = vec![0.0; N];
        snapshot
    };
    let file = folder.0.join("first.safetensors");
    pushing(1).save(&file).unwrap();
    let log = folder.0.join("run.mcap");
    let plant = start_with(&name, &pushing(1), FaultPlan::default(), Duration::from_micros(500));
    // Nothing holds this policy back: how far it throws the arm depends on when the others come, and is not what is looked at.
    let settings = RunSettings { log: Some(log.clone()), ticks: Some(1600), jump: 0.0, ..toy::settings() };
    let running = execute_with(&name, &file, &Stop::new(), settings);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(PATIENCE).unwrap();
    for version in 2..=3 {
        trainer.push(version, &pushing(version).to_bytes()).unwrap();
        let receipt = trainer.wait_for_receipt(version, PATIENCE).unwrap();
        assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    }
    let mut looser = pushing(9);
    looser.manifest.task.constraints.reached = Some(0.06);
    trainer.push(9, &looser.to_bytes()).unwrap();
    let receipt = trainer.wait_for_receipt(9, PATIENCE).unwrap();
    assert_eq!(receipt.verdict(), Verdict::Looser, "{}", receipt.text());
    assert!(receipt.text().contains("constraints.reached"), "{}", receipt.text());
    let report = running.join().unwrap().unwrap();
    let (panda, _) = plant.end();
    assert_eq!((report.log_drops, report.counters.swaps), (0, 2), "{report}");
    let edge = panda.worst[0] + 1.0;
    assert!(edge > 1e-3, "no joint was outside by more than {edge} rad, so no margin was learned");
    let found = replay(&log).unwrap();
    assert_eq!(found.difference, None);
    assert_eq!((found.ticks, found.swaps, found.complete), (report.ticks, 2, true));
}

/// Edits a message; false leaves it out.
type Change<'a> = &'a dyn Fn(&mut Value) -> bool;

/// Copies the log with the message of `tick` changed, or left out if `change` says so.
fn edit(from: &Path, to: &Path, tick: u64, change: Change<'_>) {
    edit_with(from, to, tick, change, &|_| {});
}

/// The same with the metadata changed too.
fn edit_with(
    from: &Path,
    to: &Path,
    tick: u64,
    change: Change<'_>,
    facts: &dyn Fn(&mut BTreeMap<String, String>),
) {
    use mcap::read::ChunkFlattener;
    use mcap::records::{MessageHeader, Record as Part};
    let bytes = std::fs::read(from).unwrap();
    let file = std::io::BufWriter::new(std::fs::File::create(to).unwrap());
    let mut writer = mcap::WriteOptions::new().compression(None).create(file).unwrap();
    let mut channels: BTreeMap<u16, u16> = BTreeMap::new();
    let mut is_over = false;
    for part in ChunkFlattener::new(&bytes).unwrap() {
        match part.unwrap() {
            Part::DataEnd(_) => is_over = true,
            _ if is_over => {}
            Part::Metadata(mut m) => {
                facts(&mut m.metadata);
                writer.write_metadata(&m).unwrap();
            }
            Part::Attachment { header, data, .. } => writer
                .attach(&mcap::Attachment {
                    log_time: 0,
                    create_time: 0,
                    name: header.name,
                    media_type: header.media_type,
                    data: Cow::Owned(data.into_owned()),
                })
                .unwrap(),
            Part::Channel(c) => {
                let schema = writer.add_schema(&c.topic, "jsonschema", b"{}").unwrap();
                let id = writer.add_channel(schema, &c.topic, "json", &BTreeMap::new()).unwrap();
                channels.insert(c.id, id);
            }
            Part::Message { header, data } => {
                let mut value: Value = serde_json::from_slice(&data).unwrap();
                let keep = value["tick"] != tick || change(&mut value);
                let header = MessageHeader { channel_id: channels[&header.channel_id], ..header };
                if keep {
                    writer.write_to_known_channel(&header, value.to_string().as_bytes()).unwrap();
                }
            }
            _ => {}
        }
    }
    writer.finish().unwrap();
}

/// Its ticks may have other fields: what is told is the schema, and not a field that is missing.
#[test]
fn a_log_of_another_schema_is_refused_by_its_schema() {
    let folder = Scratch::new("other-schema");
    let (log, _) = record("other-schema", &folder.0);
    let copy = folder.0.join("copy.mcap");
    let older = |m: &mut Value| {
        m["ledger"].as_object_mut().unwrap().remove("outside");
        true
    };
    edit_with(&log, &copy, 1, &older, &|facts| _ = facts.insert("schema".into(), "5".into()));
    let error = replay(&copy).unwrap_err().to_string();
    assert!(error.contains("its schema is 5") && !error.contains("damaged"), "{error}");
}

#[test]
fn an_edited_log_is_found_out_at_its_tick_and_field() {
    let folder = Scratch::new("edited");
    let (log, _) = record("edited", &folder.0);
    let copy = folder.0.join("copy.mcap");
    let found = |tick: u64, change: Change<'_>| {
        edit(&log, &copy, tick, change);
        replay(&copy).unwrap().difference
    };
    // The copy itself is the same: only the spelling of the file differs.
    assert_eq!(found(0, &|_| true), None);
    let flip = |value: &mut Value| {
        let x = value.as_f64().unwrap();
        *value = f64::from_bits(x.to_bits() ^ 1).into();
        true
    };
    // On a busy machine a tick may have had no state to act upon.
    let acting = |from: u64| {
        let acted = Cell::new(false);
        let see: Change<'_> = &|m| {
            acted.set(m["action"].is_array());
            true
        };
        (from..from + 40).find(|&tick| {
            edit(&log, &copy, tick, see);
            acted.get()
        })
    };
    let [a, b, c, d] = [250, 260, 270, 280].map(|from| acting(from).expect("a tick that acts"));
    let cases: [(u64, &str, Change<'_>); 6] = [
        (a, "action[3]", &|m| flip(&mut m["action"][3])),
        (b, "target_v[0]", &|m| flip(&mut m["target_v"][0])),
        (c, "proposal_v[6]", &|m| flip(&mut m["proposal_v"][6])),
        (302, "mode", &|m| {
            m["mode"] = "active".into();
            true
        }),
        (400, "counters.implausible_states", &|m| {
            m["counters"]["implausible_states"] = 0.into();
            true
        }),
        (d, "ledger.moved", &|m| flip(&mut m["ledger"]["moved"])),
    ];
    for (tick, field, change) in cases {
        let difference = found(tick, change).unwrap_or_else(|| panic!("{field} of tick {tick} was not seen"));
        assert_eq!((difference.tick, difference.field.as_str()), (tick, field), "{difference}");
    }
    // A changed state changes what is computed from it, in the same tick.
    let moved = |m: &mut Value| {
        m["state"]["q"][2] = (m["state"]["q"][2].as_f64().unwrap() + 1e-9).into();
        true
    };
    assert_eq!(found(a, &moved).unwrap().tick, a);
    // One with a number too many is not computed with.
    let longer = |m: &mut Value| {
        m["state"]["q"].as_array_mut().unwrap().push(0.into());
        true
    };
    let difference = found(a, &longer).expect("eight joints").to_string();
    assert!(difference.contains("state.q") && difference.contains("a robot of 7"), "{difference}");
    // What the metadata says twice.
    edit_with(&log, &copy, 1, &|_| true, &|facts| _ = facts.insert("dt".into(), "0.004".into()));
    let error = replay(&copy).unwrap_err().to_string();
    assert!(error.contains("its metadata `dt` is '0.004'"), "{error}");
}

#[test]
fn after_a_lost_tick_replay_goes_on_from_the_next_memory() {
    let folder = Scratch::new("gap");
    let (log, report) = record("gap", &folder.0);
    let copy = folder.0.join("copy.mcap");
    edit(&log, &copy, 270, &|_| false);
    let found = replay(&copy).unwrap();
    assert_eq!(found.difference, None);
    let [Gap { from, to, lost }] = found.gaps[..] else { panic!("one gap: {:?}", found.gaps) };
    assert_eq!((from, lost), (270, 1));
    assert!(
        (1000..1100).contains(&to),
        "a memory is written every 1000 ticks, at the end of a policy period: {to}"
    );
    assert_eq!(found.ticks, report.ticks - (to - from + 1));
    let failure = ReplayCommand { file: copy.clone(), json: false }.run().expect_err("ticks are missing");
    assert_eq!(exit_code(&failure), UNVERIFIED);
    let text = failure.to_string();
    assert!(text.contains("ticks could not be: 1 of them are not in the log"), "{text}");
    ReplayCommand { file: log.clone(), json: true }.run().expect("a whole log");
    // What comes after is compared as what was before.
    let late = to + 30;
    edit(&copy, &log, late, &|m| {
        m["target_v"][1] = (m["target_v"][1].as_f64().unwrap() + 1e-12).into();
        true
    });
    let difference = replay(&log).unwrap().difference.expect("a changed target");
    assert_eq!((difference.tick, difference.field.as_str()), (late, "target_v[1]"), "{difference}");
}

#[test]
fn a_log_cut_by_the_death_of_its_runtime_replays_as_far_as_it_goes() {
    let folder = Scratch::new("cut");
    let (log, report) = record("cut", &folder.0);
    let bytes = std::fs::read(&log).unwrap();
    let cut = folder.0.join("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    let found = replay(&cut).unwrap();
    assert_eq!((found.difference, found.complete), (None, false));
    assert!(found.ticks > 100 && found.ticks < report.ticks, "{} of {}", found.ticks, report.ticks);
    // Behind the last tick stands an index; a file that lost a part of it, or got a log behind it, has every tick and is not whole.
    let twice = [&bytes[..], &bytes[..]].concat();
    for other in [&bytes[..bytes.len() - 1], &bytes[..bytes.len() - 50], &twice] {
        std::fs::write(&cut, other).unwrap();
        let found = replay(&cut).unwrap();
        assert_eq!(
            (found.difference, found.complete, found.ticks),
            (None, false, report.ticks),
            "{} bytes of {}",
            other.len(),
            bytes.len()
        );
    }
    std::fs::write(&cut, otherwise_compressed(bytes)).unwrap();
    let text = replay(&cut).unwrap_err().to_string();
    assert!(text.contains("compressed with zst,") && text.contains("write it without compression"), "{text}");
}

/// A damaged file is none of the loop's doing: no bit in what the log holds makes replay name a tick that differs.
#[test]
fn a_flipped_bit_is_damage_and_no_difference() {
    let folder = Scratch::new("flipped");
    let (log, _) = record("flipped", &folder.0);
    let (bytes, file) = (std::fs::read(&log).unwrap(), folder.0.join("bit.mcap"));
    let mut refused = 0;
    for k in 1..40 {
        let mut damaged = bytes.clone();
        damaged[bytes.len() * k / 40] ^= 1 << (k % 8);
        std::fs::write(&file, damaged).unwrap();
        match replay(&file) {
            Ok(found) => {
                assert_eq!(found.difference, None, "byte {} of {}", bytes.len() * k / 40, bytes.len())
            }
            Err(_) => refused += 1,
        }
    }
    assert!(refused > 20, "{refused} of 39");
}

/// The log with its chunks said to be of another compression.
fn otherwise_compressed(mut log: Vec<u8>) -> Vec<u8> {
    let said = b"\x03\0\0\0lz4";
    let places: Vec<usize> = (0..log.len() - said.len()).filter(|at| log[*at..].starts_with(said)).collect();
    assert!(!places.is_empty(), "its chunks are compressed");
    places.iter().for_each(|at| log[at + 4..at + 7].copy_from_slice(b"zst"));
    log
}

#[test]
fn what_is_no_flight_log_is_one_sentence() {
    let folder = Scratch::new("no-log");
    let file = folder.0.join("x.mcap");
    for (content, says) in [(&b""[..], "it is empty"), (b"not mcap", "cannot be replayed")] {
        std::fs::write(&file, content).unwrap();
        let text = replay(&file).unwrap_err().to_string();
        assert!(text.contains(says) && text.contains("x.mcap"), "{text}");
    }
    let text = replay(&folder.0).unwrap_err().to_string();
    assert!(text.contains("not a regular file"), "{text}");
}

#[test]
fn a_snapshot_that_misses_its_targets_is_taken_back_and_the_log_replays() {
    let folder = Scratch::new("rollback");
    let log = folder.0.join("rollback.mcap");
    let name = Name::new("rollback");
    let pause = Duration::from_micros(200);
    let body = toy::PointMass { q: 1.0, pause, ..toy::PointMass::default() };
    let plant = toy::PlantThread::start(&name, body, PlantSettings::lockstep(toy::DT));
    let settings = RunSettings { log: Some(log.clone()), first: b"spring".to_vec(), ..toy::settings() };
    let running = toy::LoopThread::start(&name, settings, |_| {});
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(PATIENCE).unwrap();
    let ticks = |trainer: &mut TrainerLink, n: u64| {
        while trainer.state().is_none_or(|s| s.tick < n) {
            std::thread::sleep(Duration::from_millis(1));
        }
    };
    ticks(&mut trainer, 400);
    let mut verdicts = Vec::new();
    for version in [2, toy::MISSES] {
        trainer.push(version, b"spring").unwrap();
        verdicts.push(trainer.wait_for_receipt(version, PATIENCE).unwrap().verdict());
        let now = trainer.health().map_or(0, |h| h.tick);
        ticks(&mut trainer, now + 1500);
    }
    let Ok(receipt) = trainer.wait_for_receipt(toy::MISSES, PATIENCE) else {
        let report = running.end();
        panic!(
            "nothing was taken back: {} {:?} {:?} {report}",
            report.rolled_back, report.versions, report.counters
        );
    };
    assert_eq!(receipt.verdict(), Verdict::RolledBack, "{}", receipt.text());
    assert_eq!(verdicts, [Verdict::Accepted, Verdict::Accepted]);
    let report = running.end();
    plant.end();
    assert_eq!(report.versions.iter().map(|v| v.1).collect::<Vec<_>>(), [1, 2, toy::MISSES, 2]);
    assert_eq!((report.rolled_back, report.counters.swaps), (1, 3));
    assert!(report.refusals[0].contains("off the target"), "{:?}", report.refusals);
    let (drops, _dropped) = std::sync::mpsc::channel();
    let found = nearl_runtime::log::replay_with(&log, toy::SpringBuilder(drops)).unwrap();
    assert_eq!((found.difference, found.ticks, found.swaps), (None, report.ticks, 3));
}

/// Limits that an operator moves while a new snapshot is still being watched: it is taken back as it would be without, and what comes back has the limits.
#[test]
fn a_snapshot_that_misses_its_targets_is_taken_back_after_an_order_too() {
    let folder = Scratch::new("rollback-order");
    let log = folder.0.join("rollback.mcap");
    let name = Name::new("rollback-order");
    let body = toy::PointMass { q: 1.0, pause: Duration::from_millis(3), ..toy::PointMass::default() };
    let plant = toy::PlantThread::start(&name, body, PlantSettings::lockstep(toy::DT));
    let settings = RunSettings { log: Some(log.clone()), first: b"spring".to_vec(), ..toy::settings() };
    let running = toy::LoopThread::start(&name, settings, |_| {});
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(PATIENCE).unwrap();
    let mut operator = OperatorLink::open(&name.0, PATIENCE).unwrap();
    while trainer.state().is_none_or(|s| s.tick < 300) {
        std::thread::sleep(Duration::from_millis(1));
    }
    trainer.push(toy::MISSES, b"missing").unwrap();
    assert_eq!(trainer.wait_for_receipt(toy::MISSES, PATIENCE).unwrap().verdict(), Verdict::Accepted);
    let ordered = operator.move_limits(&Moved::speed(0.5), PATIENCE).unwrap();
    assert_eq!(ordered.verdict(), Verdict::Accepted, "{}", ordered.text());
    let receipt = trainer.wait_for_receipt(toy::MISSES, PATIENCE).unwrap();
    assert_eq!(receipt.verdict(), Verdict::RolledBack, "{}", receipt.text());
    assert!(
        receipt.tick > ordered.tick,
        "it was taken back before the order: {} {}",
        receipt.tick,
        ordered.tick
    );
    let report = running.end();
    plant.end();
    // The toy's version is that of the message, and what is built again came with none.
    assert_eq!(report.versions.iter().map(|v| v.1).collect::<Vec<_>>(), [1, toy::MISSES, 0]);
    assert_eq!((report.rolled_back, report.counters.swaps), (1, 3), "{report}");
    let (drops, _dropped) = std::sync::mpsc::channel();
    let found = nearl_runtime::log::replay_with(&log, toy::SpringBuilder(drops)).unwrap();
    assert_eq!((found.difference, found.ticks, found.swaps), (None, report.ticks, 3));
}
