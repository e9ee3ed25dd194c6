//! The way from the observation to an output, one operation after another.

use nearl_runtime::net::Function;
use std::ops::Range;

/// One operation; a row has one number for each entry, or one for all.
#[derive(Clone, Debug)]
pub(super) enum Operation {
    /// The observation itself, with its width where the file says it.
    Input(String, Option<usize>),
    /// `W x + b`, W row-major (n_out x n_in).
    Dense { n_in: usize, n_out: usize, weight: Vec<f64>, bias: Vec<f64> },
    /// `scale x + shift`.
    Affine(Vec<f64>, Vec<f64>),
    /// `clip(x, lower, upper)`.
    Clip(Vec<f64>, Vec<f64>),
    /// Each entry alone.
    Function(Function),
    /// Entries from the first of the range to before its end.
    Select(Range<usize>),
    /// The i-th of so many equal parts.
    Part(usize, usize),
    /// Entries from the first to before the second, counted from the end where negative, as ONNX does.
    Slice(i64, i64),
    /// Nothing, where so many entries come.
    Width(usize),
    /// Nothing: shapes, types, names.
    Same,
}

impl Operation {
    /// Which of `n` entries stay; `None` where the operation is no choice.
    pub(super) fn range(&self, n: usize) -> Option<Range<usize>> {
        let from_end = |i: i64| if i < 0 { (i + n as i64).max(0) as usize } else { (i as usize).min(n) };
        match self {
            Self::Select(range) => Some(range.clone()),
            Self::Part(i, parts) => Some(i * n.div_ceil(*parts)..((i + 1) * n.div_ceil(*parts)).min(n)),
            Self::Slice(start, end) => Some(from_end(*start)..from_end(*end)),
            _ => None,
        }
    }
}

/// An operation, and the one before.
pub(super) struct Live {
    pub(super) before: Option<usize>,
    pub(super) operation: Operation,
    /// Name of the node, for messages.
    pub(super) name: String,
    /// Operator of the node.
    pub(super) op: String,
}
