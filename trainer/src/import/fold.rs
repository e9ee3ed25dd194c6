//! Nodes of constants alone: computed here, as ONNX has them.

use super::graph::Node;
use super::tensor::Tensor;
use rten_onnx::onnx::DataType;

/// The value of a node whose inputs are constants.
pub(super) fn fold(n: &Node<'_>) -> Result<Tensor, String> {
    let x = (n.constant)(0).ok_or("has no input that this program knows")?;
    let map = |f: fn(f64) -> f64| {
        Ok(Tensor { dims: x.dims.clone(), values: x.values.iter().map(|&v| f(v)).collect() })
    };
    let fit = |a: &Tensor, b: &Tensor, f: fn(f64, f64) -> f64| {
        a.zip(b, f)
            .ok_or_else(|| format!("has constants of shapes {:?} and {:?}, which do not fit", a.dims, b.dims))
    };
    let pair = |f| fit(x, (n.constant)(1).ok_or("has one input")?, f);
    let all = |f| {
        let mut others = (1..n.width()).map(|i| (n.constant)(i).ok_or("has an input that is left out"));
        others.try_fold(x.clone(), |a, b| fit(&a, b?, f))
    };
    match n.op {
        "Add" => pair(|a, b| a + b),
        "Sub" => pair(|a, b| a - b),
        "Mul" => pair(|a, b| a * b),
        "Div" => pair(|a, b| a / b),
        "Pow" => pair(f64::powf),
        "Max" => all(f64::max),
        "Min" => all(f64::min),
        "Sqrt" => map(f64::sqrt),
        "Exp" => map(f64::exp),
        "Neg" => map(|v| -v),
        "Reciprocal" => map(|v| 1.0 / v),
        "Identity" => Ok(x.clone()),
        "Cast" => match DataType(n.integer("to", 0) as i32) {
            DataType::FLOAT | DataType::DOUBLE => Ok(x.clone()),
            DataType::INT32 | DataType::INT64 => map(f64::trunc),
            DataType::BOOL => map(|v| f64::from(u8::from(v != 0.0))),
            other => Err(cast_to(other)),
        },
        "Squeeze" => squeeze(x, n.integers(1, "axes")),
        "Unsqueeze" => unsqueeze(x, &n.integers(1, "axes").ok_or("needs constant axes")?),
        "Transpose" => transpose(x, n.integers(usize::MAX, "perm")),
        _ => Err("is none that this program computes from constants".into()),
    }
}

/// Why a change of type is not read.
pub(super) fn cast_to(kind: DataType) -> String {
    format!("makes numbers of type {}, which is not read", kind.name().unwrap_or("unknown"))
}

/// The place that an axis of `n` has, counted from the end where it is negative.
fn place(axis: i64, n: usize) -> Result<usize, String> {
    let from = if axis < 0 { axis.checked_add(n as i64) } else { Some(axis) };
    let at = from.and_then(|at| usize::try_from(at).ok()).filter(|at| *at < n);
    at.ok_or_else(|| format!("names axis {axis} of {n}"))
}

fn squeeze(x: &Tensor, axes: Option<Vec<i64>>) -> Result<Tensor, String> {
    let n = x.dims.len();
    let gone = match axes {
        Some(axes) => axes.iter().map(|&axis| place(axis, n)).collect::<Result<Vec<_>, _>>()?,
        None => (0..n).filter(|&i| x.dims[i] == 1).collect(),
    };
    if let Some(&i) = gone.iter().find(|&&i| x.dims[i] != 1) {
        return Err(format!("takes out axis {i}, which has {} entries", x.dims[i]));
    }
    let dims = (0..n).filter(|i| !gone.contains(i)).map(|i| x.dims[i]).collect();
    Ok(Tensor { dims, values: x.values.clone() })
}

fn unsqueeze(x: &Tensor, axes: &[i64]) -> Result<Tensor, String> {
    let n = x.dims.len() + axes.len();
    let new = axes.iter().map(|&axis| place(axis, n)).collect::<Result<Vec<_>, _>>()?;
    let mut old = x.dims.iter();
    let dims = (0..n).map(|i| if new.contains(&i) { 1 } else { old.next().copied().unwrap_or(1) }).collect();
    Ok(Tensor { dims, values: x.values.clone() })
}

fn transpose(x: &Tensor, order: Option<Vec<i64>>) -> Result<Tensor, String> {
    let order = order.unwrap_or_else(|| (0..x.dims.len() as i64).rev().collect());
    match order[..] {
        [1, 0] => x.transposed().ok_or_else(|| format!("turns axes {order:?} of {:?}", x.dims)),
        _ if order.len() == x.dims.len() && order.iter().copied().eq(0..order.len() as i64) => Ok(x.clone()),
        _ => Err(format!("turns axes {order:?}, where rows and columns are read")),
    }
}
