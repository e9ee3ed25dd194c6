//! The limits a projector can be built from. Each class is its constructor; what it holds is a [`Limit`].

use std::collections::BTreeMap;
use std::sync::Arc;

use nearl_constraints::limit::{
    AccelerationSettings, AlwaysHard, CollisionSettings, EnergySettings, FrameBox, FrameSettings,
    FrameSpeedSettings, HalfSpace, JerkSettings, JointProfile, KnownRobot, PositionSettings, RobotProfile,
    TorqueRateSettings, TorqueSettings, TorqueSpeedSettings, UserRowSettings, VelocityProfileSettings,
    VelocitySettings,
};
use nearl_constraints::{self as constraints, Cone, LimitError, LimitSet, PerJoint, Rows, Soft};
use pyo3::PyClass;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

use crate::errors;
use crate::model::Model;

/// Adds every class of this page to the module.
pub(crate) fn add_to(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Limit>()?;
    module.add_class::<AccelerationLimit>()?;
    module.add_class::<CollisionLimit>()?;
    module.add_class::<EnergyLimit>()?;
    module.add_class::<FrameLimit>()?;
    module.add_class::<FrameSpeedLimit>()?;
    module.add_class::<JerkLimit>()?;
    module.add_class::<LockedJoints>()?;
    module.add_class::<PositionLimit>()?;
    module.add_class::<RowLimit>()?;
    module.add_class::<TorqueLimit>()?;
    module.add_class::<TorqueRateLimit>()?;
    module.add_class::<TorqueSpeedLimit>()?;
    module.add_class::<VelocityLimit>()?;
    module.add_class::<VelocityProfileLimit>()?;
    Ok(())
}

/// What every limit is: pass a list of them to `Projector`. `name` is what `Projector.set_enabled` takes.
#[pyclass(module = "nearl._core", frozen, subclass)]
pub(crate) struct Limit(Arc<dyn constraints::Limit>, Vec<String>);

#[pymethods]
impl Limit {
    /// Name to switch the limit on and off by.
    #[getter]
    fn name(&self) -> &str {
        self.0.label()
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.0)
    }
}

/// One limit shared by many projectors.
#[derive(Debug, Clone)]
pub(crate) struct Shared(Arc<dyn constraints::Limit>);

impl constraints::Limit for Shared {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn label(&self) -> &str {
        self.0.label()
    }

    fn restrict(
        &self,
        model: &constraints::Model,
        controllable: &[usize],
        set: &mut LimitSet,
    ) -> Result<(), LimitError> {
        self.0.restrict(model, controllable, set)
    }

    fn rows(
        &self,
        model: &constraints::Model,
        controllable: &[usize],
    ) -> Result<Option<Box<dyn Rows>>, LimitError> {
        self.0.rows(model, controllable)
    }

    fn cone(
        &self,
        model: &constraints::Model,
        controllable: &[usize],
    ) -> Result<Option<Box<dyn Cone>>, LimitError> {
        self.0.cone(model, controllable)
    }

    fn soft(&self) -> Option<Soft> {
        self.0.soft()
    }
}

