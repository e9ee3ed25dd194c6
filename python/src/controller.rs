//! The controller of a snapshot.

use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use nearl_runtime::{self as runtime, Noise, Output, Snapshot, State};
use numpy::PyArray1;
use pyo3::prelude::*;

use crate::arrays::{array, vector};
use crate::errors;
use crate::target::Ledger;

struct Inner {
    controller: runtime::Controller,
    state: State,
    noise: Noise,
    out: Output,
}

/// State to action: propose, project, invert, as on the robot.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Controller {
    inner: Mutex<Inner>,
    sizes: (usize, usize, usize),
    names: Vec<String>,
    task: String,
    algo: String,
    digest: String,
}

type Updated<'py> = (Bound<'py, PyArray1<f64>>, Ledger);

#[pymethods]
impl Controller {
    /// Reads and validates a snapshot file.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Controller> {
        py.detach(|| {
            let snapshot = Snapshot::load(&path).map_err(errors::snapshot)?;
            let controller = runtime::Controller::new(&snapshot).map_err(errors::snapshot)?;
            let model = controller.model();
            let sizes = (model.nq(), model.nv(), controller.layout().n_obs());
            let names = controller.row_names();
            let (state, noise, out) = (controller.state(), controller.noise(), controller.output());
            let inner = Mutex::new(Inner { controller, state, noise, out });
            let manifest = &snapshot.manifest;
            let (task, algo, digest) = (manifest.task.name.clone(), manifest.algo.clone(), snapshot.digest());
            Ok(Controller { inner, sizes, names, task, algo, digest })
        })
    }

    /// One control tick without noise: the action (n_act) and the ledger. `q` and `v` in Pinocchio's convention.
    fn update<'py>(
        &self,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        obs: &Bound<'py, PyAny>,
    ) -> PyResult<Updated<'py>> {
        let (nq, nv, n_obs) = self.sizes;
        let (q_, v, obs) = (vector("q", q, nq)?, vector("v", v, nv)?, vector("obs", obs, n_obs)?);
        let py = q.py();
        let (action, ledger) = self.with(py, |inner| {
            inner.state.q.copy_from_slice(&q_);
            inner.state.v.copy_from_slice(&v);
            inner.state.obs.copy_from_slice(&obs);
            let Inner { controller, state, noise, out } = inner;
            controller.update(state, noise, out);
            (out.action.clone(), out.next.ledger.clone())
        });
        Ok((array(py, &action), Ledger { ledger, names: self.names.clone() }))
    }

    /// Begins an episode: the next tick is one of the policy's.
    fn reset(&self, py: Python<'_>) {
        self.with(py, |inner| inner.controller.reset());
    }

    /// Raw and projected entries of the proposed state in the last tick, each (n_state).
    #[getter]
    fn proposal<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.with(py, |inner| inner.out.proposal.clone()))
    }

    /// Projected entries of the proposed state in the last tick (n_state).
    #[getter]
    fn target<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.with(py, |inner| inner.out.target.clone()))
    }

    /// Names of the observation's entries (n_obs).
    #[getter]
    fn obs_names(&self, py: Python<'_>) -> Vec<String> {
        self.with(py, |inner| inner.controller.layout().names().to_vec())
    }

    /// Names of the proposed entries (n_state).
    #[getter]
    fn state_names(&self, py: Python<'_>) -> Vec<String> {
        self.with(py, |inner| {
            let layout = inner.controller.layout();
            (0..layout.n_state()).map(|k| layout.state_name(k).to_owned()).collect()
        })
    }

    /// Control period [s].
    #[getter]
    fn dt(&self, py: Python<'_>) -> f64 {
        self.with(py, |inner| inner.controller.dt())
    }

    /// Control ticks in one policy period.
    #[getter]
    fn policy_every(&self, py: Python<'_>) -> usize {
        self.with(py, |inner| inner.controller.policy_every())
    }

    /// Version of the snapshot.
    #[getter]
    fn version(&self, py: Python<'_>) -> u64 {
        self.with(py, |inner| inner.controller.version())
    }

    /// Task the snapshot was trained on.
    #[getter]
    fn task(&self) -> &str {
        &self.task
    }

    /// Algorithm that trained it.
    #[getter]
    fn algo(&self) -> &str {
        &self.algo
    }

    /// Digest of the snapshot.
    #[getter]
    fn digest(&self) -> &str {
        &self.digest
    }

    fn __repr__(&self) -> String {
        format!("Controller('{}', '{}', digest {})", self.task, self.algo, self.digest)
    }
}

impl Controller {
    fn with<R: Send>(&self, py: Python<'_>, f: impl FnOnce(&mut Inner) -> R + Send) -> R {
        py.detach(|| f(&mut self.inner.lock().unwrap_or_else(PoisonError::into_inner)))
    }
}
