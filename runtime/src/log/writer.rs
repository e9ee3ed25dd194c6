//! The file of a flight log: its channels, and what is written to them.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashSet};
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Seek, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};
use serde::{Deserialize, Serialize};

use super::brief::{BRIEF_SCHEMA, MEMORY_SCHEMA, encode_brief, encode_memory};
use super::tick::{SCHEMA, encode};
use crate::rt::Record;

/// Topic of the ticks.
pub(super) const TICK_TOPIC: &str = "tick";
/// Topic of the ticks of which only what replay needs was kept.
pub(super) const BRIEF_TOPIC: &str = "brief";
/// Topic of what replay can go on from.
pub(super) const MEMORY_TOPIC: &str = "memory";
/// Topic that says which snapshot number is which attachment.
pub(super) const SNAPSHOT_TOPIC: &str = "snapshot";
const SNAPSHOT_SCHEMA: &str = r#"{"title": "nearl.Snapshot", "type": "object", "properties": {
  "id": {"type": "integer"}, "version": {"type": "integer"}, "digest": {"type": "string"}, "bytes": {"type": "integer"},
  "rows": {"type": "array", "items": {"type": "string"}}}}"#;
/// Logs of one name in a folder.
const MOST_LOGS: usize = 10_000;
/// Bytes of a chunk, before it is compressed: what the end of the process may cost.
const CHUNK: usize = 128 << 10;
/// A chunk is not kept back longer than this [ns].
const LONGEST: u64 = 500_000_000;
/// A memory is written at least every so many ticks: a replay of a damaged file loses no more.
const MEMORY_EVERY: u64 = 1000;

/// A snapshot that may come into use: one message of topic `snapshot`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct SnapshotNumbered {
    /// In the order they were received; 0 for the first.
    pub(super) id: u64,
    pub(super) version: u64,
    /// blake3 of the bytes, in hex.
    pub(super) digest: String,
    pub(super) bytes: u64,
    /// What the rows of its ledgers are of, by number.
    #[serde(default)]
    pub(super) rows: Vec<String>,
}

/// Name of the attachment that holds the bytes with `digest`.
pub(super) fn attachment_name(digest: &str) -> String {
    format!("{digest}.safetensors")
}

/// A snapshot on its way to the file.
pub(super) struct Waiting {
    pub(super) id: u64,
    pub(super) version: u64,
    pub(super) bytes: Vec<u8>,
    pub(super) rows: Vec<String>,
}

