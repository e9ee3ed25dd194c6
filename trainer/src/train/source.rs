//! Where experience comes from: environments of this process or of a rollout server, or a running loop.

use super::ranked::RankedSource;
use super::served::{ServedError, ServedSource};
use crate::checkpoint::Checkpoint;
use crate::demos::Frames;
use crate::online::{LoopSource, OnlineError};
use crate::ranks::{RankError, Ranks};
use crate::rollout::{Collected, Collector, RolloutError, Scorer};
use crate::settings::TrainSettings;
use nearl_rollout_protocol::Layout;
use nearl_runtime::Snapshot;
use nearl_runtime::link::RobotName;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Why there is no more experience.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// Environments.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// A running loop.
    #[error(transparent)]
    Online(#[from] OnlineError),
    /// A rollout server.
    #[error(transparent)]
    Served(#[from] ServedError),
    /// The other ranks.
    #[error(transparent)]
    Ranks(#[from] RankError),
    /// What the ranks handed round.
    #[error("{0}")]
    Gathered(String),
}

/// What the user chose.
#[derive(Clone, Debug, Default)]
pub enum Experience {
    /// Environments of this process.
    #[default]
    Here,
    /// The same, but reward and end of a control period are somebody else's.
    Scored(Scorer),
    /// The running loop of this robot, until the flag is set.
    Loop(RobotName, Arc<AtomicBool>),
    /// The rollout server of this name, until the flag is set.
    Served(RobotName, Arc<AtomicBool>),
    /// Environments of this process, and of the other ranks of the training.
    Ranks(Arc<Ranks>),
}

/// A source of experience. A batch has `n_envs n_steps` rows, in any number of stretches in a fixed order.
pub trait Source: Send {
    /// Collects a batch with the networks of `snapshot`; false if a stop came first.
    ///
    /// # Errors
    /// [`SourceError`] in one sentence.
    fn collect(&mut self, snapshot: &Snapshot) -> Result<bool, SourceError>;
    /// Lets that share of the environments project while they collect, where they are of this process.
    fn project(&mut self, _share: f64) {}
    /// Lets that share of the episodes begin in one of the frames. With `tracked` the reward is how near they are followed, and an episode
    /// ends once a step is worth less than it. False where episodes begin elsewhere.
    fn begin_in(&mut self, _frames: &Arc<Frames>, _share: f64, _tracked: Option<f64>) -> bool {
        false
    }
    /// What was collected last.
    fn gathered(&mut self) -> Vec<&Collected>;
    /// Numbers of its own for the metrics.
    fn notes(&self) -> Vec<(&'static str, f64)> {
        Vec::new()
    }
    /// Saves the episodes under way, where they can go on.
    ///
    /// # Errors
    /// One sentence.
    fn save(&mut self, _to: &mut Checkpoint) -> Result<(), String> {
        Ok(())
    }
    /// Goes on with the episodes of a checkpoint; forgets those that cannot go on here.
    ///
    /// # Errors
    /// One sentence.
    fn restore(&mut self, from: &mut Checkpoint) -> Result<(), String> {
        from.tensors.retain(|name, _| !name.starts_with("env."));
        Ok(())
    }
}

impl Source for Collector {
    fn collect(&mut self, snapshot: &Snapshot) -> Result<bool, SourceError> {
        self.set_networks(&snapshot.networks);
        Collector::collect(self)?;
        Ok(true)
    }

    fn project(&mut self, share: f64) {
        let projecting = (share * self.workers().count() as f64).round() as usize;
        self.workers().enumerate().for_each(|(i, worker)| worker.set_projection(i < projecting));
    }

    fn begin_in(&mut self, frames: &Arc<Frames>, share: f64, tracked: Option<f64>) -> bool {
        self.workers().for_each(|worker| worker.begin_in(Arc::clone(frames), share, tracked));
        true
    }

    fn gathered(&mut self) -> Vec<&Collected> {
        self.workers().map(|w| &w.rows.collected).collect()
    }

    fn save(&mut self, to: &mut Checkpoint) -> Result<(), String> {
        self.workers().enumerate().try_for_each(|(i, worker)| worker.save(i, to))
    }

    fn restore(&mut self, from: &mut Checkpoint) -> Result<(), String> {
        let (have, need) = (from.header.workers.len(), self.workers().count());
        if have != need {
            return Err(format!("it has {have} environments where the task has {need}"));
        }
        self.workers().enumerate().try_for_each(|(i, worker)| worker.restore(i, from))
    }
}

impl Experience {
    /// Opens the source for the snapshot's task.
    ///
    /// # Errors
    /// [`SourceError`] in one sentence.
    pub(super) fn open(
        &self,
        snapshot: &Snapshot,
        sizes: Layout,
        settings: &TrainSettings,
        threads: usize,
        seed: u64,
    ) -> Result<Box<dyn Source>, SourceError> {
        match self {
            Self::Here | Self::Scored(_) => {
                let (n_envs, n_steps) = (settings.n_envs, settings.n_steps);
                let mut collector =
                    Collector::new(snapshot, 0..n_envs, n_steps, threads, settings.gamma, seed)?;
                for worker in collector.workers() {
                    worker.set_moved_penalty(settings.moved_penalty);
                    if let Self::Scored(scorer) = self {
                        worker.set_scorer(scorer.clone());
                    }
                }
                Ok(Box::new(collector))
            }
            Self::Loop(name, stop) => {
                Ok(Box::new(LoopSource::open(name, snapshot, settings, Arc::clone(stop))?))
            }
            Self::Ranks(ranks) => {
                let ranks = Arc::clone(ranks);
                Ok(Box::new(RankedSource::open(ranks, snapshot, sizes, settings, threads, seed)?))
            }
            Self::Served(name, stop) => {
                Ok(Box::new(ServedSource::open(name, settings, sizes, seed, Arc::clone(stop))?))
            }
        }
    }
}
