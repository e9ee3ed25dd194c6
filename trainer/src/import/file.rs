//! Reads the ONNX file of a policy, and the external data beside it.

use super::ImportError;
use super::graph::Graph;
use super::network::ImportedNetwork;
use super::sound::is_sound;
use super::tensor::Tensor;
use nearl_runtime::file_kind::FileKind;
use nearl_runtime::snapshot::{FAR, HUGE, MAX_BYTES, first_beyond};
use rten_onnx::onnx::{GraphProto, ModelProto};
use std::path::Path;

/// Reads the policy in an ONNX file; `output` names the output that is the action where there are several.
///
/// # Errors
/// [`ImportError`].
pub fn read(path: &Path, output: Option<&str>) -> Result<ImportedNetwork, ImportError> {
    let file = path.display().to_string();
    let unreadable = |reason: String| ImportError::Unreadable { file: file.clone(), reason };
    let meta = std::fs::metadata(path).map_err(|e| unreadable(e.to_string()))?;
    if !meta.is_file() {
        return Err(unreadable("it is not a regular file".into()));
    }
    if meta.len() > MAX_BYTES {
        return Err(unreadable(format!("it has {} bytes, more than the limit of {MAX_BYTES}", meta.len())));
    }
    let bytes = std::fs::read(path).map_err(|e| unreadable(e.to_string()))?;
    onnx(&file, &bytes, path.parent(), output)
}

/// The same from the bytes of the file named `file`; `beside` is the folder of external data.
///
/// # Errors
/// As [`read`].
pub fn onnx(
    file: &str,
    bytes: &[u8],
    beside: Option<&Path>,
    output: Option<&str>,
) -> Result<ImportedNetwork, ImportError> {
    let kind = FileKind::of(bytes);
    if kind.is_some_and(|kind| kind != FileKind::Onnx) {
        return Err(other(file, kind));
    }
    if !is_sound(bytes) {
        return Err(other(file, None));
    }
    let model = ModelProto::parse_buf(bytes).map_err(|_| other(file, None))?;
    let graph = model.graph.as_ref().filter(|g| !g.node.is_empty()).ok_or_else(|| other(file, None))?;
    let mut network = Graph::new(graph, beside).policy(output).map_err(|e| e.of(file))?;
    check_values(file, graph, beside, &network)?;
    let pairs = model.metadata_props.iter();
    network.metadata =
        pairs.filter_map(|p| Some((p.key.clone()?, p.value.clone().unwrap_or_default()))).collect();
    Ok(network)
}

/// Refuses numbers that no reader of the snapshot would take, by the tensor of the file that holds the first, else by the layer they end up in.
fn check_values(
    file: &str,
    graph: &GraphProto,
    beside: Option<&Path>,
    network: &ImportedNetwork,
) -> Result<(), ImportError> {
    let mut parts: Vec<(String, (usize, f64))> = Vec::new();
    for (i, layer) in network.dense.layers.iter().enumerate() {
        for (what, values) in [("weight", &layer.weight), ("bias", &layer.bias)] {
            let found = first_beyond(values, HUGE);
            parts.extend(found.map(|found| (format!("{what} of layer {i}"), found)));
        }
    }
    for (what, values) in [("mean of the inputs", &network.mean), ("scale of the inputs", &network.std)] {
        parts.extend(first_beyond(values, FAR).map(|found| (what.to_string(), found)));
    }
    let Some(part) = parts.into_iter().next() else { return Ok(()) };
    let of_file = graph.initializer.iter().find_map(|proto| {
        let tensor = Tensor::read(proto, beside).ok()?;
        let found = first_beyond(&tensor.values, HUGE)?;
        Some((proto.name.clone().unwrap_or_default(), found))
    });
    if let (None, Some(index)) = (&of_file, network.std.iter().position(|std| *std == 0.0)) {
        let (file, input) = (file.into(), network.input_name.clone());
        return Err(ImportError::Deviation { file, input, index }.in_one_line());
    }
    let (tensor, (index, value)) = of_file.unwrap_or(part);
    let single = value as f32;
    let value = match f64::from(single) == value {
        true if single.abs() > 1e9 && single.is_finite() => format!("{single:e}"),
        true => single.to_string(),
        false => format!("{value:e}"),
    };
    let error = ImportError::Value { file: file.into(), tensor, index, value };
    Err(error.in_one_line())
}

fn other(file: &str, kind: Option<FileKind>) -> ImportError {
    let (kind, next) = kind.map_or(
        ("of an unknown kind, or damaged", "give the .onnx file that the training framework exported"),
        |kind| (kind.name(), kind.next()),
    );
    ImportError::Kind { file: file.into(), kind: kind.into(), next: next.into() }
}
