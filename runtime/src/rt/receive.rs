//! Receives snapshots on a thread of its own: they are as large as the networks, and copying one takes longer than a tick may be late.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::link::{SnapshotBytes, SnapshotReader};
use crate::rt::thread;

/// Snapshots that wait to be collected; of those beyond, the transport keeps the newest.
const WAITING: usize = 2;
/// Time between two looks.
const NAP: Duration = Duration::from_millis(2);

/// The thread, seen from the I/O thread. No call blocks.
pub(crate) struct SnapshotReceiver {
    snapshots: Option<Receiver<SnapshotBytes>>,
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
        let (deliver, snapshots) = sync_channel(WAITING);
        let shared = Arc::new(Shared::default());
        let seen = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("nearl-receive".into())
            .spawn(move || receive(reader, &deliver, &seen))?;
        Ok(SnapshotReceiver { snapshots: Some(snapshots), shared, thread: Some(thread) })
    }

    /// The next snapshot that came.
    pub(crate) fn next(&self) -> Option<SnapshotBytes> {
        self.snapshots.as_ref().and_then(|s| s.try_recv().ok())
    }

    /// Snapshots whose header did not fit their bytes.
    pub(crate) fn refused(&self) -> u64 {
        self.shared.refused.load(Ordering::Relaxed)
    }
}

impl Drop for SnapshotReceiver {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Release);
        // Ends a delivery that nobody collects.
        self.snapshots = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn receive(mut reader: SnapshotReader, deliver: &SyncSender<SnapshotBytes>, shared: &Shared) {
    thread::be_patient();
    while !shared.over.load(Ordering::Acquire) {
        match reader.next() {
            Some(snapshot) => {
                if deliver.send(snapshot).is_err() {
                    return;
                }
            }
            None => std::thread::sleep(NAP),
        }
        shared.refused.store(reader.refused(), Ordering::Relaxed);
    }
}
