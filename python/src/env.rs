//! One native environment.

use std::path::PathBuf;
use std::sync::Mutex;

use nearl_runtime::{Manifest, Snapshot};
use nearl_trainer::env::{self, ChaCha8Rng, EnvError, Fault, SeedableRng};
use nearl_trainer::tasks::{self as task_files, TaskLoadError};
use nearl_trainer::{mj, robot, run_folder};
use numpy::PyArray1;
use pyo3::prelude::*;

use crate::arrays::{array, vector};
use crate::errors;

/// What is wrong with a period, for `info`; none when nothing is.
pub(crate) fn fault_name(fault: Fault) -> Option<&'static str> {
    match fault {
        Fault::None => None,
        Fault::Action => Some("action not finite"),
        Fault::Unstable => Some("simulation unstable"),
        Fault::Engine => Some("MuJoCo error"),
    }
}

/// Names of the tasks that [`Env`] can make, with a line about each.
#[pyfunction]
pub(crate) fn tasks() -> Vec<(&'static str, String)> {
    task_files::names().into_iter().map(|name| (name, task_files::about(name))).collect()
}

/// Control periods in an episode of a bundled task; its environment is not made for it. None for any other name.
#[pyfunction]
pub(crate) fn max_episode_steps(task: &str) -> Option<usize> {
    task_files::max_episode_steps(task)
}

struct Inner {
    env: Box<dyn env::Env>,
    rng: ChaCha8Rng,
}

impl Inner {
    fn observation(&self) -> Vec<f64> {
        let mut obs = vec![0.0; self.env.spec().n_obs()];
        self.env.observe(&mut obs);
        obs
    }
}

/// A task on one simulated robot, without Gymnasium's ceremony (see `nearl.Env`).
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Env {
    inner: Mutex<Inner>,
    spec: env::Spec,
    folder: Option<PathBuf>,
}

type Stepped<'py> = (Bound<'py, PyArray1<f64>>, f64, f64, bool, Option<&'static str>);

#[pymethods]
impl Env {
    #[new]
    fn new(py: Python<'_>, task: &str) -> PyResult<Env> {
        let made = py.detach(|| {
            let manifest = task_files::load(task, &[])?;
            Ok::<_, TaskLoadError>((env::of_task(&manifest, task)?, manifest))
        });
        let (env, manifest) = made.map_err(errors::task)?;
        Ok(Env::around(env, &manifest))
    }

    /// The environment that a snapshot, or the run in a folder, was trained in.
    #[staticmethod]
    fn of_snapshot(py: Python<'_>, path: PathBuf) -> PyResult<Env> {
        let (env, manifest) = py.detach(|| {
            let file =
                if path.is_dir() { run_folder::snapshot_of(&path).map_err(errors::value)? } else { path };
            let manifest = Snapshot::load(&file).map_err(|e| errors::snapshot_in(&file, e))?.manifest;
            let env = env::of_task(&manifest, &manifest.task.name).map_err(errors::value)?;
            Ok::<_, PyErr>((env, manifest))
        })?;
        Ok(Env::around(env, &manifest))
    }

