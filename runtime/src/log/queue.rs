//! The queue in front of the file, and the thread behind it.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};
use rtrb::{Consumer, Producer, RingBuffer};

use super::encode::{SCHEMA, encode};
use crate::rt::Record;

/// Records the queue holds: about 7 MB.
const CAPACITY: usize = 1024;
/// The thread looks for records this often.
const POLL: Duration = Duration::from_millis(2);

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
    /// Why writing stopped before the end.
    pub error: Option<String>,
}

#[derive(Default)]
struct Shared {
    over: AtomicBool,
    dropped: AtomicU64,
}

/// The open log. Pushing never blocks; [`LogQueue::finish`] closes the file.
pub struct LogQueue {
    records: Producer<Record>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<LogSummary>>,
}

impl LogQueue {
    /// Creates the file and starts its thread; `metadata` (snapshot digest, seed, command) goes into the file.
    pub fn create(path: &Path, metadata: &BTreeMap<String, String>) -> Result<LogQueue, LogError> {
        let fail = |reason: String| LogError { path: path.to_owned(), reason };
        let file = File::create(path).map_err(|e| fail(e.to_string()))?;
        LogQueue::start(Box::new(file), metadata).map_err(fail)
    }

    fn start(sink: Box<dyn Sink>, metadata: &BTreeMap<String, String>) -> Result<LogQueue, String> {
        let writer = open(sink, metadata).map_err(|e| e.to_string())?;
        let (records, waiting) = RingBuffer::new(CAPACITY);
        let shared = Arc::new(Shared::default());
        let thread = std::thread::Builder::new()
            .name("nearl-log".into())
            .spawn({
                let shared = Arc::clone(&shared);
                move || write_all(writer, waiting, &shared)
            })
            .map_err(|e| e.to_string())?;
        Ok(LogQueue { records, shared, thread: Some(thread) })
    }

    /// Adds a record; drops and counts it if the queue is full.
    pub fn push(&mut self, record: &Record) {
        if self.records.push(*record).is_err() {
            self.shared.dropped.fetch_add(1, Ordering::Relaxed);
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
        summary.unwrap_or_else(|| LogSummary {
            dropped: self.dropped(),
            error: Some("the log thread panicked".into()),
            written: 0,
        })
    }
}

impl Drop for LogQueue {
    fn drop(&mut self) {
        if self.thread.is_some() {
            self.join();
        }
    }
}

/// What the log is written to: a file, outside of tests.
trait Sink: Write + Seek + Send {}
impl<T: Write + Seek + Send> Sink for T {}

/// An open file with its one channel.
struct Log {
    writer: Writer<BufWriter<Box<dyn Sink>>>,
    channel: u16,
    line: Vec<u8>,
}

fn open(sink: Box<dyn Sink>, metadata: &BTreeMap<String, String>) -> mcap::McapResult<Log> {
    let options = WriteOptions::new().compression(None).chunk_size(Some(256 << 10)).library("nearl");
    let mut writer = options.create(BufWriter::new(sink))?;
    let schema = writer.add_schema("nearl.Tick", "jsonschema", SCHEMA.as_bytes())?;
    let channel = writer.add_channel(schema, "tick", "json", &BTreeMap::new())?;
    writer.write_metadata(&mcap::records::Metadata { name: "nearl".into(), metadata: metadata.clone() })?;
    writer.flush()?;
    Ok(Log { writer, channel, line: Vec::with_capacity(16 << 10) })
}

impl Log {
    fn write(&mut self, record: &Record) -> Result<(), String> {
        encode(record, &mut self.line).map_err(|e| e.to_string())?;
        let header = MessageHeader {
            channel_id: self.channel,
            sequence: record.tick as u32,
            log_time: record.end,
            publish_time: record.begin,
        };
        self.writer.write_to_known_channel(&header, &self.line).map_err(|e| e.to_string())
    }

    fn close(mut self) -> Result<(), String> {
        self.writer.finish().map_err(|e| e.to_string())?;
        self.writer.into_inner().flush().map_err(|e| e.to_string())
    }
}

/// Writes until the end; after the first error everything else is dropped and counted.
fn write_all(mut log: Log, mut waiting: Consumer<Record>, shared: &Shared) -> LogSummary {
    crate::rt::thread::be_last();
    let mut summary = LogSummary::default();
    loop {
        let is_over = shared.over.load(Ordering::Acquire);
        while let Ok(record) = waiting.peek() {
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
        if is_over {
            break;
        }
        std::thread::sleep(POLL);
    }
    if let Err(error) = log.close() {
        summary.error.get_or_insert(error);
    }
    summary.dropped = shared.dropped.load(Ordering::Relaxed);
    summary
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
