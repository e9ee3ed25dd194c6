//! Experience of a training on several ranks: environments of this process, and what those of the other ranks gave.
//!
//! Environment `i` of a training has the random stream `i` of its seed, whichever rank simulates it. What a rank hands to the others is a
//! checkpoint of its environments with what they collected. So each rank can save all episodes, also when another one is lost.

use super::source::{Source, SourceError};
use crate::checkpoint::{Checkpoint, FORMAT, Header, Values, WorkerHeader};
use crate::demos::Frames;
use crate::ranks::{RankError, Ranks};
use crate::rollout::{Collected, Collector};
use crate::settings::TrainSettings;
use nearl_rollout_protocol::Layout;
use nearl_runtime::Snapshot;
use std::collections::BTreeMap;
use std::sync::Arc;

/// A rank's environments, and what all ranks collected.
pub struct RankedSource {
    ranks: Arc<Ranks>,
    collector: Collector,
    sizes: Layout,
    n_envs: usize,
    n_steps: usize,
    seed: u64,
    collected: Vec<Collected>,
    /// The episodes of all ranks as they were after the last batch.
    workers: Vec<WorkerHeader>,
    episodes: BTreeMap<String, Values>,
}

impl RankedSource {
    /// Makes the environments of this rank.
    ///
    /// # Errors
    /// [`RankError::Environments`], or what keeps environments from being made.
    pub fn open(
        ranks: Arc<Ranks>,
        snapshot: &Snapshot,
        sizes: Layout,
        settings: &TrainSettings,
        threads: usize,
        seed: u64,
    ) -> Result<Self, SourceError> {
        let (n_envs, n_steps) = (settings.n_envs, settings.n_steps);
        if n_envs < ranks.size() {
            return Err(RankError::Environments { n_envs, size: ranks.size() }.into());
        }
        let own = ranks.part(ranks.rank(), n_envs);
        let mut collector = Collector::new(snapshot, own, n_steps, threads, settings.gamma, seed)?;
        collector.workers().for_each(|worker| worker.set_moved_penalty(settings.moved_penalty));
        let (collected, workers, episodes) = (Vec::new(), Vec::new(), BTreeMap::new());
        Ok(Self { ranks, collector, sizes, n_envs, n_steps, seed, collected, workers, episodes })
    }

    /// First environment of this rank.
    fn first(&self) -> usize {
        self.ranks.part(self.ranks.rank(), self.n_envs).start
    }

    /// What this rank hands to the others: its episodes, what they gave, and what it learns.
    fn message(&mut self, snapshot: &Snapshot) -> Result<Vec<u8>, String> {
        let first = self.first();
        let mut message = Checkpoint { header: self.header(snapshot), tensors: BTreeMap::new() };
        let digest = snapshot.digest().bytes().map(f32::from).collect();
        message.tensors.insert("digest".into(), Values::F32(digest));
        for (i, worker) in self.collector.workers().enumerate() {
            worker.save(first + i, &mut message)?;
            let mut numbers = Vec::new();
            worker.rows.collected.carry(&mut numbers);
            message.tensors.insert(format!("collected.{}", first + i), Values::F64(numbers));
        }
        Ok(message.to_bytes())
    }

    /// Takes in what the ranks handed round; all of it is this rank's when it returns.
    fn take_in(&mut self, snapshot: &Snapshot, messages: &[Vec<u8>]) -> Result<(), String> {
        let (mut collected, mut workers, mut episodes) = (Vec::new(), Vec::new(), BTreeMap::new());
        let digest: Vec<f32> = snapshot.digest().bytes().map(f32::from).collect();
        for (rank, bytes) in messages.iter().enumerate() {
            let mut message = Checkpoint::from_bytes(&format!("of rank {rank}"), bytes)
                .map_err(|e| format!("rank {rank} sent what is no part of a batch: {e}"))?;
            if let Some(what) = difference(&words(&self.header(snapshot)), &words(&message.header)) {
                return Err(self.different(rank, what));
            }
            if message.take_f32("digest", digest.len())? != digest {
                let what =
                    format!("after {} steps their policies have other weights", snapshot.manifest.steps);
                return Err(self.different(rank, what));
            }
            for i in self.ranks.part(rank, self.n_envs) {
                let numbers = message.take_f64(&format!("collected.{i}"), None)?;
                let rows = Collected::read(&numbers, self.sizes, self.n_steps);
                collected.push(rows.ok_or_else(|| format!("rank {rank} sent odd rows of environment {i}"))?);
            }
            workers.append(&mut message.header.workers);
            episodes.append(&mut message.tensors);
        }
        (self.collected, self.workers, self.episodes) = (collected, workers, episodes);
        Ok(())
    }

