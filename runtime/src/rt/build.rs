//! Building controllers from snapshot bytes on a thread of its own, one at a time; only the newest bytes are kept.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;

use crate::link::{RobotMessage, SnapshotBytes, SnapshotHeader, Verdict};
use crate::rt::thread;
use crate::rt::tick::{Build, Refusal};

/// A finished job.
pub(crate) struct Built<T> {
    /// Number of the snapshot, in the order they were received.
    pub(crate) id: u64,
    pub(crate) header: SnapshotHeader,
    pub(crate) bytes: Vec<u8>,
    pub(crate) result: Result<Box<T>, Refusal>,
}

/// The thread that builds, seen from the I/O thread. No call blocks.
pub(crate) struct Builder<B: Build> {
    jobs: Option<SyncSender<Job>>,
    built: Receiver<Built<B::Controller>>,
    thread: Option<JoinHandle<()>>,
    waiting: Option<Job>,
    busy: bool,
}

struct Job {
    id: u64,
    snapshot: SnapshotBytes,
    robot: RobotMessage,
}

impl<B: Build> Builder<B> {
    pub(crate) fn start(mut build: B) -> std::io::Result<Builder<B>> {
        let (jobs, work) = sync_channel::<Job>(1);
        let (done, built) = sync_channel(2);
        let thread = std::thread::Builder::new().name("nearl-build".into()).spawn(move || {
            thread::be_patient();
            for Job { id, snapshot, robot } in work {
                let result = build_one(&mut build, &snapshot, &robot);
                let SnapshotBytes { header, bytes } = snapshot;
                if done.send(Built { id, header, bytes, result }).is_err() {
                    return;
                }
            }
        })?;
        Ok(Builder { jobs: Some(jobs), built, thread: Some(thread), waiting: None, busy: false })
    }

    /// Takes a job; returns the header of the one it replaces, which is then never built.
    pub(crate) fn take(
        &mut self,
        id: u64,
        snapshot: SnapshotBytes,
        robot: RobotMessage,
    ) -> Option<SnapshotHeader> {
        let replaced = self.waiting.replace(Job { id, snapshot, robot }).map(|old| old.snapshot.header);
        self.feed();
        replaced
    }

    /// The finished job, if there is one.
    pub(crate) fn collect(&mut self) -> Option<Built<B::Controller>> {
        match self.built.try_recv() {
            Ok(built) => {
                self.busy = false;
                self.feed();
                Some(built)
            }
            Err(TryRecvError::Empty | TryRecvError::Disconnected) => None,
        }
    }

    fn feed(&mut self) {
        if self.busy {
            return;
        }
        if let (Some(job), Some(jobs)) = (self.waiting.take(), &self.jobs) {
            self.busy = jobs.try_send(job).is_ok();
        }
    }
}

impl<B: Build> Drop for Builder<B> {
    fn drop(&mut self) {
        self.jobs = None;
        // A result nobody collects is received here, so that the thread is never stuck in its send.
        while self.built.recv().is_ok() {}
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A panic in a validation is a refusal, not the end of the loop.
fn build_one<B: Build>(
    build: &mut B,
    snapshot: &SnapshotBytes,
    robot: &RobotMessage,
) -> Result<Box<B::Controller>, Refusal> {
    catch_unwind(AssertUnwindSafe(|| build.build(snapshot, robot).map(Box::new))).unwrap_or_else(|_| {
        let text =
            format!("snapshot version {} broke its validation: export it again", snapshot.header.version);
        Err(Refusal { verdict: Verdict::Other, text })
    })
}
