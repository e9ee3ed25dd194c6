//! The client of a rollout server (see `nearl.Link`).

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use nearl_runtime::link::{LinkError, RobotName};
use nearl_trainer::rollout_protocol::{self as protocol, Chunk, Constraints, Request, RequestError};
use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::exceptions::{PyConnectionError, PyRuntimeError, PyTimeoutError, PyValueError};
use pyo3::prelude::*;

use crate::errors;

/// Between two looks at Python's signals while waiting.
pub(crate) const SIGNALS: Duration = Duration::from_millis(100);

fn error(py: Python<'_>, error: RequestError) -> PyErr {
    match error {
        RequestError::Link(LinkError::Name(_)) => errors::value(error),
        RequestError::TooMany(_) => PyRuntimeError::new_err(error.to_string()),
        RequestError::Silent { .. } | RequestError::Behind { .. } => {
            PyTimeoutError::new_err(error.to_string())
        }
        RequestError::Refused { answer, text } => {
            let class = py.import("nearl.link").and_then(|m| m.getattr("RolloutRefused"));
            match class.and_then(|class| class.call1((answer.name(), text))) {
                Ok(refused) => PyErr::from_value(refused),
                Err(failed) => failed,
            }
        }
        other => PyConnectionError::new_err(other.to_string()),
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Time in [s] from Python.
pub(crate) fn seconds(patience: f64) -> PyResult<Duration> {
    Duration::try_from_secs_f64(patience).map_err(|_| {
        PyValueError::new_err(format!("patience is {patience} s; give a finite time of at least 0"))
    })
}

/// The connection to a rollout server.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct RolloutClient {
    inner: Mutex<Option<protocol::RolloutClient>>,
    name: RobotName,
}

#[pymethods]
impl RolloutClient {
    /// Waits up to `patience` [s] for the server of `name`.
    #[new]
    fn new(py: Python<'_>, name: &str, patience: f64) -> PyResult<RolloutClient> {
        let name = RobotName::new(name).map_err(errors::value)?;
        let patience = seconds(patience)?;
        let client = py.detach(|| protocol::RolloutClient::open(&name, patience));
        Ok(RolloutClient { inner: Mutex::new(Some(client.map_err(|e| error(py, e))?)), name })
    }

    /// Sends a request; `version` None takes the server's policy, `constraints` None its constraints and 0 none.
    #[pyo3(signature = (seed, n_steps, noise, version, constraints))]
    fn request(
        &self,
        py: Python<'_>,
        seed: u64,
        n_steps: u64,
        noise: bool,
        version: Option<u64>,
        constraints: Option<u64>,
    ) -> PyResult<Rollouts> {
        let constraints = match constraints {
            None => Constraints::Own,
            Some(0) => Constraints::Off,
            Some(id) => Constraints::Id(id),
        };
        let request = Request { version, noise, constraints, ..Request::new(seed, n_steps) };
        let sent = py.detach(|| lock(&self.inner).as_mut().map(|client| client.request(&request)));
        let name = &self.name;
        let closed =
            || PyConnectionError::new_err(format!("the link to `{name}` is closed: open another nearl.Link"));
        let rollouts = sent.ok_or_else(closed)?.map_err(|e| error(py, e))?;
        Ok(Rollouts { inner: Mutex::new(Some(rollouts)) })
    }

    /// Leaves; rollouts under way can still be read.
    fn close(&self, py: Python<'_>) {
        py.detach(|| drop(lock(&self.inner).take()));
    }
}

/// The answers to one request.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Rollouts {
    inner: Mutex<Option<protocol::Rollouts>>,
}

type Numbers<'py> = (u64, u64, u64, u64, Bound<'py, PyArray2<f64>>, Vec<(&'static str, usize)>);

#[pymethods]
impl Rollouts {
    /// The next chunk: its number, its first step, the versions of policy and constraints, the rows (rows x
    /// columns), and the names and widths of their columns. None at the end.
    fn next<'py>(&self, py: Python<'py>, patience: f64) -> PyResult<Option<Numbers<'py>>> {
        let (start, patience) = (Instant::now(), seconds(patience)?);
        loop {
            let wait = SIGNALS.min(patience.saturating_sub(start.elapsed()));
            let next = py.detach(|| lock(&self.inner).as_mut().map_or(Ok(None), |r| r.next(wait)));
            match next {
                Ok(None) => return Ok(None),
                Ok(Some(chunk)) => return numbers(py, chunk).map(Some),
                Err(RequestError::Silent { name, .. }) if start.elapsed() >= patience => {
                    return Err(error(py, RequestError::Silent { name, seconds: patience.as_secs_f64() }));
                }
                Err(RequestError::Silent { .. }) => py.check_signals()?,
                Err(other) => return Err(error(py, other)),
            }
        }
    }

    /// Asks the server to stop; what is under way still comes.
    fn cancel(&self, py: Python<'_>) {
        py.detach(|| lock(&self.inner).as_mut().into_iter().for_each(protocol::Rollouts::cancel));
    }

    /// Leaves without waiting; frees the server's place.
    fn close(&self, py: Python<'_>) {
        py.detach(|| drop(lock(&self.inner).take()));
    }
}

fn numbers(py: Python<'_>, chunk: Chunk) -> PyResult<Numbers<'_>> {
    let shape = [chunk.rows, chunk.layout.width()];
    let columns = chunk.layout.columns().to_vec();
    let rows = PyArray1::from_vec(py, chunk.numbers).reshape(shape)?;
    Ok((chunk.sequence, chunk.first_step, chunk.version, chunk.constraints, rows, columns))
}

/// Names of the entries of a chunk's ledger.
#[pyfunction]
pub(crate) fn rollout_ledger() -> Vec<&'static str> {
    protocol::LEDGER.to_vec()
}
