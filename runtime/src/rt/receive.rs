//! Receives snapshots on a thread of its own: they are as large as the networks, and copying one takes longer than a tick may be late.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rtrb::{Consumer, Producer, PushError, RingBuffer};

use crate::link::{SnapshotBytes, SnapshotReader};
use crate::thread;

/// Snapshots that wait to be collected; of those beyond, the transport keeps the newest.
const WAITING: usize = 2;
/// Time between two looks.
const NAP: Duration = Duration::from_millis(2);

/// The thread, seen from the I/O thread. No call blocks.
pub(crate) struct SnapshotReceiver {
    snapshots: Consumer<SnapshotBytes>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    over: AtomicBool,
    refused: AtomicU64,
}

impl SnapshotReceiver {
    pub(crate) fn start(reader: SnapshotReader) -> std::io::Result<SnapshotReceiver> {
        let (deliver, snapshots) = RingBuffer::new(WAITING);
        let shared = Arc::new(Shared::default());
        let seen = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("nearl-receive".into())
            .spawn(move || receive(reader, deliver, &seen))?;
        Ok(SnapshotReceiver { snapshots, shared, thread: Some(thread) })
    }

    /// The next snapshot that came.
    pub(crate) fn next(&mut self) -> Option<SnapshotBytes> {
        self.snapshots.pop().ok()
    }

    /// Snapshots whose header did not fit their bytes.
    pub(crate) fn refused(&self) -> u64 {
        self.shared.refused.load(Ordering::Relaxed)
    }
}

impl Drop for SnapshotReceiver {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn receive(mut reader: SnapshotReader, mut deliver: Producer<SnapshotBytes>, shared: &Shared) {
    thread::be_patient();
    let mut waiting = None;
    while !shared.over.load(Ordering::Acquire) {
        waiting = waiting.or_else(|| reader.next());
        shared.refused.store(reader.refused(), Ordering::Relaxed);
        match waiting.take().map(|snapshot| deliver.push(snapshot)) {
            Some(Ok(())) => {}
            Some(Err(PushError::Full(snapshot))) => {
                waiting = Some(snapshot);
                std::thread::sleep(NAP);
            }
            None => std::thread::sleep(NAP),
        }
    }
}
