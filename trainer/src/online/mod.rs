//! Learning from a running loop: its transitions in, snapshots out, while it runs.
//!
//! Each iteration pushes the newest networks, waits until the loop has them in use, and collects the rows of that version
//! alone. What the loop does meanwhile with the version before is counted and left out.

mod stream;

pub use stream::{LeftOut, Stream};

use crate::env::EnvError;
use crate::rollout::{Collected, RolloutError, make_env};
use crate::settings::TrainSettings;
use crate::train::{Source, SourceError};
use nearl_runtime::Snapshot;
use nearl_runtime::link::{LinkError, RobotName, TrainerLink, Verdict};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Longest wait for the loop, longest silence of it, and longest time without a usable row.
pub const PATIENCE: Duration = Duration::from_secs(30);
/// Pause when the stream is empty.
const NAP: Duration = Duration::from_micros(200);
/// Times in a row that a snapshot may be taken back before the training ends.
const TRIES: u32 = 5;

/// Why learning from a loop ended.
#[derive(Debug, thiserror::Error)]
pub enum OnlineError {
    /// The link.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The task cannot score a state.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// The loop does not want the snapshot.
    #[error("the loop of `{name}` refused version {version} ({verdict}): {text}")]
    Refused {
        /// Robot.
        name: RobotName,
        /// Version pushed.
        version: u64,
        /// Code of the reason.
        verdict: Verdict,
        /// The loop's sentence.
        text: String,
    },
    /// There is nothing to learn from.
    #[error(
        "the loop of `{0}` acts without noise, so there is nothing to learn from: start it with `nearl run SNAPSHOT --plant {0} --explore SEED`"
    )]
    NoNoise(RobotName),
    /// Transitions come, but none is usable.
    #[error(
        "the loop of `{name}` sent no usable step for {seconds:.0} s; left out so far: {} of foreign versions, {} replaced, \
         {} not active, {} in broken periods, {} with other targets, {} gaps: see `nearl run --json` for the loop's mode",
        left_out.foreign, left_out.stale, left_out.inactive, left_out.partial, left_out.unlike, left_out.gaps
    )]
    Unusable {
        /// Robot.
        name: RobotName,
        /// Patience \[s\].
        seconds: f64,
        /// What was left out.
        left_out: LeftOut,
    },
}

/// A running loop as a source of experience.
pub struct LoopSource {
    link: TrainerLink,
    stream: Stream,
    n: usize,
    stop: Arc<AtomicBool>,
    version: u64,
    rolled_back: u64,
}

impl LoopSource {
    /// Connects to the loop of `name`; `n` rows make a batch.
    ///
    /// # Errors
    /// [`SourceError`] when there is no loop, or the task cannot be simulated.
    pub fn open(
        name: &RobotName,
        snapshot: &Snapshot,
        settings: &TrainSettings,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, SourceError> {
        let env = make_env(snapshot)?;
        let (gamma, penalty) = (settings.gamma, settings.moved_penalty);
        let stream = Stream::new(snapshot, env, gamma, penalty).map_err(RolloutError::from)?;
        let mut link = TrainerLink::open(name).map_err(OnlineError::from)?;
        let health = link.wait_for_runtime(PATIENCE).map_err(OnlineError::from)?;
        let n = settings.n_envs * settings.n_steps;
        Ok(Self { link, stream, n, stop, version: health.policy_version, rolled_back: 0 })
    }

    fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Puts new networks into the loop; false if a stop came first.
    fn push(&mut self, snapshot: &Snapshot) -> Result<bool, OnlineError> {
        let mut snapshot = snapshot.clone();
        self.version += 1;
        snapshot.manifest.version = self.version;
        self.link.push(self.version, &snapshot.to_bytes())?;
        self.stream.want(self.version, &snapshot.networks);
        let end = Instant::now() + PATIENCE;
        while !self.is_stopped() {
            if let Some((verdict, text)) = self.verdict() {
                let (name, version) = (self.link.name().clone(), self.version);
                return match verdict {
                    Verdict::Accepted => Ok(true),
                    _ => Err(OnlineError::Refused { name, version, verdict, text }),
                };
            }
            if Instant::now() > end {
                return Err(LinkError::NoRuntime(self.link.name().clone()).into());
            }
            self.link.attend();
            if self.stream.rows.len() >= self.n || !self.take()? {
                std::thread::sleep(NAP);
            }
        }
        Ok(false)
    }

    /// What the loop says of the newest version.
    fn verdict(&mut self) -> Option<(Verdict, String)> {
        let (link, version) = (&mut self.link, self.version);
        std::iter::from_fn(|| link.receipt()).find(|r| r.version == version).map(|r| (r.verdict(), r.text()))
    }

    /// Takes a transition, if there is one.
    fn take(&mut self) -> Result<bool, OnlineError> {
        let Some(transition) = self.link.transition() else { return Ok(false) };
        if transition.policy_version == self.version && transition.explores == 0 {
            return Err(OnlineError::NoNoise(self.link.name().clone()));
        }
        self.stream.take(&transition)?;
        Ok(true)
    }

    fn fill(&mut self, snapshot: &Snapshot) -> Result<bool, OnlineError> {
        self.stream.rows.clear();
        if !self.push(snapshot)? {
            return Ok(false);
        }
        let (mut heard, mut gained, mut tries) = (Instant::now(), (Instant::now(), 0), 1);
        while self.stream.rows.len() < self.n {
            if self.is_stopped() {
                return Ok(false);
            }
            if let Some((Verdict::RolledBack, text)) = self.verdict() {
                self.rolled_back += 1;
                tries += 1;
                if tries > TRIES {
                    let (name, version) = (self.link.name().clone(), self.version);
                    return Err(OnlineError::Refused { name, version, verdict: Verdict::RolledBack, text });
                }
                if !self.push(snapshot)? {
                    return Ok(false);
                }
            }
            if self.take()? {
                heard = Instant::now();
            } else {
                self.link.attend();
                std::thread::sleep(NAP);
            }
            if self.stream.rows.len() > gained.1 {
                gained = (Instant::now(), self.stream.rows.len());
            }
            let name = || self.link.name().clone();
            if heard.elapsed() > PATIENCE {
                return Err(LinkError::NoRuntime(name()).into());
            }
            if gained.0.elapsed() > PATIENCE {
                let left_out = self.stream.left_out;
                return Err(OnlineError::Unusable {
                    name: name(),
                    seconds: PATIENCE.as_secs_f64(),
                    left_out,
                });
            }
        }
        self.stream.rows.cut();
        Ok(true)
    }
}

impl Source for LoopSource {
    fn collect(&mut self, snapshot: &Snapshot) -> Result<bool, SourceError> {
        Ok(self.fill(snapshot)?)
    }

    fn gathered(&mut self) -> Vec<&Collected> {
        vec![&self.stream.rows.collected]
    }

    fn notes(&self) -> Vec<(&'static str, f64)> {
        let LeftOut { foreign, stale, inactive, partial, unlike, gaps } = self.stream.left_out;
        [
            ("online/version", self.version),
            ("online/rolled_back", self.rolled_back),
            ("online/lost", self.link.lost_transitions()),
            ("online/foreign", foreign),
            ("online/stale", stale),
            ("online/inactive", inactive),
            ("online/partial", partial),
            ("online/unlike", unlike),
            ("online/gaps", gaps),
        ]
        .map(|(name, n)| (name, n as f64))
        .to_vec()
    }
}
