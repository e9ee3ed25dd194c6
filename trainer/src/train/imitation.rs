//! Demonstrations in a training: read and checked before it begins, then handed to the learner, normalised by the present statistics.

use super::{Source, TrainError};
use crate::demos::{DemoError, DemoReward, DemoSettings, Demonstrations};
use crate::learn::{Algorithm, Batch};
use crate::rollout::RolloutError;
use crate::settings::TrainSettings;
use crate::stats::RunningStats;
use nearl_runtime::Manifest;
use nearl_runtime::normaliser::Normaliser;
use std::path::Path;

/// What a training keeps of its demonstrations.
pub(super) struct Imitation {
    demos: Demonstrations,
    settings: DemoSettings,
    /// Observation index of each proposed entry.
    state: Vec<usize>,
    /// Batches of the warm-up, after the first.
    warm_ups: u64,
    /// Updates of the run, and steps of each.
    updates: u64,
    batch: u64,
    begins_in_frames: bool,
    /// Demonstrated actions are learned from.
    clones: bool,
}

/// Updates of a run of `steps` whose batches have `batch`, after `warm_ups` and the first.
fn updates(steps: u64, batch: u64, warm_ups: u64) -> u64 {
    (steps / batch).saturating_sub(warm_ups + 1)
}

impl Imitation {
    /// The demonstrations of an algorithm that learns from some; nothing of one that does not.
    ///
    /// # Errors
    /// [`TrainError`]: none where they are needed, some where they are of no use, or of another task.
    pub(super) fn read(
        algo: Algorithm,
        settings: &TrainSettings,
        manifest: &Manifest,
        state: &[usize],
        steps: u64,
        warm_ups: u64,
    ) -> Result<Option<Self>, TrainError> {
        let own = settings.demos.clone();
        let uses = match (algo.demos(), own.file.is_empty()) {
            (None, true) => return Ok(None),
            (None, false) => {
                return Err(TrainError::Settings(format!(
                    "[train.demos.file]: '{algo}' takes no demonstrations; give one of {} with --algo, or leave --demos out",
                    Algorithm::imitating()
                )));
            }
            (Some(_), true) => {
                return Err(TrainError::Settings(format!(
                    "'{algo}' learns from demonstrations and was given none; give a file with --demos ('nearl demos record RUN' writes one)"
                )));
            }
            (Some(uses), false) => uses,
        };
        if manifest.task.policy.as_ref().is_some_and(|policy| !policy.observation.is_empty()) {
            return Err(TrainError::Settings(format!(
                "'{algo}' learns from demonstrated observations, and [policy] of '{}' has its networks see something else, which no demonstrations hold; \
                 leave [policy] out, or train without demonstrations",
                manifest.task.name
            )));
        }
        let (word, those) = match own.reward {
            DemoReward::Task => ("task", None),
            DemoReward::Likeness => ("likeness", Some(Algorithm::taking(|uses| uses.likeness))),
            DemoReward::Tracking => ("tracking", Some(Algorithm::taking(|uses| uses.tracking))),
        };
        if let Some(those) = those.filter(|those| !those.contains(&algo.name())) {
            return Err(TrainError::Settings(format!(
                "[train.demos.reward]: \"{word}\" is for {}, and '{algo}' has no use for it; leave it out, or take one of these",
                listed(&those)
            )));
        }
        let wrong = |reason| TrainError::Demos(DemoError::Wrong { file: own.file.clone(), reason });
        let demos = Demonstrations::load(Path::new(&own.file))?.first(own.episodes).map_err(wrong)?;
        let task = &manifest.task;
        let mut env = crate::env::of_task(manifest, &task.name).map_err(RolloutError::from)?;
        demos.check(&mut *env, task.time.dt * task.time.policy_every as f64).map_err(wrong)?;
        let demos = demos.columns(&task.state.observation).map_err(wrong)?;
        if uses.needs_actions {
            check_actions(&demos).map_err(wrong)?;
        }
        let batch = (settings.n_envs * settings.n_steps) as u64;
        Ok(Some(Self {
            demos,
            settings: own,
            state: state.to_vec(),
            warm_ups,
            updates: updates(steps, batch, warm_ups),
            batch,
            begins_in_frames: uses.begins_there,
            clones: uses.needs_actions,
        }))
    }

