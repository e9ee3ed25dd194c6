//! Where experience comes from: environments of this process or of a rollout server, or a running loop.

use super::served::{ServedError, ServedSource};
use crate::checkpoint::Checkpoint;
use crate::online::{LoopSource, OnlineError};
use crate::rollout::{Carried, Collector, RolloutError, Rows, Segment, Tally};
use crate::settings::TrainSettings;
use crate::stats::RunningStats;
use nearl_runtime::Snapshot;
use nearl_runtime::link::RobotName;
use nearl_runtime::rollout_protocol::Layout;
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
}

/// What the user chose.
#[derive(Clone, Debug, Default)]
pub enum Experience {
    /// Environments of this process.
    #[default]
    Here,
    /// The running loop of this robot, until the flag is set.
    Loop(RobotName, Arc<AtomicBool>),
    /// The rollout server of this name, until the flag is set.
    Served(RobotName, Arc<AtomicBool>),
}

/// One stretch of experience with its statistics.
pub struct Gathered<'a> {
    /// Rows.
    pub segment: &'a Segment,
    /// Counts.
    pub tally: &'a Tally,
    /// Raw observations.
    pub obs_stats: &'a RunningStats,
    /// Changes of the proposed state.
    pub change_stats: &'a RunningStats,
    /// Discounted returns.
    pub return_stats: &'a RunningStats,
}

impl<'a> Gathered<'a> {
    /// What a rollout server collected.
    pub fn of_carried(carried: &'a Carried) -> Self {
        let Carried { segment, tally, obs_stats, change_stats, return_stats } = carried;
        Self { segment, tally, obs_stats, change_stats, return_stats }
    }

    /// What was collected in a running loop.
    pub fn of_rows(rows: &'a Rows) -> Self {
        Self {
            segment: &rows.segment,
            tally: &rows.tally,
            obs_stats: &rows.obs_stats,
            change_stats: &rows.change_stats,
            return_stats: &rows.return_stats,
        }
    }
}

/// A source of experience. A batch has `n_envs n_steps` rows, in any number of stretches in a fixed order.
pub trait Source: Send {
    /// Collects a batch with the networks of `snapshot`; false if a stop came first.
    ///
    /// # Errors
    /// [`SourceError`] in one sentence.
    fn collect(&mut self, snapshot: &Snapshot) -> Result<bool, SourceError>;
    /// What was collected last.
    fn gathered(&mut self) -> Vec<Gathered<'_>>;
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
        Collector::collect(self);
        Ok(true)
    }

    fn gathered(&mut self) -> Vec<Gathered<'_>> {
        self.workers()
            .map(|w| Gathered {
                segment: &w.segment,
                tally: &w.tally,
                obs_stats: &w.obs_stats,
                change_stats: &w.change_stats,
                return_stats: &w.return_stats,
            })
            .collect()
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
            Self::Here => {
                let (n_envs, n_steps) = (settings.n_envs, settings.n_steps);
                let mut collector = Collector::new(snapshot, n_envs, n_steps, threads, settings.gamma, seed)?;
                for worker in collector.workers() {
                    worker.set_projection(settings.project_in_training);
                    worker.set_moved_penalty(settings.moved_penalty);
                }
                Ok(Box::new(collector))
            }
            Self::Loop(name, stop) => {
                Ok(Box::new(LoopSource::open(name, snapshot, settings, Arc::clone(stop))?))
            }
            Self::Served(name, stop) => {
                Ok(Box::new(ServedSource::open(name, settings, sizes, seed, Arc::clone(stop))?))
            }
        }
    }
}
