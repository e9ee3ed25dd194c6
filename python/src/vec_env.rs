//! Many native environments stepped in one call, on all cores.

use std::path::Path;
use std::sync::Mutex;

use nearl_constraints::{Guard, Model, StateLayout};
use nearl_runtime::controller::Parts;
use nearl_runtime::net::{Dense, DenseLayer};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Controller, Manifest, Networks, PolicyKind, Snapshot};
use nearl_trainer::env::{self, ChaCha8Rng, SeedableRng};
use nearl_trainer::foresight::Foresight;
use nearl_trainer::{plant, tasks, train};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{array, array2, matrix};
use crate::env::fault_name;
use crate::errors;
use crate::lane::{Autoreset, Lane, Meaning, Proposing, Work};
use crate::pool::Pool;

/// `n` environments of one task (see `nearl.make_vec`).
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct VecEnv {
    pool: Mutex<Pool>,
    mode: Autoreset,
    n: usize,
    n_obs: usize,
    names: Vec<String>,
    low: Vec<f64>,
    high: Vec<f64>,
    dt: f64,
}

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
            other => {
                return Err(errors::value(format!(
                    "actions is '{other}'; give \"state\", \"change\" or \"guarded\""
                )));
            }
        };
        if constraints.is_none() && meaning != Meaning::State {
            return Err(errors::value(format!(
                "actions is '{actions}' without constraints; give constraints=\"task\" too"
            )));
        }
        if num_envs == 0 {
            return Err(errors::value("num_envs is 0; ask for at least one environment"));
        }
        py.detach(|| {
            let first = tasks::env(task).map_err(errors::task)?;
            let open = match constraints.as_deref() {
                None => None,
                Some("task") if meaning == Meaning::Action => Some(guarded_snapshot(task)?),
                Some("task") => Some(task_snapshot(task)?),
                Some(_) if meaning == Meaning::Action => {
                    return Err(errors::value(
                        "actions is 'guarded', which needs no trained agent; give constraints=\"task\"",
                    ));
                }
                Some(file) => Some(agent_snapshot(&first.spec().name, file)?),
            };
            let spec = first.spec().clone();
            let max_steps = max_episode_steps.unwrap_or(spec.max_episode_steps);
            let space = match &open {
                None => Space::actions(&spec),
                Some(_) if meaning == Meaning::Action => Space::actions(&spec),
                Some(snapshot) => Space::proposals(snapshot, meaning)?,
            };
            let lanes = (0..num_envs as u64)
                .map(|i| {
                    let env = first.another().map_err(errors::value)?;
                    let proposing = open.as_ref().map(|s| proposing(s, &*env, meaning)).transpose()?;
                    Ok(Lane::new(env, proposing, space.names.len(), max_steps, seed.wrapping_add(i)))
                })
                .collect::<PyResult<Vec<_>>>()?;
            let pool = Pool::new(lanes, threads).map_err(errors::value)?;
            let mode = if same_step { Autoreset::SameStep } else { Autoreset::NextStep };
            let ticks = match &open {
                Some(snapshot) => snapshot.manifest.task.time.policy_every,
                None => 1,
            };
            let (n_obs, dt) = (spec.n_obs(), spec.dt * ticks as f64);
            Ok(VecEnv {
                pool: Mutex::new(pool),
                mode,
                n: num_envs,
                n_obs,
                names: space.names,
                low: space.low,
                high: space.high,
                dt,
            })
        })
    }

    /// Begins an episode everywhere; `seeds` (num_envs) restart the random streams. Returns observations (num_envs x n_obs).
    #[pyo3(signature = (seeds=None))]
    fn reset<'py>(
        &self,
        py: Python<'py>,
        seeds: Option<Vec<Option<u64>>>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let seeds = seeds.unwrap_or_else(|| vec![None; self.n]);
        if seeds.len() != self.n {
            return Err(errors::value(format!(
                "{} seeds for {} environments; give one each",
                seeds.len(),
                self.n
            )));
        }
        let obs = self.with(py, |pool| {
            for (mut lane, seed) in pool.lanes().zip(&seeds) {
                if let Some(seed) = seed {
                    lane.rng = ChaCha8Rng::seed_from_u64(*seed);
                }
            }
            pool.run(Work::Reset)?;
            self.observations(pool)
        });
        array2(py, obs.map_err(errors::value)?, self.n_obs)
    }

    /// One step everywhere: observations, rewards, terminations, truncations and `info`.
    fn step<'py>(&self, py: Python<'py>, actions: &Bound<'py, PyAny>) -> PyResult<Stepped<'py>> {
        let width = self.names.len();
        let actions = matrix("actions", actions, self.n, width)?;
        if let Some(i) = actions.iter().position(|a| !a.is_finite()) {
            let (row, column) = (i / width, i % width);
            return Err(errors::value(format!(
                "actions[{row}, {column}] ('{}') is {}: every entry must be finite; check the policy's output",
                self.names[column], actions[i]
            )));
        }
        let obs = self.with(py, |pool| {
            for (mut lane, action) in pool.lanes().zip(actions.chunks(width)) {
                lane.action.copy_from_slice(action);
            }
            pool.run(Work::Step(self.mode))?;
            self.observations(pool)
        });
        let obs = array2(py, obs.map_err(errors::value)?, self.n_obs)?;
        let pool = self.lock();
        let rewards: Vec<f64> = pool.lanes().map(|l| l.reward).collect();
        let terminated: Vec<bool> = pool.lanes().map(|l| l.terminated).collect();
        let truncated: Vec<bool> = pool.lanes().map(|l| l.truncated).collect();
        let info = info(py, &pool)?;
        let flags = |f: Vec<bool>| PyArray1::from_vec(py, f);
        Ok((obs, array(py, &rewards), flags(terminated), flags(truncated), info))
    }

    /// Ends the episodes chosen (num_envs), as if the task had: by the autoreset mode, a new one begins in the next step, or at
    /// once. Returns observations (num_envs x n_obs).
    fn end<'py>(&self, py: Python<'py>, ended: Vec<bool>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        if ended.len() != self.n {
            return Err(errors::value(format!(
                "{} flags for {} environments; give one each",
                ended.len(),
                self.n
            )));
        }
        let obs = self.with(py, |pool| {
            for (mut lane, _) in pool.lanes().zip(&ended).filter(|(_, ended)| **ended) {
                lane.end(self.mode);
            }
            self.observations(pool)
        });
        array2(py, obs.map_err(errors::value)?, self.n_obs)
    }

    /// Puts environment `index` into a state, MuJoCo's convention; an episode begins there.
    fn set_state(&self, py: Python<'_>, index: usize, qpos: Vec<f64>, qvel: Vec<f64>) -> PyResult<()> {
        let n = self.n;
        let result = self.with(py, |pool| match pool.lanes().nth(index) {
            Some(mut lane) => lane.set_state(&qpos, &qvel).map_err(|e| e.to_string()),
            None => Err(format!("environment {index} of {n} does not exist; count from 0")),
        });
        result.map_err(errors::value)
    }

    /// Configurations (num_envs x nq), MuJoCo's convention.
    #[getter]
    fn qpos<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let rows: Vec<f64> = self.lock().lanes().flat_map(|l| l.env.qpos().to_vec()).collect();
        let width = rows.len() / self.n;
        array2(py, rows, width)
    }

    /// Velocities (num_envs x nv), MuJoCo's convention.
    #[getter]
    fn qvel<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let rows: Vec<f64> = self.lock().lanes().flat_map(|l| l.env.qvel().to_vec()).collect();
        let width = rows.len() / self.n;
        array2(py, rows, width)
    }

    /// Entries of an observation.
    #[getter]
    fn n_obs(&self) -> usize {
        self.n_obs
    }

    /// What each entry of an action is: an actuator, or an entry of the proposed state.
    #[getter]
    fn action_names(&self) -> Vec<String> {
        self.names.clone()
    }

    /// Smallest action.
    #[getter]
    fn action_low<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.low)
    }

    /// Largest action.
    #[getter]
    fn action_high<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.high)
    }

    /// Time of one step [s].
    #[getter]
    fn dt(&self) -> f64 {
        self.dt
    }
}

