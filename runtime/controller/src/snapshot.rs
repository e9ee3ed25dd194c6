//! The snapshot: policy, inverse model, normaliser, constraints, layout and robot in one safetensors file.
//!
//! The file's metadata has one key, `nearl`: the blake3 digest in hex, a line break, the manifest as JSON.
//! The digest covers the manifest text and every tensor (name, shape, bytes), so any changed bit is refused.

mod first;
mod networks;

use crate::codes::SnapshotCode;
use crate::file_kind::FileKind;
use crate::net::{Activation, Function};
use crate::task::{IdmKind, Task};
use nearl_constraints::{Guard, Moved, RobotDescription};
pub use networks::{FAR, HUGE, Networks, first_beyond};
use safetensors::tensor::{SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Version of the file format.
pub const FORMAT: u32 = 2;
/// Name of the algorithm of a snapshot without a policy.
pub const BLANK: &str = "blank";
/// Version that a file says whose networks have a linear part beside their layers: programs that know [`FORMAT`] alone would leave it out.
const FORMAT_WITH_SKIP: u32 = 3;
/// Larger files are refused before they are read, in \[byte\].
pub const MAX_BYTES: u64 = 256 << 20;
const KEY: &str = "nearl";

/// How the networks are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PolicyKind {
    /// The policy's output is the mean action; nothing is proposed or projected (plain PPO).
    Direct,
    /// The policy's output is the proposed change of the state; exploration is in the action (LEARNING, Eq. 1 of the paper).
    Deterministic,
    /// The same, and Gaussian; exploration is in the proposal.
    Stochastic,
    /// The policy's output is the next state itself, in place of its change; an imported policy, without exploration.
    State,
}

/// Language of a robot file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ModelFormat {
    /// URDF.
    Urdf,
    /// MuJoCo's MJCF.
    Mjcf,
}

/// The robot file that a simulator compiles. A controller never reads it, and a snapshot of a robot that the simulator brings
/// itself has none.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Simulation {
    /// Its language.
    pub format: ModelFormat,
    /// Its text.
    pub text: String,
    /// Where the files are that it includes, and its meshes; absent when it names none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub folder: Option<PathBuf>,
}

/// Everything but the numbers.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of the file format, [`FORMAT`].
    pub format: u32,
    /// The effective task file.
    pub task: Task,
    /// The robot: all that a controller knows of it.
    pub robot: RobotDescription,
    /// The robot file for the simulator of the trainer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub simulation: Option<Simulation>,
    /// Algorithm that made the weights, e.g. `pid2-ib`.
    pub algo: String,
    /// How the networks are read.
    pub policy: PolicyKind,
    /// What lies between the layers of the networks; tanh in files that do not say.
    #[serde(default)]
    pub activation: Activation,
    /// What follows each layer of the policy, first to last; where it does not say, `activation` between layers and nothing after the last.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub functions: Vec<Function>,
    /// Counts the snapshots of one run upwards; 0 for a file made by hand.
    pub version: u64,
    /// Environment steps seen by the learner.
    pub steps: u64,
    /// Lowest action the actuators take (n_act).
    pub action_lower: Vec<f64>,
    /// Highest action the actuators take (n_act).
    pub action_upper: Vec<f64>,
    /// Where an operator has moved the limits of the loop that runs it; as they were built in files.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moved: Option<Moved>,
}

impl Manifest {
    /// What follows each of the policy's `layers` layers.
    pub fn policy_functions(&self, layers: usize) -> Vec<Function> {
        if self.functions.is_empty() {
            Function::between(self.activation, layers)
        } else {
            self.functions.clone()
        }
    }

    /// Whether actions are kept within limits of their own: `[constraints.action]`, or the forces of drives.
    pub fn limits_actions(&self) -> bool {
        self.task.constraints.action.is_some() || self.bounds_drives()
    }

    /// Whether the controller of this snapshot guards its actions: those of a network, where the task asks for it. Analytic inverse dynamics
    /// of a projected state needs no guard.
    pub fn guards(&self) -> bool {
        let network = self.policy == PolicyKind::Direct || self.task.idm.kind == IdmKind::Learned;
        network && self.task.constraints.guard == Guard::Model
    }

    /// Whether the forces of its drives are bounded ([`Guard::Drive`]).
    pub fn bounds_drives(&self) -> bool {
        let network = self.policy == PolicyKind::Direct || self.task.idm.kind == IdmKind::Learned;
        network && self.task.constraints.guard == Guard::Drive
    }