    /// The run ends after `steps` in all.
    pub(super) fn extend(&mut self, steps: u64) {
        self.updates = updates(steps, self.batch, self.warm_ups);
    }

    /// Whether how near the demonstrations are followed is the reward.
    pub(super) fn is_tracked(&self) -> bool {
        self.settings.reward == DemoReward::Tracking
    }

    /// Lets episodes begin in the demonstrations' states, and be rewarded by how near they follow them if that is the reward.
    ///
    /// # Errors
    /// [`TrainError::Settings`] where the experience comes from elsewhere.
    pub(super) fn place(&self, source: &mut dyn Source) -> Result<(), TrainError> {
        let tracked = self.is_tracked().then_some(self.settings.stray);
        let resets = if self.begins_in_frames { self.settings.resets } else { 0.0 };
        if resets == 0.0 && tracked.is_none() {
            return Ok(());
        }
        if source.begin_in(&self.demos.frames(&self.state).into(), resets, tracked) {
            return Ok(());
        }
        let (key, what, next) = match tracked.is_some() {
            true => ("reward", "demonstrations can be tracked", "take another reward"),
            false => ("resets", "episodes can begin in demonstrated states", "set it to 0"),
        };
        Err(TrainError::Settings(format!(
            "[train.demos.{key}]: {what} in environments of this process alone; leave --from and --collect out, or {next}"
        )))
    }

    /// Adds what was demonstrated to the statistics of observations and of changes.
    pub(super) fn seed(&self, obs: &mut RunningStats, change: &mut RunningStats) {
        let width = self.demos.names.len();
        let mut step = vec![0.0; self.state.len()];
        for e in &self.demos.episodes {
            e.observations.chunks_exact(width).for_each(|row| _ = obs.push(row));
            for pair in e.observations.windows(2 * width).step_by(width) {
                let (now, next) = pair.split_at(width);
                step.iter_mut().zip(&self.state).for_each(|(step, &k)| *step = next[k] - now[k]);
                change.push(&step);
            }
        }
    }

    /// The transitions as rows of the networks.
    pub(super) fn batch(&self, normaliser: &Normaliser) -> Batch {
        self.demos.batch(normaliser, &self.state, self.settings.batch_size)
    }

    /// What a row of them weighs in the policy gradient after `iterations` of the training.
    pub(super) fn weight(&self, iterations: u64) -> f64 {
        self.settings.weight(iterations.saturating_sub(self.warm_ups + 1), self.updates)
    }

    /// Whether the demonstrations alone are learned from once `iterations` are done.
    pub(super) fn pretrains(&self, iterations: u64) -> bool {
        iterations == self.warm_ups + 1
    }

    /// Whether networks are carried over to the statistics of these iterations: those of the first are no longer of unit 1.
    pub(super) fn carries(iterations: u64) -> bool {
        iterations > 1
    }

    /// What tells these demonstrations from others: a sum over every number in them that is learned from.
    pub(super) fn fingerprint(&self) -> f64 {
        let mut hash = crc32fast::Hasher::new();
        for e in &self.demos.episodes {
            let actions = if self.clones { &e.actions[..] } else { &[] };
            for list in [&e.observations, &e.qpos, &e.qvel, actions] {
                list.iter().for_each(|x| hash.update(&x.to_le_bytes()));
            }
        }
        f64::from(hash.finalize())
    }

    /// The file, for messages.
    pub(super) fn file(&self) -> &str {
        &self.settings.file
    }
}

/// `a`, `a and b`, `a, b and c`.
fn listed(names: &[&str]) -> String {
    match names.split_last() {
        Some((last, [])) => (*last).into(),
        Some((last, others)) => format!("{} and {last}", others.join(", ")),
        None => String::new(),
    }
}

/// Every episode has actions.
fn check_actions(demos: &Demonstrations) -> Result<(), String> {
    for (i, e) in demos.episodes.iter().enumerate() {
        if e.actions.is_empty() {
            return Err(format!(
                "episode {i} has no 'actions', which dapg clones; record them with 'nearl demos record', or take soil or pid2-il, which need none"
            ));
        }
    }
    Ok(())
}