/// The Rust limits behind a list of Python ones.
pub(crate) fn boxed(
    limits: &[Bound<'_, PyAny>],
    robot: &constraints::Model,
) -> PyResult<Vec<Box<dyn constraints::Limit>>> {
    limits.iter().enumerate().map(|(i, limit)| one(i, limit, robot)).collect()
}

/// Names of a robot's joints.
fn joints(robot: &constraints::Model) -> Vec<String> {
    robot.joints().iter().map(|joint| joint.name.clone()).collect()
}

fn one(
    i: usize,
    limit: &Bound<'_, PyAny>,
    robot: &constraints::Model,
) -> PyResult<Box<dyn constraints::Limit>> {
    match limit.cast::<Limit>() {
        Ok(limit) if limit.get().1 != joints(robot) => Err(errors::value(format!(
            "limits[{i}], {}, was made for another robot, with joints {}; build it with this one's model",
            limit.get().0.label(),
            limit.get().1.join(", ")
        ))),
        Ok(limit) => Ok(Box::new(Shared(limit.get().0.clone()))),
        Err(_) => Err(PyTypeError::new_err(format!(
            "limits[{i}] is {}, not a limit; pass objects such as nearl.PositionLimit(model)",
            limit.get_type()
        ))),
    }
}

/// Refuses unknown joints and impossible numbers where they are written, before any projector is built.
fn checked<P: PyClass<BaseType = Limit>>(
    model: &Model,
    own: P,
    limit: impl constraints::Limit + 'static,
) -> PyResult<PyClassInitializer<P>> {
    let robot = &model.model;
    let tried = limit
        .restrict(robot, &[], &mut LimitSet::unlimited(robot.nv()))
        .and_then(|()| limit.rows(robot, &[]).map(|_| ()))
        .and_then(|()| limit.cone(robot, &[]).map(|_| ()));
    tried.map_err(errors::value)?;
    Ok(PyClassInitializer::from(Limit(Arc::new(limit), joints(robot))).add_subclass(own))
}

/// One number for every joint, numbers by joint name, or one for each dof.
pub(crate) enum Values {
    All(f64),
    Joints(BTreeMap<String, f64>),
    Each(Vec<f64>),
}

impl<'a, 'py> FromPyObject<'a, 'py> for Values {
    type Error = PyErr;

    fn extract(given: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        let all = given.extract().map(Values::All);
        let named = all.or_else(|_: PyErr| given.extract().map(Values::Joints));
        named.or_else(|_: PyErr| given.extract().map(Values::Each)).map_err(|_: PyErr| {
            let what =
                "a number for all joints, numbers by name: {\"elbow\": 1.5}, or one for each dof: [1.5, 2.0]";
            expected(what, &given)
        })
    }
}

/// Names in a list; a single string would be read letter by letter.
struct Names(Vec<String>);

impl<'a, 'py> FromPyObject<'a, 'py> for Names {
    type Error = PyErr;

    fn extract(given: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        given.extract().map(Names).map_err(|_: PyErr| expected("a list of names: [\"elbow\"]", &given))
    }
}

/// Why an argument is refused; Python says which one before it.
fn expected(what: &str, given: &Bound<'_, PyAny>) -> PyErr {
    let name = given.get_type().name().map_or("another type".into(), |n| n.to_string());
    PyTypeError::new_err(format!("expected {what}; got {name}"))
}

impl Values {
    pub(crate) fn per_joint(self) -> PerJoint {
        match self {
            Values::All(value) => PerJoint::All(value),
            Values::Joints(map) => PerJoint::Joints(map),
            Values::Each(list) => PerJoint::Each(list),
        }
    }
}

/// Where limits are moved: velocity, acceleration, lowest and highest position by joint, and those that have names.
pub(crate) fn moved(
    speed: f64,
    joints: [Option<Values>; 4],
    frame: Option<BTreeMap<String, f64>>,
    frame_speed: Option<BTreeMap<String, f64>>,
    energy: Option<f64>,
) -> constraints::Moved {
    let [velocity, acceleration, lower, upper] = joints.map(|values| values.map(Values::per_joint));
    let (frame, frame_speed) = (frame.unwrap_or_default(), frame_speed.unwrap_or_default());
    constraints::Moved { speed, velocity, acceleration, lower, upper, frame, frame_speed, energy }
}

/// `(linear, quadratic)` weights.
struct Weights(f64, f64);

impl<'a, 'py> FromPyObject<'a, 'py> for Weights {
    type Error = PyErr;

    fn extract(given: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        let pair = given.extract().map(|(linear, quadratic)| Weights(linear, quadratic));
        pair.map_err(|_: PyErr| expected("the weights (linear, quadratic): (1.0, 100.0)", &given))
    }
}

fn soft(Weights(linear, quadratic): Weights) -> Soft {
    Soft { linear, quadratic }
}

/// Position limits of the robot file, `margin` [rad or m] inside.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct PositionLimit;

#[pymethods]
impl PositionLimit {
    #[new]
    #[pyo3(signature = (model, margin=Values::All(0.0)))]
    fn new(model: &Model, margin: Values) -> PyResult<PyClassInitializer<Self>> {
        let settings = PositionSettings { margin: margin.per_joint(), soft: AlwaysHard };
        checked(model, Self, constraints::PositionLimit::new(settings))
    }
}

/// Speed limits: `scale` (0, 1] times the robot file's, or `limit` [rad/s or m/s]; the smaller where both are given, less `margin`.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct VelocityLimit;

#[pymethods]
impl VelocityLimit {
    #[new]
    #[pyo3(signature = (model, limit=None, *, scale=None, margin=None))]
    fn new(
        model: &Model,
        limit: Option<Values>,
        scale: Option<f64>,
        margin: Option<Values>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let (limit, margin) = (limit.map(Values::per_joint), margin.map(Values::per_joint));
        let settings = VelocitySettings { scale, limit, margin, soft: AlwaysHard };
        checked(model, Self, constraints::VelocityLimit::new(settings))
    }
}

/// Speed limits that fall in front of position limits: `"fr3"` for a Franka Research 3, or by joint a dictionary of `limit`
/// [rad/s], `offset` [rad/s], `squared` [rad/s²], `lower` and `upper` [rad] in `v <= min(limit, -offset + sqrt(squared (upper - q)))`.
/// `margin` [rad/s] is kept below all of them.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct VelocityProfileLimit;

/// A robot's name or curves by joint.
#[derive(FromPyObject)]
enum Profile {
    Robot(String),
    Joints(BTreeMap<String, Curve>),
}

#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct Curve {
    limit: f64,
    offset: f64,
    squared: f64,
    lower: f64,
    upper: f64,
}

