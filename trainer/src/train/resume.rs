//! Writes a training to a checkpoint, and goes on from one.

use super::{Experience, Request, TrainError, Training};
use crate::checkpoint::{self, Checkpoint, CheckpointError, FORMAT, Header, Values};
use crate::learn::Params;
use crate::run_folder::RunFolder;
use crate::stats::RunningStats;
use nearl_runtime::net::kernel::{LANES, V, scalars, scalars_mut};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Margins of `[constraints] reached`.
pub(super) const MARGINS: &str = "margins";

impl Training {
    /// Everything the next iteration depends on.
    ///
    /// # Errors
    /// One sentence.
    pub fn checkpoint(&mut self) -> Result<Checkpoint, String> {
        let rng = u64::try_from(self.rng.get_word_pos()).map_err(|e| format!("random stream: {e}"))?;
        let params = self.learner.params();
        let header = Header {
            format: FORMAT,
            manifest: self.snapshot.manifest.clone(),
            total: self.total,
            seed: self.seed,
            rng,
            adam: params.adam.iter().map(|a| a.t).collect(),
            workers: Vec::new(),
            is_scored_elsewhere: self.scorer.is_some(),
            starts_warm: self.starts_warm,
        };
        let mut to = Checkpoint { header, tensors: BTreeMap::new() };
        let mut put = |name: String, values: Values| to.tensors.insert(name, values);
        for (i, group) in params.groups.iter().enumerate() {
            put(format!("group.{i}"), f32s(&group.p));
        }
        for (i, adam) in params.adam.iter().enumerate() {
            put(format!("adam.{i}.m"), f32s(&adam.m));
            put(format!("adam.{i}.v"), f32s(&adam.v));
        }
        put("beta".into(), Values::F32(vec![params.beta]));
        put("adapted".into(), Values::F32(vec![params.adapted]));
        put("stats.obs".into(), Values::F64(self.obs_stats.to_vec()));
        if self.dims.n_privileged > 0 {
            put("stats.privileged".into(), Values::F64(self.privileged_stats.to_vec()));
        }
        put("stats.change".into(), Values::F64(self.change_stats.to_vec()));
        put("stats.return".into(), Values::F64(self.return_stats.to_vec()));
        if self.settings.cost.is_limited() {
            put("stats.cost".into(), Values::F64(self.cost_stats.to_vec()));
        }
        let recent = self.recent.iter().flat_map(|&(r, n)| [r, n as f64]).collect();
        put("recent".into(), Values::F64(recent));
        put("recent_costs".into(), Values::F64(self.recent_costs.clone()));
        put("best".into(), Values::F64(self.best.into_iter().collect()));
        if !self.snapshot.networks.margins.is_empty() {
            put(MARGINS.into(), Values::F64(self.snapshot.networks.margins.clone()));
        }
        put("seconds".into(), Values::F64(vec![self.seconds()]));
        if let Some(imitation) = &self.imitation {
            put("demos".into(), Values::F64(vec![imitation.fingerprint()]));
        }
        self.source.save(&mut to)?;
        Ok(to)
    }

    /// The training of a checkpoint; `file` is named in messages. `steps` other than the checkpoint's change its end.
    ///
    /// # Errors
    /// [`TrainError`]: what [`Training::new`] refuses, or a checkpoint that does not fit its own task.
    pub fn resume(
        from: Checkpoint,
        file: &Path,
        steps: Option<u64>,
        threads: usize,
    ) -> Result<Self, TrainError> {
        Self::resume_on(from, file, &Experience::Here, steps, threads)
    }

    /// The same with experience from elsewhere: the episodes under way are forgotten.
    ///
    /// # Errors
    /// As [`Training::resume`].
    pub fn resume_on(
        mut from: Checkpoint,
        file: &Path,
        experience: &Experience,
        steps: Option<u64>,
        threads: usize,
    ) -> Result<Self, TrainError> {
        let header = &from.header;
        if header.is_scored_elsewhere && !matches!(experience, Experience::Scored(_)) {
            return Err(TrainError::Settings(format!(
                "the training in '{}' has its reward or its termination from Python functions, which no file holds; go on in Python with \
                 nearl.PID2.load(run, reward=..., termination=...)",
                file.display()
            )));
        }
        let request = Request {
            manifest: header.manifest.clone(),
            algo: header.manifest.algo.parse().map_err(TrainError::Algorithm)?,
            steps: steps.unwrap_or(header.total),
            seed: header.seed,
            threads,
        };
        let mut training = Self::on(&request, experience)?;
        let foreign = |reason| CheckpointError::Foreign { file: file.display().to_string(), reason };
        training.restore(&mut from).map_err(foreign)?;
        Ok(training)
    }

