//! A robot's driver, and the loop beside it, from Python (see `nearl.Plant` and `nearl.Loop`).

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use nearl_runtime::link::{Exchange, LinkError, Robot, RobotName, STATE_RESET, Turn};
use nearl_runtime::rt::{
    ProposerSettings, RollbackSettings, RunError, RunReport, RunSettings, Stop, ThreadSettings, run,
};
use numpy::PyArray1;
use pyo3::exceptions::{PyConnectionError, PyRuntimeError};
use pyo3::prelude::*;

use crate::arrays::{array, number, vector};
use crate::errors;

fn error(error: LinkError) -> PyErr {
    match error {
        LinkError::Name(_) | LinkError::Announced { .. } => errors::value(error),
        other => PyConnectionError::new_err(other.to_string()),
    }
}

/// A robot or simulator in front of a loop.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Plant {
    exchange: Mutex<Option<Exchange>>,
    /// nq, nv, n_obs.
    sizes: [usize; 3],
}

type Told<'py> = (&'static str, Option<Bound<'py, PyArray1<f64>>>);

#[pymethods]
impl Plant {
    /// Announces the robot; joints in the order of v. After `watchdog` [s] without a fresh action the plant is told to brake.
    #[new]
    #[pyo3(signature = (name, joints, observation, dt, nu, *, nq=None, nv=None, watchdog, lockstep=false))]
    fn new(
        name: &str,
        joints: Vec<String>,
        observation: Vec<String>,
        dt: &Bound<'_, PyAny>,
        nu: usize,
        nq: Option<usize>,
        nv: Option<usize>,
        watchdog: &Bound<'_, PyAny>,
        lockstep: bool,
    ) -> PyResult<Plant> {
        let (dt, watchdog) = (number("dt", dt)?, number("watchdog", watchdog)?);
        for (what, value) in [("dt", dt), ("watchdog", watchdog)] {
            if !(value.is_finite() && value > 0.0) {
                return Err(errors::value(format!("{what} is {value} s; give a positive number of seconds")));
            }
        }
        let (nq, nv, n_obs) = (nq.unwrap_or(joints.len()), nv.unwrap_or(joints.len()), observation.len());
        let robot = Robot { joints, observation, limits: 0, stated: None, nq, nv, nu, dt, lockstep };
        let name = RobotName::new(name).map_err(errors::value)?;
        let exchange = Exchange::open(&name, &robot, watchdog).map_err(error)?;
        Ok(Plant { exchange: Mutex::new(Some(exchange)), sizes: [nq, nv, n_obs] })
    }

    /// Gives the state q (nq) [rad or m], v (nv) [rad/s or m/s], obs (n_obs) to the loop and waits at most `patience` [s] for an action
    /// (nu): ("act", action), ("hold", the action before) or ("brake", None).
    #[pyo3(signature = (q, v, obs, patience, *, time=0.0, episode=0, begins=false, braked=false))]
    #[expect(clippy::too_many_arguments)]
    fn exchange<'py>(
        &self,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        obs: &Bound<'py, PyAny>,
        patience: f64,
        time: f64,
        episode: u64,
        begins: bool,
        braked: bool,
    ) -> PyResult<Told<'py>> {
        let py = q.py();
        let [nq, nv, n_obs] = self.sizes;
        let (q, v, obs) = (vector("q", q, nq)?, vector("v", v, nv)?, vector("obs", obs, n_obs)?);
        if !(0.0..=1e6).contains(&patience) {
            return Err(errors::value(format!("patience is {patience} s; give 0 to 1e6 seconds")));
        }
        let told = py.detach(|| {
            let mut open = self.open();
            let exchange = open.as_mut()?;
            if braked {
                exchange.braked();
            }
            let state = exchange.state();
            (state.time, state.episode, state.bits) = (time, episode, if begins { STATE_RESET } else { 0 });
            Some(match exchange.exchange(&q, &v, &obs, patience) {
                Turn::Act(action) => ("act", Some(action.to_vec())),
                Turn::Hold(action) => ("hold", Some(action.to_vec())),
                Turn::Brake => ("brake", None),
            })
        });
        let (turn, action) =
            told.ok_or_else(|| PyRuntimeError::new_err("the plant is closed; open another one"))?;
        Ok((turn, action.map(|a| array(py, &a))))
    }

    /// Whether a loop answered the last exchange.
    #[getter]
    fn attached(&self) -> bool {
        self.open().as_ref().is_some_and(Exchange::is_attached)
    }

    /// Leaves; the loop sees that the plant is gone.
    fn close(&self) {
        *self.open() = None;
    }
}

