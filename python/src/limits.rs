//! The limits a projector can be built from.

use std::collections::BTreeMap;

use nearl_constraints::limit::{AccelerationSettings, PositionSettings, VelocitySettings};
use nearl_constraints::{self as constraints, Limit, LimitSet, PerJoint};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;

use crate::errors;
use crate::model::Model;

/// One number for every joint, or numbers by joint name.
#[derive(FromPyObject)]
enum Values {
    All(f64),
    Joints(BTreeMap<String, f64>),
}

impl Values {
    fn per_joint(self) -> PerJoint {
        match self {
            Values::All(value) => PerJoint::All(value),
            Values::Joints(map) => PerJoint::Joints(map),
        }
    }
}

/// Refuses unknown joints and impossible numbers where they are written, before any projector is built.
fn checked<L: Limit>(model: &Model, limit: L) -> PyResult<L> {
    let mut set = LimitSet::unlimited(model.model.nv());
    limit.restrict(&model.model, &[], &mut set).map_err(errors::value)?;
    Ok(limit)
}

/// Position limits of the robot file, `margin` [rad or m] inside.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct PositionLimit(constraints::PositionLimit);

#[pymethods]
impl PositionLimit {
    #[new]
    #[pyo3(signature = (model, margin=Values::All(0.0)))]
    fn new(model: &Model, margin: Values) -> PyResult<Self> {
        let settings = PositionSettings { margin: margin.per_joint() };
        checked(model, constraints::PositionLimit::new(settings)).map(Self)
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.0)
    }
}

/// Speed limits: `scale` (0, 1] times the robot file's, or `limit` [rad/s or m/s]; the smaller where both are given.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct VelocityLimit(constraints::VelocityLimit);

#[pymethods]
impl VelocityLimit {
    #[new]
    #[pyo3(signature = (model, limit=None, *, scale=None))]
    fn new(model: &Model, limit: Option<Values>, scale: Option<f64>) -> PyResult<Self> {
        let settings = VelocitySettings { scale, limit: limit.map(Values::per_joint) };
        checked(model, constraints::VelocityLimit::new(settings)).map(Self)
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.0)
    }
}

/// Acceleration limits [rad/s² or m/s²]. `braking`: the deceleration that braking in front of a position limit counts on, at most
/// `limit`, which is also its default.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct AccelerationLimit(constraints::AccelerationLimit);

#[pymethods]
impl AccelerationLimit {
    #[new]
    #[pyo3(signature = (model, limit, braking=None))]
    fn new(model: &Model, limit: Values, braking: Option<Values>) -> PyResult<Self> {
        let settings =
            AccelerationSettings { limit: limit.per_joint(), braking: braking.map(Values::per_joint) };
        checked(model, constraints::AccelerationLimit::new(settings)).map(Self)
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.0)
    }
}

/// Motor force limits of the robot file times `scale` (0, 1].
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct TorqueLimit(constraints::TorqueLimit);

#[pymethods]
impl TorqueLimit {
    #[new]
    #[pyo3(signature = (model, scale=1.0))]
    fn new(model: &Model, scale: f64) -> PyResult<Self> {
        checked(model, constraints::TorqueLimit::scaled(scale)).map(Self)
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.0)
    }
}

/// The Rust limits behind a list of Python ones.
pub(crate) fn boxed(limits: &[Bound<'_, PyAny>]) -> PyResult<Vec<Box<dyn Limit>>> {
    limits.iter().enumerate().map(|(i, limit)| one(i, limit)).collect()
}

fn one(i: usize, limit: &Bound<'_, PyAny>) -> PyResult<Box<dyn Limit>> {
    if let Ok(l) = limit.cast::<PositionLimit>() {
        return Ok(Box::new(l.get().0.clone()));
    }
    if let Ok(l) = limit.cast::<VelocityLimit>() {
        return Ok(Box::new(l.get().0.clone()));
    }
    if let Ok(l) = limit.cast::<AccelerationLimit>() {
        return Ok(Box::new(l.get().0.clone()));
    }
    if let Ok(l) = limit.cast::<TorqueLimit>() {
        return Ok(Box::new(l.get().0.clone()));
    }
    Err(PyTypeError::new_err(format!(
        "limits[{i}] is {}, not a limit; pass PositionLimit, VelocityLimit, AccelerationLimit or TorqueLimit objects",
        limit.get_type()
    )))
}