impl VecEnv {
    fn lock(&self) -> std::sync::MutexGuard<'_, Pool> {
        self.pool.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn with<R: Send>(&self, py: Python<'_>, f: impl FnOnce(&mut Pool) -> R + Send) -> R {
        py.detach(|| f(&mut self.lock()))
    }

    fn observations(&self, pool: &Pool) -> Result<Vec<f64>, String> {
        let mut obs = Vec::with_capacity(self.n * self.n_obs);
        for mut lane in pool.lanes() {
            if let Some(error) = lane.error.take() {
                return Err(error.to_string());
            }
            obs.extend_from_slice(&lane.obs);
        }
        Ok(obs)
    }
}

/// `final_obs`, `fault` and what the projection did, each with its mask `_<key>`, only where there is something to say.
fn info<'py>(py: Python<'py>, pool: &Pool) -> PyResult<Bound<'py, PyDict>> {
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
    put("final_obs", pool.lanes().map(|l| l.final_obs.as_ref().map(|o| array(py, o).into_any())).collect())?;
    let fault = |l: &Lane| fault_name(l.fault).map(|f| pyo3::types::PyString::new(py, f).into_any());
    put("fault", pool.lanes().map(|l| fault(&l)).collect())?;
    if pool.lanes().next().is_some_and(|l| l.env.spec().has_cost) {
        info.set_item("cost", array(py, &pool.lanes().map(|l| l.cost).collect::<Vec<_>>()))?;
    }
    if pool.lanes().next().is_some_and(|l| l.proposing.is_some()) {
        let counts =
            |f: fn(&Lane) -> u32| PyArray1::from_vec(py, pool.lanes().map(|l| f(&l)).collect::<Vec<u32>>());
        info.set_item("raw_violations", counts(|l| l.projected.raw_violations))?;
        info.set_item("target_violations", counts(|l| l.projected.target_violations))?;
        info.set_item("moved", array(py, &pool.lanes().map(|l| l.projected.moved).collect::<Vec<_>>()))?;
    }
    Ok(info)
}

