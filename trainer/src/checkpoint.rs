//! A checkpoint: everything a training needs to go on as if it had never stopped, in one safetensors file.
//!
//! The file's metadata has one key, `nearl-checkpoint`: the blake3 digest in hex, a line break, a header as JSON. The digest
//! covers header and tensors, as in a snapshot. Floating-point numbers of the state are tensors, so no bit is lost.

use nearl_runtime::snapshot::{Manifest, digest, write_whole};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Version of the file format.
pub const FORMAT: u32 = 2;
const KEY: &str = "nearl-checkpoint";
/// Largest file that is read: far above what the widest networks need, and below what a wrong file would fill memory with.
const MAX_BYTES: u64 = 8 << 30;

/// Everything but floating-point state.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Version of the file format, [`FORMAT`].
    pub format: u32,
    /// Task, robot, algorithm, steps done (`manifest.steps`) and iterations done (`manifest.version`).
    pub manifest: Manifest,
    /// Steps asked for.
    pub total: u64,
    /// Seed of everything random.
    pub seed: u64,
    /// Position in the learner's random stream.
    pub rng: u64,
    /// Steps taken by each optimiser.
    pub adam: Vec<i32>,
    /// One entry an environment.
    pub workers: Vec<WorkerHeader>,
    /// Reward or end of a control period were somebody else's code: without it the training cannot go on.
    #[serde(default, alias = "judged", skip_serializing_if = "std::ops::Not::not")]
    pub is_scored_elsewhere: bool,
    /// It started from the networks of another training, without a warm-up.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub starts_warm: bool,
}

/// Whole numbers of one environment.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorkerHeader {
    /// Position in its random stream.
    pub rng: u64,
    /// Control ticks of the episode so far.
    pub ticks: usize,
    /// Policy steps of the episode so far.
    pub length: usize,
}

/// Values of one tensor.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Parameters and moments.
    F32(Vec<f32>),
    /// Statistics and states.
    F64(Vec<f64>),
}

impl Values {
    fn bytes(&self) -> (Dtype, usize, Vec<u8>) {
        match self {
            Self::F32(v) => (Dtype::F32, v.len(), v.iter().flat_map(|x| x.to_le_bytes()).collect()),
            Self::F64(v) => (Dtype::F64, v.len(), v.iter().flat_map(|x| x.to_le_bytes()).collect()),
        }
    }
}

/// A training at rest between two iterations.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    /// Whole numbers and the manifest.
    pub header: Header,
    /// Floating-point state by name.
    pub tensors: BTreeMap<String, Values>,
}

/// Why a checkpoint cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system.
    #[error("cannot write checkpoint '{file}': {reason}; one that was there before still holds")]
    Unwritable {
        /// Path.
        file: String,
        /// What the system said.
        reason: String,
    },
    /// Missing, not a regular file, or too large.
    #[error(
        "cannot use checkpoint '{file}': {reason}; give the run folder of 'nearl train' with --resume or --start-from"
    )]
    Unusable {
        /// Path.
        file: String,
        /// One sentence.
        reason: String,
    },
    /// Cut short or changed.
    #[error("checkpoint '{file}' is damaged: {reason}; copy it again or start a new run with --out")]
    Damaged {
        /// Path.
        file: String,
        /// One sentence.
        reason: String,
    },
    /// Whole, but of something else.
    #[error("checkpoint '{file}' is not of this training: {reason}; start a new run with --out")]
    Foreign {
        /// Path.
        file: String,
        /// One sentence.
        reason: String,
    },
}

/// Where a run folder keeps its checkpoint.
pub fn path_in(run: &Path) -> PathBuf {
    run.join("checkpoints").join("resume.safetensors")
}

impl Checkpoint {
    /// Writes the file whole: to a name beside it, then renamed.
    ///
    /// # Errors
    /// [`CheckpointError::Unwritable`] with what the system said.
    pub fn save(&self, path: &Path) -> Result<(), CheckpointError> {
        write_whole(path, &self.to_bytes()).map_err(|e| CheckpointError::Unwritable {
            file: path.display().to_string(),
            reason: e.to_string(),
        })
    }