    fn restore(&mut self, from: &mut Checkpoint) -> Result<(), String> {
        self.learner.restore(&mut |params| restore_params(params, from))?;
        take_statistics(self, from)?;
        if self.settings.cost.is_limited() {
            let n = self.cost_stats.to_vec().len();
            self.cost_stats.set(&from.take_f64("stats.cost", Some(n))?);
        }
        self.best = from.take_f64("best", None)?.first().copied();
        self.recent_costs = from.take_f64("recent_costs", None)?;
        let recent = from.take_f64("recent", None)?;
        self.recent = recent.as_chunks::<2>().0.iter().map(|&[r, n]| (r, n as usize)).collect();
        self.earlier = from.take_f64("seconds", Some(1))?[0];
        if let Some(imitation) = &self.imitation
            && from.take_f64("demos", Some(1))? != [imitation.fingerprint()]
        {
            let file = imitation.file();
            return Err(format!("it learned from other demonstrations than '{file}' holds now"));
        }
        self.rng.set_word_pos(from.header.rng.into());
        if from.header.starts_warm {
            (self.warm_ups, self.starts_warm) = (0, true);
        }
        let n = self.snapshot.networks.margins.len();
        if n > 0 {
            self.snapshot.networks.margins = from.take_f64(MARGINS, Some(n))?;
        }
        self.source.restore(from)?;
        if let Some(name) = from.tensors.keys().next() {
            return Err(format!("tensor '{name}' belongs to nothing"));
        }
        if self.snapshot.manifest.steps > 0 {
            let normaliser = self.normaliser();
            self.renew(&normaliser);
        }
        Ok(())
    }

    /// Writes the snapshot (`final` when the steps are done, else `latest`) and the checkpoint; returns the snapshot's path.
    ///
    /// # Errors
    /// [`TrainError`] with what the system said.
    pub fn save(&mut self, folder: &mut RunFolder) -> Result<PathBuf, TrainError> {
        let name = if self.is_done() { "final" } else { "latest" };
        // The checkpoint first: from it the snapshot can be written again, should this end here.
        self.checkpoint().map_err(TrainError::Settings)?.save(&checkpoint::path_in(folder.path()))?;
        Ok(folder.save(name, self.snapshot())?)
    }
}

fn f32s(p: &[V]) -> Values {
    Values::F32(scalars(p).to_vec())
}

/// Takes the statistics of what was seen.
pub(super) fn take_statistics(to: &mut Training, from: &mut Checkpoint) -> Result<(), String> {
    let mut take = |name: &str, stats: &mut RunningStats| -> Result<(), String> {
        let n = stats.to_vec().len();
        stats.set(&from.take_f64(name, Some(n))?);
        Ok(())
    };
    take("stats.obs", &mut to.obs_stats)?;
    take("stats.change", &mut to.change_stats)?;
    take("stats.return", &mut to.return_stats)?;
    if to.dims.n_privileged > 0 {
        take("stats.privileged", &mut to.privileged_stats)?;
    }
    Ok(())
}

/// Takes the weights of the `n`-th group.
pub(super) fn take_group(params: &mut Params, n: usize, from: &mut Checkpoint) -> Result<(), String> {
    let to = &mut params.groups[n].p;
    let values = from.take_f32(&format!("group.{n}"), to.len() * LANES)?;
    scalars_mut(to).copy_from_slice(&values);
    Ok(())
}

fn restore_params(params: &mut Params, from: &mut Checkpoint) -> Result<(), String> {
    (0..params.groups.len()).try_for_each(|n| take_group(params, n, from))?;
    let mut fill = |name: String, to: &mut [V]| -> Result<(), String> {
        let values = from.take_f32(&name, to.len() * LANES)?;
        scalars_mut(to).copy_from_slice(&values);
        Ok(())
    };
    for (i, adam) in params.adam.iter_mut().enumerate() {
        fill(format!("adam.{i}.m"), &mut adam.m)?;
        fill(format!("adam.{i}.v"), &mut adam.v)?;
    }
    params.beta = from.take_f32("beta", 1)?[0];
    params.adapted = from.take_f32("adapted", 1)?[0];
    let (have, need) = (from.header.adam.len(), params.adam.len());
    if have != need {
        return Err(format!("it has {have} optimisers where the algorithm has {need}"));
    }
    params.adam.iter_mut().zip(&from.header.adam).for_each(|(adam, t)| adam.t = *t);
    Ok(())
}
