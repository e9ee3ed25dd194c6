//! The threads that simulate: one chunk or portion of one request at a time.

use crate::env::Env;
use crate::rollout::{RolloutError, Worker, make_env, stream};
use nearl_rollout_protocol::Layout;
use nearl_runtime::Snapshot;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::Scope;
use std::time::Duration;

/// What an environment begins with.
#[derive(Clone, Copy, Debug)]
pub(super) struct Start {
    pub(super) seed: u64,
    /// Random stream of the seed.
    pub(super) stream: u64,
    pub(super) projection: bool,
    pub(super) gamma: f64,
    pub(super) moved_penalty: f64,
}

/// What is to be simulated.
pub(super) enum Order {
    /// The next chunk of a rollout, the first of which begins with `start`.
    Chunk { start: Option<Start>, noise: bool },
    /// The next portion of a training's segment by the networks of `snapshot`. The first of a segment says how long it is; an
    /// environment without a worker begins with `start`.
    Segment { snapshot: Arc<Snapshot>, begins: Option<usize>, start: Start },
}

/// So many steps to simulate.
pub(super) struct Task {
    pub(super) slot: u64,
    /// Which environment of a training.
    pub(super) place: Option<usize>,
    /// The environment's own worker. A rollout that begins takes any idle one.
    pub(super) worker: Option<Box<Worker>>,
    pub(super) rows: usize,
    pub(super) order: Order,
}

/// What was simulated, or one sentence why it was not; the worker is lost then.
pub(super) struct Outcome {
    pub(super) slot: u64,
    pub(super) place: Option<usize>,
    pub(super) rows: usize,
    /// The numbers of a chunk; a segment stays in its worker.
    pub(super) result: Result<(Box<Worker>, Vec<f64>), String>,
}

/// Threads with a queue in and a queue out; they end when the pool is dropped.
pub(super) struct Pool {
    tasks: Sender<Task>,
    outcomes: Receiver<Outcome>,
    layout: Layout,
    threads: usize,
    /// Tasks handed out and not yet back.
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

    /// True while another task keeps a thread from waiting.
    pub(super) fn wants_more(&self) -> bool {
        self.at_work < 2 * self.threads
    }

    /// Queues a task; a rollout that begins gets an idle worker if there is one.
    pub(super) fn give(&mut self, mut task: Task) {
        if task.worker.is_none() && matches!(task.order, Order::Chunk { .. }) {
            task.worker = self.idle.pop();
        }
        if self.tasks.send(task).is_ok() {
            self.at_work += 1;
        }
    }

    /// Keeps the worker of a rollout for the next one.
    pub(super) fn keep(&mut self, worker: Box<Worker>) {
        self.idle.push(worker);
    }

    /// The next finished task, if one comes in time.
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
        let Ok(Task { slot, place, worker, rows, order }) = task else { return };
        let run = || match order {
            Order::Chunk { start, noise } => chunk(env, snapshot, worker, start, rows, noise),
            Order::Segment { snapshot, begins, start } => {
                portion(env, &snapshot, worker, start, begins, rows)
            }
        };
        let result = catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|_| {
            Err("the simulator stopped; the reason is in the server's error output".into())
        });
        if done.send(Outcome { slot, place, rows, result }).is_err() {
            return;
        }
    }
}

type Simulated = Result<(Box<Worker>, Vec<f64>), String>;

fn chunk(
    env: &dyn Env,
    snapshot: &Snapshot,
    worker: Option<Box<Worker>>,
    start: Option<Start>,
    rows: usize,
    noise: bool,
) -> Simulated {
    let mut worker = match worker {
        Some(worker) => worker,
        None => {
            let env = env.another().map_err(|e| e.to_string())?;
            Box::new(Worker::new(env, snapshot, 1.0, stream(0, 0)).map_err(|e| e.to_string())?)
        }
    };
    if let Some(start) = start {
        worker.set_projection(start.projection);
        worker.reseed(stream(start.seed, start.stream)).map_err(|e| e.to_string())?;
    }
    let mut numbers = Vec::with_capacity(rows * worker.layout().width());
    for _ in 0..rows {
        worker.transition(noise, &mut numbers).map_err(|e| e.to_string())?;
    }
    Ok((worker, numbers))
}

fn portion(
    env: &dyn Env,
    snapshot: &Snapshot,
    worker: Option<Box<Worker>>,
    start: Start,
    begins: Option<usize>,
    rows: usize,
) -> Simulated {
    let mut worker = match worker {
        Some(worker) => worker,
        None => {
            let (mut env, rng) =
                (env.another().map_err(|e| e.to_string())?, stream(start.seed, start.stream));
            env.start_curriculum();
            let mut worker = Worker::new(env, snapshot, start.gamma, rng).map_err(|e| e.to_string())?;
            worker.set_projection(start.projection);
            worker.set_moved_penalty(start.moved_penalty);
            Box::new(worker)
        }
    };
    if let Some(n_steps) = begins {
        worker.set_networks(&snapshot.networks);
        worker.begin(n_steps);
    }
    worker.go_on(rows).map_err(|e| e.to_string())?;
    Ok((worker, Vec::new()))
}