/// Names and range of an action.
struct Space {
    names: Vec<String>,
    low: Vec<f64>,
    high: Vec<f64>,
}

impl Space {
    fn actions(spec: &env::Spec) -> Space {
        let names = spec.actuators.iter().map(|a| a.name.clone()).collect();
        Space { names, low: spec.action_low().collect(), high: spec.action_high().collect() }
    }

    /// A proposed position ranges over the joint's limits, a velocity over its own; anything else is unbounded. A change ranges over [-1, 1].
    fn proposals(snapshot: &Snapshot, meaning: Meaning) -> PyResult<Space> {
        let controller = Controller::new(snapshot).map_err(errors::snapshot)?;
        let (model, layout) = (controller.model(), controller.layout());
        let (mut names, mut low, mut high) = (Vec::new(), Vec::new(), Vec::new());
        for k in 0..layout.n_state() {
            let (l, h) = if meaning == Meaning::Change { (-1.0, 1.0) } else { range(model, layout, k) };
            names.push(layout.state_name(k).to_owned());
            low.push(l);
            high.push(h);
        }
        Ok(Space { names, low, high })
    }
}

fn range(model: &Model, layout: &StateLayout, k: usize) -> (f64, f64) {
    use nearl_constraints::Entry;
    match layout.state_entry(k) {
        Entry::Position { idx_q, .. } => {
            (model.lower_position_limit()[idx_q], model.upper_position_limit()[idx_q])
        }
        Entry::Velocity { dof } => (-model.velocity_limit()[dof], model.velocity_limit()[dof]),
        Entry::Other => (f64::NEG_INFINITY, f64::INFINITY),
    }
}

/// A snapshot of the task alone: its inverse dynamics needs no learning.
fn task_snapshot(task: &str) -> PyResult<Snapshot> {
    let mut manifest = tasks::load(task, &[]).map_err(errors::task)?;
    if manifest.task.idm.kind == IdmKind::Learned {
        return Err(errors::value(format!(
            "task '{task}' has a learned inverse model, so constraints=\"task\" has no way from a proposed state to an action; \
             give the snapshot of a trained agent: constraints=\"runs/{task}/.../checkpoints/final.safetensors\""
        )));
    }
    train::complete(&mut manifest).map_err(errors::value)?;
    let n_obs = manifest.task.state.observation.len();
    let n_state = manifest.task.state.propose.as_ref().map_or(n_obs, Vec::len);
    let normaliser = Normaliser::identity(n_obs, n_state);
    Ok(open(Snapshot {
        networks: Networks {
            normaliser,
            policy: Dense { layers: Vec::new() },
            policy_log_std: Vec::new(),
            idm: None,
        },
        manifest,
    }))
}