    /// What a loop cannot do for this policy: its task asks for a guard that steps a simulator, which a robot does not have.
    pub fn without_simulator(&self) -> Option<&'static str> {
        let network = self.policy == PolicyKind::Direct || self.task.idm.kind == IdmKind::Learned;
        (network && self.task.constraints.guard == Guard::Simulator).then_some(
            "constraints.guard is \"simulator\", which `nearl plant` and training have and a robot's driver has not: there its \
             actions go to the motors as they are; for a robot write guard = true or guard = \"drive\"",
        )
    }

    /// That it has no policy: another process is to propose in its place.
    pub fn without_policy(&self) -> Option<&'static str> {
        (self.algo == BLANK).then_some(
            "the snapshot has no policy (`nearl blank` wrote it), and keeps the robot where it is: give `nearl run` --proposer, and start a process \
             that proposes; or take a snapshot of a training",
        )
    }

    /// Whether a state is proposed in each tick, by the policy or by the guard on its behalf.
    pub fn proposes(&self) -> bool {
        self.policy != PolicyKind::Direct || self.guards()
    }
}

/// What a controller is built from.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// Everything but the numbers.
    pub manifest: Manifest,
    /// The numbers.
    pub networks: Networks,
}

/// Why a snapshot was refused. [`SnapshotError::code`] is the stable name of the reason.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SnapshotError {
    /// Missing, unreadable, not a regular file, or too large.
    #[error("cannot read snapshot '{file}': {reason}; give a .safetensors file written by 'nearl train'")]
    Unreadable {
        /// Path as given.
        file: String,
        /// One sentence.
        reason: String,
    },
    /// The file cannot be written.
    #[error("cannot write snapshot '{file}': {reason}; give another path, or make room")]
    Unwritable {
        /// Path as given.
        file: String,
        /// What the system said.
        reason: String,
    },
    /// Not a safetensors file, or cut short.
    #[error("{what} is not a safetensors file: {reason}")]
    Malformed {
        /// The file, if it is known.
        what: String,
        /// What the reader said, and what to do.
        reason: String,
    },
    /// Another kind of file.
    #[error("the file is {kind}, not a snapshot; {next}")]
    Kind {
        /// What it is, with an article.
        kind: &'static str,
        /// What to do with it.
        next: &'static str,
    },
    /// The manifest is missing or not ours.
    #[error("snapshot has no manifest of this program: {reason}; write it with 'nearl train'")]
    Foreign {
        /// One sentence.
        reason: String,
    },
    /// The digest does not match.
    #[error(
        "snapshot digest mismatch: the file says {expected}, its content gives {actual}; it was changed or damaged: copy it again"
    )]
    Digest {
        /// Digest in the file.
        expected: String,
        /// Digest of the content.
        actual: String,
    },
    /// A tensor that must be there is not.
    #[error(
        "snapshot has no tensor '{name}'; it was written by another version or cut: train again or convert it"
    )]
    MissingTensor {
        /// Name of the tensor.
        name: String,
    },
    /// A tensor of the wrong type or shape.
    #[error(
        "tensor '{name}' is {actual}, but the task needs {expected}; the snapshot belongs to another task"
    )]
    Shape {
        /// Name of the tensor.
        name: String,
        /// Shape needed.
        expected: String,
        /// Shape found.
        actual: String,
    },
    /// A value that is NaN, infinite, huge, or a standard deviation that is not positive.
    #[error("tensor '{name}' has {value} at index {index}; the training diverged: use an earlier snapshot")]
    Value {
        /// Name of the tensor.
        name: String,
        /// Where.
        index: usize,
        /// The value.
        value: f64,
    },
    /// Statistics of an observation that is no number of a robot.
    #[error(
        "tensor '{name}' has {value:e} at index {index}, and no observation counts beyond {FAR:e}; scale that entry of state.observation, and train again"
    )]
    Far {
        /// Name of the tensor.
        name: String,
        /// Which observation or state.
        index: usize,
        /// The value.
        value: f64,
    },
    /// The robot, layout or limits of the task (a file, or inside a snapshot) are refused.
    #[error("task cannot be used: {reason}")]
    Unusable {
        /// One sentence from the layer that refused.
        reason: String,
    },
    /// Canary inference gave something that is not a number.
    #[error(
        "canary inference gave {value} for action {index}; the weights are unusable: use an earlier snapshot"
    )]
    Canary {
        /// Action entry.
        index: usize,
        /// The value.
        value: f64,
    },
}