    /// Starts an episode from the task's own distribution; `seed` restarts the random stream. Returns the observation (n_obs).
    #[pyo3(signature = (seed=None))]
    fn reset<'py>(&self, py: Python<'py>, seed: Option<u64>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let obs = self.with(py, |inner| {
            if let Some(seed) = seed {
                inner.rng = ChaCha8Rng::seed_from_u64(seed);
            }
            inner.env.reset(&mut inner.rng).map(|()| inner.observation())
        });
        Ok(array(py, &obs.map_err(errors::value)?))
    }

    /// Starts an episode from `qpos` (nq) and `qvel` (nv), MuJoCo's convention, `time` seconds after its beginning. Returns the observation (n_obs).
    #[pyo3(signature = (qpos, qvel, time=0.0))]
    fn set_state<'py>(
        &self,
        py: Python<'py>,
        qpos: &Bound<'py, PyAny>,
        qvel: &Bound<'py, PyAny>,
        time: f64,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let (qpos, qvel) = (vector("qpos", qpos, self.spec.nq)?, vector("qvel", qvel, self.spec.nv)?);
        if !time.is_finite() {
            return Err(errors::value(format!("time is {time}; give the seconds since the episode began")));
        }
        let obs = self.with(py, |inner| {
            inner.env.set_state(&qpos, &qvel)?;
            inner.env.set_time(time);
            Ok::<_, EnvError>(inner.observation())
        });
        Ok(array(py, &obs.map_err(errors::value)?))
    }

    /// Simulates one control period under `action` (n_act). Returns observation (n_obs), reward, cost, terminated, and the fault's name if the physics failed.
    fn step<'py>(&self, py: Python<'py>, action: &Bound<'py, PyAny>) -> PyResult<Stepped<'py>> {
        let action = vector("action", action, self.spec.n_act())?;
        if let Some(i) = action.iter().position(|a| !a.is_finite()) {
            let name = &self.spec.actuators[i].name;
            return Err(errors::value(format!(
                "action[{i}] ('{name}') is {}: every entry must be finite; check the policy's output",
                action[i]
            )));
        }
        let (step, obs) = self.with(py, |inner| (inner.env.step(&action), inner.observation()));
        Ok((array(py, &obs), step.reward, step.cost, step.terminated, fault_name(step.fault)))
    }

    /// The observation (n_obs).
    fn observe<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.with(py, |inner| inner.observation()))
    }

    /// Configuration (nq) and velocity (nv) in Pinocchio's convention, as `Projector` and `Controller` take them.
    fn state<'py>(&self, py: Python<'py>) -> (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>) {
        let (mut q, mut v) = (vec![0.0; self.spec.nq], vec![0.0; self.spec.nv]);
        self.with(py, |inner| inner.env.state(&mut q, &mut v));
        (array(py, &q), array(py, &v))
    }

    /// Forces of the motors (nv) [N m or N] under `action` (n_act) in a state `q` (nq), `v` (nv) of Pinocchio's convention; the
    /// environment stays as it is.
    fn motor_forces<'py>(
        &self,
        py: Python<'py>,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        action: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let (q, v) = (vector("q", q, self.spec.nq)?, vector("v", v, self.spec.nv)?);
        let action = vector("action", action, self.spec.n_act())?;
        let mut force = vec![0.0; self.spec.nv];
        self.with(py, |inner| inner.env.motor_forces(&q, &v, &action, &mut force)).map_err(errors::value)?;
        Ok(array(py, &force))
    }

    /// Configuration (nq), MuJoCo's convention.
    #[getter]
    fn qpos<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.with(py, |inner| inner.env.qpos().to_vec()))
    }

    /// Velocity (nv), MuJoCo's convention.
    #[getter]
    fn qvel<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.with(py, |inner| inner.env.qvel().to_vec()))
    }

    /// What the task asks for (n_goal); empty where it has no goal.
    #[getter]
    fn goal<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.with(py, |inner| inner.env.goal().to_vec()))
    }

    #[setter]
    fn set_goal(&self, goal: &Bound<'_, PyAny>) -> PyResult<()> {
        let py = goal.py();
        let goal: Vec<f64> = goal.extract().map_err(|_| errors::value("goal is not a vector of numbers"))?;
        self.with(py, |inner| inner.env.set_goal(&goal)).map_err(errors::value)
    }

    /// Name of the task.
    #[getter]
    fn task(&self) -> &str {
        &self.spec.name
    }

    /// Names of the observation's entries (n_obs).
    #[getter]
    fn obs_names(&self) -> Vec<String> {
        self.spec.obs.clone()
    }

    /// Joints in MuJoCo's order.
    #[getter]
    fn joint_names(&self) -> Vec<String> {
        self.spec.joints.iter().map(|j| j.name.clone()).collect()
    }

    /// What each entry of the action moves (n_act).
    #[getter]
    fn actuator_names(&self) -> Vec<String> {
        self.spec.actuators.iter().map(|a| a.name.clone()).collect()
    }

    /// Smallest action (n_act).
    #[getter]
    fn action_low<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.spec.action_low().collect::<Vec<_>>())
    }

    /// Largest action (n_act).
    #[getter]
    fn action_high<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.spec.action_high().collect::<Vec<_>>())
    }

    /// Entries of a configuration.
    #[getter]
    fn nq(&self) -> usize {
        self.spec.nq
    }

    /// Degrees of freedom.
    #[getter]
    fn nv(&self) -> usize {
        self.spec.nv
    }

    /// Control period [s].
    #[getter]
    fn dt(&self) -> f64 {
        self.spec.dt
    }

    /// Whether the task counts a cost beside its reward.
    #[getter]
    fn has_cost(&self) -> bool {
        self.spec.has_cost
    }

    /// Control periods after which an episode is truncated by those who count.
    #[getter]
    fn max_episode_steps(&self) -> usize {
        self.spec.max_episode_steps
    }

    /// The robot file's text, with the places of files that it names by a package of ROS.
    #[getter]
    fn model_text(&self, py: Python<'_>) -> String {
        let folder = self.folder.as_deref();
        self.with(py, |inner| mj::placed(inner.env.model_text(), folder))
    }

    /// The folder from which the robot file names other files; None where it names none.
    #[getter]
    fn model_folder(&self) -> Option<PathBuf> {
        self.folder.clone()
    }

    fn __repr__(&self) -> String {
        format!(
            "Env('{}', {} observations, {} actions)",
            self.spec.name,
            self.spec.n_obs(),
            self.spec.n_act()
        )
    }
}

impl Env {
    fn around(env: Box<dyn env::Env>, manifest: &Manifest) -> Env {
        let spec = env.spec().clone();
        // a native environment brings its own robot, which names no file
        let file = robot::simulation(manifest).filter(|file| file.text == env.model_text());
        let folder = file.and_then(|file| file.folder);
        Env { inner: Mutex::new(Inner { env, rng: ChaCha8Rng::seed_from_u64(0) }), spec, folder }
    }

    /// Runs `f` on the environment with the interpreter released.
    fn with<R: Send>(&self, py: Python<'_>, f: impl FnOnce(&mut Inner) -> R + Send) -> R {
        py.detach(|| f(&mut self.inner.lock().unwrap_or_else(std::sync::PoisonError::into_inner)))
    }
}
