//! The limits a projector can be built from. The registry says what each kind takes; the classes by name are written from it
//! (`python/nearl/limits.py`).

use std::collections::BTreeMap;
use std::sync::Arc;

use nearl_constraints::limit::{Argument, ConstraintSettings, REGISTRY, RegisteredLimit, Takes};
use nearl_constraints::{self as constraints, Cone, LimitError, LimitSet, PerJoint, Rows, Soft};
use nearl_runtime::task::Task;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyString};
use toml::{Table, Value};

use crate::arrays::refuse_complex;
use crate::errors;
use crate::model::Model;

/// Adds the class of this page to the module.
pub(crate) fn add_to(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Limit>()
}

/// What every limit is: pass a list of them to `Projector`. `name` is what `Projector.set_enabled` takes. Each kind has a class of its own
/// (`nearl.VelocityLimit` and its like); `Limit(model, "velocity", {"scale": 0.8})` is the same by the name that the kind has in a task file.
#[pyclass(module = "nearl._core", frozen, subclass)]
pub(crate) struct Limit(Arc<dyn constraints::Limit>, Vec<String>, String);

#[pymethods]
impl Limit {
    #[new]
    fn new(model: &Model, kind: &str, settings: &Bound<'_, PyDict>) -> PyResult<Limit> {
        let robot = &model.model;
        let (limit, written) = made(kind, settings)?;
        // Unknown joints and impossible numbers are refused where they are written, before any projector is built.
        let tried = limit
            .restrict(robot, &[], &mut LimitSet::unlimited(robot.nv()))
            .and_then(|()| limit.rows(robot, &[]).map(|_| ()))
            .and_then(|()| limit.cone(robot, &[]).map(|_| ()));
        tried.map_err(errors::value)?;
        Ok(Limit(Arc::from(limit), joints(robot), written))
    }

    /// Name to switch the limit on and off by.
    #[getter]
    fn name(&self) -> &str {
        self.0.label()
    }

    fn __repr__(&self) -> &str {
        &self.2
    }
}

/// As Python writes it: the class, and what a task file would say with all that was left out.
fn in_python(entry: &RegisteredLimit, settings: &ConstraintSettings) -> String {
    let class = entry.about.class;
    let written = Table::try_from(settings).unwrap_or_default().remove(entry.name);
    let section = match written {
        Some(Value::Array(mut several)) if entry.many && several.len() == 1 => several.pop(),
        other => other,
    };
    match section {
        Some(Value::Table(table)) => {
            let given: Vec<String> = table.iter().map(|(key, x)| format!("{key}={}", literal(x))).collect();
            format!("{class}({})", given.join(", "))
        }
        Some(value) => format!("{class}({})", literal(&value)),
        None => format!("{class}()"),
    }
}

/// A value as Python writes it.
fn literal(value: &Value) -> String {
    match value {
        Value::Boolean(true) => "True".into(),
        Value::Boolean(false) => "False".into(),
        Value::Float(x) => format!("{x:?}"),
        Value::Array(list) => format!("[{}]", list.iter().map(literal).collect::<Vec<_>>().join(", ")),
        Value::Table(table) => {
            let entries: Vec<String> =
                table.iter().map(|(key, x)| format!("{key:?}: {}", literal(x))).collect();
            format!("{{{}}}", entries.join(", "))
        }
        Value::String(text) => format!("{text:?}"),
        other => other.to_string(),
    }
}

/// The limit of `kind`, one of the registry, from the arguments of its class, and how Python writes it.
fn made(kind: &str, settings: &Bound<'_, PyDict>) -> PyResult<(Box<dyn constraints::Limit>, String)> {
    let entry = REGISTRY.iter().find(|entry| entry.name == kind).ok_or_else(|| {
        let known: Vec<&str> = REGISTRY.iter().map(|entry| entry.name).collect();
        errors::value(format!("there is no limit of kind '{kind}'; choose one of {}", known.join(", ")))
    })?;
    let section = section(entry, settings)?;
    let section = if entry.many { Value::Array(vec![section]) } else { section };
    let table = Table::from_iter([(kind.to_string(), section)]);
    let read = Task::constraints_of(Value::Table(table))
        .map_err(|(_, reason)| errors::value(format!("limit '{kind}': {reason}; see docs/LIMITS.md")))?;
    let limit = (entry.build)(&read)
        .pop()
        .ok_or_else(|| errors::value(format!("limit '{kind}' is empty; give it a setting")))?;
    Ok((limit, in_python(entry, &read)))
}