impl SnapshotError {
    /// Stable name of the reason, for logs, replies and `nearl explain`.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Unreadable { .. } | Self::Unwritable { .. } => SnapshotCode::Unreadable,
            Self::Malformed { .. } | Self::Kind { .. } => SnapshotCode::Malformed,
            Self::Foreign { .. } => SnapshotCode::Foreign,
            Self::Digest { .. } => SnapshotCode::Digest,
            Self::MissingTensor { .. } => SnapshotCode::MissingTensor,
            Self::Shape { .. } => SnapshotCode::Shape,
            Self::Value { .. } | Self::Far { .. } => SnapshotCode::Value,
            Self::Unusable { .. } => SnapshotCode::Unusable,
            Self::Canary { .. } => SnapshotCode::Canary,
        }
        .name()
    }
}

/// What a parser says of a damaged file, which may quote any of it: its first line, cut to what a message holds.
pub fn one_line(text: &dyn std::fmt::Display) -> String {
    const MOST: usize = 200;
    let text = text.to_string();
    let mut line: String = text.lines().next().unwrap_or_default().chars().take(MOST).collect();
    if line.len() < text.trim_end().len() {
        line.push_str("...");
    }
    line
}

/// Writes a file whole, in a folder that is made where it is missing: to a name beside it, then renamed, so that no reader ever sees a part of it. A link
/// stays, and what it leads to is written.
///
/// # Errors
/// What the system said; devices, pipes and folders, which are not replaced by a file.
pub fn write_whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let is_link = std::fs::symlink_metadata(path).is_ok_and(|is| is.is_symlink());
    let path = &if is_link { std::fs::canonicalize(path)? } else { path.to_path_buf() };
    if std::fs::metadata(path).is_ok_and(|is| !is.is_file()) {
        return Err(std::io::Error::other("it is a folder, a device or a pipe, and no file"));
    }
    let beside = path.with_extension(format!("part{}", std::process::id()));
    let write = || {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let mut file = std::fs::File::create(&beside)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&beside, path)
    };
    // what failed half-way takes room that is missing already
    write().inspect_err(|_| drop(std::fs::remove_file(&beside)))
}

/// The snapshot file in a run folder of `nearl train`, its final one, else its latest; any other path as it is.
pub fn in_run(path: &Path) -> PathBuf {
    let file = |name: &str| path.join("checkpoints").join(format!("{name}.safetensors"));
    ["final", "latest"].into_iter().map(file).find(|p| p.is_file()).unwrap_or_else(|| path.into())
}

impl Snapshot {
    /// Reads and validates a file.
    ///
    /// # Errors
    /// [`SnapshotError`]; links, pipes, devices and folders are refused without opening them.
    pub fn load(path: &Path) -> Result<Self, SnapshotError> {
        let unreadable =
            |reason: String| SnapshotError::Unreadable { file: path.display().to_string(), reason };
        let bytes = nearl_constraints::read_bounded(path, MAX_BYTES, false);
        let bytes = bytes.map_err(|e| unreadable(e.to_string()))?;
        Self::from_bytes(&bytes).map_err(|e| match e {
            SnapshotError::Malformed { reason, .. } => {
                let is_text = bytes.len() > 8
                    && std::str::from_utf8(&bytes).is_ok()
                    && bytes.iter().all(|b| *b >= b'\t');
                let text =
                    "it is text, as task files are; give a snapshot (.safetensors) or the folder of a run";
                let reason = if is_text { text.to_string() } else { reason };
                SnapshotError::Malformed { what: format!("'{}'", path.display()), reason }
            }
            e => e,
        })
    }

    /// Writes the file whole: to a name beside it, then renamed.
    ///
    /// # Errors
    /// [`SnapshotError::Unwritable`] with what the system said.
    pub fn save(&self, path: &Path) -> Result<(), SnapshotError> {
        write_whole(path, &self.to_bytes()).map_err(|e| SnapshotError::Unwritable {
            file: path.display().to_string(),
            reason: e.to_string(),
        })
    }

