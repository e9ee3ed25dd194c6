//! The snapshot: policy, inverse model, normaliser, constraints, layout and robot in one safetensors file.
//!
//! The file's metadata has one key, `nearl`: the blake3 digest in hex, a line break, the manifest as JSON.
//! The digest covers the manifest text and every tensor (name, shape, bytes), so any changed bit is refused.

mod first;

use crate::codes::SnapshotCode;
use crate::file_kind::FileKind;
use crate::net::{Activation, Dense, Function};
use crate::normaliser::Normaliser;
use crate::task::{IdmKind, Task};
use nearl_constraints::{Guard, Moved, RobotDescription};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
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
const MARGINS: &str = "reached.margins";

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

/// The numbers of a policy, as the learner hands them to a controller.
#[derive(Clone, Debug, PartialEq)]
pub struct Networks {
    /// Observation normaliser and scale of change.
    pub normaliser: Normaliser,
    /// Meta policy (n_obs -> n_state), or n_obs -> n_act for [`PolicyKind::Direct`].
    pub policy: Dense,
    /// Log standard deviation of the policy's Gaussian; empty when deterministic.
    pub policy_log_std: Vec<f32>,
    /// Learned inverse dynamics (n_input -> n_act) and its log standard deviation.
    pub idm: Option<(Dense, Vec<f32>)>,
    /// The margins of `[constraints] reached` as the controllers of the training learned them; empty without it, and before they did.
    pub margins: Vec<f64>,
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

struct Tensor {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

fn f32s(name: String, shape: Vec<usize>, values: &[f32]) -> Tensor {
    Tensor { name, dtype: Dtype::F32, shape, bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect() }
}
fn f64s(name: &str, values: &[f64]) -> Tensor {
    let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    Tensor { name: name.into(), dtype: Dtype::F64, shape: vec![values.len()], bytes }
}

impl Networks {
    fn have_skip(&self) -> bool {
        self.policy.skip.is_some() || self.idm.as_ref().is_some_and(|(dense, _)| dense.skip.is_some())
    }

    /// Whether a tensor of this name is one of a snapshot.
    fn knows(name: &str) -> bool {
        let (net, rest) = name.split_once('.').unwrap_or((name, ""));
        match net {
            "reached" => rest == "margins",
            "normaliser" => ["mean", "std", "scale", "lower", "upper"].contains(&rest),
            "policy" | "idm" => {
                let layer = rest.strip_suffix(".weight").or_else(|| rest.strip_suffix(".bias"));
                ["skip", "log_std"].contains(&rest) || layer.is_some_and(|i| i.parse::<usize>().is_ok())
            }
            _ => false,
        }
    }

    /// Refuses what a reader of the snapshot would refuse: weights that are NaN, infinite or huge, of a training that diverged, and statistics of
    /// observations that are no numbers of a robot.
    ///
    /// # Errors
    /// [`SnapshotError::Value`], [`SnapshotError::Far`].
    pub fn check(&self) -> Result<(), SnapshotError> {
        let Normaliser { mean, std, scale, .. } = &self.normaliser;
        for (name, values) in
            [("normaliser.mean", mean), ("normaliser.std", std), ("normaliser.scale", scale)]
        {
            within_reach(name, values)?;
        }
        let idm = self.idm.iter().map(|(dense, log_std)| ("idm", dense, log_std));
        for (net, dense, log_std) in
            std::iter::once(("policy", &self.policy, &self.policy_log_std)).chain(idm)
        {
            for (i, layer) in dense.layers.iter().enumerate() {
                sound(&layer.weight, || format!("{net}.{i}.weight"))?;
                sound(&layer.bias, || format!("{net}.{i}.bias"))?;
            }
            sound(dense.skip.as_deref().unwrap_or_default(), || format!("{net}.skip"))?;
            sound(log_std, || format!("{net}.log_std"))?;
        }
        Ok(())
    }

