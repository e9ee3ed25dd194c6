//! The viewer of a running loop (see `nearl.view`).

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use nearl_constraints::{Kind, Rung};
use nearl_runtime::codes::LedgerStatus;
use nearl_runtime::link::{LeanedOn, LinkError, RobotName, RowsMessage, TickMessage, ViewLink, Watched};
use nearl_runtime::rt::{Mode, Reason};
use numpy::PyArray1;
use pyo3::exceptions::PyConnectionError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::array;
use crate::errors;
use crate::link::{SIGNALS, seconds};

/// Reads the ticks of a loop and the names and limits of its rows; the loop does not wait for it.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct ViewClient {
    inner: Mutex<Option<Inner>>,
    name: RobotName,
}

struct Inner {
    link: ViewLink,
    rows: RowsMessage,
    /// The plant waits for every action, so no tick has a deadline.
    is_lockstep: bool,
}

#[pymethods]
impl ViewClient {
    /// Waits up to `patience` [s] for the loop of `name`.
    #[new]
    fn new(py: Python<'_>, name: &str, patience: f64) -> PyResult<ViewClient> {
        let name = RobotName::new(name).map_err(errors::value)?;
        let patience = seconds(patience)?;
        let opened = py.detach(|| {
            let mut link = ViewLink::open(&name)?;
            let rows = link.wait_for_rows(patience)?;
            let is_lockstep = link.wait_for_plant(patience)?.is_lockstep();
            Ok(Inner { link, rows, is_lockstep })
        });
        let inner = opened.map_err(|e| match e {
            LinkError::Name(_) => errors::value(e),
            other => PyConnectionError::new_err(other.to_string()),
        })?;
        Ok(ViewClient { inner: Mutex::new(Some(inner)), name })
    }

    /// Task, row names and limits of the snapshot in use, and whether the plant waits for every action: a dict.
    fn told<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        self.with(|inner| {
            let (rows, out) = (&inner.rows, PyDict::new(py));
            out.set_item("task", rows.task_name())?;
            out.set_item("rows", rows.row_names())?;
            out.set_item(
                "kinds",
                rows.row_kinds().iter().map(|kind| kind.map(Kind::name)).collect::<Vec<_>>(),
            )?;
            out.set_item("snapshot", rows.snapshot)?;
            out.set_item("lockstep", inner.is_lockstep)?;
            let limits = [
                ("lower_position", rows.q_lower()),
                ("upper_position", rows.q_upper()),
                ("velocity", rows.velocity()),
                ("acceleration", rows.acceleration()),
                ("effort", rows.effort()),
            ];
            for (name, values) in limits {
                out.set_item(name, array(py, values))?;
            }
            Ok(out)
        })?
    }

    /// What the ticks of the next `span` [s] did, as a dict; none where no tick came.
    fn look<'py>(&self, py: Python<'py>, span: f64) -> PyResult<Option<Bound<'py, PyDict>>> {
        let (start, span) = (Instant::now(), seconds(span)?);
        let mut watched = Watched::default();
        loop {
            let wait = SIGNALS.min(span.saturating_sub(start.elapsed()));
            py.detach(|| {
                self.with(|inner| {
                    if let Some(rows) = inner.link.watch(wait, &mut watched) {
                        inner.rows = rows;
                    }
                })
            })?;
            if start.elapsed() >= span {
                break;
            }
            py.check_signals()?;
        }
        let Some(tick) = &watched.newest else { return Ok(None) };
        let lost = self.with(|inner| inner.link.lost())?;
        picture(py, tick, &watched, lost).map(Some)
    }

    /// Leaves.
    fn close(&self, py: Python<'_>) {
        py.detach(|| drop(self.inner.lock().unwrap_or_else(PoisonError::into_inner).take()));
    }
}

impl ViewClient {
    fn with<T>(&self, use_it: impl FnOnce(&mut Inner) -> T) -> PyResult<T> {
        let name = &self.name;
        let closed = || PyConnectionError::new_err(format!("the view of `{name}` is closed: open another"));
        self.inner.lock().unwrap_or_else(PoisonError::into_inner).as_mut().map(use_it).ok_or_else(closed)
    }
}

fn picture<'py>(
    py: Python<'py>,
    tick: &TickMessage,
    watched: &Watched,
    lost: u64,
) -> PyResult<Bound<'py, PyDict>> {
    let out = PyDict::new(py);
    let acts = tick.nu > 0;
    out.set_item("acts", acts)?;
    out.set_item("mode", Mode::from_code(tick.mode).name())?;
    out.set_item("reason", Reason::ALL.get(tick.reason as usize).map(|reason| reason.name()))?;
    let numbers = [
        ("tick", tick.tick),
        ("version", tick.policy_version),
        ("snapshot", tick.snapshot),
        ("episode", tick.episode),
        ("period_ns", tick.period),
        ("overruns", tick.overruns),
        ("raw_total", tick.raw_violations),
        ("target_total", tick.target_violations),
        ("raw", watched.raw_violations),
        ("target", watched.target_violations),
        ("ticks", watched.ticks),
        ("lost", lost),
    ];
    for (name, value) in numbers {
        out.set_item(name, value)?;
    }
    out.set_item("latency_ns", PyArray1::from_slice(py, &watched.latency))?;
    out.set_item("q", array(py, tick.q()))?;
    out.set_item("v", array(py, tick.v()))?;
    for (name, values) in [
        ("proposal_q", tick.proposal_q()),
        ("proposal_v", tick.proposal_v()),
        ("target_q", tick.target_q()),
        ("target_v", tick.target_v()),
        ("action", tick.action()),
    ] {
        out.set_item(name, acts.then(|| array(py, values)))?;
    }
    out.set_item("ledger", if acts { Some(ledger(py, tick)?) } else { None })?;
    out.set_item("active", active(py, watched)?)?;
    Ok(out)
}

fn ledger<'py>(py: Python<'py>, tick: &TickMessage) -> PyResult<Bound<'py, PyDict>> {
    let (l, out) = (&tick.ledger, PyDict::new(py));
    let status = LedgerStatus::ALL.iter().find(|status| status.number() == l.status);
    out.set_item("status", status.map_or("unknown", |status| status.name()))?;
    out.set_item("rung", Rung::ALL.get(l.rung as usize).map_or("unknown", |rung| rung.name()))?;
    out.set_item("active", l.active)?;
    out.set_item("iterations", l.iterations)?;
    out.set_item("moved", l.moved)?;
    out.set_item("slack", l.slack)?;
    out.set_item("residual", l.residual)?;
    out.set_item("duration_ns", l.duration)?;
    Ok(out)
}

fn active<'py>(py: Python<'py>, watched: &Watched) -> PyResult<Vec<Bound<'py, PyDict>>> {
    let row = |(&(row, kind, side), leaned): (&(u32, u32, u32), &LeanedOn)| {
        let out = PyDict::new(py);
        out.set_item("row", row)?;
        out.set_item("kind", Kind::ALL.get(kind as usize).map_or("unknown", |kind| kind.name()))?;
        out.set_item("side", if side == 0 { "lower" } else { "upper" })?;
        out.set_item("multiplier", leaned.multiplier)?;
        out.set_item("slack", leaned.slack)?;
        out.set_item("ticks", leaned.ticks)?;
        Ok(out)
    };
    watched.active.iter().map(row).collect()
}
