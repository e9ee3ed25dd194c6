//! `nearl sweep`: tasks x algorithms x seeds, one worker process a run, as many at a time as there are cores.
//!
//! A run lies in `<out>/<task>/<algo>_<seed>`. One that is finished with the same task file and steps is left alone, one that
//! was broken off goes on from its checkpoint, or is begun anew where it has none. Whatever else is there is refused before
//! anything starts, and nothing is ever removed but the metrics of a run that never reached a checkpoint.

mod summary;
mod worker;

use std::fs::File;
use std::path::{Path, PathBuf};

use crate::checkpoint::{self, Checkpoint};
use crate::learn::Algorithm;
use crate::preset::Preset;
use crate::run_folder::{self, RunError};
use crate::settings::TrainSettings;
use crate::tasks::{self, TaskLoadError};
use crate::train::{TrainError, complete};
use nearl_runtime::Manifest;

pub use summary::{Row, Summary};
pub use worker::{Event, run};

/// What to sweep over.
#[derive(Clone, Debug)]
pub struct Sweep {
    /// Task names or files.
    pub tasks: Vec<String>,
    /// Algorithms.
    pub algos: Vec<Algorithm>,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// Environment steps of each run.
    pub steps: u64,
    /// Folder of all runs.
    pub out: PathBuf,
    /// Settings by name, before `set`.
    pub preset: Option<Preset>,
    /// Overrides of every task file.
    pub set: Vec<String>,
}

/// One training of a sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// Task as given.
    pub task: String,
    /// Name in the task file.
    pub name: String,
    /// Algorithm.
    pub algo: Algorithm,
    /// Seed.
    pub seed: u64,
    /// Run folder.
    pub folder: PathBuf,
    /// What is there already.
    pub found: Found,
}

/// What a sweep finds in a run folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Found {
    /// Nothing.
    Nothing,
    /// A run that was broken off before its first checkpoint.
    Broken,
    /// A run that was broken off and can go on.
    Resumable,
    /// A run with all its steps.
    Finished,
}

/// Why a sweep cannot start.
#[derive(Debug, thiserror::Error)]
pub enum SweepError {
    /// A task.
    #[error(transparent)]
    Task(#[from] TaskLoadError),
    /// Its environment.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A list with nothing in it, or with something twice.
    #[error("{0}")]
    List(String),
    /// Something else is where a run should lie.
    #[error("'{path}' holds {what}; give another --out, or move it away")]
    Other {
        /// Run folder.
        path: String,
        /// What is there.
        what: String,
    },
    /// The run folder itself.
    #[error(transparent)]
    Folder(#[from] RunError),
    /// The folder.
    #[error("cannot write '{path}': {reason}; give another folder with --out")]
    Write {
        /// Folder or file.
        path: String,
        /// What the system said.
        reason: String,
    },
    /// Another sweep works there.
    #[error("another sweep is at work in '{path}'; wait for it or give another folder with --out")]
    Busy {
        /// Folder.
        path: String,
    },
}

impl Sweep {
    /// Every run with what is already there, seed by seed, so that a sweep cut short has all tasks and algorithms.
    ///
    /// # Errors
    /// [`SweepError`]: everything that can be wrong before hours are spent.
    pub fn plan(&self) -> Result<Vec<Run>, SweepError> {
        for (what, n) in
            [("task", self.tasks.len()), ("algorithm", self.algos.len()), ("seed", self.seeds.len())]
        {
            if n == 0 {
                return Err(SweepError::List(format!("a sweep needs at least one {what}")));
            }
        }
        let mut files = Vec::new();
        for task in &self.tasks {
            let mut manifest = tasks::load_with(task, self.preset, &self.set)?;
            complete(&mut manifest)?;
            // A key that nobody reads is told before it makes of every run another one.
            TrainSettings::read(&manifest.task.train).map_err(TrainError::Settings)?;
            let text = run_folder::task_file(&manifest).0;
            files.push((task, text, manifest));
        }
        let mut runs: Vec<Run> = Vec::new();
        for &seed in &self.seeds {
            for (task, text, manifest) in &files {
                let name = &manifest.task.name;
                for &algo in &self.algos {
                    let folder = self.out.join(name).join(format!("{algo}_{seed}"));
                    if runs.iter().any(|r| r.folder == folder) {
                        return Err(SweepError::List(format!(
                            "{name}, {algo}, seed {seed} is asked for twice"
                        )));
                    }
                    let found = self.found(&folder, text, manifest)?;
                    runs.push(Run { task: (*task).clone(), name: name.clone(), algo, seed, folder, found });
                }
            }
        }
        Ok(runs)
    }

    fn found(&self, folder: &Path, task: &str, manifest: &Manifest) -> Result<Found, SweepError> {
        if !folder.exists() {
            return Ok(Found::Nothing);
        }
        drop(run_folder::lock(folder)?);
        let other = |what: String| Err(SweepError::Other { path: folder.display().to_string(), what });
        match std::fs::read_to_string(folder.join("task.toml")) {
            Ok(text) if text != task => {
                return other("a run of another task file or of other settings (--set)".into());
            }
            Ok(_) => {}
            Err(_) if is_empty(folder) => return Ok(Found::Nothing),
            Err(_) => return other("no run: it has no task.toml".into()),
        }
        let checkpoint = checkpoint::path_in(folder);
        if !run_folder::has_checkpoint(folder) {
            return Ok(Found::Broken);
        }
        let file = checkpoint.display().to_string();
        let Ok(Checkpoint { header, .. }) = Checkpoint::load(&checkpoint) else {
            return other(format!("a run whose checkpoint '{file}' cannot be read"));
        };
        if !run_folder::is_same_robot(&header.manifest, manifest) {
            return other("a run of another robot, or of a robot file that was changed since".into());
        }
        // The learning rate's schedule depends on the steps, so that a run of others is another run.
        let (done, total) = (header.manifest.steps, header.total);
        if total != self.steps {
            return other(format!(
                "a run of {total} steps, {done} of them done, where {} are asked for",
                self.steps
            ));
        }
        let is_whole = folder.join("checkpoints/final.safetensors").is_file();
        Ok(if done >= total && is_whole { Found::Finished } else { Found::Resumable })
    }

    /// Holds the folder until the file is dropped.
    ///
    /// # Errors
    /// [`SweepError::Busy`], [`SweepError::Write`].
    pub fn lock(&self) -> Result<File, SweepError> {
        let path = self.out.join("sweep.lock");
        let write =
            |e: std::io::Error| SweepError::Write { path: path.display().to_string(), reason: e.to_string() };
        std::fs::create_dir_all(&self.out).map_err(write)?;
        let file = File::create(&path).map_err(write)?;
        match run_folder::is_ours(&file).map_err(write)? {
            true => Ok(file),
            false => Err(SweepError::Busy { path: self.out.display().to_string() }),
        }
    }
}

/// Nothing in it but what a run makes before its task file.
fn is_empty(folder: &Path) -> bool {
    let is_bare = |at: &Path, but: &[&str]| {
        let known = |e: std::fs::DirEntry| but.iter().any(|name| e.file_name() == *name);
        std::fs::read_dir(at).is_ok_and(|mut inside| inside.all(|e| e.is_ok_and(known)))
    };
    let checkpoints = folder.join("checkpoints");
    is_bare(folder, &["checkpoints", "env.json"]) && (!checkpoints.exists() || is_bare(&checkpoints, &[]))
}