#[pymethods]
impl VelocityProfileLimit {
    #[new]
    #[pyo3(signature = (model, profile, *, margin=0.0))]
    fn new(model: &Model, profile: Profile, margin: f64) -> PyResult<PyClassInitializer<Self>> {
        let settings = match profile {
            Profile::Robot(name) if name == "fr3" => {
                VelocityProfileSettings::RobotLess(RobotProfile { robot: KnownRobot::Fr3, margin })
            }
            Profile::Robot(name) => {
                return Err(errors::value(format!(
                    "no velocity profile is built in for '{name}'; use \"fr3\" or a dictionary by joint"
                )));
            }
            Profile::Joints(map) => {
                let curve = |c: Curve| JointProfile {
                    limit: c.limit,
                    offset: c.offset,
                    squared: c.squared,
                    lower: c.lower,
                    upper: c.upper,
                    margin,
                };
                VelocityProfileSettings::Joints(map.into_iter().map(|(joint, c)| (joint, curve(c))).collect())
            }
        };
        checked(model, Self, constraints::VelocityProfileLimit::new(settings))
    }
}

/// Acceleration limits [rad/s² or m/s²], less `margin`. `braking`: the deceleration that braking in front of a position limit counts on, at most
/// `limit`, which is also its default.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct AccelerationLimit;

#[pymethods]
impl AccelerationLimit {
    #[new]
    #[pyo3(signature = (model, limit, braking=None, *, margin=None))]
    fn new(
        model: &Model,
        limit: Values,
        braking: Option<Values>,
        margin: Option<Values>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let margin = margin.map(Values::per_joint);
        let of = AccelerationSettings::of(limit.per_joint(), braking.map(Values::per_joint));
        let settings = AccelerationSettings { margin, ..of };
        checked(model, Self, constraints::AccelerationLimit::new(settings))
    }
}

/// Jerk limits [rad/s³ or m/s³], less `margin`; soft, with `soft = (linear, quadratic)` weights, unless `hard`: then position, velocity,
/// acceleration and jerk hold at once. They need the tick before: see `previous` of `Projector.project`.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct JerkLimit;

#[pymethods]
impl JerkLimit {
    #[new]
    #[pyo3(signature = (model, limit, soft=None, *, margin=None, hard=false))]
    fn new(
        model: &Model,
        limit: Values,
        soft: Option<Weights>,
        margin: Option<Values>,
        hard: bool,
    ) -> PyResult<PyClassInitializer<Self>> {
        if hard && soft.is_some() {
            let text = "the jerk limit is hard and has weights of a soft one; drop hard or soft";
            return Err(PyValueError::new_err(text));
        }
        let soft = (!hard).then(|| soft.map_or_else(Soft::default, self::soft));
        let (limit, margin) = (limit.per_joint(), margin.map(Values::per_joint));
        checked(model, Self, constraints::JerkLimit::new(JerkSettings { limit, margin, soft }))
    }
}