    /// What this rank is doing.
    fn header(&self, snapshot: &Snapshot) -> Header {
        let (manifest, seed) = (snapshot.manifest.clone(), self.seed);
        let (adam, workers) = (Vec::new(), Vec::new());
        Header {
            format: FORMAT,
            manifest,
            total: 0,
            seed,
            rng: 0,
            adam,
            workers,
            is_scored_elsewhere: false,
            starts_warm: false,
        }
    }

    fn different(&self, other: usize, what: String) -> String {
        RankError::Different { rank: self.ranks.rank(), other, what }.to_string()
    }
}

/// What must be the same on all ranks, with a name for each.
fn words(header: &Header) -> Vec<(&'static str, String)> {
    let m = &header.manifest;
    let task = serde_json::to_string(&m.task).unwrap_or_else(|e| unreachable!("a task as JSON: {e}"));
    let robot = serde_json::to_string(&m.robot).unwrap_or_else(|e| unreachable!("a robot as JSON: {e}"));
    vec![
        ("task", m.task.name.clone()),
        ("algorithm", m.algo.clone()),
        ("seed", header.seed.to_string()),
        ("steps so far", m.steps.to_string()),
        ("settings", task),
        ("robot", robot),
    ]
}

/// The first difference of two ranks.
fn difference(here: &[(&'static str, String)], there: &[(&'static str, String)]) -> Option<String> {
    let ((name, here), (_, there)) = here.iter().zip(there).find(|(here, there)| here != there)?;
    let at = here.bytes().zip(there.bytes()).take_while(|(a, b)| a == b).count();
    let about = |text: &str| -> String { text.chars().skip(at.saturating_sub(40)).take(80).collect() };
    Some(format!("their {name} differ, '{}' and '{}'", about(here), about(there)))
}

impl Source for RankedSource {
    fn collect(&mut self, snapshot: &Snapshot) -> Result<bool, SourceError> {
        let steps = snapshot.manifest.steps;
        self.ranks.check(steps)?;
        self.collector.set_networks(&snapshot.networks);
        self.collector.collect()?;
        let message = self.message(snapshot).map_err(SourceError::Gathered)?;
        let messages = self.ranks.uneven(&message);
        self.ranks.check(steps)?;
        self.take_in(snapshot, &messages.unwrap_or_default()).map_err(SourceError::Gathered)?;
        Ok(true)
    }

    fn project(&mut self, share: f64) {
        let (projecting, first) = ((share * self.n_envs as f64).round() as usize, self.first());
        let workers = self.collector.workers().enumerate();
        workers.for_each(|(i, worker)| worker.set_projection(first + i < projecting));
    }

    fn begin_in(&mut self, frames: &Arc<Frames>, share: f64, tracked: Option<f64>) -> bool {
        self.collector.begin_in(frames, share, tracked)
    }

    fn gathered(&mut self) -> Vec<&Collected> {
        self.collected.iter().collect()
    }

    fn save(&mut self, to: &mut Checkpoint) -> Result<(), String> {
        to.header.workers.clone_from(&self.workers);
        to.tensors.extend(self.episodes.clone());
        Ok(())
    }

    fn restore(&mut self, from: &mut Checkpoint) -> Result<(), String> {
        let (have, need) = (from.header.workers.len(), self.n_envs);
        if have != need {
            return Err(format!("it has {have} environments where the task has {need}"));
        }
        self.workers.clone_from(&from.header.workers);
        let of_envs = from.tensors.iter().filter(|(name, _)| name.starts_with("env."));
        self.episodes = of_envs.map(|(name, values)| (name.clone(), values.clone())).collect();
        let first = self.first();
        let mut workers = self.collector.workers().enumerate();
        workers.try_for_each(|(i, worker)| worker.restore(first + i, from))?;
        from.tensors.retain(|name, _| !name.starts_with("env."));
        Ok(())
    }
}
