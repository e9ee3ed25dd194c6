//! The quadratic programme of the simulator's guard, for `nearl.Guard`.

use nearl_trainer::foresight::Nearest;
use numpy::PyArray1;
use pyo3::prelude::*;

use crate::arrays::{array, rows, vector};

/// The u in [-1, 1] (n) nearest to `asked` (n) with `lower <= slope (u - trial) <= upper`, `slope` (rows x n); rows give way where they cannot
/// all hold.
#[pyfunction]
pub(crate) fn nearest_action<'py>(
    py: Python<'py>,
    asked: Vec<f64>,
    trial: &Bound<'py, PyAny>,
    slope: &Bound<'py, PyAny>,
    lower: &Bound<'py, PyAny>,
    upper: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let n = asked.len();
    let trial = vector("trial", trial, n)?;
    let (slope, count) = rows("slope", slope, n)?;
    let (lower, upper) = (vector("lower", lower, count)?, vector("upper", upper, count)?);
    let mut nearest = Nearest::new(n, count);
    nearest.solve(&asked, &trial, &slope, |r| [lower[r], upper[r]]);
    Ok(array(py, nearest.solution()))
}