    fn tensors(&self) -> Vec<Tensor> {
        let mut out = vec![
            f64s("normaliser.mean", &self.normaliser.mean),
            f64s("normaliser.std", &self.normaliser.std),
            f64s("normaliser.scale", &self.normaliser.scale),
        ];
        if !self.normaliser.clip.is_empty() {
            let side = |i: usize| self.normaliser.clip.iter().map(|c| c[i]).collect::<Vec<f64>>();
            out.push(f64s("normaliser.lower", &side(0)));
            out.push(f64s("normaliser.upper", &side(1)));
        }
        if !self.margins.is_empty() {
            out.push(f64s(MARGINS, &self.margins));
        }
        let mut net = |prefix: &str, dense: &Dense, log_std: &[f32]| {
            for (i, l) in dense.layers.iter().enumerate() {
                out.push(f32s(format!("{prefix}.{i}.weight"), vec![l.n_out, l.n_in], &l.weight));
                out.push(f32s(format!("{prefix}.{i}.bias"), vec![l.n_out], &l.bias));
            }
            if let Some(skip) = &dense.skip {
                out.push(f32s(format!("{prefix}.skip"), vec![dense.n_out(), dense.n_in()], skip));
            }
            out.push(f32s(format!("{prefix}.log_std"), vec![log_std.len()], log_std));
        };
        net("policy", &self.policy, &self.policy_log_std);
        if let Some((dense, log_std)) = &self.idm {
            net("idm", dense, log_std);
        }
        out
    }

