//! The client of a running loop (see `nearl.Link`).

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use nearl_constraints::description::Payload;
use nearl_runtime::link::{
    LinkError, OperatorLink, ReceiptMessage, RobotName, TrainerLink, TransitionMessage, Verdict,
};
use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::exceptions::PyConnectionError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::errors;
use crate::limits;
use crate::link::{SIGNALS, seconds};

/// Pause when the stream is empty.
const NAP: Duration = Duration::from_millis(1);

/// The connection to a loop.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct LoopClient {
    inner: Mutex<Option<Inner>>,
    name: RobotName,
}

struct Inner {
    link: TrainerLink,
    /// Snapshots pushed.
    pushed: u64,
    /// Once limits were moved.
    operator: Option<OperatorLink>,
}

fn error(error: LinkError) -> PyErr {
    match error {
        LinkError::Name(_) => errors::value(error),
        other => PyConnectionError::new_err(other.to_string()),
    }
}

#[pymethods]
impl LoopClient {
    /// Waits up to `patience` [s] for the loop of `name`.
    #[new]
    fn new(py: Python<'_>, name: &str, patience: f64) -> PyResult<LoopClient> {
        let name = RobotName::new(name).map_err(errors::value)?;
        let patience = seconds(patience)?;
        let link = py.detach(|| {
            let mut link = TrainerLink::open(&name)?;
            link.wait_for_runtime(patience)?;
            Ok(link)
        });
        let inner = Inner { link: link.map_err(error)?, pushed: 0, operator: None };
        Ok(LoopClient { inner: Mutex::new(Some(inner)), name })
    }

    /// All transitions since the last call, as arrays by name, and how many were lost so far; waits up to `patience` [s] for the
    /// first one.
    fn transitions<'py>(&self, py: Python<'py>, patience: f64) -> PyResult<(Bound<'py, PyDict>, u64)> {
        let (start, patience) = (Instant::now(), seconds(patience)?);
        loop {
            let wait = SIGNALS.min(patience.saturating_sub(start.elapsed()));
            let (all, lost) = py
                .detach(|| self.with(|inner| (read(&mut inner.link, wait), inner.link.lost_transitions())))?;
            if !all.is_empty() || start.elapsed() >= patience {
                return Ok((arrays(py, &all)?, lost));
            }
            py.check_signals()?;
        }
    }

    /// Pushes the bytes of a snapshot: whether the loop took it, the code of its answer, its sentence, and the first tick.
    fn push(
        &self,
        py: Python<'_>,
        bytes: Vec<u8>,
        patience: f64,
    ) -> PyResult<(bool, &'static str, String, u64)> {
        let patience = seconds(patience)?;
        let receipt = py.detach(|| {
            self.with(|Inner { link, pushed, .. }| {
                *pushed += 1;
                link.push(*pushed, &bytes)?;
                link.wait_for_receipt(*pushed, patience)
            })
        })?;
        let receipt = receipt.map_err(error)?;
        Ok(answer(&receipt))
    }

    /// Moves the loop's limits: whether it took them, the code of its answer, its sentence, and the first tick.
    #[pyo3(signature = (
        patience, *, speed=1.0, velocity=None, acceleration=None, lower=None, upper=None, frame=None, frame_speed=None, energy=None,
        plane=None, body=None, payload=None
    ))]
    fn move_limits(
        &self,
        py: Python<'_>,
        patience: f64,
        speed: f64,
        #[pyo3(from_py_with = limits::velocity)] velocity: Option<limits::Values>,
        #[pyo3(from_py_with = limits::acceleration)] acceleration: Option<limits::Values>,
        #[pyo3(from_py_with = limits::lower)] lower: Option<limits::Values>,
        #[pyo3(from_py_with = limits::upper)] upper: Option<limits::Values>,
        #[pyo3(from_py_with = limits::frame)] frame: limits::Named,
        #[pyo3(from_py_with = limits::frame_speed)] frame_speed: limits::Named,
        #[pyo3(from_py_with = limits::energy)] energy: Option<f64>,
        #[pyo3(from_py_with = limits::plane)] plane: limits::Places,
        #[pyo3(from_py_with = limits::body)] body: limits::Places,
        payload: Option<(String, f64, [f64; 3], [f64; 6])>,
    ) -> PyResult<(bool, &'static str, String, u64)> {
        let patience = seconds(patience)?;
        let joints = [velocity, acceleration, lower, upper];
        let mut moved = limits::moved(speed, joints, [frame, frame_speed], energy, [plane, body]);
        moved.payload = payload.map(|(frame, mass, com, inertia)| Payload { frame, mass, com, inertia });
        let receipt = py.detach(|| {
            self.with(|Inner { operator, .. }| {
                if operator.is_none() {
                    *operator = Some(OperatorLink::open(&self.name, patience)?);
                }
                operator.as_mut().map(|link| link.move_limits(&moved, patience)).transpose()
            })
        })?;
        let closed = || LinkError::NoRuntime(self.name.clone());
        let receipt = receipt.and_then(|receipt| receipt.ok_or_else(closed)).map_err(error)?;
        Ok(answer(&receipt))
    }

    /// Leaves.
    fn close(&self, py: Python<'_>) {
        py.detach(|| drop(self.lock().take()));
    }
}

