//! The flight log: readable by an independent reader.

use std::path::Path;
use std::process::Command;

use crate::arm::Scratch;
use crate::toy::*;
use nearl_runtime::link::{PlantSettings, remove_files};
use nearl_runtime::rt::RunSettings;

fn run(test: &str, ticks: u64, log: &Path) -> nearl_runtime::rt::RunReport {
    let name = Name::new(test);
    let plant = PointMass { q: 1.0, ..PointMass::default() };
    let plant = PlantThread::start(&name, plant, PlantSettings::lockstep(DT));
    let metadata = [("digest".to_owned(), "abc".to_owned())].into();
    let settings = RunSettings { ticks: Some(ticks), log: Some(log.to_owned()), metadata, ..settings() };
    let report = LoopThread::start(&name, settings, |_| {}).join();
    plant.end();
    remove_files(&name.0);
    report
}

/// Python's `mcap` package is the reader of the report; it must see every tick in order.
const READER: &str = r#"
import json, sys
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as f:
    reader = make_reader(f)
    metadata = [m for m in reader.iter_metadata()]
    assert metadata[0].metadata["digest"] == "abc", metadata
    ticks, mode, q, v = [], "active", 1.0, 0.0
    names = {"tick": "nearl.Tick", "brief": "nearl.Brief"}
    for schema, channel, message in reader.iter_messages(topics=list(names)):
        assert (schema.name, schema.encoding, channel.message_encoding) == (names[channel.topic], "jsonschema", "json")
        m = json.loads(message.data)
        ticks.append(m["tick"])
        mode = m.get("mode", mode)  # a busy disk leaves what replay computes out, not the state
        if mode == "active":
            assert m["state"]["q"] == [q] and m["state"]["v"] == [v] and m.get("action", [-q]) == [-q], (m, q, v)
            v += -q * 1e-3
            q += v * 1e-3
    assert ticks == list(range(1, len(ticks) + 1)), "ticks are missing"
    print(len(ticks))
"#;

#[test]
fn python_reads_every_tick_bit_for_bit() {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join("../.venv/bin/python");
    assert!(python.exists(), "run `make setup` first: {} is missing", python.display());
    let folder = Scratch::new("log");
    let log = folder.0.join("flight.mcap");
    let report = run("log", 500, &log);
    assert_eq!((report.log_drops, report.log_error.as_deref()), (0, None));
    let output = Command::new(python).args(["-c", READER]).arg(&log).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let ticks: u64 = String::from_utf8(output.stdout).unwrap().trim().parse().unwrap();
    assert_eq!(ticks, report.ticks);
}

#[test]
fn a_log_that_cannot_be_created_is_refused_by_name() {
    let error =
        nearl_runtime::log::LogQueue::create(Path::new("/dev/full"), &Default::default(), 0).err().unwrap();
    assert!(error.to_string().contains("/dev/full"), "{error}");
}

/// What a stranger with Python's `mcap` package finds: names for every number, the time of day, and numbers that agree with each other.
const STRANGER: &str = r#"
import datetime, json, sys
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as f:
    reader = make_reader(f)
    facts = {k: v for m in reader.iter_metadata() for k, v in m.metadata.items()}
    joints, rows, units = facts["joints"].split(","), json.loads(facts["rows"]), json.loads(facts["units"])
    commands = json.loads(facts["commands"])
    assert sorted(commands) == joints and set(commands.values()) == {"effort [N m or N]"}, commands
    statuses, kinds = json.loads(facts["statuses"]), json.loads(facts["kinds"])
    assert joints[6] == "panda_joint7" and rows[:7] == joints, (joints, rows)
    assert units["v"] == "rad/s" and statuses["13"] == "braked-no-verified-brake" and "torque" in kinds
    ahead, named, brakes = int(facts["clock"]), set(), 0
    for schema, channel, message in reader.iter_messages(topics=["tick"]):
        m = json.loads(message.data)
        assert (message.publish_time, message.log_time) == (m["begin_ns"] + ahead, m["end_ns"] + ahead)
        assert datetime.datetime.fromtimestamp(message.log_time / 1e9, datetime.timezone.utc).year == 2033
        assert str(m["ledger"]["status"]) in statuses
        for row in m["ledger"]["active_rows"]:
            assert row["kind"] in kinds and row["multiplier"] >= 0
            named.add(rows[row["row"]])
        brakes += len(m["brake"]) == 7 and all(0 <= b <= 10 for b in m["brake"])
    entry = [json.loads(message.data) for _, _, message in reader.iter_messages(topics=["snapshot"])][0]
    assert entry["rows"] == rows
    assert named and named <= set(joints), named
    print(brakes)
