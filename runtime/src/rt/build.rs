//! Building controllers from snapshot bytes on a thread of its own, one at a time; only the newest bytes are kept.
//!
//! Between this thread and the I/O thread lie rings that neither side ever waits in. A channel's receiver spins while a sender is
//! in the middle of a send: at a real-time priority it may keep the very core that the sender needs to go on.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use nearl_constraints::Moved;
use rtrb::{Consumer, Producer, RingBuffer};

use crate::link::{RobotMessage, SnapshotBytes, SnapshotHeader, Verdict};
use crate::rt::tick::{Build, Refusal};
use crate::thread;

/// A finished job.
pub(crate) struct Built<T> {
    /// Number of the snapshot, in the order they were received.
    pub(crate) id: u64,
    pub(crate) header: SnapshotHeader,
    /// With the limits moved as `source` says: what the controller was built from.
    pub(crate) bytes: Vec<u8>,
    pub(crate) source: Source,
    pub(crate) result: Result<Box<T>, Refusal>,
}

/// The thread that builds, seen from the I/O thread. No call blocks.
pub(crate) struct Builder<B: Build> {
    /// `None` once the thread is to end.
    jobs: Option<Producer<Job>>,
    built: Consumer<Built<B::Controller>>,
    /// What is no longer needed: freeing megabytes may wait for the allocator, so it is done where they came from.
    scrap: Producer<Box<dyn Send>>,
    thread: Option<JoinHandle<()>>,
    waiting: Option<Job>,
    busy: bool,
}

/// Things that may wait to be dropped.
const SCRAP: usize = 16;
/// Room of the thread: parsers of robot files recurse as deep as the files are nested [bytes].
const STACK: usize = 16 << 20;
/// Time between two looks for a job.
const NAP: Duration = Duration::from_millis(1);

/// What a controller is made of.
#[derive(Clone)]
pub(crate) struct Source {
    /// The snapshot as it came.
    pub(crate) bytes: Arc<Vec<u8>>,
    /// Where its limits are moved.
    pub(crate) moved: Moved,
    /// Only the limits are new.
    pub(crate) is_order: bool,
    /// It was in use before, with other limits, and is to be so again.
    pub(crate) goes_back: bool,
}

struct Job {
    id: u64,
    header: SnapshotHeader,
    source: Source,
    robot: RobotMessage,
}

impl<B: Build> Builder<B> {
    pub(crate) fn start(mut build: B) -> std::io::Result<Builder<B>> {
        let (jobs, mut work) = RingBuffer::<Job>::new(1);
        let (mut done, built) = RingBuffer::new(1);
        let (scrap, mut scraps) = RingBuffer::<Box<dyn Send>>::new(SCRAP);
        let thread =
            std::thread::Builder::new().name("nearl-build".into()).stack_size(STACK).spawn(move || {
                thread::be_patient();
                loop {
                    while let Ok(scrap) = scraps.pop() {
                        drop(scrap);
                    }
                    let Ok(Job { id, header, source, robot }) = work.pop() else {
                        if work.is_abandoned() {
                            return;
                        }
                        std::thread::sleep(NAP);
                        continue;
                    };
                    let (bytes, result) = build_one(&mut build, header, &source, &robot);
                    // There is room: the next job is only given once this one was collected.
                    let _ = done.push(Built { id, header, bytes, source, result });
                }
            })?;
        Ok(Builder { jobs: Some(jobs), built, scrap, thread: Some(thread), waiting: None, busy: false })
    }

    /// Takes a job; returns the header of the one it replaces, which is then never built.
    pub(crate) fn take(
        &mut self,
        id: u64,
        header: SnapshotHeader,
        source: Source,
        robot: RobotMessage,
    ) -> Option<SnapshotHeader> {
        let replaced = self.waiting.replace(Job { id, header, source, robot }).map(|old| old.header);
        self.feed();
        replaced
    }

    /// Has `scrap` dropped on the builder's thread, or here if too much waits for that.
    pub(crate) fn discard(&mut self, scrap: Box<dyn Send>) {
        let _ = self.scrap.push(scrap);
    }

    /// The finished job, if there is one.
    pub(crate) fn collect(&mut self) -> Option<Built<B::Controller>> {
        let built = self.built.pop().ok()?;
        self.busy = false;
        self.feed();
        Some(built)
    }

    /// Nothing waits, is built, or waits to be collected.
    pub(crate) fn is_idle(&self) -> bool {
        !self.busy && self.waiting.is_none()
    }

    fn feed(&mut self) {
        if self.busy {
            return;
        }
        if let (Some(job), Some(jobs)) = (self.waiting.take(), &mut self.jobs) {
            self.busy = jobs.push(job).is_ok();
        }
    }
}

impl<B: Build> Drop for Builder<B> {
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The bytes with the limits moved, and the controller. A panic in a validation is a refusal, not the end of the loop.
fn build_one<B: Build>(
    build: &mut B,
    header: SnapshotHeader,
    source: &Source,
    robot: &RobotMessage,
) -> (Vec<u8>, Result<Box<B::Controller>, Refusal>) {
    let mut made = SnapshotBytes { header, bytes: Vec::new() };
    let mut both = || {
        made.bytes = match source.moved == Moved::default() {
            true => source.bytes.to_vec(),
            false => build.with_limits(&source.bytes, &source.moved)?,
        };
        build.build(&made, robot).map(Box::new)
    };
    let result = catch_unwind(AssertUnwindSafe(&mut both)).unwrap_or_else(|_| {
        let text = format!("snapshot version {} broke its validation: export it again", header.version);
        Err(Refusal { verdict: Verdict::Other, text })
    });
    (made.bytes, result)
}