/// A new file at `path`, or beside the one that is there: the record of a crash outlives the restart. What is there and is no file is
/// refused without being opened. A limit on the size of files is an error of the write from now on, not the end of the process.
pub(super) fn begin(path: &Path) -> std::io::Result<(File, PathBuf)> {
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
pub(super) trait Sink: Write + Seek + Send {}
impl<T: Write + Seek + Send> Sink for T {}

/// An open file with its channels.
pub(super) struct Log {
    writer: Writer<BufWriter<Box<dyn Sink>>>,
    ticks: u16,
    briefs: u16,
    memories: u16,
    snapshots: u16,
    /// Digests of the attachments so far: the same bytes are written once.
    attached: HashSet<String>,
    line: Vec<u8>,
    brief: Vec<u8>,
    /// What the wall clock was ahead of the monotonic one when the log began [ns].
    wall: u64,
    /// The tick written last, and the last one whose memory was written.
    last: u64,
    remembered: u64,
    /// A tick is missing since a memory was written.
    is_behind: bool,
    /// When the last chunk ended [ns].
    flushed: u64,
    /// Ticks and bytes of the chunk that is being filled: they are in the file once it has ended.
    open_ticks: u64,
    open_bytes: usize,
}

/// Opens the log in `sink`; `metadata` is written at once.
pub(super) fn open(
    sink: Box<dyn Sink>,
    metadata: &BTreeMap<String, String>,
    wall: u64,
) -> mcap::McapResult<Log> {
    let compression = Some(mcap::Compression::Lz4);
    let options = WriteOptions::new().compression(compression).chunk_size(None).library("nearl");
    let mut writer = options.create(BufWriter::new(sink))?;
    let mut channel = |topic: &str, title: &str, schema: &str| {
        let schema = writer.add_schema(title, "jsonschema", schema.as_bytes())?;
        writer.add_channel(schema, topic, "json", &BTreeMap::new())
    };
    let ticks = channel(TICK_TOPIC, "nearl.Tick", SCHEMA)?;
    let briefs = channel(BRIEF_TOPIC, "nearl.Brief", BRIEF_SCHEMA)?;
    let memories = channel(MEMORY_TOPIC, "nearl.Memory", MEMORY_SCHEMA)?;
    let snapshots = channel(SNAPSHOT_TOPIC, "nearl.Snapshot", SNAPSHOT_SCHEMA)?;
    writer.write_metadata(&mcap::records::Metadata { name: "nearl".into(), metadata: metadata.clone() })?;
    writer.flush()?;
    Ok(Log {
        writer,
        ticks,
        briefs,
        memories,
        snapshots,
        attached: HashSet::new(),
        line: Vec::with_capacity(16 << 10),
        brief: Vec::with_capacity(16 << 10),
        wall,
        last: 0,
        remembered: 0,
        is_behind: false,
        flushed: 0,
        open_ticks: 0,
        open_bytes: 0,
    })
}

impl Log {
    /// Writes a tick, or only what its replay needs; a memory too where one is due.
    pub(super) fn write(&mut self, record: &Record, in_brief: bool) -> Result<(), String> {
        self.open_ticks += 1;
        encode(record, &mut self.line).map_err(|e| e.to_string())?;
        self.is_behind |= record.tick != self.last + 1;
        self.last = record.tick;
        let is_old = record.tick >= self.remembered + MEMORY_EVERY;
        let remembers = record.resume.is_set && (self.is_behind || is_old);
        // A memory is of use with the whole tick alone, and what another process proposed is an input.
        if in_brief && !remembers && !record.heard {
            encode_brief(record, &self.line, &mut self.brief).map_err(|e| e.to_string())?;
            self.send(record, self.briefs, true)?;
            return self.end_chunk(record.end);
        }
        self.send(record, self.ticks, false)?;
        if remembers {
            (self.is_behind, self.remembered) = (false, record.tick);
            encode_memory(record, &mut self.brief).map_err(|e| e.to_string())?;
            self.send(record, self.memories, true)?;
        }
        self.end_chunk(record.end)
    }

    /// Ends the chunk where it is large or old enough.
    fn end_chunk(&mut self, now: u64) -> Result<(), String> {
        if self.open_bytes < CHUNK && now <= self.flushed + LONGEST {
            return Ok(());
        }
        self.flushed = now;
        self.flush()
    }

    fn flush(&mut self) -> Result<(), String> {
        self.writer.flush().map_err(said)?;
        (self.open_ticks, self.open_bytes) = (0, 0);
        Ok(())
    }

    /// Ticks that were given and are not in the file: all of a chunk that could not be written.
    pub(super) fn open_ticks(&self) -> u64 {
        self.open_ticks
    }

    fn send(&mut self, record: &Record, channel_id: u16, is_brief: bool) -> Result<(), String> {
        let header = MessageHeader {
            channel_id,
            sequence: record.tick as u32,
            log_time: record.end.saturating_add(self.wall),
            publish_time: record.begin.saturating_add(self.wall),
        };
        let line = if is_brief { &self.brief } else { &self.line };
        self.open_bytes += line.len();
        self.writer.write_to_known_channel(&header, line).map_err(said)
    }

    /// Writes a snapshot's bytes, unless they are there, and its number.
    pub(super) fn attach(&mut self, snapshot: &Waiting) -> Result<(), String> {
        let now = crate::clock::now().saturating_add(self.wall);
        let numbered = SnapshotNumbered {
            id: snapshot.id,
            version: snapshot.version,
            digest: blake3::hash(&snapshot.bytes).to_hex().to_string(),
            bytes: snapshot.bytes.len() as u64,
            rows: snapshot.rows.clone(),
        };
        if self.attached.insert(numbered.digest.clone()) {
            let attachment = mcap::Attachment {
                log_time: now,
                create_time: now,
                name: attachment_name(&numbered.digest),
                media_type: "application/octet-stream".into(),
                data: Cow::Borrowed(&snapshot.bytes),
            };
            // The chunk ends before an attachment.
            self.writer.attach(&attachment).map_err(said)?;
            self.flush()?;
        }
        let line = serde_json::to_vec(&numbered).map_err(|e| e.to_string())?;
        let sequence = snapshot.id as u32;
        let header = MessageHeader { channel_id: self.snapshots, sequence, log_time: now, publish_time: now };
        self.writer.write_to_known_channel(&header, &line).map_err(said)
    }

    /// Ends the file; where that fails, why, and how many ticks are not in it.
    pub(super) fn close(mut self) -> Result<(), (String, u64)> {
        self.writer.flush().map_err(|e| (said(e), self.open_ticks))?;
        self.writer.finish().map_err(|e| (said(e), 0))?;
        self.writer.into_inner().flush().map_err(|e| (e.to_string(), 0))
    }
}

/// The system's own words, where it has any.
fn said(error: mcap::McapError) -> String {
    match error {
        mcap::McapError::Io(e) => e.to_string(),
        other => other.to_string(),
    }
}
