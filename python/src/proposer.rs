//! A process that proposes in place of a policy, from Python (see `nearl.Proposer`).

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use nearl_runtime::link::{LinkError, ProposerLink, RobotName};
use nearl_runtime::rt::Mode;
use numpy::PyArray1;
use pyo3::exceptions::PyConnectionError;
use pyo3::prelude::*;

use crate::arrays::{array, vector};
use crate::errors;
use crate::link::{SIGNALS, seconds};

/// The proposer of a loop.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct ProposerClient {
    link: Mutex<Option<ProposerLink>>,
    n: usize,
    name: RobotName,
}

type Numbers<'py> = Bound<'py, PyArray1<f64>>;
type Seen<'py> = (Numbers<'py>, Numbers<'py>, Numbers<'py>, f64, u64, u64);

#[pymethods]
impl ProposerClient {
    /// Waits up to `patience` [s] for a loop of `name` that asks for proposals.
    #[new]
    fn new(py: Python<'_>, name: &str, patience: f64) -> PyResult<ProposerClient> {
        let name = RobotName::new(name).map_err(errors::value)?;
        let patience = seconds(patience)?;
        let opened = py.detach(|| ProposerLink::open(&name, patience));
        let link = opened.map_err(|e| match e {
            LinkError::Name(_) => errors::value(e),
            other => PyConnectionError::new_err(other.to_string()),
        })?;
        Ok(ProposerClient { n: link.asked().entries.len(), link: Mutex::new(Some(link)), name })
    }

    /// What is asked for: whether it is commands, names, control period [s], ticks to reach a state in, age limit [s], hold [s].
    fn asked(&self) -> PyResult<(bool, Vec<String>, f64, usize, f64, f64)> {
        let asked = self.with(|link| link.asked())?;
        Ok((asked.is_action, asked.entries, asked.dt, asked.policy_every, asked.age_limit, asked.hold))
    }

    /// The newest state that was not read before: q (nq), v (nv), obs (n_obs), time [s], tick, episode; waits up to `patience` [s] for one.
    fn state<'py>(&self, py: Python<'py>, patience: f64) -> PyResult<Option<Seen<'py>>> {
        let (start, patience) = (Instant::now(), seconds(patience)?);
        loop {
            let wait = SIGNALS.min(patience.saturating_sub(start.elapsed())).max(Duration::from_micros(1));
            let found = py.detach(|| self.with(|link| link.wait_for_state(wait).copied()))?;
            if let Some(s) = found {
                let seen =
                    (array(py, s.q()), array(py, s.v()), array(py, s.obs()), s.time, s.tick, s.episode);
                return Ok(Some(seen));
            }
            if start.elapsed() >= patience {
                return Ok(None);
            }
            py.check_signals()?;
        }
    }

    /// Proposes `values` (n_entries), as an answer to the state read last.
    fn propose(&self, values: &Bound<'_, PyAny>) -> PyResult<()> {
        let values = vector("values", values, self.n)?;
        self.with(|link| link.propose(&values)).map(|_| ())
    }

    /// What the loop said last: its mode, and proposals taken, overtaken, refused, ticks held, ticks silent.
    fn account(&self) -> PyResult<(&'static str, [u64; 5])> {
        self.with(|link| {
            let a = link.account();
            (Mode::from_code(a.mode).name(), [a.taken, a.overtaken, a.refused, a.held, a.silent])
        })
    }

    /// Leaves.
    fn close(&self, py: Python<'_>) {
        py.detach(|| drop(self.lock().take()));
    }
}

/// Writes the robot and the limits of a task as a snapshot without a policy.
#[pyfunction]
pub(crate) fn blank(task: &str, path: std::path::PathBuf, actions: bool) -> PyResult<()> {
    let snapshot = nearl_trainer::blank::snapshot(task, actions).map_err(errors::value)?;
    snapshot.save(&path).map_err(errors::value)
}

impl ProposerClient {
    fn lock(&self) -> MutexGuard<'_, Option<ProposerLink>> {
        self.link.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn with<T>(&self, use_it: impl FnOnce(&mut ProposerLink) -> T) -> PyResult<T> {
        let name = &self.name;
        let closed = || {
            PyConnectionError::new_err(format!(
                "the proposer of `{name}` is closed: open another nearl.Proposer"
            ))
        };
        self.lock().as_mut().map(use_it).ok_or_else(closed)
    }
}
