//! Experience from a rollout server: its environments, the policy of this process.
//!
//! Each iteration pushes the networks over the links of the server's name and asks for one segment of every environment. They
//! go on in the server from request to request, so a seed gives the same weights as environments of this process.

use super::source::{Source, SourceError};
use crate::checkpoint::Checkpoint;
use crate::rollout::Collected;
use crate::settings::TrainSettings;
use nearl_rollout_protocol::{Answer, Constraints, Layout, Request, RequestError, RolloutClient, Training};
use nearl_runtime::Snapshot;
use nearl_runtime::link::{LinkError, RobotName, TrainerLink, Verdict};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Longest wait for the server, and longest silence of it.
pub const PATIENCE: Duration = Duration::from_secs(60);
/// Pause before a server that was busy is asked again.
const BUSY: Duration = Duration::from_millis(20);
/// Between two looks whether a stop was asked for.
const LOOK: Duration = Duration::from_millis(100);

/// Why a rollout server gives no more experience.
#[derive(Debug, thiserror::Error)]
pub enum ServedError {
    /// The link the policy travels by.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The server, or what it answered.
    #[error(transparent)]
    Request(#[from] RequestError),
    /// The server does not want the policy.
    #[error("the rollout server `{name}` refused the policy ({verdict}): {text}")]
    Refused {
        /// Server.
        name: RobotName,
        /// Code of the reason.
        verdict: Verdict,
        /// The server's sentence.
        text: String,
    },
}

/// A rollout server as a source of experience.
pub struct ServedSource {
    link: TrainerLink,
    client: RolloutClient,
    name: RobotName,
    stop: Arc<AtomicBool>,
    sizes: Layout,
    request: Request,
    training: Training,
    collected: Vec<Collected>,
    version: u64,
}

impl ServedSource {
    /// Connects to the server of `name`; `sizes` are those of the task's rows.
    ///
    /// # Errors
    /// [`ServedError`] when there is no server.
    pub fn open(
        name: &RobotName,
        settings: &TrainSettings,
        sizes: Layout,
        seed: u64,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, ServedError> {
        let client = RolloutClient::open(name, PATIENCE)?;
        let link = TrainerLink::open(name)?;
        let constraints = if settings.project_in_training { Constraints::Own } else { Constraints::Off };
        let training = Training {
            n_envs: settings.n_envs as u64,
            begins: true,
            stream: 0,
            gamma: settings.gamma,
            moved_penalty: settings.moved_penalty,
        };
        let request = Request { constraints, ..Request::new(seed, settings.n_steps as u64) };
        let (name, collected) = (name.clone(), Vec::new());
        Ok(Self { link, client, name, stop, sizes, request, training, collected, version: 0 })
    }

    fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn fill(&mut self, snapshot: &Snapshot) -> Result<bool, ServedError> {
        self.version += 1;
        self.link.push(self.version, &snapshot.to_bytes())?;
        let begin = Instant::now();
        let numbers = loop {
            match self.ask() {
                Ok(Some(numbers)) => break numbers,
                Ok(None) => return Ok(false),
                // Others have taken all places for now.
                Err(ServedError::Request(RequestError::Refused { answer: Answer::Busy, .. }))
                    if begin.elapsed() < PATIENCE && !self.is_stopped() =>
                {
                    std::thread::sleep(BUSY);
                }
                _ if self.is_stopped() => return Ok(false),
                Err(e) => return Err(self.refusal().unwrap_or(e)),
            }
        };
        self.collected = self.read(&numbers)?;
        self.training.begins = false;
        Ok(true)
    }

    /// Every number of the answer; `None` if a stop came first.
    fn ask(&mut self) -> Result<Option<Vec<f64>>, ServedError> {
        let (version, training) = (Some(self.version), Some(self.training));
        let mut answers = self.client.request(&Request { version, training, ..self.request })?;
        let (mut numbers, mut heard) = (Vec::new(), Instant::now());
        loop {
            match answers.next_part(LOOK) {
                Ok(Some(part)) => {
                    numbers.extend_from_slice(&part);
                    heard = Instant::now();
                }
                Ok(None) => return Ok(Some(numbers)),
                Err(RequestError::Silent { .. }) if heard.elapsed() < PATIENCE => {}
                Err(e) => return Err(e.into()),
            }
            if self.is_stopped() {
                answers.cancel();
                return Ok(None);
            }
        }
    }

    /// Why the server did not take the policy, if it did not.
    fn refusal(&mut self) -> Option<ServedError> {
        let receipt = self.link.wait_for_receipt(self.version, LOOK).ok()?;
        let (name, verdict, text) = (self.name.clone(), receipt.verdict(), receipt.text());
        (verdict != Verdict::Accepted).then_some(ServedError::Refused { name, verdict, text })
    }

    /// The segments in the order of their environments, whatever order they came in.
    fn read(&self, mut numbers: &[f64]) -> Result<Vec<Collected>, ServedError> {
        let broken = |what| ServedError::from(RequestError::Broken { name: self.name.clone(), what });
        let n_envs = self.training.n_envs as usize;
        let mut found: Vec<Option<Collected>> = vec![None; n_envs];
        while let [env, length, rest @ ..] = numbers {
            let cut = || broken(format!("a segment of {length} numbers where {} are left", rest.len()));
            let (segment, more) = rest.split_at_checked(*length as usize).ok_or_else(cut)?;
            let odd = || broken(format!("a segment of environment {env} that is none of this task"));
            let carried =
                Collected::read(segment, self.sizes, self.request.n_steps as usize).ok_or_else(odd)?;
            *found.get_mut(*env as usize).ok_or_else(odd)? = Some(carried);
            numbers = more;
        }
        let count = found.iter().flatten().count();
        let all: Option<Vec<Collected>> = found.into_iter().collect();
        all.ok_or_else(|| broken(format!("segments of {count} environments where there are {n_envs}")))
    }
}

impl Source for ServedSource {
    fn collect(&mut self, snapshot: &Snapshot) -> Result<bool, SourceError> {
        Ok(self.fill(snapshot)?)
    }

    fn gathered(&mut self) -> Vec<&Collected> {
        self.collected.iter().collect()
    }

    /// The episodes begin anew, with random streams that were not used before.
    fn restore(&mut self, from: &mut Checkpoint) -> Result<(), String> {
        self.training.stream = from.header.manifest.version * self.training.n_envs;
        from.tensors.retain(|name, _| !name.starts_with("env."));
        Ok(())
    }
}