/// The section of a task file that says the same as the arguments.
fn section(entry: &RegisteredLimit, settings: &Bound<'_, PyDict>) -> PyResult<Value> {
    let arguments = entry.about.arguments;
    for name in settings.keys() {
        let name: String = name.extract()?;
        if !arguments.iter().any(|argument| argument.name == name) {
            let known: Vec<&str> = arguments.iter().map(|argument| argument.name).collect();
            let class = entry.about.class;
            let text = format!("{class} takes no '{name}'; it takes {}", known.join(", "));
            return Err(PyTypeError::new_err(text));
        }
    }
    let curves = arguments[0].takes == Takes::Curves;
    let mut section = Value::Table(Table::new());
    for argument in arguments {
        let given = settings.get_item(argument.name)?.filter(|given| !given.is_none());
        match given {
            Some(given) if curves => put_curves(&mut section, argument, value(argument, &given)?),
            Some(given) => put(&mut section, argument, value(argument, &given)?),
            None if argument.default.is_none() => {
                let class = entry.about.class;
                return Err(PyTypeError::new_err(format!("{class} needs '{}'", argument.name)));
            }
            None => {}
        }
    }
    complete(&mut section)?;
    if section.as_array().is_some_and(Vec::is_empty) {
        let class = entry.about.class;
        return Err(errors::value(format!("{class} names nothing; name a joint, or leave the limit out")));
    }
    if entry.name == "frame" && section.get("half_space").is_none() && section.get("box").is_none() {
        let class = entry.about.class;
        return Err(errors::value(format!(
            "{class} states no place for the frame to be in; give normal and through for a plane, or lower and upper for a box, in m"
        )));
    }
    Ok(section)
}

/// Puts a value where the argument of curves belongs: what is said of all stands with a robot's name, or with each joint.
fn put_curves(section: &mut Value, argument: &Argument, value: Value) {
    let (key, given) = (argument.key, value);
    match section {
        _ if key.is_empty() => *section = given,
        Value::String(robot) => {
            let robot = Value::String(std::mem::take(robot));
            *section = Value::Table(Table::from_iter([("robot".into(), robot), (key.into(), given)]));
        }
        Value::Table(joints) => {
            for (_, joint) in joints.iter_mut() {
                put(joint, argument, given.clone());
            }
        }
        _ => {}
    }
}

/// Puts a value where the argument belongs.
fn put(section: &mut Value, argument: &Argument, value: Value) {
    if argument.key.is_empty() {
        *section = value;
        return;
    }
    let Value::Table(table) = section else { return };
    match argument.key.split_once('.') {
        Some((outer, inner)) => {
            let part = table.entry(outer).or_insert_with(|| Value::Table(Table::new()));
            if let Value::Table(part) = part {
                part.insert(inner.to_string(), value);
            }
        }
        None => {
            table.insert(argument.key.to_string(), value);
        }
    }
}

/// What a task file has to say and an argument may leave out.
fn complete(section: &mut Value) -> PyResult<()> {
    let Value::Table(table) = section else { return Ok(()) };
    let all = |x: f64| Value::Array(vec![Value::Float(x); 3]);
    if let Some(Value::Table(half_space)) = table.get_mut("half_space") {
        if !half_space.contains_key("normal") {
            return Err(errors::value("through needs normal, the direction that is not allowed; give both"));
        }
        half_space.entry("through").or_insert_with(|| all(0.0));
    }
    if let Some(Value::Table(inside)) = table.get_mut("box") {
        inside.entry("lower").or_insert_with(|| all(f64::NEG_INFINITY));
        inside.entry("upper").or_insert_with(|| all(f64::INFINITY));
    }
    Ok(())
}

/// An argument as a task file has it.
fn value(argument: &Argument, given: &Bound<'_, PyAny>) -> PyResult<Value> {
    let refused = |got: &str| {
        let (expected, name) = (argument.takes.expected(), argument.name);
        PyTypeError::new_err(format!("expected {expected}; got {got}, as '{name}'"))
    };
    refuse_complex(argument.name, given).map_err(|_| refused("complex numbers"))?;
    let is_bool = given.is_instance_of::<PyBool>()
        || given.get_type().name().is_ok_and(|name| ["bool", "bool_"].iter().any(|own| name == *own));
    if is_bool && !matches!(argument.takes, Takes::Flag) {
        return Err(refused("bool"));
    }
    read(argument.takes, given).map_err(|_: PyErr| refused(&shown(given)))
}

