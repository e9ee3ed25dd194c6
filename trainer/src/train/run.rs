//! A training in its run folder: rows of metrics, checkpoints on the way, the snapshot at the end.

use super::{COLUMNS, Experience, Progress, Request, TrainError, Training};
use crate::checkpoint::{self, Checkpoint};
use crate::run_folder::{self, RunFolder};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Seconds after which a checkpoint is written even if a tenth of the run is not done.
const SAVE_SECONDS: f64 = 120.0;

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
    let training = Training::on(request, experience)?;
    let folder = RunFolder::create(out, &training.snapshot().manifest, request.seed, COLUMNS)?;
    let _held = run_folder::lock(out)?;
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
    let _held = run_folder::lock(path)?;
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
    if let (true, Ok(snapshot)) = (training.is_done(), run_folder::snapshot_of(path)) {
        return Ok(snapshot);
    }
    let folder = RunFolder::reopen(path, COLUMNS, manifest.steps, manifest.version)?;
    run(training, folder, report)
}

fn run(
    mut training: Training,
    mut folder: RunFolder,
    mut report: impl FnMut(&Progress, f64) -> bool,
) -> Result<PathBuf, TrainError> {
    let every = (training.total / 10).max(1);
    let (mut next_save, mut saved) = (every, Instant::now());
    let mut go_on = true;
    while go_on && !training.is_done() {
        let progress = match training.step() {
            Ok(Some(progress)) => progress,
            Ok(None) => break,
            Err(e) => {
                // What was learned is kept; the reason is what the caller hears.
                training.save(&folder)?;
                return Err(e);
            }
        };
        folder.row(&training.row(&progress))?;
        go_on = report(&progress, training.fraction());
        if progress.steps >= next_save || saved.elapsed().as_secs_f64() > SAVE_SECONDS {
            training.save(&folder)?;
            next_save = (progress.steps / every + 1) * every;
            saved = Instant::now();
        }
    }
    training.save(&folder)
}
