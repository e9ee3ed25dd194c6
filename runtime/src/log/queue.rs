//! The queue in front of the file, and the thread behind it.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashSet};
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Seek, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};
use rtrb::{Consumer, Producer, RingBuffer};
use serde::{Deserialize, Serialize};

use super::tick::{SCHEMA, encode};
use crate::rt::Record;

/// Records the queue holds: about 9 MB.
const CAPACITY: usize = 1024;
/// Snapshots the queue holds, and the bytes of all that wait.
const SNAPSHOTS: usize = 16;
const SNAPSHOT_BYTES: u64 = 512 << 20;
/// Topic of the ticks.
pub(super) const TICK_TOPIC: &str = "tick";
/// Topic that says which snapshot number is which attachment.
pub(super) const SNAPSHOT_TOPIC: &str = "snapshot";
const SNAPSHOT_SCHEMA: &str = r#"{"title": "nearl.Snapshot", "type": "object", "properties": {
  "id": {"type": "integer"}, "version": {"type": "integer"}, "digest": {"type": "string"}, "bytes": {"type": "integer"}}}"#;
/// Logs of one name in a folder.
const MOST_LOGS: usize = 10_000;
/// The thread looks for records this often.
const POLL: Duration = Duration::from_millis(2);

/// A snapshot that may come into use: one message of topic `snapshot`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct SnapshotEntry {
    /// In the order they were received; 0 for the first.
    pub(super) id: u64,
    pub(super) version: u64,
    /// blake3 of the bytes, in hex.
    pub(super) digest: String,
    pub(super) bytes: u64,
}

/// Name of the attachment that holds the bytes with `digest`.
pub(super) fn attachment_name(digest: &str) -> String {
    format!("{digest}.safetensors")
}

/// A snapshot on its way to the file.
struct Waiting {
    id: u64,
    version: u64,
    bytes: Vec<u8>,
}

/// The flight log cannot be started.
#[derive(Debug, thiserror::Error)]
#[error("flight log {path} cannot be written ({reason}): choose another --log file")]
pub struct LogError {
    path: PathBuf,
    reason: String,
}

/// What the log did.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct LogSummary {
    /// Records handed to the file; the last chunk of them is missing if `error` is set.
    pub written: u64,
    /// Records lost: the queue or the disk was full.
    pub dropped: u64,
    /// Snapshots lost for the same reason: replay ends where they came into use.
    pub dropped_snapshots: u64,
    /// Why writing stopped before the end.
    pub error: Option<String>,
}

#[derive(Default)]
struct Shared {
    over: AtomicBool,
    dropped: AtomicU64,
    dropped_snapshots: AtomicU64,
    snapshot_bytes: AtomicU64,
}

/// The open log. Pushing never blocks; [`LogQueue::finish`] closes the file.
pub struct LogQueue {
    records: Producer<Record>,
    snapshots: Producer<Waiting>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<LogSummary>>,
    path: PathBuf,
}

impl LogQueue {
    /// Creates the file, with a number behind its name if there is one already, and starts its thread; `metadata` (snapshot digest, seed, command) goes into the file.
    pub fn create(path: &Path, metadata: &BTreeMap<String, String>) -> Result<LogQueue, LogError> {
        let fail = |reason: String| LogError { path: path.to_owned(), reason };
        let (file, path) = begin(path).map_err(|e| fail(e.to_string()))?;
        let mut log = LogQueue::start(Box::new(file), metadata).map_err(fail)?;
        log.path = path;
        Ok(log)
    }

