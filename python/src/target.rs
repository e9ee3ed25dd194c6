//! What a projection returns.

use nearl_constraints::{self as constraints, Counts, Side};
use numpy::{PyArray1, PyArray2};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{array, array2};

fn counts<'py>(py: Python<'py>, c: &Counts) -> PyResult<Bound<'py, PyDict>> {
    let out = PyDict::new(py);
    for (name, n) in [
        ("position", c.position),
        ("velocity", c.velocity),
        ("acceleration", c.acceleration),
        ("viability", c.viability),
        ("torque", c.torque),
        ("other", c.other),
    ] {
        out.set_item(name, n)?;
    }
    Ok(out)
}

/// What the projector reports about a tick.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Ledger {
    pub(crate) ledger: constraints::Ledger,
    pub(crate) names: Vec<String>,
}

#[pymethods]
impl Ledger {
    /// "unchanged", "clamped", "solved", "slowed", "recovering", "tightening", "braked" or "refused".
    #[getter]
    fn status(&self) -> &'static str {
        self.ledger.status.name()
    }

    /// Why the status is "slowed", "recovering", "tightening", "braked" or "refused".
    #[getter]
    fn reason(&self) -> Option<&'static str> {
        self.ledger.status.reason()
    }

    /// Whether the target answers the proposal: the nearest allowed state, or one near it where `reason` says why. False where it is "braked" or
    /// "refused".
    #[getter]
    fn is_ok(&self) -> bool {
        self.ledger.status.is_ok()
    }

    /// Which stage answered: "closed form", "active set", "clarabel", "relaxed", "stored brake" or "brake".
    #[getter]
    fn rung(&self) -> &'static str {
        self.ledger.rung.name()
    }

    /// Rows that hold the target back: `{"kind", "row", "name", "side", "multiplier", "slack"}` each.
    #[getter]
    fn active<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let row = |row: &constraints::ActiveRow| {
            let out = PyDict::new(py);
            out.set_item("kind", row.kind.name())?;
            out.set_item("row", row.row)?;
            out.set_item("name", self.names.get(row.row))?;
            out.set_item("side", if row.side == Side::Lower { "lower" } else { "upper" })?;
            out.set_item("multiplier", row.multiplier)?;
            out.set_item("slack", row.slack)?;
            Ok(out)
        };
        self.ledger.active.iter().map(row).collect()
    }

    /// Names of the joints and rows that the measured state is beyond already; they may only come back or brake. A joint whose speed a period
    /// brings back is not named, nor is a row over speeds, and `frame_speed` and `energy` are where they make the robot brake.
    #[getter]
    fn outside(&self) -> Vec<&str> {
        self.ledger.outside.iter().filter_map(|row| self.names.get(*row)).map(String::as_str).collect()
    }

    /// Weighted distance between proposal and target [rad/s].
    #[getter]
    fn moved(&self) -> f64 {
        self.ledger.moved
    }

    /// Largest violation left by the target, as a share of its limit; 0 unless braking or recovering.
    #[getter]
    fn slack(&self) -> f64 {
        self.ledger.slack
    }

    /// Iterations of the active-set stage and of Clarabel.
    #[getter]
    fn iterations(&self) -> u32 {
        self.ledger.iterations
    }

    /// Largest violation of the optimality conditions; 0 for the closed form.
    #[getter]
    fn residual(&self) -> f64 {
        self.ledger.residual
    }

    /// Time the projection took [ns].
    #[getter]
    fn duration_ns(&self) -> u64 {
        self.ledger.duration_ns
    }

    /// Limits the raw proposal would have broken, by kind.
    #[getter]
    fn raw_violations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        counts(py, &self.ledger.raw_violations)
    }

    /// Limits the target breaks, by kind and by an independent checker.
    #[getter]
    fn target_violations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        counts(py, &self.ledger.target_violations)
    }

    /// Whether `outside` names nothing and the target breaks a limit: what `target_violations` counts over many ticks.
    #[getter]
    fn target_breaks(&self) -> bool {
        self.ledger.target_breaks()
    }

    fn __repr__(&self) -> String {
        let l = &self.ledger;
        format!("Ledger('{}', {} active, moved {:.3e})", l.status.name(), l.active.len(), l.moved)
    }
}

/// The nearest next state that every limit allows, with its ledger.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Target {
    target: constraints::Target,
    ledger: Py<Ledger>,
}