/// Motor force limits of the robot file times `scale` (0, 1], less `margin` [N·m or N]. With `soft = (linear, quadratic)` weights they are no
/// promise that braking may count on.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct TorqueLimit;

#[pymethods]
impl TorqueLimit {
    #[new]
    #[pyo3(signature = (model, scale=1.0, *, margin=None, soft=None))]
    fn new(
        model: &Model,
        scale: f64,
        margin: Option<Values>,
        soft: Option<Weights>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let (margin, soft) = (margin.map(Values::per_joint), soft.map(self::soft));
        checked(model, Self, constraints::TorqueLimit::new(TorqueSettings { scale, margin, soft }))
    }
}

/// Motors whose force falls with speed: `|tau + stall / no_load v| <= stall - margin`, in [N·m or N] and [rad/s or m/s].
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct TorqueSpeedLimit;

#[pymethods]
impl TorqueSpeedLimit {
    #[new]
    #[pyo3(signature = (model, stall, no_load, soft=None, *, margin=None))]
    fn new(
        model: &Model,
        stall: Values,
        no_load: Values,
        soft: Option<Weights>,
        margin: Option<Values>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let (stall, no_load, soft) = (stall.per_joint(), no_load.per_joint(), soft.map(self::soft));
        let settings = TorqueSpeedSettings { stall, no_load, margin: margin.map(Values::per_joint), soft };
        checked(model, Self, constraints::TorqueSpeedLimit::new(settings))
    }
}

/// Limits on the change of motor forces [N·m/s or N/s], less `margin`, always soft; they need the tick before, like `JerkLimit`.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct TorqueRateLimit;

#[pymethods]
impl TorqueRateLimit {
    #[new]
    #[pyo3(signature = (model, limit, soft=None, *, margin=None))]
    fn new(
        model: &Model,
        limit: Values,
        soft: Option<Weights>,
        margin: Option<Values>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let (limit, soft) = (limit.per_joint(), soft.map_or_else(Soft::default, self::soft));
        let settings = TorqueRateSettings { limit, margin: margin.map(Values::per_joint), soft };
        checked(model, Self, constraints::TorqueRateLimit::new(settings))
    }
}

/// Joints that brake to standstill and stay.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct LockedJoints;

#[pymethods]
impl LockedJoints {
    #[new]
    fn new(model: &Model, joints: Names) -> PyResult<PyClassInitializer<Self>> {
        checked(model, Self, constraints::LockedJoints::new(joints.0))
    }
}

/// A linear row over the next state: `lower <= sum of terms <= upper` or `equals`, with terms such as `{"q.elbow": 1.0, "v.wrist": -0.5}`.
/// `braking` lets a sum of positions stop in front of its bounds, `margin` inside them; `soft` is `(linear, quadratic)` weights.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct RowLimit;

#[pymethods]
impl RowLimit {
    #[new]
    #[pyo3(signature = (model, name, terms, *, lower=None, upper=None, equals=None, braking=None, soft=None, margin=0.0))]
    #[expect(clippy::too_many_arguments, reason = "one argument a setting, by keyword")]
    fn new(
        model: &Model,
        name: String,
        terms: BTreeMap<String, f64>,
        lower: Option<f64>,
        upper: Option<f64>,
        equals: Option<f64>,
        braking: Option<f64>,
        soft: Option<Weights>,
        margin: f64,
    ) -> PyResult<PyClassInitializer<Self>> {
        let soft = soft.map(self::soft);
        let settings = UserRowSettings { name, terms, lower, upper, equals, braking, margin, soft };
        checked(model, Self, constraints::UserRow::new(settings))
    }
}

/// A point of a frame on one side of a plane, `normal . (p - through) <= 0`, or inside a box of world axes, `lower <= p <= upper`; `point` is in
/// the frame's axes [m]. It stops in front of the faces with `braking` [m/s²], `margin` [m] inside.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct FrameLimit;

