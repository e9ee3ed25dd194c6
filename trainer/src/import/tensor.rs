//! Constants of a graph.

use rten_onnx::onnx::{AttributeProto, DataType, TensorProto};
use std::path::Path;

/// A constant, row-major. Whole numbers are kept as `f64`, which holds every size and index that occurs.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tensor {
    pub(super) dims: Vec<usize>,
    pub(super) values: Vec<f64>,
}

/// More elements than any policy's layer has.
pub(super) const MOST: usize = 1 << 26;

impl Tensor {
    pub(super) fn scalar(value: f64) -> Self {
        Self { dims: Vec::new(), values: vec![value] }
    }

    pub(super) fn vector(values: Vec<f64>) -> Self {
        Self { dims: vec![values.len()], values }
    }

    /// Reads a constant; `beside` is the folder of external data.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(super) fn read(proto: &TensorProto, beside: Option<&Path>) -> Result<Self, String> {
        let dims: Option<Vec<usize>> = proto.dims.iter().map(|&d| usize::try_from(d).ok()).collect();
        let dims = dims.ok_or("has a negative size")?;
        let count = dims.iter().try_fold(1_usize, |n, &d| n.checked_mul(d)).filter(|&n| n <= MOST);
        let count = count.ok_or_else(|| format!("has {dims:?} elements, more than any policy's layer"))?;
        let kind = proto.data_type.unwrap_or(DataType(0));
        let values = match outside(proto, beside)? {
            Some(bytes) => decode(kind, &bytes)?,
            None => match &proto.raw_data {
                Some(raw) => decode(kind, &raw.borrow())?,
                None => listed(proto, kind)?,
            },
        };
        if values.len() != count {
            return Err(format!("says it has {count} elements and holds {}", values.len()));
        }
        Ok(Self { dims, values })
    }

    /// The value of a `Constant` node's attribute.
    pub(super) fn of_attribute(a: &AttributeProto, beside: Option<&Path>) -> Result<Self, String> {
        match a.name.as_deref() {
            Some("value") => Self::read(a.t.as_ref().ok_or("has no value")?, beside),
            Some("value_float") => Ok(Self::scalar(f64::from(a.f.ok_or("has no value")?))),
            Some("value_int") => Ok(Self::scalar(a.i.ok_or("has no value")? as f64)),
            Some("value_floats") => Ok(Self::vector(a.floats.iter().map(|&x| f64::from(x)).collect())),
            Some("value_ints") => Ok(Self::vector(a.ints.iter().map(|&x| x as f64).collect())),
            _ => Err("is neither a number nor a tensor".into()),
        }
    }

    /// Whole numbers.
    pub(super) fn integers(&self) -> Vec<i64> {
        self.values.iter().map(|&x| x as i64).collect()
    }

    /// One value for each of a row's entries, or one for all: every other dimension is 1.
    pub(super) fn row(&self) -> Option<&[f64]> {
        let last = self.dims.last().copied().unwrap_or(1);
        (self.values.len() == last).then_some(&self.values)
    }

    /// Rows and columns.
    pub(super) fn matrix(&self) -> Option<(usize, usize)> {
        match self.dims[..] {
            [rows, columns] => Some((rows, columns)),
            _ => None,
        }
    }

    /// Rows and columns exchanged.
    pub(super) fn transposed(&self) -> Option<Self> {
        let (rows, columns) = self.matrix()?;
        let at = |i: usize| self.values[(i % rows) * columns + i / rows];
        Some(Self { dims: vec![columns, rows], values: (0..rows * columns).map(at).collect() })
    }

    /// Element by element with another constant, broadcast as ONNX does; `None` where the shapes do not fit.
    pub(super) fn zip(&self, other: &Self, f: impl Fn(f64, f64) -> f64) -> Option<Self> {
        let n = self.dims.len().max(other.dims.len());
        let dim = |t: &Self, i: usize| (i + t.dims.len()).checked_sub(n).map_or(1, |i| t.dims[i]);
        let dims: Option<Vec<usize>> = (0..n)
            .map(|i| match (dim(self, i), dim(other, i)) {
                (a, b) if a == b || b == 1 => Some(a),
                (1, b) => Some(b),
                _ => None,
            })
            .collect();
        let dims = dims?;
        let count = dims.iter().try_fold(1_usize, |n, &d| n.checked_mul(d)).filter(|&n| n <= MOST)?;
        // The element of a tensor that stands at the `k`-th place of all: axis by axis from the last, an axis of one at its one place.
        let at = |t: &Self, k: usize| {
            let (mut index, mut stride, mut k) = (0, 1, k);
            for i in (0..n).rev() {
                let (here, own) = (k % dims[i], dim(t, i));
                (k, index, stride) =
                    (k / dims[i], index + if own == 1 { 0 } else { here * stride }, stride * own);
            }
            t.values[index]
        };
        let values = (0..count).map(|k| f(at(self, k), at(other, k))).collect();
        Some(Self { dims, values })
    }
}

