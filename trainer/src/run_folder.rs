//! The run folder: `task.toml metrics.csv env.json checkpoints/` and the robot file of one training.

use crate::checkpoint;
use crate::robot;
use nearl_runtime::snapshot::{in_run, write_whole};
use nearl_runtime::task::Task;
use nearl_runtime::{Manifest, Snapshot, SnapshotError};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Why a run folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// Creating or writing.
    #[error("cannot write '{path}': {reason}; give another folder with --out, or make this one writable")]
    Write {
        /// File or folder.
        path: String,
        /// What the system said.
        reason: String,
    },
    /// The metrics do not belong to the checkpoint.
    #[error("cannot go on with '{path}': {reason}; restore the file or start a new run with --out")]
    Metrics {
        /// File.
        path: String,
        /// One sentence.
        reason: String,
    },
    /// A training is at work there.
    #[error("another training is at work in '{path}'; wait for it or give another folder with --out")]
    Busy {
        /// Folder.
        path: String,
    },
    /// A file of somebody's is already there.
    #[error(
        "'{file}' is there already, and a run in this folder would write its own in its place; give another folder with --out"
    )]
    Foreign {
        /// Path.
        file: String,
    },
    /// A run is already there.
    #[error(
        "'{path}' already holds a run; go on with --resume, give another folder with --out, or remove it"
    )]
    Exists {
        /// Folder.
        path: String,
    },
    /// Reading.
    #[error("'{path}' is not a run: {reason}; give a folder or snapshot written by 'nearl train'")]
    Read {
        /// Folder.
        path: String,
        /// What is missing.
        reason: String,
    },
}

/// The effective task file as it stands in a run folder, and the robot file beside it by name and text. A robot file that names
/// other files stays where it is.
pub fn task_file(manifest: &Manifest) -> (String, Option<(String, String)>) {
    let mut task = manifest.task.clone();
    let mut copy = None;
    if let Some(simulation) = robot::simulation(manifest) {
        let model = &mut task.model;
        for file in [&mut model.urdf, &mut model.mjcf].into_iter().flatten() {
            let name =
                Path::new(file).file_name().map_or("robot".into(), |n| n.to_string_lossy().into_owned());
            match &simulation.folder {
                Some(folder) => *file = folder.join(name).display().to_string(),
                None => {
                    file.clone_from(&name);
                    copy = Some((name, simulation.text.clone()));
                }
            }
        }
    }
    (to_toml(&task), copy)
}

/// Whether two manifests are of one robot: the same file, and the same robot read of it where it names other files.
pub fn is_same_robot(a: &Manifest, b: &Manifest) -> bool {
    match (robot::simulation(a), robot::simulation(b)) {
        (Some(x), Some(y)) => x.text == y.text && (x.folder.is_none() || a.robot == b.robot),
        (x, y) => x.is_none() && y.is_none(),
    }
}

/// The effective task as the text of a task file.
pub(crate) fn to_toml(task: &Task) -> String {
    toml::to_string(task).unwrap_or_else(|e| unreachable!("a task was read from TOML: {e}"))
}

/// Writes the effective task file as `<name>.toml` with its robot file beside it; returns its path.
///
/// # Errors
/// [`RunError::Write`] naming the file.
pub fn write_task(folder: &Path, name: &str, manifest: &Manifest) -> Result<PathBuf, RunError> {
    let (task, robot) = task_file(manifest);
    let file = folder.join(format!("{name}.toml"));
    put(&file, &task)?;
    if let Some((name, text)) = robot {
        put(&folder.join(name), &text)?;
    }
    Ok(file)
}

fn put(file: &Path, text: &str) -> Result<(), RunError> {
    std::fs::write(file, text).map_err(unwritten(file))
}

/// Why `file` cannot be written.
fn unwritten(file: &Path) -> impl Fn(std::io::Error) -> RunError {
    move |e| RunError::Write { path: file.display().to_string(), reason: e.to_string() }
}

/// Writes what is known of a run into the file that holds it.
fn about_run(held: Option<&File>, about: &serde_json::Value) -> std::io::Result<()> {
    let Some(mut file) = held else { return Ok(()) };
    file.set_len(0)?;
    file.write_all(format!("{about:#}\n").as_bytes())
}

/// A file of the user's, in a folder that no run has begun in, whose place the task or the robot of a run would take.
fn foreign(path: &Path, manifest: &Manifest) -> Option<PathBuf> {
    if path.join("metrics.csv").exists() {
        return None;
    }
    let env = path.join("env.json");
    if std::fs::metadata(&env).is_ok_and(|facts| facts.len() > 0) {
        return Some(env);
    }
    let (task, robot) = task_file(manifest);
    let files = [Some(("task.toml".into(), task)), robot].into_iter().flatten();
    let differs = |(file, text): (PathBuf, String)| {
        let is_other = file.exists() && std::fs::read(&file).map_or(true, |there| there != text.as_bytes());
        is_other.then_some(file)
    };
    files.map(|(name, text): (String, String)| (path.join(name), text)).find_map(differs)
}

