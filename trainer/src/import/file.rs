//! Reads the ONNX file of a policy, and the external data beside it.

use super::ImportError;
use super::graph::Graph;
use super::network::ImportedNetwork;
use super::sound::is_sound;
use nearl_runtime::file_kind::FileKind;
use nearl_runtime::snapshot::MAX_BYTES;
use rten_onnx::onnx::ModelProto;
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
    let mut network = Graph::new(graph, beside).policy(output).map_err(ImportError::in_one_line)?;
    let pairs = model.metadata_props.iter();
    network.metadata =
        pairs.filter_map(|p| Some((p.key.clone()?, p.value.clone().unwrap_or_default()))).collect();
    Ok(network)
}

fn other(file: &str, kind: Option<FileKind>) -> ImportError {
    let (kind, next) = kind.map_or(
        ("of an unknown kind, or damaged", "give the .onnx file that the training framework exported"),
        |kind| (kind.name(), kind.next()),
    );
    ImportError::Kind { file: file.into(), kind: kind.into(), next: next.into() }
}
