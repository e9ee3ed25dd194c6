//! The search of the simulator's guard, for `nearl.Guard`, and its quadratic programme.

use std::sync::{Mutex, PoisonError};

use nearl_trainer::foresight::{Bound, Nearest, Search};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::sync::MutexExt;

use crate::arrays::{array, rows, vector};
use crate::errors;

/// Finds actions whose step ends within bounds; what a step leads to, a function of the caller says.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct ActionSearch(Mutex<Search>);

type Found<'py> = (&'static str, Array<'py>);
type Array<'py> = pyo3::Bound<'py, PyArray1<f64>>;

#[pymethods]
impl ActionSearch {
    /// Bounds on positions, lowest and highest [rad or m], then on velocities [rad/s or m/s]; lowest and highest of each action; the seed of
    /// drawn actions.
    #[new]
    fn new(
        positions: Vec<(f64, f64)>,
        velocities: Vec<f64>,
        actions: Vec<(f64, f64)>,
        seed: u64,
    ) -> ActionSearch {
        let positions = positions.into_iter().map(|(lower, upper)| Bound::position(lower, upper));
        let bounds = positions.chain(velocities.into_iter().map(Bound::velocity)).collect();
        ActionSearch(Mutex::new(Search::new(bounds, &actions, seed)))
    }

    /// What became of an action (n_act), and the action to take: `foresee(action)` gives positions and velocities after a step under it.
    fn find<'py>(
        &self,
        py: Python<'py>,
        mut action: Vec<f64>,
        foresee: &pyo3::Bound<'py, PyAny>,
    ) -> PyResult<Found<'py>> {
        let mut search = self.0.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner);
        let (n, mut failed) = (search.n_bounds(), None);
        let mut step = |action: &[f64], values: &mut [f64]| {
            if failed.is_some() {
                return false; // the search goes on to its end, and the caller is not asked again
            }
            let found = foresee.call1((array(py, action),)).and_then(|found| vector("foresee", &found, n));
            match found {
                Ok(found) => values.copy_from_slice(&found),
                Err(error) => failed = Some(error),
            }
            failed.is_none()
        };
        let verdict = search.update(&mut step, &mut action);
        match failed {
            Some(error) => Err(error),
            None => Ok((verdict.name(), array(py, &action))),
        }
    }

    /// How far positions and velocities are outside, as shares of the bounds' sizes; 0 inside.
    fn excess(&self, values: Vec<f64>) -> PyResult<f64> {
        let search = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match values.len() == search.n_bounds() {
            true => Ok(search.excess(&values)),
            false => Err(errors::value(format!("{} values for {} bounds", values.len(), search.n_bounds()))),
        }
    }
}

/// The u in [-1, 1] (n) nearest to `asked` (n) with `lower <= slope (u - trial) <= upper`, `slope` (rows x n); rows give way where they cannot
/// all hold.
#[pyfunction]
pub(crate) fn nearest_action<'py>(
    py: Python<'py>,
    asked: Vec<f64>,
    trial: &pyo3::Bound<'py, PyAny>,
    slope: &pyo3::Bound<'py, PyAny>,
    lower: &pyo3::Bound<'py, PyAny>,
    upper: &pyo3::Bound<'py, PyAny>,
) -> PyResult<Array<'py>> {
    let n = asked.len();
    let trial = vector("trial", trial, n)?;
    let (slope, count) = rows("slope", slope, n)?;
    let (lower, upper) = (vector("lower", lower, count)?, vector("upper", upper, count)?);
    let mut nearest = Nearest::new(n, count);
    nearest.solve(&asked, &trial, &slope, |r| [lower[r], upper[r]]);
    Ok(array(py, nearest.solution()))
}