/// Whether something was learned there: a checkpoint, or a row of metrics, of which a run of this program has one before anything is learned.
fn holds_a_run(path: &Path) -> bool {
    let unlearned = usize::from(path.join("env.json").is_file());
    let rows = |text: String| text.lines().count() > 1 + unlearned;
    std::fs::read_to_string(path.join("metrics.csv"))
        .map_or_else(|e| e.kind() != std::io::ErrorKind::NotFound, rows)
        || has_checkpoint(path)
}

/// Whether there is something to go on from or to evaluate.
pub fn has_checkpoint(path: &Path) -> bool {
    checkpoint::path_in(path).exists() || snapshot_of(path).is_ok()
}

/// Holds a run folder until the file is dropped: two trainings would mix their rows. What is locked is `env.json`, which is written
/// once and not replaced; none where there is none, hence no run.
///
/// # Errors
/// [`RunError::Busy`]; [`RunError::Write`] when it cannot be opened or locked.
pub fn lock(path: &Path) -> Result<Option<File>, RunError> {
    let file = path.join("env.json");
    // for appending: a file system over the network locks nothing that may not be written
    let held = match File::options().append(true).open(&file) {
        Ok(held) => held,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(unwritten(&file)(e)),
    };
    match is_ours(&held).map_err(unwritten(&file))? {
        true => Ok(Some(held)),
        false => Err(RunError::Busy { path: path.display().to_string() }),
    }
}

/// Locks a file until it is dropped; false if another process or handle holds it.
///
/// # Errors
/// What the system said.
pub fn is_ours(file: &File) -> std::io::Result<bool> {
    match file.try_lock() {
        Ok(()) => Ok(true),
        Err(std::fs::TryLockError::WouldBlock) => Ok(false),
        Err(std::fs::TryLockError::Error(e)) => Err(e),
    }
}

/// Seconds after which a checkpoint is written even if a tenth of the run is not done.
const SAVE_SECONDS: f64 = 120.0;

/// Writes one training to disk. Others are kept from the folder until it is dropped.
pub struct RunFolder {
    path: PathBuf,
    metrics: BufWriter<File>,
    columns: usize,
    saved: (u64, Instant),
    /// Dropped with the run.
    _held: Option<File>,
}

impl RunFolder {
    /// Creates the folder with `task.toml` and its robot file, `env.json` and an empty `metrics.csv` with `columns`. `origin` is what the run
    /// starts from, where that is another run.
    ///
    /// # Errors
    /// [`RunError`]; a folder that already holds a run is never overwritten.
    pub fn create(
        path: &Path,
        manifest: &Manifest,
        seed: u64,
        columns: &[&str],
        origin: Option<&serde_json::Value>,
    ) -> Result<Self, RunError> {
        let is_free = || match holds_a_run(path) {
            true => Err(RunError::Exists { path: path.display().to_string() }),
            false => Ok(()),
        };
        drop(lock(path)?);
        is_free()?;
        let checkpoints = path.join("checkpoints");
        std::fs::create_dir_all(&checkpoints).map_err(unwritten(&checkpoints))?;
        // Held before anything is written, and looked at again: another training may have come at the same time.
        let env = path.join("env.json");
        File::options().append(true).create(true).open(&env).map_err(unwritten(&env))?;
        let held = lock(path)?;
        is_free()?;
        if let Some(file) = foreign(path, manifest) {
            // What was made here is empty, and nobody else's.
            if std::fs::metadata(&env).is_ok_and(|facts| facts.len() == 0) {
                let _ = std::fs::remove_file(&env);
            }
            let _ = std::fs::remove_dir(&checkpoints);
            return Err(RunError::Foreign { file: file.display().to_string() });
        }
        write_task(path, "task", manifest)?;
        let mut about = serde_json::json!({
            "algo": manifest.algo, "seed": seed, "version": env!("CARGO_PKG_VERSION"),
            "mujoco": "3.17.0", "pinocchio": "4.1.0", "isa": nearl_runtime::net::kernel::isa(),
            "cores": std::thread::available_parallelism().map_or(1, usize::from), "os": std::env::consts::OS, "arch": std::env::consts::ARCH,
        });
        if let Some(origin) = origin {
            about["start_from"] = origin.clone();
        }
        about_run(held.as_ref(), &about).map_err(unwritten(&env))?;
        let file = path.join("metrics.csv");
        let mut metrics = BufWriter::new(File::create(&file).map_err(unwritten(&file))?);
        writeln!(metrics, "{}", columns.join(",")).map_err(unwritten(&file))?;
        Ok(Self::open(path, metrics, columns, 0, held))
    }

