//! Many native environments stepped in one call, on all cores.

use std::sync::Mutex;

use nearl_trainer::vector::{Autoreset, Constraints, Lane, Meaning, Settings, Vector, VectorError};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{array, array2, matrix};
use crate::env::fault_name;
use crate::errors;

/// `n` environments of one task (see `nearl.make_vec`).
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct VecEnv(Mutex<Vector>);

type Stepped<'py> = (
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<bool>>,
    Bound<'py, PyArray1<bool>>,
    Bound<'py, PyDict>,
);

#[pymethods]
impl VecEnv {
    /// `constraints`: None, "task", or a snapshot file; `actions`: what an action is then. `same_step`: how an ended episode is begun anew.
    #[new]
    #[pyo3(signature = (task, num_envs, constraints, seed, threads, max_episode_steps, same_step, actions="state"))]
    fn new(
        py: Python<'_>,
        task: &str,
        num_envs: usize,
        constraints: Option<String>,
        seed: u64,
        threads: usize,
        max_episode_steps: Option<usize>,
        same_step: bool,
        actions: &str,
    ) -> PyResult<VecEnv> {
        let meaning = match actions {
            "state" => Meaning::State,
            "change" => Meaning::Change,
            "guarded" => Meaning::Action,
            "limited" => Meaning::Limited,
            other => {
                return Err(errors::value(format!(
                    "actions is '{other}'; give \"state\", \"change\", \"guarded\" or \"limited\""
                )));
            }
        };
        let constraints = match constraints.as_deref() {
            None if meaning != Meaning::State => {
                return Err(errors::value(format!(
                    "actions is '{actions}' without constraints; give constraints=\"task\" too"
                )));
            }
            None => None,
            Some("task") => Some(Constraints::Task),
            Some(file) => Some(Constraints::Agent(file.to_owned())),
        };
        let actions = meaning;
        let autoreset = if same_step { Autoreset::SameStep } else { Autoreset::NextStep };
        let settings =
            Settings { num_envs, constraints, actions, seed, threads, max_episode_steps, autoreset };
        let vector = py.detach(|| Vector::new(task, &settings)).map_err(errors::vector)?;
        vector.notes().iter().try_for_each(|note| errors::warn(py, note))?;
        Ok(VecEnv(Mutex::new(vector)))
    }

    /// Begins an episode everywhere; `seeds` (num_envs) restart the random streams. Returns observations (num_envs x n_obs).
    #[pyo3(signature = (seeds=None))]
    fn reset<'py>(
        &self,
        py: Python<'py>,
        seeds: Option<Vec<Option<u64>>>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.with(py, |vector| vector.reset(seeds.as_deref()))?;
        self.observations(py)
    }

    /// One step everywhere under `actions` (num_envs x n_act): observations (num_envs x n_obs), rewards, terminations and truncations
    /// (num_envs) and `info`.
    fn step<'py>(&self, py: Python<'py>, actions: &Bound<'py, PyAny>) -> PyResult<Stepped<'py>> {
        let (n, width) = self.of(|vector| (vector.n(), vector.action_names().len()));
        let actions = matrix("actions", actions, n, width)?;
        self.with(py, |vector| vector.step(&actions))?;
        let obs = self.observations(py)?;
        let vector = self.lock();
        let rewards: Vec<f64> = vector.lanes().map(|l| l.reward).collect();
        let terminated: Vec<bool> = vector.lanes().map(|l| l.terminated).collect();
        let truncated: Vec<bool> = vector.lanes().map(|l| l.truncated).collect();
        let info = info(py, &vector)?;
        let flags = |f: Vec<bool>| PyArray1::from_vec(py, f);
        Ok((obs, array(py, &rewards), flags(terminated), flags(truncated), info))
    }

    /// Ends the episodes chosen (num_envs), as if the task had: by the autoreset mode, a new one begins in the next step, or at
    /// once. Returns observations (num_envs x n_obs).
    fn end<'py>(&self, py: Python<'py>, ended: Vec<bool>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.with(py, |vector| vector.end(&ended))?;
        self.observations(py)
    }

    /// Puts environment `index` into a state, MuJoCo's convention; an episode begins there.
    fn set_state(&self, py: Python<'_>, index: usize, qpos: Vec<f64>, qvel: Vec<f64>) -> PyResult<()> {
        self.with(py, |vector| vector.set_state(index, &qpos, &qvel))
    }

    /// Configurations (num_envs x nq), MuJoCo's convention.
    #[getter]
    fn qpos<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.rows(py, |lane| lane.qpos())
    }

    /// Velocities (num_envs x nv), MuJoCo's convention.
    #[getter]
    fn qvel<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.rows(py, |lane| lane.qvel())
    }

    /// Entries of an observation.
    #[getter]
    fn n_obs(&self) -> usize {
        self.of(Vector::n_obs)
    }

    /// What each entry of an observation is.
    #[getter]
    fn obs_names(&self) -> Vec<String> {
        self.of(|vector| vector.obs_names().to_vec())
    }

    /// What each entry of an action is: an actuator, or an entry of the proposed state.
    #[getter]
    fn action_names(&self) -> Vec<String> {
        self.of(|vector| vector.action_names().to_vec())
    }

    /// Smallest action (n_act).
    #[getter]
    fn action_low<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.of(|vector| array(py, vector.action_range().0))
    }

    /// Largest action (n_act).
    #[getter]
    fn action_high<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.of(|vector| array(py, vector.action_range().1))
    }

    /// Time of one step [s].
    #[getter]
    fn dt(&self) -> f64 {
        self.of(Vector::dt)
    }
}

