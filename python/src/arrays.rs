//! Turns what NumPy accepts into vectors, and vectors into arrays.

use numpy::{
    AllowTypeChange, PyArray1, PyArray2, PyArrayDyn, PyArrayLikeDyn, PyArrayMethods, PyUntypedArray,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyFloat};

/// A vector of `expected` numbers; `name` is what the message calls it.
pub(crate) fn vector(name: &str, value: &Bound<'_, PyAny>, expected: usize) -> PyResult<Vec<f64>> {
    let array = numbers(name, value)?;
    if array.shape() != [expected] {
        return Err(shape(name, array.shape(), &format!("({expected},)")));
    }
    Ok(values(&array))
}

/// Rows of `columns` numbers each, row by row, and how many there are.
pub(crate) fn rows(name: &str, value: &Bound<'_, PyAny>, columns: usize) -> PyResult<(Vec<f64>, usize)> {
    let array = numbers(name, value)?;
    match array.shape() {
        [n, width] if *width == columns => Ok((values(&array), *n)),
        other => Err(shape(name, other, &format!("(n, {columns})"))),
    }
}

/// The same where the number of rows is known.
pub(crate) fn matrix(name: &str, value: &Bound<'_, PyAny>, n: usize, columns: usize) -> PyResult<Vec<f64>> {
    let (values, given) = rows(name, value, columns)?;
    if given == n { Ok(values) } else { Err(shape(name, &[given, columns], &format!("({n}, {columns})"))) }
}

fn numbers<'py>(
    name: &str,
    value: &Bound<'py, PyAny>,
) -> PyResult<PyArrayLikeDyn<'py, f64, AllowTypeChange>> {
    refuse_complex(name, value)?;
    refuse_masked(name, value)?;
    value.extract().map_err(|_| {
        let kind = value.get_type().to_string();
        PyValueError::new_err(format!("{name} is not an array of numbers but {kind}; pass a NumPy array"))
    })
}

/// NumPy drops the imaginary part of what is made real, with no more than a warning.
pub(crate) fn refuse_complex(name: &str, value: &Bound<'_, PyAny>) -> PyResult<()> {
    if value.cast::<PyArrayDyn<f64>>().is_ok() || value.is_exact_instance_of::<PyFloat>() {
        return Ok(());
    }
    if let Ok(map) = value.cast::<PyDict>() {
        return map.values().iter().try_for_each(|value| refuse_complex(name, &value));
    }
    // What NumPy cannot look at is refused by whoever reads it.
    let answer = value.py().import("numpy")?.call_method1("iscomplexobj", (value,));
    if answer.and_then(|is| is.is_truthy()).unwrap_or(false) {
        return Err(PyValueError::new_err(format!(
            "{name} holds complex numbers, and a robot has none; give real ones, e.g. {name}.real"
        )));
    }
    Ok(())
}

/// A single number.
pub(crate) fn number(name: &str, value: &Bound<'_, PyAny>) -> PyResult<f64> {
    refuse_complex(name, value)?;
    value.extract().map_err(|_| PyTypeError::new_err(format!("{name} is of {}; give a number", kind(value))))
}

/// A whole number from `least` on.
pub(crate) fn whole(name: &str, value: &Bound<'_, PyAny>, least: u32) -> PyResult<u32> {
    let asked = format!("give a whole number from {least} to {}", u32::MAX);
    if !value.hasattr("__index__")? {
        return Err(PyTypeError::new_err(format!("{name} is of {}; {asked}", kind(value))));
    }
    match value.extract() {
        Ok(number) if number >= least => Ok(number),
        _ => Err(PyValueError::new_err(format!("{name} is {value}; {asked}"))),
    }
}

/// Steps of a simulator in a period; 0 for constant acceleration.
pub(crate) fn sub_steps(value: &Bound<'_, PyAny>) -> PyResult<u32> {
    whole("sub_steps", value, 0)
}

/// Names of joints: a text alone is none of them, although it is a sequence.
pub(crate) fn joint_names(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Vec<String>> {
    value.extract().map_err(|_| {
        PyTypeError::new_err(format!(
            "{name} is of {}; give a list of the names of joints, e.g. {name}=[\"elbow\"]",
            kind(value)
        ))
    })
}

fn kind(value: &Bound<'_, PyAny>) -> String {
    value.get_type().name().map_or("another type".into(), |kind| kind.to_string())
}

/// NumPy gives what lies under a mask as if it were meant.
fn refuse_masked(name: &str, value: &Bound<'_, PyAny>) -> PyResult<()> {
    if value.is_exact_instance_of::<PyUntypedArray>() || !value.hasattr("mask")? {
        return Ok(());
    }
    let masked = value.py().import("numpy")?.getattr("ma")?.call_method1("is_masked", (value,))?;
    if masked.is_truthy()? {
        return Err(PyValueError::new_err(format!(
            "{name} holds masked numbers, and a state has a number for each joint; fill them, e.g. {name}.filled(0.0)"
        )));
    }
    Ok(())
}

/// In C order, whatever the strides were.
fn values(array: &PyArrayLikeDyn<'_, f64, AllowTypeChange>) -> Vec<f64> {
    // `as_slice` also takes Fortran order, in which the memory is not the rows.
    match array.as_slice() {
        Ok(slice) if array.is_c_contiguous() => slice.to_vec(),
        _ => array.as_array().iter().copied().collect(),
    }
}

fn shape(name: &str, given: &[usize], expected: &str) -> PyErr {
    let given = match given {
        [n] => format!("({n},)"),
        _ => format!("({})", given.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")),
    };
    PyValueError::new_err(format!("{name} has shape {given}, expected {expected}"))
}

/// A NumPy vector.
pub(crate) fn array<'py>(py: Python<'py>, values: &[f64]) -> Bound<'py, PyArray1<f64>> {
    PyArray1::from_slice(py, values)
}

/// A NumPy matrix from its rows.
pub(crate) fn array2<'py>(
    py: Python<'py>,
    values: Vec<f64>,
    columns: usize,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let n = values.len().checked_div(columns).unwrap_or(0);
    PyArray1::from_vec(py, values).reshape([n, columns])
}