impl Target {
    pub(crate) fn of(py: Python<'_>, target: constraints::Target, names: &[String]) -> PyResult<Target> {
        let ledger = Py::new(py, Ledger { ledger: target.ledger.clone(), names: names.to_vec() })?;
        Ok(Target { target, ledger })
    }
}

#[pymethods]
impl Target {
    /// Configuration at the end of the period (nq).
    #[getter]
    fn q<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.target.q)
    }

    /// Velocity at the end of the period (nv).
    #[getter]
    fn v<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.target.v)
    }

    /// `(v' - v) / dt` (nv): what inverse dynamics is asked for.
    #[getter]
    fn acceleration<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.target.acceleration)
    }

    /// The whole report; its fields are also the target's.
    #[getter]
    fn ledger(&self, py: Python<'_>) -> Py<Ledger> {
        self.ledger.clone_ref(py)
    }

    /// A field of the ledger: `status`, `active`, `slack`, `moved`, `iterations`, `residual` and so on.
    fn __getattr__<'py>(&self, py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        self.ledger.bind(py).getattr(name)
    }

    fn __repr__(&self) -> String {
        let words = self.target.ledger.status.name();
        format!("Target('{words}', q={:?}, v={:?})", self.target.q, self.target.v)
    }
}

/// Targets of a batch, as arrays; indexing gives one [`Target`].
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Targets {
    pub(crate) targets: Vec<constraints::Target>,
    pub(crate) names: Vec<String>,
    pub(crate) sizes: (usize, usize),
}

impl Targets {
    fn matrix<'py>(
        &self,
        py: Python<'py>,
        width: usize,
        row: impl Fn(&constraints::Target) -> &[f64],
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        array2(py, self.targets.iter().flat_map(|t| row(t).iter().copied()).collect(), width)
    }

    fn column<'py>(
        &self,
        py: Python<'py>,
        f: impl Fn(&constraints::Ledger) -> f64,
    ) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.targets.iter().map(|t| f(&t.ledger)).collect::<Vec<_>>())
    }
}

#[pymethods]
impl Targets {
    /// Configurations (n x nq).
    #[getter]
    fn q<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.matrix(py, self.sizes.0, |t| &t.q)
    }

    /// Velocities (n x nv).
    #[getter]
    fn v<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.matrix(py, self.sizes.1, |t| &t.v)
    }

    /// Accelerations (n x nv).
    #[getter]
    fn acceleration<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.matrix(py, self.sizes.1, |t| &t.acceleration)
    }

    /// Status of each (n).
    #[getter]
    fn status(&self) -> Vec<&'static str> {
        self.targets.iter().map(|t| t.ledger.status.name()).collect()
    }

    /// Whether each answers its proposal (n), as `Target.is_ok`.
    #[getter]
    fn is_ok<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<bool>> {
        PyArray1::from_vec(py, self.targets.iter().map(|t| t.ledger.status.is_ok()).collect())
    }

    /// Weighted distance between proposal and target (n) [rad/s].
    #[getter]
    fn moved<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |l| l.moved)
    }

    /// Largest violation left by each target (n), as a share of its limit.
    #[getter]
    fn slack<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |l| l.slack)
    }

    /// Iterations (n).
    #[getter]
    fn iterations<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        PyArray1::from_vec(py, self.targets.iter().map(|t| t.ledger.iterations).collect())
    }

    /// Largest violation of the optimality conditions (n).
    #[getter]
    fn residual<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |l| l.residual)
    }

    /// Number of limits each raw proposal would have broken (n).
    #[getter]
    fn raw_violations<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        PyArray1::from_vec(py, self.targets.iter().map(|t| t.ledger.raw_violations.total()).collect())
    }

    /// Number of limits each target breaks (n).
    #[getter]
    fn target_violations<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        PyArray1::from_vec(py, self.targets.iter().map(|t| t.ledger.target_violations.total()).collect())
    }

    fn __len__(&self) -> usize {
        self.targets.len()
    }

    fn __getitem__(&self, py: Python<'_>, index: isize) -> PyResult<Target> {
        let n = self.targets.len() as isize;
        let at = if index < 0 { index + n } else { index };
        if !(0..n).contains(&at) {
            return Err(PyIndexError::new_err(format!("target {index} of {n} does not exist")));
        }
        Target::of(py, self.targets[at as usize].clone(), &self.names)
    }
}
