//! The queue in front of the file, and the thread behind it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rtrb::{Consumer, Producer, RingBuffer};

use super::writer::{Log, Sink, Waiting, begin, open};
use crate::rt::Record;

/// Records the queue holds: about 11 MB.
const CAPACITY: usize = 1024;
/// With more records waiting, only what replay needs is written of each, until few wait.
const MANY: usize = CAPACITY / 4;
const FEW: usize = CAPACITY / 16;
/// Snapshots the queue holds, and the bytes of all that wait.
const SNAPSHOTS: usize = 16;
const SNAPSHOT_BYTES: u64 = 512 << 20;
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
    /// Those of them of which only what replay needs was written, because the disk was slow.
    pub brief: u64,
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
    /// Creates the file, with a number behind its name if there is one already, and starts its thread; `metadata` (snapshot digest, seed, command)
    /// goes into the file. `wall` is what the wall clock is ahead of the monotonic one \[ns\]: readers of logs show times of day.
    ///
    /// # Errors
    /// [`LogError`] for a path that cannot be written.
    pub fn create(path: &Path, metadata: &BTreeMap<String, String>, wall: u64) -> Result<LogQueue, LogError> {
        let fail = |reason: String| LogError { path: path.to_owned(), reason };
        let (file, path) = begin(path).map_err(|e| fail(e.to_string()))?;
        let mut log = LogQueue::start(Box::new(file), metadata, wall).map_err(fail)?;
        log.path = path;
        Ok(log)
    }

    /// The file that is written.
    pub fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn start(
        sink: Box<dyn Sink>,
        metadata: &BTreeMap<String, String>,
        wall: u64,
    ) -> Result<LogQueue, String> {
        let writer = open(sink, metadata, wall).map_err(|e| e.to_string())?;
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
    pub fn push_snapshot(&mut self, id: u64, version: u64, bytes: Vec<u8>, rows: Vec<String>) {
        let (shared, length) = (&self.shared, bytes.len() as u64);
        let has_room = shared.snapshot_bytes.load(Ordering::Acquire) + length <= SNAPSHOT_BYTES;
        shared.snapshot_bytes.fetch_add(length, Ordering::AcqRel);
        if !has_room || self.snapshots.push(Waiting { id, version, bytes, rows }).is_err() {
            shared.snapshot_bytes.fetch_sub(length, Ordering::AcqRel);
            shared.dropped_snapshots.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Records lost so far.
    pub fn dropped(&self) -> u64 {
        self.shared.dropped.load(Ordering::Relaxed)
    }

    /// Records that wait for the file.
    pub fn waiting(&self) -> usize {
        CAPACITY - self.records.slots()
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

fn write_all(
    mut log: Log,
    mut waiting: Consumer<Record>,
    mut snapshots: Consumer<Waiting>,
    shared: &Shared,
) -> LogSummary {
    crate::thread::be_patient();
    let (mut summary, mut in_brief) = (LogSummary::default(), false);
    loop {
        let is_over = shared.over.load(Ordering::Acquire);
        while let Ok(record) = waiting.peek() {
            // A snapshot is pushed before the first record that uses it, so it is seen here at the latest.
            attach_all(&mut log, &mut snapshots, shared, &mut summary);
            let behind = waiting.slots();
            in_brief = behind > if in_brief { FEW } else { MANY };
            match &summary.error {
                Some(_) => drop_one(shared),
                None => match log.write(record, in_brief) {
                    Ok(()) => {
                        summary.written += 1;
                        summary.brief += u64::from(in_brief);
                    }
                    Err(error) => {
                        summary.error = Some(error);
                        // With this one those before it that wait for the same chunk.
                        lose(log.open_ticks(), 1, &mut summary, shared);
                    }
                },
            }
            let _ = waiting.pop();
        }
        attach_all(&mut log, &mut snapshots, shared, &mut summary);
        if is_over {
            break;
        }
        std::thread::sleep(POLL);
    }
    if summary.error.is_none()
        && let Err((error, ticks)) = log.close()
    {
        summary.error = Some(error);
        lose(ticks, 0, &mut summary, shared);
    }
    summary.dropped = shared.dropped.load(Ordering::Relaxed);
    summary.dropped_snapshots = shared.dropped_snapshots.load(Ordering::Relaxed);
    summary
}

fn attach_all(log: &mut Log, snapshots: &mut Consumer<Waiting>, shared: &Shared, summary: &mut LogSummary) {
    while let Ok(snapshot) = snapshots.pop() {
        shared.snapshot_bytes.fetch_sub(snapshot.bytes.len() as u64, Ordering::AcqRel);
        if summary.error.is_none()
            && let Err(reason) = log.attach(&snapshot)
        {
            summary.error = Some(reason);
            lose(log.open_ticks(), 0, summary, shared);
        }
        if summary.error.is_some() {
            shared.dropped_snapshots.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Counts the ticks of a chunk that could not be written, of which all but `new` had been counted as written.
fn lose(ticks: u64, new: u64, summary: &mut LogSummary, shared: &Shared) {
    summary.written -= ticks.saturating_sub(new).min(summary.written);
    summary.brief = summary.brief.min(summary.written);
    shared.dropped.fetch_add(ticks, Ordering::Relaxed);
}

fn drop_one(shared: &Shared) {
    shared.dropped.fetch_add(1, Ordering::Relaxed);
}

#[cfg(test)]
mod tests {
    use std::io::{Cursor, Error, ErrorKind, Result, Seek, SeekFrom, Write};
    use std::sync::Mutex;
    use std::sync::mpsc::{Receiver, channel};

    use super::*;
    use crate::log::writer::{BRIEF_TOPIC, TICK_TOPIC};

    /// Takes `room` bytes, then fails like a full disk; waits for a word before its first write past the start.
    struct Disk {
        content: Cursor<Vec<u8>>,
        kept: Arc<Mutex<Vec<u8>>>,
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
            let done = self.content.write(bytes)?;
            self.kept.lock().unwrap().clone_from(self.content.get_ref());
            Ok(done)
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

    fn disk(room: usize, wait: Option<Receiver<()>>, kept: &Arc<Mutex<Vec<u8>>>) -> Box<dyn Sink> {
        Box::new(Disk { content: Cursor::new(Vec::new()), kept: Arc::clone(kept), room, wait })
    }

    /// Ticks, whole or in brief, in a log that may end in the middle of a chunk.
    fn ticks(log: &[u8]) -> u64 {
        use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
        let mut reader =
            LinearReader::new_with_options(LinearReaderOptions::default().with_skip_end_magic(true));
        let (mut at, mut ticks, mut of_ticks) = (0, 0, Vec::new());
        while let Some(event) = reader.next_event() {
            match event {
                Ok(LinearReadEvent::ReadRequest(wanted)) => {
                    let more = &log[at..log.len().min(at + wanted)];
                    reader.insert(wanted)[..more.len()].copy_from_slice(more);
                    reader.notify_read(more.len());
                    at += more.len();
                }
                Ok(LinearReadEvent::Record { data, opcode }) => match mcap::parse_record(opcode, data) {
                    Ok(mcap::records::Record::Channel(channel))
                        if [TICK_TOPIC, BRIEF_TOPIC].contains(&channel.topic.as_str()) =>
                    {
                        of_ticks.push(channel.id);
                    }
                    Ok(mcap::records::Record::Message { header, .. })
                        if of_ticks.contains(&header.channel_id) =>
                    {
                        ticks += 1
                    }
                    _ => {}
                },
                Err(_) => break,
            }
        }
        ticks
    }

    #[test]
    fn a_full_disk_costs_records_and_nothing_else() {
        let kept = Arc::default();
        let mut log = LogQueue::start(disk(1_000_000, None, &kept), &BTreeMap::new(), 0).unwrap();
        let mut record = Record::new();
        record.state.n_obs = 128;
        for tick in 0..5000 {
            // Numbers that no compression makes small.
            for (k, x) in record.state.obs.iter_mut().enumerate() {
                *x = f64::from(tick * 128 + k as u32).sin();
            }
            log.push(&record);
        }
        let summary = log.finish();
        assert!(summary.dropped > 4000, "{summary:?}");
        assert_eq!(summary.written + summary.dropped, 5000);
        assert!(summary.error.is_some());
        // Those of the chunk that could not be written are not called written, of which the file may have a part.
        let there = ticks(&kept.lock().unwrap());
        assert!(summary.written > 0 && (summary.written..summary.written + 100).contains(&there), "{there}");
    }

    #[test]
    fn a_stuck_disk_drops_exactly_what_the_queue_cannot_hold() {
        let (release, wait) = channel();
        let mut log =
            LogQueue::start(disk(usize::MAX, Some(wait), &Arc::default()), &BTreeMap::new(), 0).unwrap();
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
