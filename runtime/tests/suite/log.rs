//! The flight log: readable by an independent reader.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::toy::*;
use nearl_runtime::link::{PlantSettings, remove_files};
use nearl_runtime::rt::RunSettings;

struct Scratch(PathBuf);

impl Scratch {
    fn new(test: &str) -> Scratch {
        let folder = std::env::temp_dir().join(format!("nearl-test-{}-{test}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        Scratch(folder)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

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
    ticks, q, v = [], 1.0, 0.0
    for schema, channel, message in reader.iter_messages(topics=["tick"]):
        assert (schema.name, schema.encoding, channel.message_encoding) == ("nearl.Tick", "jsonschema", "json")
        m = json.loads(message.data)
        ticks.append(m["tick"])
        if m["mode"] == "active":
            assert m["state"]["q"] == [q] and m["state"]["v"] == [v] and m["action"] == [-q], (m, q, v)
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
        nearl_runtime::log::LogQueue::create(Path::new("/dev/full"), &Default::default()).err().unwrap();
    assert!(error.to_string().contains("/dev/full"), "{error}");
}