"#;

#[test]
fn a_stranger_finds_names_times_of_day_and_ways_to_stop_in_half_the_bytes() {
    let (name, folder) = (Name::new("named-log"), Scratch::new("named-log"));
    let first = crate::arm::snapshot(1, |_| {});
    let file = crate::arm::File::new("named-log", &first);
    // About the rate of the robot: a simulation that waits for nobody outruns any log.
    let pace = std::time::Duration::from_micros(800);
    let plant = crate::arm::start_with(&name, &first, nearl_runtime::rt::FaultPlan::default(), pace);
    let (log, ticks) = (folder.0.join("arm.mcap"), 2000);
    // In 2033, by the monotonic clock of a machine that was not started before 2000.
    let wall = 2_000_000_000_000_000_000;
    let settings = RunSettings { ticks: Some(ticks), log: Some(log.clone()), wall, ..settings() };
    let (mut told, mut shown) = (None, Vec::new());
    let running = crate::arm::execute_with(&name, &file.0, &nearl_runtime::rt::Stop::new(), settings);
    {
        let mut view = nearl_runtime::link::ViewLink::open(&name.0).unwrap();
        told = view.wait_for_rows(crate::arm::PATIENCE).ok().or(told);
        while !running.is_finished() {
            shown.extend(std::iter::from_fn(|| view.tick()));
            // A viewer that never rests takes the core on which the log is written.
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
    }
    let report = running.join().unwrap().unwrap();
    plant.end();
    assert_eq!((report.log_drops, report.log_brief, report.log_error.as_deref()), (0, 0, None), "{report}");
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join("../.venv/bin/python");
    let output = Command::new(python).args(["-c", STRANGER]).arg(&log).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let brakes: u64 = String::from_utf8(output.stdout).unwrap().trim().parse().unwrap();
    assert!(brakes >= ticks - 10, "{brakes} ticks with a way to stop");
    let each = (std::fs::metadata(&log).unwrap().len() - first.to_bytes().len() as u64) / ticks;
    assert!(each <= 1450, "{each} bytes a tick");
    let replayed = nearl_runtime::log::replay(&log).unwrap();
    assert!(replayed.difference.is_none() && replayed.ticks >= ticks, "{replayed:?}");
    // A viewer was told the same, and which limits the projection keeps.
    let told = told.expect("rows");
    let rows = told.row_names();
    let limits = nearl_runtime::Controller::new(&first).unwrap().limits().clone();
    assert_eq!((told.task_name(), told.velocity()), (first.manifest.task.name.clone(), &limits.velocity[..]));
    assert_eq!((told.q_lower(), told.q_upper()), (&limits.q_lower[..], &limits.q_upper[..]));
    assert_eq!((told.acceleration(), told.effort()), (&limits.acceleration[..], &limits.effort[..]));
    let kinds = told.row_kinds();
    assert!(
        kinds[..7].iter().all(Option::is_none)
            && kinds[7..].iter().all(|kind| *kind == Some(nearl_constraints::Kind::Torque))
    );
    assert_eq!(rows.len(), 14, "seven joints and their torques: {rows:?}");
    let tick = shown.iter().rfind(|tick| tick.n_active > 0 && tick.nu > 0).expect("a tick with active rows");
    assert!(tick.multipliers().iter().all(|x| *x > 0.0) && tick.brake().len() == 7, "{tick:?}");
    assert!(usize::try_from(tick.rows[0]).unwrap() < rows.len() && tick.end >= tick.begin);
}