/// The type of what was given, and its beginning as Python prints it.
fn shown(given: &Bound<'_, PyAny>) -> String {
    const LONGEST: usize = 60;
    let kind = given.get_type().name().map_or("another type".into(), |n| n.to_string());
    let text = given.repr().map_or(String::new(), |text| text.to_string());
    let ends = if text.chars().count() > LONGEST { "..." } else { "" };
    format!("{kind} {}{ends}", text.chars().take(LONGEST).collect::<String>())
}

fn read(takes: Takes, given: &Bound<'_, PyAny>) -> PyResult<Value> {
    let numbers =
        |map: BTreeMap<String, f64>| Value::Table(map.into_iter().map(|(k, x)| (k, x.into())).collect());
    Ok(match takes {
        Takes::PerJoint => match given.extract()? {
            Values::All(value) => value.into(),
            Values::Joints(map) => numbers(map),
            Values::Each(list) => list.into(),
        },
        Takes::Number => given.extract::<f64>()?.into(),
        Takes::Vector => given.extract::<[f64; 3]>()?.to_vec().into(),
        Takes::Flag => given.extract::<bool>()?.into(),
        Takes::Count => given.extract::<u32>()?.into(),
        Takes::Text => given.extract::<String>()?.into(),
        Takes::Names => given.extract::<Vec<String>>()?.into(),
        Takes::Pairs => {
            given.extract::<Vec<[String; 2]>>()?.into_iter().map(Vec::from).collect::<Vec<_>>().into()
        }
        Takes::Numbers => numbers(given.extract()?),
        Takes::Soft => {
            let (linear, quadratic): (f64, f64) = given.extract()?;
            numbers(BTreeMap::from([("linear".into(), linear), ("quadratic".into(), quadratic)]))
        }
        Takes::Solids => written(given)?,
        Takes::Curves => match given.cast::<PyString>() {
            Ok(robot) => robot.to_string().into(),
            Err(_) => written(given)?,
        },
    })
}

/// A value that already is as in a task file.
fn written(given: &Bound<'_, PyAny>) -> PyResult<Value> {
    if let Ok(text) = given.cast::<PyString>() {
        return Ok(text.to_string().into());
    }
    if let Ok(flag) = given.cast::<PyBool>() {
        return Ok(flag.is_true().into());
    }
    if let Ok(number) = given.extract::<f64>() {
        return Ok(number.into());
    }
    if let Ok(map) = given.extract::<BTreeMap<String, Bound<'_, PyAny>>>() {
        let entries = map.into_iter().map(|(key, value)| Ok((key, written(&value)?)));
        return Ok(Value::Table(entries.collect::<PyResult<_>>()?));
    }
    let list: Vec<Bound<'_, PyAny>> = given.extract()?;
    Ok(Value::Array(list.iter().map(written).collect::<PyResult<_>>()?))
}

/// One limit shared by many projectors, and how it was written.
#[derive(Clone)]
pub(crate) struct Shared(Arc<dyn constraints::Limit>, String);

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.1)
    }
}

impl constraints::Limit for Shared {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn label(&self) -> &str {
        self.0.label()
    }

    fn named_joints(&self) -> Vec<&str> {
        self.0.named_joints()
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

    fn notes(&self, model: &constraints::Model, controllable: &[usize]) -> Vec<String> {
        self.0.notes(model, controllable)
    }

    fn soft(&self) -> Option<Soft> {
        self.0.soft()
    }
}

/// The Rust limits behind a list of Python ones.
pub(crate) fn boxed(
    limits: &Bound<'_, PyAny>,
    robot: &constraints::Model,
) -> PyResult<Vec<Box<dyn constraints::Limit>>> {
    let limits: Vec<Bound<'_, PyAny>> = limits.extract().map_err(|_| {
        let kind = limits.get_type().name().map_or("another type".into(), |kind| kind.to_string());
        PyTypeError::new_err(format!(
            "limits is of {kind}; give a list of limits, e.g. [nearl.VelocityLimit(model)]"
        ))
    })?;
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
        Ok(limit) => Ok(Box::new(Shared(limit.get().0.clone(), limit.get().2.clone()))),
        Err(_) => Err(PyTypeError::new_err(format!(
            "limits[{i}] is {}, not a limit; pass objects such as nearl.PositionLimit(model)",
            limit.get_type()
        ))),
    }
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
        refuse_complex("the value", &given.to_owned())?;
        let all = given.extract().map(Values::All);
        let named = all.or_else(|_: PyErr| given.extract().map(Values::Joints));
        named.or_else(|_: PyErr| given.extract().map(Values::Each)).map_err(|_: PyErr| {
            PyTypeError::new_err(format!("expected {}; got {}", Takes::PerJoint.expected(), shown(&given)))
        })
    }
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

