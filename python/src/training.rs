//! A training in this process.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use nearl_trainer::checkpoint::{self, Checkpoint};
use nearl_trainer::run_folder::RunFolder;
use nearl_trainer::tasks;
use nearl_trainer::train::{self, COLUMNS, Request, complete};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::controller::Controller;
use crate::errors;

struct Inner {
    training: train::Training,
    folder: Option<RunFolder>,
}

/// The Rust trainer, one iteration at a time (see `nearl.PID2`).
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Training {
    inner: Mutex<Inner>,
    task: String,
}

#[pymethods]
impl Training {
    /// `settings`: overrides of the task file, `key=value`. `out`: run folder to write, as `nearl train` does.
    #[new]
    fn new(
        py: Python<'_>,
        task: &str,
        algo: &str,
        seed: u64,
        threads: usize,
        settings: Vec<String>,
        out: Option<PathBuf>,
    ) -> PyResult<Training> {
        py.detach(|| {
            let mut manifest = tasks::load(task, &settings).map_err(errors::task)?;
            complete(&mut manifest).map_err(errors::value)?;
            let task = manifest.task.name.clone();
            let request = Request { manifest, algo: algo.into(), steps: 0, seed, threads: threads.max(1) };
            let training = train::Training::new(&request).map_err(errors::value)?;
            let create = |out: PathBuf| RunFolder::create(&out, &training.snapshot().manifest, seed, COLUMNS);
            let folder = out.map(create).transpose().map_err(errors::value)?;
            Ok(Training { inner: Mutex::new(Inner { training, folder }), task })
        })
    }

    /// The training of a run folder where it stopped, to go on in it.
    #[staticmethod]
    fn resume(py: Python<'_>, path: PathBuf, threads: usize) -> PyResult<Training> {
        py.detach(|| {
            let file = checkpoint::path_in(&path);
            let from = Checkpoint::load(&file).map_err(errors::value)?;
            let training =
                train::Training::resume(from, &file, None, threads.max(1)).map_err(errors::value)?;
            let manifest = &training.snapshot().manifest;
            let task = manifest.task.name.clone();
            let folder = RunFolder::reopen(&path, COLUMNS, manifest.steps, manifest.version);
            let folder = Some(folder.map_err(errors::value)?);
            Ok(Training { inner: Mutex::new(Inner { training, folder }), task })
        })
    }

    /// Asks for `steps` more; the learning rate falls to zero at their end.
    fn extend(&self, steps: u64) {
        self.lock().training.extend(steps);
    }

    /// Collects and learns once; metrics by column, those that exist.
    fn iterate<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let row = py.detach(|| {
            let mut inner = self.lock();
            let progress = inner.training.iterate();
            let row = inner.training.row(&progress);
            inner.folder.as_mut().map_or(Ok(()), |f| f.row(&row)).map_err(errors::value)?;
            Ok::<_, PyErr>(row)
        })?;
        let metrics = PyDict::new(py);
        for (name, value) in COLUMNS.iter().zip(row).filter(|(_, value)| value.is_finite()) {
            metrics.set_item(name, value)?;
        }
        Ok(metrics)
    }

    /// Writes snapshot and checkpoint into the run folder; returns the snapshot's path.
    fn checkpoint(&self, py: Python<'_>) -> PyResult<PathBuf> {
        py.detach(|| {
            let mut inner = self.lock();
            let Inner { training, folder } = &mut *inner;
            let none = || errors::value("this training has no run folder; give out=");
            training.save(folder.as_ref().ok_or_else(none)?).map_err(errors::value)
        })
    }

    /// A controller with what was learned so far.
    fn controller(&self, py: Python<'_>) -> PyResult<Controller> {
        py.detach(|| Controller::new(self.lock().training.snapshot()))
    }

    /// Whether the steps asked for are done.
    #[getter]
    fn done(&self) -> bool {
        self.lock().training.is_done()
    }

    /// Environment steps so far.
    #[getter]
    fn steps(&self) -> u64 {
        self.lock().training.snapshot().manifest.steps
    }

    /// Name of the task.
    #[getter]
    fn task(&self) -> &str {
        &self.task
    }

    /// Names of all metrics.
    #[getter]
    fn columns(&self) -> Vec<&'static str> {
        COLUMNS.to_vec()
    }
}

impl Training {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