    /// Opens the folder of a run to go on: keeps the rows of `metrics.csv` up to `steps`, of which there must be `rows`.
    ///
    /// Rows behind the checkpoint (of a run that was killed) are dropped: they come again. `held` is the folder's [`lock`], taken
    /// before the checkpoint was read.
    ///
    /// # Errors
    /// [`RunError`] when there is no `metrics.csv`, or it has other columns or lacks rows.
    pub fn reopen(
        path: &Path,
        held: Option<File>,
        columns: &[&str],
        steps: u64,
        rows: u64,
    ) -> Result<Self, RunError> {
        let file = path.join("metrics.csv");
        let broken = |reason: String| RunError::Metrics { path: file.display().to_string(), reason };
        if std::fs::metadata(&file).is_ok_and(|facts| !facts.is_file()) {
            return Err(broken("it is no regular file".into()));
        }
        let text = std::fs::read_to_string(&file).map_err(|e| broken(e.to_string()))?;
        let mut lines = text.split_inclusive('\n').filter_map(|l| l.strip_suffix('\n'));
        if lines.next() != Some(columns.join(",").as_str()) {
            return Err(broken("it has other columns than this program writes".into()));
        }
        let done = |l: &&str| {
            let n = l.split(',').next().and_then(|c| c.parse::<f64>().ok());
            n.is_some_and(|n| n <= steps as f64) && l.split(',').count() == columns.len()
        };
        let kept: Vec<&str> = lines.filter(done).collect();
        if kept.len() as u64 != rows {
            let found = kept.len();
            return Err(broken(format!(
                "it has {found} rows up to the checkpoint's {steps} steps, not {rows}"
            )));
        }
        let whole: String =
            std::iter::once(columns.join(",").as_str()).chain(kept).flat_map(|l| [l, "\n"]).collect();
        let open = || -> std::io::Result<File> {
            write_whole(&file, whole.as_bytes())?;
            File::options().append(true).open(&file)
        };
        let metrics = BufWriter::new(open().map_err(unwritten(&file))?);
        Ok(Self::open(path, metrics, columns, steps, held))
    }

    fn open(path: &Path, metrics: BufWriter<File>, columns: &[&str], steps: u64, held: Option<File>) -> Self {
        let saved = (steps, Instant::now());
        Self { path: path.into(), metrics, columns: columns.len(), saved, _held: held }
    }

    /// Whether a checkpoint is due after `steps` of `total`: at every tenth, and after two minutes.
    pub fn is_due(&self, steps: u64, total: u64) -> bool {
        let every = (total / 10).max(1);
        steps / every > self.saved.0 / every || self.saved.1.elapsed().as_secs_f64() > SAVE_SECONDS
    }

    /// Appends one row of metrics; numbers that do not exist are empty cells.
    ///
    /// # Errors
    /// [`RunError::Write`].
    pub fn row(&mut self, values: &[f64]) -> Result<(), RunError> {
        assert_eq!(values.len(), self.columns, "one value a column");
        let cell = |v: &f64| if v.is_finite() { v.to_string() } else { String::new() };
        let line = values.iter().map(cell).collect::<Vec<_>>().join(",");
        let file = self.path.join("metrics.csv");
        writeln!(self.metrics, "{line}").and_then(|()| self.metrics.flush()).map_err(unwritten(&file))
    }

    /// Writes `checkpoints/<name>.safetensors` whole. Only the newest of `final` and `latest` stays.
    ///
    /// # Errors
    /// [`SnapshotError`] with what the system said.
    pub fn save(&mut self, name: &str, snapshot: &Snapshot) -> Result<PathBuf, SnapshotError> {
        self.saved = (snapshot.manifest.steps, Instant::now());
        let path = self.path.join("checkpoints").join(format!("{name}.safetensors"));
        snapshot.save(&path)?;
        let other = if name == "final" { "latest" } else { "final" };
        let stale = path.with_file_name(format!("{other}.safetensors"));
        match std::fs::remove_file(&stale) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                Err(SnapshotError::Unwritable { file: stale.display().to_string(), reason: e.to_string() })
            }
            _ => Ok(path),
        }
    }

    /// Writes `checkpoints/<name>.safetensors` whole, beside the newest.
    ///
    /// # Errors
    /// [`SnapshotError`] with what the system said.
    pub fn keep(&self, name: &str, snapshot: &Snapshot) -> Result<(), SnapshotError> {
        snapshot.save(&self.path.join("checkpoints").join(format!("{name}.safetensors")))
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// The snapshot of a run folder (its final one, else its latest), or of a snapshot file.
///
/// # Errors
/// [`RunError::Read`] naming what is missing.
pub fn snapshot_of(run: &Path) -> Result<PathBuf, RunError> {
    if run.is_file() {
        return Ok(run.into());
    }
    if !run.is_dir() {
        let reason =
            if run.exists() { "it is neither a folder nor a regular file" } else { "it does not exist" };
        return Err(RunError::Read { path: run.display().to_string(), reason: reason.into() });
    }
    let file = in_run(run);
    let reason = "it has no checkpoints/final.safetensors or latest.safetensors";
    let none = || RunError::Read { path: run.display().to_string(), reason: reason.into() };
    if file.is_file() { Ok(file) } else { Err(none()) }
}
