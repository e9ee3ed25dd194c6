//! A training in its run folder: rows of metrics, checkpoints on the way, the snapshot at the end.

use super::{Experience, Progress, Request, TrainError, Training};
use crate::checkpoint::{self, Checkpoint};
use crate::run_folder::{self, RunFolder};
use std::path::{Path, PathBuf};

/// Trains to the end in a new run folder; `report` sees each iteration and may stop the training by returning `false`.
///
/// # Errors
/// [`TrainError`].
pub fn train(
    request: &Request,
    out: &Path,
    report: impl FnMut(&Progress, f64) -> bool,
) -> Result<PathBuf, TrainError> {
    train_on(request, &Experience::Here, out, report)
}

/// [`train`] with experience from elsewhere.
///
/// # Errors
/// [`TrainError`].
pub fn train_on(
    request: &Request,
    experience: &Experience,
    out: &Path,
    report: impl FnMut(&Progress, f64) -> bool,
) -> Result<PathBuf, TrainError> {
    train_in(out, Training::on(request, experience)?, report)
}

/// [`train`] with a training that has been made already.
///
/// # Errors
/// [`TrainError`].
pub fn train_in(
    out: &Path,
    training: Training,
    report: impl FnMut(&Progress, f64) -> bool,
) -> Result<PathBuf, TrainError> {
    let (manifest, columns) = (&training.snapshot().manifest, training.columns());
    let folder = RunFolder::create(out, manifest, training.seed, &columns, training.origin())?;
    run(training, folder, report)
}

/// Goes on where the run in folder `run` stopped, with the settings it was started with, as if it had not stopped: weights
/// and metrics are the same bit for bit (but the columns of time), whatever the threads. Other `steps` than at first change
/// the schedule of the learning rate from here on.
///
/// # Errors
/// [`TrainError`]; a damaged or foreign checkpoint, or a `metrics.csv` that lacks rows, is refused in one sentence.
pub fn resume(
    path: &Path,
    steps: Option<u64>,
    threads: usize,
    report: impl FnMut(&Progress, f64) -> bool,
) -> Result<PathBuf, TrainError> {
    resume_on(path, &Experience::Here, steps, threads, report)
}

/// [`resume`] with experience from elsewhere: weights, statistics and schedule go on, episodes begin anew.
///
/// # Errors
/// [`TrainError`].
pub fn resume_on(
    path: &Path,
    experience: &Experience,
    steps: Option<u64>,
    threads: usize,
    report: impl FnMut(&Progress, f64) -> bool,
) -> Result<PathBuf, TrainError> {
    let held = run_folder::lock(path)?;
    let file = checkpoint::path_in(path);
    let training = Training::resume_on(Checkpoint::load(&file)?, &file, experience, steps, threads)?;
    let manifest = &training.snapshot().manifest;
    if let Some(asked) = steps.filter(|asked| *asked < manifest.steps) {
        return Err(TrainError::Settings(format!(
            "--steps: {asked}, but '{}' has {} steps already; give the steps of the whole run, or leave it out",
            path.display(),
            manifest.steps
        )));
    }
    let last = path.join("checkpoints").join("final.safetensors");
    if training.is_done() && last.is_file() {
        return Ok(last);
    }
    let folder = RunFolder::reopen(path, held, &training.columns(), manifest.steps, manifest.version)?;
    run(training, folder, report)
}

fn run(
    mut training: Training,
    mut folder: RunFolder,
    mut report: impl FnMut(&Progress, f64) -> bool,
) -> Result<PathBuf, TrainError> {
    while !training.is_done() {
        let Some(progress) = training.iterate_in(&mut folder)? else { break };
        if !report(&progress, training.fraction()) {
            break;
        }
    }
    training.save(&mut folder)
}

impl Training {
    /// [`Training::try_iterate`], its row in the run folder, and a checkpoint after the first batch and where one is due on the way; at the end it is the
    /// caller's to [`save`](Training::save). What was learned is kept when it fails.
    ///
    /// # Errors
    /// [`TrainError`].
    pub fn iterate_in(&mut self, folder: &mut RunFolder) -> Result<Option<Progress>, TrainError> {
        let progress = match self.try_iterate() {
            Ok(Some(progress)) => progress,
            Ok(None) => return Ok(None),
            Err(e @ TrainError::Diverged { .. }) => {
                let name = format!("step_{}", self.snapshot().manifest.steps);
                folder.keep(&name, self.snapshot())?;
                let file = folder.path().join("checkpoints").join(name);
                return Err(TrainError::Settings(format!(
                    "{e}; '{}.safetensors' is of before",
                    file.display()
                )));
            }
            Err(e) => {
                if self.snapshot().manifest.version > 0
                    && let Err(unsaved) = self.save(folder)
                {
                    return Err(TrainError::Settings(format!("{e}; besides, {unsaved}")));
                }
                return Err(e);
            }
        };
        folder.row(&self.row(&progress))?;
        let kept = [
            (self.is_best, "best".to_string()),
            (self.passed(self.settings.save_every), format!("step_{}", progress.steps)),
        ];
        for (_, name) in kept.into_iter().filter(|(due, _)| *due) {
            folder.keep(&name, self.snapshot())?;
        }
        let is_first = self.snapshot().manifest.version == 1;
        if !self.is_done() && (is_first || folder.is_due(progress.steps, self.total)) {
            self.save(folder)?;
        }
        Ok(Some(progress))
    }
}