    /// The file's bytes; equal snapshots give equal bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        let tensors = self.networks.tensors();
        let views: Vec<(String, TensorView<'_>)> = tensors
            .iter()
            .map(|t| {
                let view = TensorView::new(t.dtype, t.shape.clone(), &t.bytes);
                (t.name.clone(), view.unwrap_or_else(|e| unreachable!("tensor '{}': {e}", t.name)))
            })
            .collect();
        let format = if self.networks.have_skip() { FORMAT_WITH_SKIP } else { self.manifest.format };
        let manifest = Manifest { format, ..self.manifest.clone() };
        let manifest = serde_json::to_string(&manifest).unwrap_or_else(|e| unreachable!("manifest: {e}"));
        let parsed = views.iter().map(|(n, v)| (n.as_str(), v.shape(), v.data()));
        let header = format!("{}\n{manifest}", digest(&manifest, parsed));
        safetensors::serialize(views, Some([(KEY.to_string(), header)].into_iter().collect()))
            .unwrap_or_else(|e| unreachable!("safetensors: {e}"))
    }

    /// Reads and validates the bytes of a file.
    ///
    /// # Errors
    /// [`SnapshotError`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SnapshotError> {
        let malformed = |e: safetensors::SafeTensorError| SnapshotError::Malformed {
            what: "snapshot".into(),
            reason: format!("{}; it may be cut short: copy it again", one_line(&e)),
        };
        let foreign = |reason: String| SnapshotError::Foreign { reason: one_line(&reason) };
        if let Some(kind) = FileKind::of(bytes).filter(|kind| *kind != FileKind::Safetensors) {
            return Err(SnapshotError::Kind { kind: kind.name(), next: kind.next() });
        }
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(malformed)?;
        let file = SafeTensors::deserialize(bytes).map_err(malformed)?;
        let text = header
            .metadata()
            .as_ref()
            .and_then(|m| m.get(KEY))
            .ok_or_else(|| foreign(format!("no metadata key '{KEY}'")))?;
        let (expected, manifest) =
            text.split_once('\n').ok_or_else(|| foreign("the digest line is missing".into()))?;
        let mut views: Vec<(String, TensorView<'_>)> = file.tensors();
        views.sort_by(|a, b| a.0.cmp(&b.0));
        let actual = digest(manifest, views.iter().map(|(n, v)| (n.as_str(), v.shape(), v.data())));
        if actual != expected {
            return Err(SnapshotError::Digest { expected: one_line(&expected), actual });
        }
        let manifest = first::read(manifest).map_err(foreign)?;
        manifest.robot.check("its robot").map_err(|e| foreign(e.to_string()))?;
        manifest.task.check("its task").map_err(|e| foreign(e.to_string()))?;
        let ranges = manifest.action_lower.iter().zip(&manifest.action_upper);
        if let Some((lower, upper)) =
            ranges.into_iter().find(|(l, u)| !(l.is_finite() && u.is_finite() && l <= u))
        {
            return Err(foreign(format!("an action range from {lower} to {upper}")));
        }
        let networks = Networks::read(&views, manifest.policy)?;
        if let Some((name, _)) = views.iter().find(|(name, _)| !Networks::knows(name)) {
            return Err(foreign(format!("a tensor '{name}' that this program does not know")));
        }
        let (said, layers) = (manifest.functions.len(), networks.policy.layers.len());
        if said != 0 && said != layers {
            return Err(foreign(format!("functions after {said} layers of a policy that has {layers}")));
        }
        Ok(Self { manifest, networks })
    }

    /// Refuses, before a file is written, what [`Snapshot::load`] and [`Controller::new`](crate::Controller::new) would refuse of it.
    ///
    /// # Errors
    /// [`SnapshotError`] as a reader of the file would say it.
    pub fn check(&self) -> Result<(), SnapshotError> {
        crate::Controller::new(&Self::from_bytes(&self.to_bytes())?).map(drop)
    }

    /// Digest of the content in hex; two snapshots with the same digest behave the same.
    pub fn digest(&self) -> String {
        let bytes = self.to_bytes();
        blake3::hash(&bytes).to_hex()[..16].to_string()
    }
}

/// blake3 in hex over a text and tensors (name, shape, bytes), whatever their order.
pub fn digest<'a>(manifest: &str, tensors: impl Iterator<Item = (&'a str, &'a [usize], &'a [u8])>) -> String {
    let mut hash = blake3::Hasher::new();
    hash.update(manifest.as_bytes());
    let mut sorted: Vec<_> = tensors.collect();
    sorted.sort_by(|a, b| a.0.cmp(b.0));
    for (name, shape, data) in sorted {
        hash.update(name.as_bytes()).update(format!("{shape:?}").as_bytes()).update(data);
    }
    hash.finalize().to_hex().to_string()
}
