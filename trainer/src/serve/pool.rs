//! The threads that simulate: one chunk of one request at a time.

use crate::env::Env;
use crate::rollout::{RolloutError, Worker, make_env, stream};
use nearl_runtime::Snapshot;
use nearl_runtime::rollout_protocol::Layout;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::Scope;
use std::time::Duration;

/// What the first chunk of a request begins with.
#[derive(Clone, Copy, Debug)]
pub(super) struct Start {
    pub(super) seed: u64,
    pub(super) projection: bool,
}

/// One chunk to simulate.
pub(super) struct Task {
    pub(super) slot: u64,
    /// The request's own worker; any idle one, or none, when `start` is given.
    pub(super) worker: Option<Box<Worker>>,
    pub(super) start: Option<Start>,
    pub(super) rows: usize,
    pub(super) noise: bool,
}

/// A simulated chunk, or one sentence why there is none; the worker is lost then.
pub(super) struct Outcome {
    pub(super) slot: u64,
    pub(super) rows: usize,
    pub(super) result: Result<(Box<Worker>, Vec<f64>), String>,
}

/// Threads with a queue in and a queue out; they end when the pool is dropped.
pub(super) struct Pool {
    tasks: Sender<Task>,
    outcomes: Receiver<Outcome>,
    layout: Layout,
    threads: usize,
    /// Chunks handed out and not yet back.
    at_work: usize,
    idle: Vec<Box<Worker>>,
}

impl Pool {
    pub(super) fn start<'scope>(
        scope: &'scope Scope<'scope, '_>,
        snapshot: &'scope Snapshot,
        threads: usize,
    ) -> Result<Pool, RolloutError> {
        let first = make_env(snapshot)?;
        let worker = Box::new(Worker::new(first.another()?, snapshot, 1.0, stream(0, 0))?);
        let (tasks, queue) = channel();
        let (done, outcomes) = channel();
        let queue = Arc::new(Mutex::new(queue));
        for _ in 0..threads {
            let (env, queue, done) = (first.another()?, Arc::clone(&queue), done.clone());
            scope.spawn(move || simulate(&*env, snapshot, &queue, &done));
        }
        Ok(Pool { tasks, outcomes, layout: worker.layout(), threads, at_work: 0, idle: vec![worker] })
    }

    pub(super) fn layout(&self) -> Layout {
        self.layout
    }

    /// True while another chunk keeps a thread from waiting.
    pub(super) fn wants_more(&self) -> bool {
        self.at_work < 2 * self.threads
    }

    /// Queues a chunk; a first one gets an idle worker if there is one.
    pub(super) fn give(&mut self, mut task: Task) {
        if task.worker.is_none() {
            task.worker = self.idle.pop();
        }
        if self.tasks.send(task).is_ok() {
            self.at_work += 1;
        }
    }

    /// Keeps a worker for the next request.
    pub(super) fn keep(&mut self, worker: Box<Worker>) {
        self.idle.push(worker);
    }

    /// The next finished chunk, if one comes in time.
    pub(super) fn wait(&mut self, patience: Duration) -> Option<Outcome> {
        match self.outcomes.recv_timeout(patience) {
            Ok(outcome) => {
                self.at_work -= 1;
                Some(outcome)
            }
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => None,
        }
    }
}

fn simulate(env: &dyn Env, snapshot: &Snapshot, queue: &Mutex<Receiver<Task>>, done: &Sender<Outcome>) {
    loop {
        let task = queue.lock().unwrap_or_else(PoisonError::into_inner).recv();
        let Ok(task) = task else { return };
        let (slot, rows) = (task.slot, task.rows);
        let result = catch_unwind(AssertUnwindSafe(|| chunk(env, snapshot, task))).unwrap_or_else(|_| {
            Err("the simulator stopped; the reason is in the server's error output".into())
        });
        if done.send(Outcome { slot, rows, result }).is_err() {
            return;
        }
    }
}

fn chunk(env: &dyn Env, snapshot: &Snapshot, task: Task) -> Result<(Box<Worker>, Vec<f64>), String> {
    let mut worker = match task.worker {
        Some(worker) => worker,
        None => {
            let env = env.another().map_err(|e| e.to_string())?;
            Box::new(Worker::new(env, snapshot, 1.0, stream(0, 0)).map_err(|e| e.to_string())?)
        }
    };
    if let Some(start) = task.start {
        worker.set_projection(start.projection);
        worker.reseed(stream(start.seed, 0)).map_err(|e| e.to_string())?;
    }
    let mut numbers = Vec::with_capacity(task.rows * worker.layout().width());
    for _ in 0..task.rows {
        worker.transition(task.noise, &mut numbers);
    }
    Ok((worker, numbers))
}
