//! The controller of a snapshot.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use nearl_runtime::{self as runtime, Noise, Output, PolicyKind, Snapshot, State, doctor};
use nearl_trainer::run_folder;
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{array, vector};
use crate::errors;
use crate::target::Ledger;

struct Inner {
    controller: runtime::Controller,
    state: State,
    noise: Noise,
    out: Output,
    stochastic: bool,
}

impl Inner {
    /// A tick for an observation; joints that it does not hold stay at rest.
    fn act(&mut self, obs: &[f64], noise: Option<&[f64]>) -> Vec<f64> {
        self.controller.observed(obs, &mut self.state);
        let wanted = if self.stochastic { &mut self.noise.proposal } else { &mut self.noise.action };
        wanted.fill(0.0);
        for (n, x) in wanted.iter_mut().zip(noise.into_iter().flatten()) {
            *n = *x as f32;
        }
        self.controller.update(&self.state, &self.noise, &mut self.out);
        silence(&mut self.noise);
        self.out.action.clone()
    }
}

/// `update` is without noise.
fn silence(noise: &mut Noise) {
    noise.proposal.fill(0.0);
    noise.action.fill(0.0);
}

/// State to action: propose, project, invert, as on the robot.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Controller {
    inner: Mutex<Inner>,
    sizes: (usize, usize, usize),
    n_noise: usize,
    /// What the observation lacks of a joint's state though a tick needs it.
    unseen: Option<String>,
    snapshot: Arc<Snapshot>,
    names: Vec<String>,
    task: String,
    algo: String,
    digest: String,
}

type Updated<'py> = (Bound<'py, PyArray1<f64>>, Ledger);

