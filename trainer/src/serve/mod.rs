//! The rollout server: constrained rollouts on MuJoCo for other processes of this machine.
//!
//! Every request has an environment and a controller of its own, through the same [`Worker`](crate::rollout::Worker) as
//! training, with the random stream of its seed: its transitions do not depend on who else asks or on the number of threads.
//! A client may also learn: it keeps its environments, and pushes the policy they act by (`training`, `policy`).
//! One thread talks to the clients; the others simulate one chunk at a time, and `turns` says whose.

mod dispatcher;
mod job;
mod policy;
mod pool;
mod pushed;
mod refusal;
mod training;
mod turns;

use crate::rollout::RolloutError;
use nearl_rollout_protocol::{MAX_CHUNK, RolloutServer};
use nearl_runtime::Snapshot;
use nearl_runtime::link::{LinkError, RobotName};
use nearl_runtime::rt::Stop;
use serde::Serialize;
use std::time::{Duration, Instant};

/// What a server allows.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Threads that simulate.
    pub threads: usize,
    /// Requests under way at once; further ones are answered busy.
    pub requests: usize,
    /// Policy steps of one request at most, and of all trainings together: what they collect is kept until it is sent.
    pub max_steps: u64,
    /// Environments at most that are kept for all clients that learn.
    pub max_envs: u64,
    /// A client that takes nothing for so long loses its place.
    pub patience: Duration,
}

/// What a server did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Report {
    /// Requests that came, whatever became of them.
    pub requests: u64,
    /// Requests whose every step was sent.
    pub done: u64,
    /// Requests cancelled by their client.
    pub cancelled: u64,
    /// Requests refused because all places, or all environments of trainings, were taken.
    pub busy: u64,
    /// Requests refused for too many steps or environments.
    pub limit: u64,
    /// Requests refused for a wrong length, schema or value.
    pub malformed: u64,
    /// Requests whose client died, dropped them or took nothing for too long.
    pub gone: u64,
    /// Requests the simulator failed in.
    pub failed: u64,
    /// Requests cut short by the server's end.
    pub closed: u64,
    /// Policy steps simulated.
    pub steps: u64,
}

/// Why a server could not start.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The environment or the snapshot.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// The links.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// One transition is larger than a chunk.
    #[error(
        "a transition of task '{task}' has {width} numbers, but a chunk holds {MAX_CHUNK}: raise MAX_CHUNK and rebuild server and clients"
    )]
    Wide {
        /// Task.
        task: String,
        /// Numbers in a row.
        width: usize,
    },
    /// A setting that serves nobody.
    #[error("--{what} 0 serves nobody; give at least 1")]
    Nothing {
        /// Option.
        what: &'static str,
    },
}

/// Longest wait for a finished chunk before the clients are looked at again.
const WAIT: Duration = Duration::from_millis(1);
/// The same while a client waits for the server.
const SHORT_WAIT: Duration = Duration::from_micros(100);
/// Between two searches for clients that died.
const SEARCH: Duration = Duration::from_millis(250);

/// Serves until `stop`; calls `begin` once clients are let in.
///
/// # Errors
/// [`ServeError`].
pub fn serve(
    snapshot: &Snapshot,
    name: &RobotName,
    settings: &Settings,
    stop: &Stop,
    begin: impl FnOnce(),
) -> Result<Report, ServeError> {
    let nothing = [("threads", settings.threads), ("requests", settings.requests)];
    if let Some((what, _)) = nothing.into_iter().find(|(_, n)| *n == 0) {
        return Err(ServeError::Nothing { what });
    }
    std::thread::scope(|scope| {
        let mut pool = pool::Pool::start(scope, snapshot, settings.threads)?;
        let mut dispatcher = dispatcher::Dispatcher::new(snapshot, settings, pool.layout())?;
        let mut server = RolloutServer::open(name)?;
        let mut pushed = pushed::Pushed::default();
        begin();
        let mut searched = Instant::now();
        while !stop.is_requested() {
            let callers = server.receive();
            pushed.attend(scope, &mut server, &mut dispatcher, callers);
            if searched.elapsed() > SEARCH {
                dispatcher.keep_only(&server.survivors());
                searched = Instant::now();
            }
            dispatcher.attend();
            dispatcher.hand_out(&mut pool);
            if let Some(outcome) = pool.wait(if dispatcher.is_awaited() { SHORT_WAIT } else { WAIT }) {
                dispatcher.take_back(outcome);
            }
        }
        pushed.end(&mut dispatcher);
        Ok(dispatcher.close())
    })
}