    /// The file that is written.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn start(sink: Box<dyn Sink>, metadata: &BTreeMap<String, String>) -> Result<LogQueue, String> {
        let writer = open(sink, metadata).map_err(|e| e.to_string())?;
        let (records, waiting) = RingBuffer::new(CAPACITY);
        let (snapshots, snapshots_out) = RingBuffer::new(SNAPSHOTS);
        let shared = Arc::new(Shared::default());
        let thread = std::thread::Builder::new()
            .name("nearl-log".into())
            .spawn({
                let shared = Arc::clone(&shared);
                move || write_all(writer, waiting, snapshots_out, &shared)
            })
            .map_err(|e| e.to_string())?;
        Ok(LogQueue { records, snapshots, shared, thread: Some(thread), path: PathBuf::new() })
    }

    /// Adds a record; drops and counts it if the queue is full.
    pub fn push(&mut self, record: &Record) {
        if self.records.push(*record).is_err() {
            self.shared.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Adds a snapshot before the first record that uses it; drops and counts it if too many bytes wait.
    pub(crate) fn push_snapshot(&mut self, id: u64, version: u64, bytes: Vec<u8>) {
        let (shared, length) = (&self.shared, bytes.len() as u64);
        let has_room = shared.snapshot_bytes.load(Ordering::Acquire) + length <= SNAPSHOT_BYTES;
        shared.snapshot_bytes.fetch_add(length, Ordering::AcqRel);
        if !has_room || self.snapshots.push(Waiting { id, version, bytes }).is_err() {
            shared.snapshot_bytes.fetch_sub(length, Ordering::AcqRel);
            shared.dropped_snapshots.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Records lost so far.
    pub fn dropped(&self) -> u64 {
        self.shared.dropped.load(Ordering::Relaxed)
    }

    /// Writes what waits and closes the file.
    pub fn finish(mut self) -> LogSummary {
        self.join()
    }

    fn join(&mut self) -> LogSummary {
        self.shared.over.store(true, Ordering::Release);
        let summary = self.thread.take().and_then(|thread| thread.join().ok());
        let mut summary = summary.unwrap_or_else(|| LogSummary {
            dropped: self.dropped(),
            error: Some("its thread panicked".into()),
            ..LogSummary::default()
        });
        if let Some(reason) = &mut summary.error {
            let path = self.path.display();
            *reason = format!(
                "flight log {path} stopped ({reason}): free space there, or choose another --log file"
            );
        }
        summary
    }
}

impl Drop for LogQueue {
    fn drop(&mut self) {
        if self.thread.is_some() {
            self.join();
        }
    }
}

/// A new file at `path`, or beside the one that is there: the record of a crash outlives the restart. What is there and is no file is
/// refused without being opened. A limit on the size of files is an error of the write from now on, not the end of the process.
fn begin(path: &Path) -> std::io::Result<(File, PathBuf)> {
    // SAFETY: plain call; the disposition of this signal alone.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
    for number in 1..=MOST_LOGS {
        let path = if number == 1 { path.to_owned() } else { numbered(path, number) };
        match OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path) {
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
            opened => return opened.map(|file| (file, path)),
        }
        if !std::fs::symlink_metadata(&path)?.is_file() {
            return Err(std::io::Error::other("there is something that is not a regular file"));
        }
    }
    Err(std::io::Error::other(format!("there are {MOST_LOGS} of this name already")))
}

/// `arm-2.mcap` of `arm.mcap`.
fn numbered(path: &Path, number: usize) -> PathBuf {
    let part = |text: Option<&std::ffi::OsStr>| text.unwrap_or_default().to_string_lossy().into_owned();
    let (stem, end) = (part(path.file_stem()), part(path.extension()));
    path.with_file_name(if end.is_empty() {
        format!("{stem}-{number}")
    } else {
        format!("{stem}-{number}.{end}")
    })
}

/// What the log is written to: a file, outside of tests.
trait Sink: Write + Seek + Send {}
impl<T: Write + Seek + Send> Sink for T {}

/// An open file with its channels.
struct Log {
    writer: Writer<BufWriter<Box<dyn Sink>>>,
    ticks: u16,
    snapshots: u16,
    /// Digests of the attachments so far: the same bytes are written once.
    attached: HashSet<String>,
    line: Vec<u8>,
}

fn open(sink: Box<dyn Sink>, metadata: &BTreeMap<String, String>) -> mcap::McapResult<Log> {
    let options = WriteOptions::new().compression(None).chunk_size(Some(256 << 10)).library("nearl");
    let mut writer = options.create(BufWriter::new(sink))?;
    let schema = writer.add_schema("nearl.Tick", "jsonschema", SCHEMA.as_bytes())?;
    let ticks = writer.add_channel(schema, TICK_TOPIC, "json", &BTreeMap::new())?;
    let schema = writer.add_schema("nearl.Snapshot", "jsonschema", SNAPSHOT_SCHEMA.as_bytes())?;
    let snapshots = writer.add_channel(schema, SNAPSHOT_TOPIC, "json", &BTreeMap::new())?;
    writer.write_metadata(&mcap::records::Metadata { name: "nearl".into(), metadata: metadata.clone() })?;
    writer.flush()?;
    Ok(Log { writer, ticks, snapshots, attached: HashSet::new(), line: Vec::with_capacity(16 << 10) })
}

impl Log {
    fn write(&mut self, record: &Record) -> Result<(), String> {
        encode(record, &mut self.line).map_err(|e| e.to_string())?;
        let header = MessageHeader {
            channel_id: self.ticks,
            sequence: record.tick as u32,
            log_time: record.end,
            publish_time: record.begin,
        };
        self.writer.write_to_known_channel(&header, &self.line).map_err(said)
    }

    fn attach(&mut self, snapshot: &Waiting) -> Result<(), String> {
        let fail = said;
        let now = crate::clock::now();
        let entry = SnapshotEntry {
            id: snapshot.id,
            version: snapshot.version,
            digest: blake3::hash(&snapshot.bytes).to_hex().to_string(),
            bytes: snapshot.bytes.len() as u64,
        };
        if self.attached.insert(entry.digest.clone()) {
            let attachment = mcap::Attachment {
                log_time: now,
                create_time: now,
                name: attachment_name(&entry.digest),
                media_type: "application/octet-stream".into(),
                data: Cow::Borrowed(&snapshot.bytes),
            };
            self.writer.attach(&attachment).map_err(fail)?;
        }
        let line = serde_json::to_vec(&entry).map_err(|e| e.to_string())?;
        let sequence = snapshot.id as u32;
        let header = MessageHeader { channel_id: self.snapshots, sequence, log_time: now, publish_time: now };
        self.writer.write_to_known_channel(&header, &line).map_err(fail)
    }

    fn close(mut self) -> Result<(), String> {
        self.writer.finish().map_err(said)?;
        self.writer.into_inner().flush().map_err(|e| e.to_string())
    }
}

/// The system's own words, where it has any.
fn said(error: mcap::McapError) -> String {
    match error {
        mcap::McapError::Io(e) => e.to_string(),
        other => other.to_string(),
    }
}

/// Writes until the end; after the first error everything else is dropped and counted.
fn write_all(
    mut log: Log,
    mut waiting: Consumer<Record>,
    mut snapshots: Consumer<Waiting>,
    shared: &Shared,
) -> LogSummary {
    crate::thread::be_patient();
    let mut summary = LogSummary::default();
    loop {
        let is_over = shared.over.load(Ordering::Acquire);
        while let Ok(record) = waiting.peek() {
            // A snapshot is pushed before the first record that uses it, so it is seen here at the latest.
            attach_all(&mut log, &mut snapshots, shared, &mut summary.error);
            match &summary.error {
                Some(_) => drop_one(shared),
                None => match log.write(record) {
                    Ok(()) => summary.written += 1,
                    Err(error) => {
                        summary.error = Some(error);
                        drop_one(shared);
                    }
                },
            }
            let _ = waiting.pop();
        }
        attach_all(&mut log, &mut snapshots, shared, &mut summary.error);
        if is_over {
            break;
        }
        std::thread::sleep(POLL);
    }
    if let Err(error) = log.close() {
        summary.error.get_or_insert(error);
    }
    summary.dropped = shared.dropped.load(Ordering::Relaxed);
    summary.dropped_snapshots = shared.dropped_snapshots.load(Ordering::Relaxed);
    summary
}

fn attach_all(log: &mut Log, snapshots: &mut Consumer<Waiting>, shared: &Shared, error: &mut Option<String>) {
    while let Ok(snapshot) = snapshots.pop() {
        shared.snapshot_bytes.fetch_sub(snapshot.bytes.len() as u64, Ordering::AcqRel);
        let result = if error.is_some() { Err(String::new()) } else { log.attach(&snapshot) };
        if let Err(reason) = result {
            error.get_or_insert(reason);
            shared.dropped_snapshots.fetch_add(1, Ordering::Relaxed);
        }
    }
}

fn drop_one(shared: &Shared) {
    shared.dropped.fetch_add(1, Ordering::Relaxed);
}

#[cfg(test)]
mod tests {
    use std::io::{Cursor, Error, ErrorKind, Result, SeekFrom};
    use std::sync::mpsc::{Receiver, channel};

    use super::*;

    /// Takes `room` bytes, then fails like a full disk; waits for a word before its first write past the start.
    struct Disk {
        content: Cursor<Vec<u8>>,
        room: usize,
        wait: Option<Receiver<()>>,
    }

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> Result<usize> {
            let at = self.content.position() as usize;
            if at > 8192
                && let Some(wait) = self.wait.take()
            {
                let _ = wait.recv();
            }
            if at + bytes.len() > self.room {
                return Err(Error::from(ErrorKind::StorageFull));
            }
            self.content.write(bytes)
        }
        fn flush(&mut self) -> Result<()> {
            Ok(())
        }
    }

    impl Seek for Disk {
        fn seek(&mut self, to: SeekFrom) -> Result<u64> {
            self.content.seek(to)
        }
    }

    fn disk(room: usize, wait: Option<Receiver<()>>) -> Box<dyn Sink> {
        Box::new(Disk { content: Cursor::new(Vec::new()), room, wait })
    }

    #[test]
    fn a_full_disk_costs_records_and_nothing_else() {
        let mut log = LogQueue::start(disk(100_000, None), &BTreeMap::new()).unwrap();
        let record = Record::new();
        for _ in 0..5000 {
            log.push(&record);
        }
        let summary = log.finish();
        assert!(summary.dropped > 4000, "{summary:?}");
        assert_eq!(summary.written + summary.dropped, 5000);
        assert!(summary.error.is_some());
    }

    #[test]
    fn a_stuck_disk_drops_exactly_what_the_queue_cannot_hold() {
        let (release, wait) = channel();
        let mut log = LogQueue::start(disk(usize::MAX, Some(wait)), &BTreeMap::new()).unwrap();
        let record = Record::new();
        for _ in 0..5000 {
            log.push(&record); // returns at once although nothing is being written
        }
        assert!(log.dropped() > 0);
        release.send(()).unwrap();
        let summary = log.finish();
        assert_eq!(summary.written + summary.dropped, 5000);
        assert_eq!(summary.error, None);
    }
}