/// A trained agent with its inverse model, its policy replaced by the caller.
fn agent_snapshot(task: &str, file: &str) -> PyResult<Snapshot> {
    let snapshot = Snapshot::load(Path::new(file)).map_err(errors::snapshot)?;
    let Manifest { task: of, policy, .. } = &snapshot.manifest;
    if of.name != task {
        return Err(errors::value(format!(
            "snapshot '{file}' was trained on '{}', not on '{task}'",
            of.name
        )));
    }
    if *policy == PolicyKind::Direct {
        return Err(errors::value(format!(
            "snapshot '{file}' holds a policy that acts directly: it has no inverse model; give one trained with pid2-ib"
        )));
    }
    Ok(open(snapshot))
}

/// The same with a policy of zeros and unit deviation: the noise becomes the proposed change.
fn open(mut snapshot: Snapshot) -> Snapshot {
    let (n_obs, n_state) =
        (snapshot.networks.normaliser.mean.len(), snapshot.networks.normaliser.scale.len());
    snapshot.networks.policy = Dense { layers: vec![zeros(n_obs, n_state)] };
    snapshot.networks.policy_log_std = vec![0.0; n_state];
    snapshot.manifest.policy = PolicyKind::Stochastic;
    snapshot.manifest.functions.clear();
    snapshot
}

/// The task's limits around actions as the actuators take them: by the robot model where it knows what they lead to, else by the simulator.
fn guarded_snapshot(task: &str) -> PyResult<Snapshot> {
    let mut manifest = tasks::load(task, &[]).map_err(errors::task)?;
    let by_model = manifest.task.idm.kind == IdmKind::Pinocchio;
    manifest.task.constraints.guard = if by_model { Guard::Model } else { Guard::Simulator };
    train::complete(&mut manifest).map_err(errors::value)?;
    manifest.policy = PolicyKind::Direct;
    let n_obs = manifest.task.state.observation.len();
    let n_state = manifest.task.state.propose.as_ref().map_or(n_obs, Vec::len);
    let n_act = manifest.action_lower.len();
    let policy = Dense { layers: vec![zeros(n_obs, n_act)] };
    let normaliser = Normaliser::identity(n_obs, n_state);
    let networks = Networks { normaliser, policy, policy_log_std: vec![0.0; n_act], idm: None };
    Ok(Snapshot { manifest, networks })
}

fn zeros(n_in: usize, n_out: usize) -> DenseLayer {
    DenseLayer { n_in, n_out, weight: vec![0.0; n_in * n_out], bias: vec![0.0; n_out] }
}

fn proposing(snapshot: &Snapshot, env: &dyn env::Env, meaning: Meaning) -> PyResult<Proposing> {
    let controller = Controller::new(snapshot).map_err(errors::snapshot)?;
    let (state, noise, out) = (controller.state(), controller.noise(), controller.output());
    let scale = controller.normaliser().scale.clone();
    let unit = if meaning == Meaning::Change { units(snapshot, &controller)? } else { Vec::new() };
    let asks = meaning == Meaning::Action && snapshot.manifest.task.constraints.guard == Guard::Simulator;
    let foresight = asks
        .then(|| Foresight::new(env, &plant::watched_limits(env, controller.model(), controller.limits())));
    Ok(Proposing { meaning, unit, foresight, scale, controller, state, noise, out })
}

/// The change that an action of 1 asks for: what the limits allow in a policy period, or three standard deviations of a trained agent's changes.
fn units(snapshot: &Snapshot, controller: &Controller) -> PyResult<Vec<f64>> {
    if snapshot.manifest.task.idm.kind == IdmKind::Learned {
        return Ok(controller.normaliser().scale.iter().map(|s| 3.0 * s).collect());
    }
    let parts = Parts::new(&snapshot.manifest).map_err(errors::snapshot)?;
    train::limit_scale(&parts, &snapshot.manifest).map_err(errors::value)
}