impl LoopClient {
    fn lock(&self) -> MutexGuard<'_, Option<Inner>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn with<T>(&self, use_it: impl FnOnce(&mut Inner) -> T) -> PyResult<T> {
        let name = &self.name;
        let closed =
            || PyConnectionError::new_err(format!("the link to `{name}` is closed: open another nearl.Link"));
        self.lock().as_mut().map(use_it).ok_or_else(closed)
    }
}

/// What is there; waits for the first one.
fn read(link: &mut TrainerLink, patience: Duration) -> Vec<TransitionMessage> {
    let end = Instant::now() + patience;
    loop {
        link.attend();
        let all: Vec<_> = std::iter::from_fn(|| link.transition()).take(1 << 14).collect();
        if !all.is_empty() || Instant::now() >= end {
            return all;
        }
        std::thread::sleep(NAP);
    }
}

type Numbers = fn(&TransitionMessage) -> &[f64];
type Integer = fn(&TransitionMessage) -> u64;
type Number = fn(&TransitionMessage) -> f64;

const VECTORS: [(&str, Numbers); 9] = [
    ("q", TransitionMessage::q),
    ("v", TransitionMessage::v),
    ("obs", TransitionMessage::obs),
    ("proposal_q", TransitionMessage::proposal_q),
    ("proposal_v", TransitionMessage::proposal_v),
    ("target_q", TransitionMessage::target_q),
    ("target_v", TransitionMessage::target_v),
    ("action", TransitionMessage::action),
    ("time", |t| std::slice::from_ref(&t.time)),
];
const INTEGERS: [(&str, Integer); 11] = [
    ("tick", |t| t.tick),
    ("version", |t| t.policy_version),
    ("epoch", |t| t.state_epoch),
    ("sequence", |t| t.state_seq),
    ("next_sequence", |t| t.next_state_seq),
    ("episode", |t| t.episode),
    ("next_bits", |t| u64::from(t.next_bits)),
    ("mode", |t| u64::from(t.mode)),
    ("period_tick", |t| u64::from(t.period_tick)),
    ("raw_violations", |t| u64::from(t.ledger.raw_violations)),
    ("target_violations", |t| u64::from(t.ledger.target_violations)),
];
const NUMBERS: [(&str, Number); 3] = [
    ("log_prob_proposal", |t| t.log_prob_proposal),
    ("log_prob_action", |t| t.log_prob_action),
    ("moved", |t| t.ledger.moved),
];

fn arrays<'py>(py: Python<'py>, all: &[TransitionMessage]) -> PyResult<Bound<'py, PyDict>> {
    // A plant that came back as another robot begins another array; the loop gives it no action anyway.
    let sizes = |t: &TransitionMessage| (t.nq, t.nv, t.nu, t.n_obs);
    let same: Vec<_> =
        all.iter().filter(|t| all.last().is_some_and(|last| sizes(last) == sizes(t))).collect();
    let arrays = PyDict::new(py);
    for (name, get) in VECTORS {
        let width = same.first().map_or(0, |t| get(t).len());
        let numbers: Vec<f64> = same.iter().flat_map(|t| get(t).iter().copied()).collect();
        let array: Bound<'py, PyArray2<f64>> =
            PyArray1::from_vec(py, numbers).reshape([same.len(), width])?;
        arrays.set_item(name, array)?;
    }
    for (name, get) in INTEGERS {
        arrays.set_item(name, PyArray1::from_vec(py, same.iter().map(|t| get(t)).collect()))?;
    }
    for (name, get) in NUMBERS {
        arrays.set_item(name, PyArray1::from_vec(py, same.iter().map(|t| get(t)).collect()))?;
    }
    Ok(arrays)
}

/// Names of the loop's modes by their number.
#[pyfunction]
pub(crate) fn loop_modes() -> Vec<&'static str> {
    nearl_runtime::rt::Mode::ALL.iter().map(|mode| mode.name()).collect()
}

/// Whether the loop took it, the code of its answer, its sentence, and the first tick.
fn answer(receipt: &ReceiptMessage) -> (bool, &'static str, String, u64) {
    let verdict = receipt.verdict();
    (verdict == Verdict::Accepted, verdict.name(), receipt.text(), receipt.tick)
}