/// By name, numbers; and by name, a place in the world.
pub(crate) type Named = Option<BTreeMap<String, f64>>;
pub(crate) type Places = Option<BTreeMap<String, ([f64; 3], [f64; 3])>>;

/// What `what` is given as, where it is at all: what `read` takes, or a sentence that says what is expected.
fn given<T>(
    what: &str,
    expected: &str,
    value: &Bound<'_, PyAny>,
    read: impl FnOnce(&Bound<'_, PyAny>) -> Option<T>,
) -> PyResult<Option<T>> {
    if value.is_none() {
        return Ok(None);
    }
    let wrong = || PyTypeError::new_err(format!("{what}: expected {expected}; got {}", shown(value)));
    read(value).ok_or_else(wrong).map(Some)
}

fn named(what: &str, value: &Bound<'_, PyAny>) -> PyResult<Named> {
    given(what, "numbers by the name of a limit: {\"wall\": 0.1}", value, |v| v.extract().ok())
}

fn places(what: &str, expected: &str, value: &Bound<'_, PyAny>) -> PyResult<Places> {
    given(what, expected, value, |v| v.extract().ok())
}

/// Numbers by joint, if any; a refusal names the argument.
fn values(what: &str, value: &Bound<'_, PyAny>) -> PyResult<Option<Values>> {
    given(what, Takes::PerJoint.expected(), value, |v| v.extract().ok())
}

/// The argument `velocity`.
pub(crate) fn velocity(value: &Bound<'_, PyAny>) -> PyResult<Option<Values>> {
    values("velocity", value)
}

/// The argument `acceleration`.
pub(crate) fn acceleration(value: &Bound<'_, PyAny>) -> PyResult<Option<Values>> {
    values("acceleration", value)
}

/// The argument `lower`.
pub(crate) fn lower(value: &Bound<'_, PyAny>) -> PyResult<Option<Values>> {
    values("lower", value)
}

/// The argument `upper`.
pub(crate) fn upper(value: &Bound<'_, PyAny>) -> PyResult<Option<Values>> {
    values("upper", value)
}

/// The argument `frame`.
pub(crate) fn frame(value: &Bound<'_, PyAny>) -> PyResult<Named> {
    named("frame", value)
}

/// The argument `frame_speed`.
pub(crate) fn frame_speed(value: &Bound<'_, PyAny>) -> PyResult<Named> {
    named("frame_speed", value)
}

/// The argument `energy`.
pub(crate) fn energy(value: &Bound<'_, PyAny>) -> PyResult<Option<f64>> {
    given("energy", "a number in J", value, |v| v.extract().ok())
}

/// The argument `plane`.
pub(crate) fn plane(value: &Bound<'_, PyAny>) -> PyResult<Places> {
    let expected =
        "by the name of a limit a normal and a point, as a pair: {\"wall\": ([0, 1, 0], [0, 0.2, 0])}";
    places("plane", expected, value)
}

/// The argument `body`.
pub(crate) fn body(value: &Bound<'_, PyAny>) -> PyResult<Places> {
    let expected = "by the name of an obstacle its position and roll, pitch and yaw, as a pair: {\"ball\": ([0.2, 0.5, 0.2], [0, 0, 0])}";
    places("body", expected, value)
}

/// Where limits are moved: velocity, acceleration, lowest and highest position by joint, planes inside and speeds of frames, then where planes lie
/// (normal, a point of theirs) and obstacles stand (position, roll, pitch and yaw).
pub(crate) fn moved(
    speed: f64,
    joints: [Option<Values>; 4],
    [frame, frame_speed]: [Named; 2],
    energy: Option<f64>,
    [plane, body]: [Places; 2],
) -> constraints::Moved {
    let [velocity, acceleration, lower, upper] = joints.map(|values| values.map(Values::per_joint));
    let (frame, frame_speed) = (frame.unwrap_or_default(), frame_speed.unwrap_or_default());
    let plane = plane.unwrap_or_default().into_iter();
    let plane =
        plane.map(|(name, (normal, through))| (name, constraints::limit::HalfSpace { normal, through }));
    let body = body.unwrap_or_default().into_iter();
    let body = body.map(|(name, (position, rpy))| (name, constraints::limit::Pose { position, rpy }));
    constraints::Moved {
        speed,
        velocity,
        acceleration,
        lower,
        upper,
        frame,
        frame_speed,
        energy,
        plane: plane.collect(),
        body: body.collect(),
        payload: None,
    }
}