    fn read(views: &[(String, TensorView<'_>)], policy: PolicyKind) -> Result<Self, SnapshotError> {
        let normaliser = Normaliser {
            mean: far(views, "normaliser.mean")?,
            std: far(views, "normaliser.std")?,
            scale: far(views, "normaliser.scale")?,
            clip: read_clip(views)?,
        };
        for (name, values) in [("normaliser.std", &normaliser.std), ("normaliser.scale", &normaliser.scale)] {
            if let Some((index, &value)) = values.iter().enumerate().find(|(_, v)| **v <= 0.0) {
                return Err(SnapshotError::Value { name: name.into(), index, value });
            }
        }
        let (policy_net, policy_log_std) = read_net(views, "policy")?;
        let has_idm = views.iter().any(|(n, _)| n.starts_with("idm."));
        let idm = if has_idm && policy != PolicyKind::Direct { Some(read_net(views, "idm")?) } else { None };
        let has_margins = views.iter().any(|(n, _)| n == MARGINS);
        let margins = if has_margins { read_f64(views, MARGINS)? } else { Vec::new() };
        Ok(Self { normaliser, policy: policy_net, policy_log_std, idm, margins })
    }
}

/// Weights beyond this are refused: no trained network of this kind has them.
pub const HUGE: f64 = 1e6;
/// Means and standard deviations of observations and of changes of the state beyond this are refused, in their own units.
pub const FAR: f64 = 1e12;

fn find<'a, 'b>(
    views: &'a [(String, TensorView<'b>)],
    name: &str,
    dtype: Dtype,
    rank: usize,
) -> Result<&'a TensorView<'b>, SnapshotError> {
    let view = &views
        .iter()
        .find(|(n, _)| n == name)
        .ok_or_else(|| SnapshotError::MissingTensor { name: name.into() })?
        .1;
    if view.dtype() != dtype || view.shape().len() != rank {
        return Err(SnapshotError::Shape {
            name: name.into(),
            expected: format!("{dtype:?} with {rank} dimension(s)"),
            actual: format!("{:?} {:?}", view.dtype(), view.shape()),
        });
    }
    Ok(view)
}

fn checked<T: Copy + Into<f64>>(name: &str, values: Vec<T>) -> Result<Vec<T>, SnapshotError> {
    sound(&values, || name.into()).map(|()| values)
}

fn sound<T: Copy + Into<f64>>(values: &[T], name: impl Fn() -> String) -> Result<(), SnapshotError> {
    match first_beyond(values, HUGE) {
        Some((index, value)) => Err(SnapshotError::Value { name: name(), index, value }),
        None => Ok(()),
    }
}

/// The first of `values` that is no number, or larger than `most`, and where it stands.
pub fn first_beyond<T: Copy + Into<f64>>(values: &[T], most: f64) -> Option<(usize, f64)> {
    let mut all = values.iter().enumerate().map(|(i, &v)| (i, v.into()));
    all.find(|(_, v)| !v.is_finite() || v.abs() > most)
}

fn doubles(views: &[(String, TensorView<'_>)], name: &str) -> Result<Vec<f64>, SnapshotError> {
    let view = find(views, name, Dtype::F64, 1)?;
    Ok(view.data().as_chunks::<8>().0.iter().map(|c| f64::from_le_bytes(*c)).collect())
}

fn read_f64(views: &[(String, TensorView<'_>)], name: &str) -> Result<Vec<f64>, SnapshotError> {
    checked(name, doubles(views, name)?)
}

/// Statistics in units of the user's.
fn far(views: &[(String, TensorView<'_>)], name: &str) -> Result<Vec<f64>, SnapshotError> {
    let values = doubles(views, name)?;
    within_reach(name, &values).map(|()| values)
}

fn within_reach(name: &str, values: &[f64]) -> Result<(), SnapshotError> {
    match first_beyond(values, FAR) {
        Some((index, value)) => Err(SnapshotError::Far { name: name.into(), index, value }),
        None => Ok(()),
    }
}

/// `normaliser.lower` and `normaliser.upper`, which may be infinite; empty where the file has neither.
fn read_clip(views: &[(String, TensorView<'_>)]) -> Result<Vec<[f64; 2]>, SnapshotError> {
    if !views.iter().any(|(n, _)| n == "normaliser.lower" || n == "normaliser.upper") {
        return Ok(Vec::new());
    }
    let (lower, upper) = (doubles(views, "normaliser.lower")?, doubles(views, "normaliser.upper")?);
    if lower.len() != upper.len() {
        return Err(SnapshotError::Shape {
            name: "normaliser.upper".into(),
            expected: format!("{} wide", lower.len()),
            actual: format!("{} wide", upper.len()),
        });
    }
    // also refuses what is not a number
    if let Some(index) =
        lower.iter().zip(&upper).position(|(l, u)| !matches!(l.partial_cmp(u), Some(o) if o.is_le()))
    {
        return Err(SnapshotError::Value { name: "normaliser.lower".into(), index, value: lower[index] });
    }
    Ok(lower.into_iter().zip(upper).map(|(l, u)| [l, u]).collect())
}

fn read_f32(
    views: &[(String, TensorView<'_>)],
    name: &str,
    rank: usize,
) -> Result<(Vec<f32>, Vec<usize>), SnapshotError> {
    let view = find(views, name, Dtype::F32, rank)?;
    let values = view.data().as_chunks::<4>().0.iter().map(|c| f32::from_le_bytes(*c)).collect();
    Ok((checked(name, values)?, view.shape().to_vec()))
}

fn read_net(views: &[(String, TensorView<'_>)], prefix: &str) -> Result<(Dense, Vec<f32>), SnapshotError> {
    let mut layers = Vec::new();
    let count = views.iter().filter(|(n, _)| n.starts_with(prefix) && n.ends_with(".weight")).count();
    for i in 0..count.max(1) {
        let (weight, shape) = read_f32(views, &format!("{prefix}.{i}.weight"), 2)?;
        let (bias, bias_shape) = read_f32(views, &format!("{prefix}.{i}.bias"), 1)?;
        let n_in = layers.last().map_or(shape[1], |l: &crate::net::DenseLayer| l.n_out);
        if shape[1] != n_in || bias_shape[0] != shape[0] || shape[0] == 0 || n_in == 0 {
            return Err(SnapshotError::Shape {
                name: format!("{prefix}.{i}.weight"),
                expected: format!("[{}, {n_in}]", bias_shape[0]),
                actual: format!("{shape:?}"),
            });
        }
        layers.push(crate::net::DenseLayer { n_in, n_out: shape[0], weight, bias });
    }
    let mut net = Dense { layers, skip: None };
    let name = format!("{prefix}.skip");
    if views.iter().any(|(n, _)| *n == name) {
        let (weight, shape) = read_f32(views, &name, 2)?;
        if shape != [net.n_out(), net.n_in()] {
            return Err(SnapshotError::Shape {
                name,
                expected: format!("[{}, {}]", net.n_out(), net.n_in()),
                actual: format!("{shape:?}"),
            });
        }
        net.skip = Some(weight);
    }
    Ok((net, read_f32(views, &format!("{prefix}.log_std"), 1)?.0))
}
