//! Rust errors as Python exceptions, with the same sentence.

use nearl_constraints::ModelError;
use nearl_runtime::SnapshotError;
use nearl_runtime::task::TaskError;
use nearl_trainer::checkpoint::CheckpointError;
use nearl_trainer::demos::DemoError;
use nearl_trainer::robot::RobotError;
use nearl_trainer::run_folder::RunError;
use nearl_trainer::tasks::TaskLoadError;
use nearl_trainer::train::TrainError;
use nearl_trainer::vector::VectorError;
use pyo3::exceptions::{PyFileNotFoundError, PyOSError, PyUserWarning, PyValueError};
use pyo3::prelude::*;
use std::io::ErrorKind;
use std::path::Path;

/// What the user gave is wrong.
pub(crate) fn value(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// A robot file.
pub(crate) fn model(error: ModelError) -> PyErr {
    match error {
        ModelError::Unreadable { .. } => PyOSError::new_err(error.to_string()),
        other => value(other),
    }
}

/// A robot file that MuJoCo or our own reader looked at.
pub(crate) fn robot(error: RobotError) -> PyErr {
    match error {
        RobotError::Model(error) => model(error),
        other => value(other),
    }
}

/// A task.
pub(crate) fn task(error: TaskLoadError) -> PyErr {
    match error {
        TaskLoadError::Robot { .. } | TaskLoadError::Task(TaskError::Unreadable { .. }) => {
            PyOSError::new_err(error.to_string())
        }
        other => value(other),
    }
}

/// A training and its run folder.
pub(crate) fn train(error: TrainError) -> PyErr {
    match error {
        TrainError::Run(RunError::Write { .. })
        | TrainError::Checkpoint(CheckpointError::Unusable { .. } | CheckpointError::Unwritable { .. }) => {
            PyOSError::new_err(error.to_string())
        }
        TrainError::Demos(DemoError::Unreadable { kind: ErrorKind::NotFound, .. }) => {
            PyFileNotFoundError::new_err(error.to_string())
        }
        TrainError::Demos(DemoError::Unreadable { .. }) => PyOSError::new_err(error.to_string()),
        TrainError::Snapshot(e) => snapshot(e),
        other => value(other),
    }
}

/// A vector of environments.
pub(crate) fn vector(error: VectorError) -> PyErr {
    match error {
        VectorError::Task(e) => task(e),
        VectorError::Snapshot(e) => snapshot(e),
        other => value(other),
    }
}

/// A snapshot.
pub(crate) fn snapshot(error: SnapshotError) -> PyErr {
    match error {
        SnapshotError::Unreadable { .. } | SnapshotError::Unwritable { .. } => {
            PyOSError::new_err(error.to_string())
        }
        other => value(other),
    }
}

/// A snapshot in a file, which every sentence names.
pub(crate) fn snapshot_in(file: &Path, error: SnapshotError) -> PyErr {
    let (name, text) = (file.display().to_string(), error.to_string());
    if text.contains(&name) { snapshot(error) } else { value(format!("'{name}': {text}")) }
}

/// Says as a `UserWarning` what is allowed and hardly meant.
pub(crate) fn warn(py: Python<'_>, text: &str) -> PyResult<()> {
    let text = std::ffi::CString::new(text).unwrap_or_default();
    PyErr::warn(py, &py.get_type::<PyUserWarning>(), &text, level(py).unwrap_or(1))
}

/// Where a warning points: past the frames of this package, and of Gymnasium which makes environments of it, to whoever called.
fn level(py: Python<'_>) -> PyResult<i32> {
    let mut frame = py.import("sys")?.getattr("_getframe")?.call0()?;
    for level in 1.. {
        let name = frame.getattr("f_globals")?.get_item("__name__")?.extract::<String>()?;
        if !["nearl", "gymnasium"].contains(&name.split('.').next().unwrap_or_default()) {
            return Ok(level);
        }
        frame = frame.getattr("f_back")?;
        if frame.is_none() {
            break;
        }
    }
    Ok(1)
}