    /// The file as it is written.
    pub fn to_bytes(&self) -> Vec<u8> {
        let bytes: Vec<_> = self.tensors.iter().map(|(name, values)| (name, values.bytes())).collect();
        let mut views: Vec<(String, TensorView<'_>)> = Vec::with_capacity(bytes.len());
        for (name, (dtype, n, bytes)) in &bytes {
            let view = TensorView::new(*dtype, vec![*n], bytes);
            views.push(((*name).clone(), view.unwrap_or_else(|e| unreachable!("tensor '{name}': {e}"))));
        }
        let header = serde_json::to_string(&self.header).unwrap_or_else(|e| unreachable!("header: {e}"));
        let sum = digest(&header, views.iter().map(|(n, v)| (n.as_str(), v.shape(), v.data())));
        let metadata = [(KEY.to_string(), format!("{sum}\n{header}"))].into_iter().collect();
        safetensors::serialize(views, Some(metadata)).unwrap_or_else(|e| unreachable!("safetensors: {e}"))
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`CheckpointError`]; links, pipes, devices and folders are refused without opening them.
    pub fn load(path: &Path) -> Result<Self, CheckpointError> {
        let file = path.display().to_string();
        let unusable = |reason: String| CheckpointError::Unusable { file: file.clone(), reason };
        let bytes = nearl_runtime::constraints::read_bounded(path, MAX_BYTES, false);
        let bytes = bytes.map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => {
                unusable("there is none, which a run has after its first batch".into())
            }
            _ => unusable(e.to_string()),
        })?;
        Self::from_bytes(&file, &bytes)
    }

    /// [`Checkpoint::load`] from the bytes of a file, which messages call `file`.
    ///
    /// # Errors
    /// [`CheckpointError`].
    pub fn from_bytes(file: &str, bytes: &[u8]) -> Result<Self, CheckpointError> {
        let damaged = |reason: String| CheckpointError::Damaged { file: file.into(), reason };
        let foreign = |reason: String| CheckpointError::Foreign { file: file.into(), reason };
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|e| damaged(e.to_string()))?;
        let content = SafeTensors::deserialize(bytes).map_err(|e| damaged(e.to_string()))?;
        let text = metadata.metadata().as_ref().and_then(|m| m.get(KEY));
        let text = text.ok_or_else(|| foreign(format!("it has no metadata key '{KEY}'")))?;
        let (expected, header) =
            text.split_once('\n').ok_or_else(|| damaged("the digest line is missing".into()))?;
        let views = content.tensors();
        let actual = digest(header, views.iter().map(|(n, v)| (n.as_str(), v.shape(), v.data())));
        if actual != expected {
            return Err(damaged(format!("the file says digest {expected}, its content gives {actual}")));
        }
        let header: Header = serde_json::from_str(header).map_err(|e| foreign(e.to_string()))?;
        if header.format != FORMAT {
            return Err(foreign(format!(
                "it has format {} where this program reads {FORMAT}",
                header.format
            )));
        }
        let mut tensors = BTreeMap::new();
        for (name, view) in views {
            let data = view.data();
            let values = match view.dtype() {
                Dtype::F32 => {
                    Values::F32(data.as_chunks().0.iter().map(|c| f32::from_le_bytes(*c)).collect())
                }
                Dtype::F64 => {
                    Values::F64(data.as_chunks().0.iter().map(|c| f64::from_le_bytes(*c)).collect())
                }
                other => return Err(foreign(format!("tensor '{name}' has type {other:?}"))),
            };
            tensors.insert(name, values);
        }
        Ok(Self { header, tensors })
    }

    /// Takes tensor `name`, which must have `n` entries (any number if `None`).
    ///
    /// # Errors
    /// One sentence naming the tensor.
    pub fn take_f64(&mut self, name: &str, n: Option<usize>) -> Result<Vec<f64>, String> {
        match self.tensors.remove(name) {
            Some(Values::F64(v)) if n.is_none_or(|n| n == v.len()) => Ok(v),
            other => Err(unfit(name, other, n, "F64")),
        }
    }

    /// See [`Checkpoint::take_f64`].
    ///
    /// # Errors
    /// One sentence naming the tensor.
    pub fn take_f32(&mut self, name: &str, n: usize) -> Result<Vec<f32>, String> {
        match self.tensors.remove(name) {
            Some(Values::F32(v)) if n == v.len() => Ok(v),
            other => Err(unfit(name, other, Some(n), "F32")),
        }
    }
}

fn unfit(name: &str, found: Option<Values>, n: Option<usize>, dtype: &str) -> String {
    let need = n.map_or(String::new(), |n| format!("{n} "));
    match found {
        None => format!("it has no tensor '{name}'"),
        Some(Values::F32(v)) => {
            format!("tensor '{name}' has {} F32 entries where {need}{dtype} are needed", v.len())
        }
        Some(Values::F64(v)) => {
            format!("tensor '{name}' has {} F64 entries where {need}{dtype} are needed", v.len())
        }
    }
}