impl VecEnv {
    fn lock(&self) -> std::sync::MutexGuard<'_, Vector> {
        self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn of<R>(&self, f: impl FnOnce(&Vector) -> R) -> R {
        f(&self.lock())
    }

    fn with(
        &self,
        py: Python<'_>,
        f: impl FnOnce(&mut Vector) -> Result<(), VectorError> + Send,
    ) -> PyResult<()> {
        py.detach(|| f(&mut self.lock())).map_err(errors::vector)
    }

    /// A row of each environment.
    fn rows<'py>(&self, py: Python<'py>, of: fn(&Lane) -> &[f64]) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let vector = self.lock();
        let rows: Vec<f64> = vector.lanes().flat_map(|lane| of(&lane).to_vec()).collect();
        let width = rows.len() / vector.n();
        array2(py, rows, width)
    }

    fn observations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.rows(py, |lane| &lane.obs)
    }
}

/// `final_obs`, `fault` and what the projection did, each with its mask `_<key>`, only where there is something to say.
fn info<'py>(py: Python<'py>, vector: &Vector) -> PyResult<Bound<'py, PyDict>> {
    let info = PyDict::new(py);
    let put = |key: &str, values: Vec<Option<Bound<'py, PyAny>>>| -> PyResult<()> {
        if values.iter().all(Option::is_none) {
            return Ok(());
        }
        info.set_item(
            format!("_{key}"),
            PyArray1::from_vec(py, values.iter().map(Option::is_some).collect()),
        )?;
        let objects = values.into_iter().map(|v| v.map_or_else(|| py.None(), Bound::unbind));
        info.set_item(key, PyArray1::from_vec(py, objects.collect::<Vec<Py<PyAny>>>()))
    };
    put(
        "final_obs",
        vector.lanes().map(|l| l.final_obs.as_ref().map(|o| array(py, o).into_any())).collect(),
    )?;
    let fault = |l: &Lane| fault_name(l.fault).map(|f| pyo3::types::PyString::new(py, f).into_any());
    put("fault", vector.lanes().map(|l| fault(&l)).collect())?;
    if vector.lanes().next().is_some_and(|l| l.has_cost()) {
        info.set_item("cost", array(py, &vector.lanes().map(|l| l.cost).collect::<Vec<_>>()))?;
    }
    if vector.lanes().next().is_some_and(|l| l.is_projected()) {
        let counts = |f: fn(&Lane) -> u64| {
            PyArray1::from_vec(py, vector.lanes().map(|l| f(&l) as u32).collect::<Vec<u32>>())
        };
        info.set_item("raw_violations", counts(|l| l.tally.raw_violations))?;
        info.set_item("target_violations", counts(|l| l.tally.target_violations))?;
        info.set_item("recovering", counts(|l| l.tally.recovering))?;
        let executed: Vec<f64> = vector.lanes().flat_map(|lane| lane.executed().to_vec()).collect();
        let width = executed.len() / vector.n();
        info.set_item("executed", array2(py, executed, width)?)?;
        info.set_item("moved", array(py, &vector.lanes().map(|l| l.moved).collect::<Vec<_>>()))?;
    }
    Ok(info)
}