impl Plant {
    fn open(&self) -> MutexGuard<'_, Option<Exchange>> {
        self.exchange.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// How often a wait for the end of a loop looks for signals.
const SIGNALS: Duration = Duration::from_millis(5);

type Running = JoinHandle<Result<RunReport, RunError>>;

/// `nearl run` on threads of this process.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct LoopThread {
    stop: Stop,
    running: Mutex<Option<Running>>,
}

#[pymethods]
impl LoopThread {
    /// Starts the loop of a snapshot on the plant `name`.
    #[new]
    #[pyo3(signature = (snapshot, name, *, seconds=None, log=None, patience=None, ramp=None, priority=None, proposal_age=None,
                        proposal_hold=None, rollback_window=None))]
    fn new(
        snapshot: PathBuf,
        name: &str,
        seconds: Option<f64>,
        log: Option<PathBuf>,
        patience: Option<f64>,
        ramp: Option<f64>,
        priority: Option<i32>,
        proposal_age: Option<f64>,
        proposal_hold: Option<f64>,
        rollback_window: Option<i64>,
    ) -> PyResult<LoopThread> {
        for (what, value) in [("proposal_age", proposal_age), ("proposal_hold", proposal_hold)] {
            if let Some(value) = value.filter(|value| !(0.0..=1e6).contains(value)) {
                return Err(errors::value(format!("{what} is {value} s; give 0 to 1e6 seconds")));
            }
        }
        let nanoseconds = |s: f64| (s * 1e9) as u64;
        let proposer = proposal_age.map(|age| ProposerSettings {
            age_limit: nanoseconds(age),
            hold: proposal_hold.map_or(ProposerSettings::default().hold, nanoseconds),
        });
        let name = RobotName::new(name).map_err(errors::value)?;
        if let Some(priority) = priority.filter(|priority| !(0..=99).contains(priority)) {
            return Err(errors::value(format!(
                "priority is {priority}; give 1 to 99, or 0 for the normal scheduler"
            )));
        }
        let priority = priority.filter(|priority| *priority > 0);
        let thread = ThreadSettings { priority, cpu: None, lock_memory: priority.is_some() };
        let unsaid = RunSettings::default();
        let (patience, ramp) = (patience.unwrap_or(unsaid.patience), ramp.unwrap_or(unsaid.ramp));
        let most = RollbackSettings::MOST_WINDOW;
        let window = match rollback_window {
            None => unsaid.rollback.window,
            Some(window) => {
                usize::try_from(window).ok().filter(|window| *window <= most).ok_or_else(|| {
                    errors::value(format!("rollback_window is {window} ticks; give 0 to {most}"))
                })?
            }
        };
        let rollback = RollbackSettings { window, ..unsaid.rollback };
        let settings = RunSettings { seconds, log, patience, ramp, thread, proposer, rollback, ..unsaid };
        settings.check().map_err(errors::value)?;
        let stop = Stop::new();
        let running = std::thread::Builder::new().name("nearl-loop".into()).spawn({
            let stop = stop.clone();
            move || run(&settings, &snapshot, &name, &stop)
        });
        let running =
            running.map_err(|e| PyRuntimeError::new_err(format!("no thread could be started: {e}")))?;
        Ok(LoopThread { stop, running: Mutex::new(Some(running)) })
    }

    /// Whether it still runs.
    #[getter]
    fn running(&self) -> bool {
        let held = self.running.lock().unwrap_or_else(PoisonError::into_inner);
        held.as_ref().is_some_and(|thread| !thread.is_finished())
    }

    /// Asks it to stop (unless `wait`), waits for its end and returns the report as JSON. A signal that Python raises ends the waiting, not the loop.
    #[pyo3(signature = (wait=false))]
    fn end(&self, py: Python<'_>, wait: bool) -> PyResult<String> {
        if !wait {
            self.stop.request();
        }
        while self.running() {
            py.detach(|| std::thread::sleep(SIGNALS));
            py.check_signals()?;
        }
        let taken = self.running.lock().unwrap_or_else(PoisonError::into_inner).take();
        let thread = taken.ok_or_else(|| PyRuntimeError::new_err("the loop has ended; start another one"))?;
        let report = py
            .detach(|| thread.join())
            .map_err(|_| PyRuntimeError::new_err("the loop panicked; report it"))?;
        let report = report.map_err(|e| PyRuntimeError::new_err(e.to_string()))?;
        serde_json::to_string(&report).map_err(errors::value)
    }
}
