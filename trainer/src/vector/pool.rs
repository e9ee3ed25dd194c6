//! Threads that step the environments of a vector, and wait in between.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use super::lane::{Lane, Round};

/// A round for all lanes; threads take the next lane until none is left.
struct Shared {
    lanes: Arc<Vec<Mutex<Lane>>>,
    next: AtomicUsize,
    round: Round,
}

impl Shared {
    fn run(&self) {
        while let Some(lane) = self.lanes.get(self.next.fetch_add(1, Ordering::Relaxed)) {
            lane.lock().unwrap_or_else(PoisonError::into_inner).run(self.round);
        }
    }
}

/// The lanes and the threads that run them, one fewer than there are: the caller is one too.
pub(super) struct Pool {
    lanes: Arc<Vec<Mutex<Lane>>>,
    rounds: Vec<Sender<Arc<Shared>>>,
    done: Receiver<bool>,
    threads: Vec<JoinHandle<()>>,
    process: u32,
}

impl Pool {
    pub(super) fn new(lanes: Vec<Lane>, threads: usize) -> std::io::Result<Pool> {
        let lanes = Arc::new(lanes.into_iter().map(Mutex::new).collect::<Vec<_>>());
        let (finished, done) = channel();
        let mut pool =
            Pool { rounds: Vec::new(), done, threads: Vec::new(), process: std::process::id(), lanes };
        for i in 1..threads.clamp(1, pool.lanes.len().max(1)) {
            let (send, rounds) = channel::<Arc<Shared>>();
            let finished = finished.clone();
            pool.rounds.push(send);
            pool.threads.push(std::thread::Builder::new().name(format!("nearl-vec-{i}")).spawn(
                move || {
                    for shared in rounds {
                        let run = std::panic::AssertUnwindSafe(|| shared.run());
                        let _ = finished.send(std::panic::catch_unwind(run).is_ok());
                    }
                },
            )?);
        }
        Ok(pool)
    }

    /// Runs a round in every lane.
    ///
    /// # Errors
    /// A sentence when the process was forked since the threads were made, or a thread panicked.
    pub(super) fn run(&mut self, round: Round) -> Result<(), String> {
        if self.process != std::process::id() {
            return Err(
                "this vector environment was made before the process was forked, so its threads are gone; make it in the child process"
                    .into(),
            );
        }
        let shared = Arc::new(Shared { lanes: Arc::clone(&self.lanes), next: AtomicUsize::new(0), round });
        for thread in &self.rounds {
            let _ = thread.send(Arc::clone(&shared));
        }
        shared.run();
        let ended = self.rounds.iter().filter(|_| self.done.recv() == Ok(true)).count();
        if ended == self.rounds.len() {
            Ok(())
        } else {
            Err("a thread of the vector environment panicked; make a new one".into())
        }
    }

    /// The lanes, between rounds.
    pub(super) fn lanes(&self) -> impl Iterator<Item = std::sync::MutexGuard<'_, Lane>> {
        self.lanes.iter().map(|lane| lane.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.rounds.clear();
        if self.process == std::process::id() {
            self.threads.drain(..).for_each(|thread| drop(thread.join()));
        }
    }
}
