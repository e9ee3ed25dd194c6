//! The ranks of a training on several hosts: Python hands the bytes round.

use std::sync::Arc;

use nearl_trainer::ranks::{Gather, Ranks};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::PyBytes;

use crate::errors;

/// An object with `rank`, `size` and `gather(bytes) -> bytes` (see `nearl.Ranks`).
struct Caller(Py<PyAny>);

impl Gather for Caller {
    fn gather(&self, mine: &[u8]) -> Result<Vec<u8>, String> {
        Python::attach(|py| {
            let all = self.0.bind(py).call_method1("gather", (PyBytes::new(py, mine),))?;
            Ok(all.extract::<PyBackedBytes>()?.to_vec())
        })
        .map_err(|e: PyErr| e.to_string().split_whitespace().collect::<Vec<_>>().join(" "))
    }
}

/// The ranks of a training that Python gives, if it gives some.
pub(crate) fn read(py: Python<'_>, ranks: Option<Py<PyAny>>) -> PyResult<Option<Arc<Ranks>>> {
    let Some(ranks) = ranks else { return Ok(None) };
    let number = |name: &str| ranks.bind(py).getattr(name)?.extract::<usize>();
    let (rank, size) = (number("rank")?, number("size")?);
    let ranks = Ranks::new(rank, size, Box::new(Caller(ranks))).map_err(|e| errors::value(e.to_string()))?;
    Ok(Some(Arc::new(ranks)))
}