#[pymethods]
impl FrameLimit {
    #[new]
    #[pyo3(signature = (model, frame, braking, *, normal=None, through=None, lower=None, upper=None, point=[0.0; 3], margin=0.0, soft=None, name=None))]
    #[expect(clippy::too_many_arguments, reason = "one argument a setting, by keyword")]
    fn new(
        model: &Model,
        frame: String,
        braking: f64,
        normal: Option<[f64; 3]>,
        through: Option<[f64; 3]>,
        lower: Option<[f64; 3]>,
        upper: Option<[f64; 3]>,
        point: [f64; 3],
        margin: f64,
        soft: Option<Weights>,
        name: Option<String>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let half_space = match (normal, through) {
            (None, None) => None,
            (Some(normal), through) => Some(HalfSpace { normal, through: through.unwrap_or_default() }),
            (None, Some(_)) => {
                return Err(errors::value(
                    "through needs normal, the direction that is not allowed; give both",
                ));
            }
        };
        let inside = (lower.is_some() || upper.is_some()).then(|| FrameBox {
            lower: lower.unwrap_or([f64::NEG_INFINITY; 3]),
            upper: upper.unwrap_or([f64::INFINITY; 3]),
        });
        let soft = soft.map(self::soft);
        let settings = FrameSettings { name, frame, point, half_space, inside, braking, margin, soft };
        checked(model, Self, constraints::FrameLimit::new(settings))
    }
}

/// The speed of a frame's `point` [m, in its axes] stays below `limit - margin` [m/s], in every direction; `soft` is `(linear, quadratic)` weights.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct FrameSpeedLimit;

#[pymethods]
impl FrameSpeedLimit {
    #[new]
    #[pyo3(signature = (model, frame, limit, *, point=[0.0; 3], name=None, margin=0.0, soft=None))]
    fn new(
        model: &Model,
        frame: String,
        limit: f64,
        point: [f64; 3],
        name: Option<String>,
        margin: f64,
        soft: Option<Weights>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let soft = soft.map(self::soft);
        let settings = FrameSpeedSettings { name, frame, point, limit, margin, soft };
        checked(model, Self, constraints::FrameSpeedLimit::new(settings))
    }
}

/// The kinetic energy of the whole robot stays below `limit - margin` [J]; `soft` is `(linear, quadratic)` weights.
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct EnergyLimit;

#[pymethods]
impl EnergyLimit {
    #[new]
    #[pyo3(signature = (model, limit, *, margin=0.0, soft=None))]
    fn new(
        model: &Model,
        limit: f64,
        margin: f64,
        soft: Option<Weights>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let soft = soft.map(self::soft);
        checked(model, Self, constraints::EnergyLimit::new(EnergySettings { limit, margin, soft }))
    }
}

/// Bodies keep clear of each other and of what stands around them. `shapes`: dictionaries as in a task file, such as
/// `{"frame": "hand", "shape": {"sphere": {"radius": 0.1}}, "position": [0, 0, 0.05]}` or `{"name": "floor", "shape": "half_space"}`; `urdf=True`
/// adds the robot file's own spheres, boxes, cylinders and capsules. Distances close with at most `braking` [m/s²], down to `margin` [m].
#[pyclass(module = "nearl._core", frozen, extends = Limit)]
pub(crate) struct CollisionLimit;

#[pymethods]
impl CollisionLimit {
    #[new]
    #[pyo3(signature = (model, shapes, braking, *, margin=0.0, urdf=false, ignore=vec![], adjacent=false, influence=0.2, rows=16, soft=None))]
    #[expect(clippy::too_many_arguments, reason = "one argument a setting, by keyword")]
    fn new(
        model: &Model,
        shapes: &Bound<'_, PyAny>,
        braking: f64,
        margin: f64,
        urdf: bool,
        ignore: Vec<[String; 2]>,
        adjacent: bool,
        influence: f64,
        rows: usize,
        soft: Option<Weights>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let text: String = shapes.py().import("json")?.call_method1("dumps", (shapes,))?.extract()?;
        let shapes = serde_json::from_str(&text).map_err(|e| {
            errors::value(format!("shapes are not as in a task file: {e}; see docs/LIMITS.md"))
        })?;
        let soft = soft.map(self::soft);
        let settings =
            CollisionSettings { shapes, urdf, ignore, adjacent, braking, margin, influence, rows, soft };
        checked(model, Self, constraints::CollisionLimit::new(settings))
    }
}