#[pymethods]
impl Controller {
    /// Reads and validates a snapshot file, or that of a run folder.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Controller> {
        py.detach(|| {
            let path =
                if path.is_dir() { run_folder::snapshot_of(&path).map_err(errors::value)? } else { path };
            let snapshot = Snapshot::load(&path).map_err(|e| errors::snapshot_in(&path, e))?;
            Controller::new(&snapshot)
        })
    }

    /// One control tick without noise: the action (n_act) and the ledger. The action is what the actuators get, in their order: of a robot file's
    /// motors their controls, which are forces [N m or N] where a motor has no gear, else force by gear; of drives what `[command]` says. `q` (nq)
    /// [rad or m] and `v` (nv) [rad/s or m/s] in Pinocchio's convention, `obs` (n_obs). With NaN or infinity in them the ledger says "refused", and the
    /// action is the one that the last finite state asked for: right for a tick or two, so brake if it lasts.
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
            let Inner { controller, state, noise, out, .. } = inner;
            controller.update(state, noise, out);
            (out.action.clone(), out.next.ledger.clone())
        });
        Ok((array(py, &action), Ledger { ledger, names: self.names.clone() }))
    }

    /// One control tick for an observation (n_obs) that holds what the controller needs of the joints' state, as all bundled
    /// tasks' do. `noise` (n_noise): standard normal numbers of the policy; none is deterministic. Returns the action (n_act). An
    /// observation or noise that is not finite raises ValueError, and the controller stays as it was.
    #[pyo3(signature = (obs, noise=None))]
    fn act<'py>(
        &self,
        obs: &Bound<'py, PyAny>,
        noise: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let py = obs.py();
        if let Some(entry) = &self.unseen {
            return Err(errors::value(format!(
                "the observation of '{}' has no '{entry}', which analytic inverse dynamics, a guard or the policy's own observation needs; observe \
                 it, or use update(q, v, obs) of the controller, with q and v as Env.state has them",
                self.task
            )));
        }
        let obs = vector("obs", obs, self.sizes.2)?;
        if let Some(i) = obs.iter().position(|x| !x.is_finite()) {
            return Err(errors::value(format!(
                "obs[{i}] ('{}') is {}; check the sensor behind it, and brake if it lasts",
                self.obs_names(py)[i],
                obs[i]
            )));
        }
        let noise = noise.map(|n| vector("noise", n, self.n_noise)).transpose()?;
        let not_finite = |noise: &Vec<f64>| noise.iter().position(|x| !x.is_finite()).map(|i| (i, noise[i]));
        if let Some((i, value)) = noise.as_ref().and_then(not_finite) {
            return Err(errors::value(format!(
                "noise[{i}] is {value}; give standard normal numbers, or none"
            )));
        }
        let action = self.with(py, |inner| inner.act(&obs, noise.as_deref()));
        Ok(array(py, &action))
    }

    /// The same controller once more, at the start of an episode.
    fn another(&self, py: Python<'_>) -> PyResult<Controller> {
        py.detach(|| Controller::of(self.snapshot.clone()))
    }

    /// Writes the snapshot that it runs on.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| self.snapshot.save(&path)).map_err(errors::snapshot)
    }

    /// Begins an episode: the next tick is one of the policy's.
    fn reset(&self, py: Python<'_>) {
        self.with(py, |inner| inner.controller.reset());
    }

    /// Raw entries of the state proposed in the last tick (n_state).
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

    /// Names of the rows that a ledger speaks of by number; the first are the degrees of freedom.
    #[getter]
    fn row_names(&self) -> Vec<String> {
        self.names.clone()
    }

    /// Kind of each row by number; None for those of the degrees of freedom, which several limits share.
    #[getter]
    fn row_kinds(&self, py: Python<'_>) -> Vec<Option<&'static str>> {
        self.with(py, |inner| inner.controller.row_kinds())
            .iter()
            .map(|kind| kind.map(|k| k.name()))
            .collect()
    }

    /// Limits of the degrees of freedom (nv each), infinite where there is none, by name: lower_position, upper_position [rad or m],
    /// velocity [rad/s or m/s], acceleration [rad/s² or m/s²], effort [N·m or N].
    #[getter]
    fn limits<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let limits = self.with(py, |inner| inner.controller.limits().clone());
        let out = PyDict::new(py);
        for (name, values) in [
            ("lower_position", &limits.q_lower),
            ("upper_position", &limits.q_upper),
            ("velocity", &limits.velocity),
            ("acceleration", &limits.acceleration),
            ("effort", &limits.effort),
        ] {
            out.set_item(name, array(py, values))?;
        }
        Ok(out)
    }

    /// What `nearl import` and `nearl doctor` say of its robot and limits, a sentence each: limits that nothing holds, a guard that only a simulator
    /// has, friction, targets that are cut.
    #[getter]
    fn notes(&self, py: Python<'_>) -> PyResult<Vec<String>> {
        let manifest = &self.snapshot.manifest;
        let mut notes = py.detach(|| doctor::told(manifest)).map_err(errors::snapshot)?;
        notes.extend(manifest.without_simulator().map(str::to_owned));
        Ok(notes)
    }

    /// Control period [s].
    #[getter]
    fn dt(&self, py: Python<'_>) -> f64 {
        self.with(py, |inner| inner.controller.dt())
    }

    /// Random numbers of the policy in one tick.
    #[getter]
    fn n_noise(&self) -> usize {
        self.n_noise
    }

    /// Whether what comes out of a tick depends on the ticks before.
    #[getter]
    fn remembers(&self, py: Python<'_>) -> bool {
        self.with(py, |inner| inner.controller.remembers())
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

    /// Environment steps that the snapshot was learned from; 0 for an imported one.
    #[getter]
    fn steps(&self) -> u64 {
        self.snapshot.manifest.steps
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
    /// The controller of a snapshot.
    pub(crate) fn new(snapshot: &Snapshot) -> PyResult<Controller> {
        Controller::of(Arc::new(snapshot.clone()))
    }

    /// The same of one that several controllers share.
    fn of(snapshot: Arc<Snapshot>) -> PyResult<Controller> {
        let controller = runtime::Controller::new(&snapshot).map_err(errors::snapshot)?;
        let (model, layout) = (controller.model(), controller.layout());
        let sizes = (model.nq(), model.nv(), layout.n_obs());
        let names = controller.row_names();
        let (state, noise, out) = (controller.state(), controller.noise(), controller.output());
        let manifest = &snapshot.manifest;
        let stochastic = manifest.policy == PolicyKind::Stochastic;
        let n_noise = if stochastic { noise.proposal.len() } else { noise.action.len() };
        let unseen = controller.first_unseen();
        let (task, algo, digest) = (manifest.task.name.clone(), manifest.algo.clone(), snapshot.digest());
        let inner = Mutex::new(Inner { controller, state, noise, out, stochastic });
        Ok(Controller { inner, sizes, n_noise, unseen, names, task, algo, digest, snapshot })
    }

    fn with<R: Send>(&self, py: Python<'_>, f: impl FnOnce(&mut Inner) -> R + Send) -> R {
        py.detach(|| f(&mut self.inner.lock().unwrap_or_else(PoisonError::into_inner)))
    }
}