fn listed(proto: &TensorProto, kind: DataType) -> Result<Vec<f64>, String> {
    Ok(match kind {
        DataType::FLOAT => proto.float_data.iter().map(|&x| f64::from(x)).collect(),
        DataType::DOUBLE => proto.double_data.clone(),
        DataType::INT64 => proto.int64_data.iter().map(|&x| x as f64).collect(),
        DataType::INT32 | DataType::BOOL => proto.int32_data.iter().map(|&x| f64::from(x)).collect(),
        other => return Err(unread(other)),
    })
}

fn decode(kind: DataType, bytes: &[u8]) -> Result<Vec<f64>, String> {
    Ok(match kind {
        DataType::FLOAT => bytes.as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
        DataType::DOUBLE => bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        DataType::INT64 => bytes.as_chunks().0.iter().map(|b| i64::from_le_bytes(*b) as f64).collect(),
        DataType::INT32 => bytes.as_chunks().0.iter().map(|b| f64::from(i32::from_le_bytes(*b))).collect(),
        DataType::BOOL => bytes.iter().map(|&b| f64::from(b)).collect(),
        other => return Err(unread(other)),
    })
}

fn unread(kind: DataType) -> String {
    format!(
        "has elements of type {}, where float32, float64 and integers are read",
        kind.name().unwrap_or("unknown")
    )
}

/// The bytes that lie in a file beside the model's, if they do.
fn outside(proto: &TensorProto, beside: Option<&Path>) -> Result<Option<Vec<u8>>, String> {
    if proto.external_data.is_empty() {
        return Ok(None);
    }
    let entry = |key: &str| {
        let of = proto.external_data.iter().find(|e| e.key.as_deref() == Some(key));
        of.and_then(|e| e.value.as_deref())
    };
    let name = entry("location").ok_or("lies in a file that is not named")?;
    let plain = Path::new(name).components().count() == 1 && !name.contains(['/', '\\']) && name != "..";
    let folder = beside.filter(|_| plain);
    let folder =
        folder.ok_or_else(|| format!("lies in '{name}', which is not a file beside the policy's"))?;
    let number =
        |key: &str| entry(key).map(str::parse::<usize>).transpose().map_err(|_| format!("has no {key}"));
    let bytes = nearl_runtime::constraints::read_bounded(
        &folder.join(name),
        nearl_runtime::snapshot::MAX_BYTES,
        false,
    )
    .map_err(|e| format!("lies in '{name}', which cannot be read ({e})"))?;
    let start = number("offset")?.unwrap_or(0);
    let length = number("length")?.unwrap_or(bytes.len().saturating_sub(start));
    let range = start..start.saturating_add(length);
    let part = bytes.get(range).ok_or_else(|| format!("goes beyond the end of '{name}'"))?;
    Ok(Some(part.to_vec()))
}
