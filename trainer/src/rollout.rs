//! Vectorised constrained rollouts: many environments, each through its own `Controller`, on all cores.
//!
//! Every environment has its own random stream and nothing is shared while they run, so a seed gives the
//! same bits whatever the number of threads.

mod carried;
mod demonstrated;
mod resume;
mod rows;
mod scorer;
mod segment;
mod worker;

pub use rows::{Period, Rows};
pub use scorer::Scorer;
pub(crate) use segment::nth;
pub use segment::{Collected, Segment, Tally};
pub use worker::Worker;

use crate::env::{Env, EnvError};
use nearl_runtime::{Networks, Snapshot, SnapshotError};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Why rollouts could not start.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError {
    /// The environment.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// The snapshot.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    /// The limits that an evaluation watches.
    #[error(transparent)]
    Watch(#[from] crate::watch::WatchError),
    /// More environments or steps than fit into memory.
    #[error(
        "[train.n_envs] = {n_envs}, [train.n_steps] = {n_steps}: {what} would take more memory than the {free} MB that are free; give fewer"
    )]
    Memory {
        /// Environments.
        n_envs: usize,
        /// Steps of each.
        n_steps: usize,
        /// What does not fit.
        what: String,
        /// Free memory \[MB\].
        free: u64,
    },
    /// The policy saw what is no finite number.
    #[error("{what} of '{task}' came out as {value}, and no policy can act on it; {WHERE_TO_LOOK}")]
    Odd {
        /// Task.
        task: String,
        /// What of its observation.
        what: String,
        /// What it came out as.
        value: f64,
    },
    /// The task's observation is not the environment's.
    #[error(
        "task '{task}' observes {task_says}, but its environment gives {env_says}; leave state.observation out to use the environment's"
    )]
    Observation {
        /// Task.
        task: String,
        /// In the task file.
        task_says: String,
        /// In the environment.
        env_says: String,
    },
}

/// Where an observation that is no number may come from.
pub(crate) const WHERE_TO_LOOK: &str = "look for a logarithm, root or quotient that leaves its domain, there or in [commands], [noise], [delay] or [pushes]";

/// Portions of the work a thread takes, at least.
const PORTIONS: usize = 32;

/// All workers of a training.
pub struct Collector {
    workers: Vec<Mutex<Worker>>,
    threads: usize,
    n_steps: usize,
}

/// Makes the environment of a snapshot's task and checks that its observation is the task's.
///
/// # Errors
/// [`RolloutError`].
pub fn make_env(snapshot: &Snapshot) -> Result<Box<dyn Env>, RolloutError> {
    let task = &snapshot.manifest.task;
    let env = crate::env::of_task(&snapshot.manifest, &task.name)?;
    if env.spec().obs != task.state.observation {
        return Err(RolloutError::Observation {
            task: task.name.clone(),
            task_says: task.state.observation.join(" "),
            env_says: env.spec().obs.join(" "),
        });
    }
    Ok(env)
}

/// Memory that is free, and all there is [MB]; nothing where the system does not say.
fn memory() -> Option<[u64; 2]> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let of = |key: &str| {
        let line = text.lines().find_map(|l| l.strip_prefix(key))?;
        Some(line.trim_end_matches("kB").trim().parse::<u64>().ok()? >> 10)
    };
    Some([of("MemAvailable:")?, of("MemTotal:")?])
}

/// The free memory \[MB\] where `needed` MB more would leave less than a sixteenth of all there is.
pub(crate) fn lacks_memory(needed: u64) -> Option<u64> {
    let [free, total] = memory()?;
    (free < needed.saturating_add(total / 16)).then_some(free)
}

impl Collector {
    /// The environments `envs` of a training, which collect `n_steps` policy steps each, on `threads` threads.
    ///
    /// # Errors
    /// [`RolloutError`].
    pub fn new(
        snapshot: &Snapshot,
        envs: Range<usize>,
        n_steps: usize,
        threads: usize,
        gamma: f64,
        seed: u64,
    ) -> Result<Self, RolloutError> {
        let (first, n_envs) = (make_env(snapshot)?, envs.len());
        // Float32 numbers of a row, in the workers and once more in the batch.
        let row =
            8 * (first.spec().n_obs() + 6 * (first.spec().nq + first.spec().nv) + 3 * first.spec().n_act());
        let batch = (n_envs as u64).saturating_mul(n_steps as u64).saturating_mul(row as u64) >> 20;
        let (mut workers, full) =
            (Vec::new(), |what: String, free| RolloutError::Memory { n_envs, n_steps, what, free });
        for i in envs {
            if workers.len() % 64 == 0
                && let Some(free) = lacks_memory(batch)
            {
                let what = if workers.is_empty() {
                    format!("a batch of {batch} MB")
                } else {
                    format!("environments after the first {}", workers.len())
                };
                return Err(full(what, free));
            }
            let mut env = first.another()?;
            env.start_curriculum();
            workers.push(Mutex::new(Worker::new(env, snapshot, gamma, stream(seed, i as u64))?));
        }
        Ok(Self { workers, threads: threads.clamp(1, n_envs.max(1)), n_steps })
    }

    /// Hands new networks to every controller.
    pub fn set_networks(&mut self, networks: &Networks) {
        for w in &mut self.workers {
            let w = w.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner);
            w.set_networks(networks);
        }
    }

    /// Collects one segment in every environment.
    ///
    /// Threads take portions of segments in turn, so that all end at nearly the same time; which thread takes which does
    /// not matter, the next portion of a worker is always the same.
    ///
    /// # Errors
    /// [`RolloutError::Env`] of a reset.
    pub fn collect(&mut self) -> Result<(), RolloutError> {
        let n_steps = self.n_steps;
        self.workers().for_each(|w| w.begin(n_steps));
        let n = self.workers.len();
        let portion = (n * n_steps).div_ceil(PORTIONS * self.threads).clamp(1, n_steps);
        let (next, portions) = (AtomicUsize::new(0), n * n_steps.div_ceil(portion));
        let failed = Mutex::new(None);
        let run = || {
            loop {
                let k = next.fetch_add(1, Ordering::Relaxed);
                if k >= portions {
                    break;
                }
                let mut worker =
                    self.workers[k % n].lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                if let Err(e) = worker.go_on(portion) {
                    next.store(portions, Ordering::Relaxed);
                    *failed.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = Some(e);
                }
            }
        };
        std::thread::scope(|s| {
            for _ in 1..self.threads {
                s.spawn(run);
            }
            run();
        });
        let failed = failed.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        failed.map_or(Ok(()), |e| Err(e.into()))
    }

    /// The workers in a fixed order.
    pub fn workers(&mut self) -> impl Iterator<Item = &mut Worker> {
        self.workers.iter_mut().map(|w| w.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner))
    }
}

/// Random stream `index` of a seed.
pub fn stream(seed: u64, index: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(index);
    rng
}
