//! Policies made elsewhere: an ONNX file becomes the networks of a snapshot.
//!
//! ```text
//!     bytes -> ModelProto -> chain of steps (graph.rs) -> normaliser and layers (network.rs) -> snapshot (assemble.rs)
//! ```
//!
//! Only what a fully connected policy consists of is read; whatever else lies on the way from the observation to the action is refused by
//! its name. Nothing of the file is run.

mod assemble;
mod chain;
mod deploy;
mod elementwise;
mod file;
mod fold;
mod graph;
mod in_task;
pub(crate) mod metadata;
mod network;
mod sound;
mod tensor;

pub use assemble::{Setting, snapshot};
pub use file::{onnx, read};
pub use in_task::{Gives, for_task};
pub use metadata::brought;
pub use network::ImportedNetwork;

/// Why a policy was not imported; one sentence.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ImportError {
    /// The file cannot be read.
    #[error("cannot read '{file}': {reason}")]
    Unreadable {
        /// Path as given.
        file: String,
        /// What the system said.
        reason: String,
    },
    /// Another kind of file.
    #[error("'{file}' is {kind}, not an ONNX policy; {next}")]
    Kind {
        /// Path as given.
        file: String,
        /// What it is.
        kind: String,
        /// What to do.
        next: String,
    },
    /// A node that is none of a policy's, or one with arguments a policy's node does not have.
    #[error(
        "node '{name}' ({op}) {reason}; export the policy alone, without what comes before and after its layers"
    )]
    Node {
        /// Name of the node, else of its output.
        name: String,
        /// Its operator.
        op: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A number that is none, or that no trained policy has.
    #[error(
        "{file}: tensor '{tensor}' has {value} at index {index}, where a trained policy has numbers up to 1e6; export an earlier checkpoint of the policy"
    )]
    Value {
        /// Path as given.
        file: String,
        /// Its name in the file, or the layer.
        tensor: String,
        /// Where.
        index: usize,
        /// The value.
        value: String,
    },
    /// A normaliser that divides by 0.
    #[error(
        "{file}: the standard deviation of entry {index} of the input '{input}' is 0, and the normaliser divides by it; write a positive one, 1 where \
         the entry never varied, and export again"
    )]
    Deviation {
        /// Path as given.
        file: String,
        /// Name of the input.
        input: String,
        /// Which entry.
        index: usize,
    },
    /// Nothing says what the inputs are.
    #[error(
        "the policy does not say what the {n_in} entries of its input '{input}' are; give a recipe (--recipe FILE, in Python recipe=FILE), see \
         docs/POLICIES.md"
    )]
    NoRecipe {
        /// Name of the input.
        input: String,
        /// Its width.
        n_in: usize,
    },
    /// Metadata that cannot be used.
    #[error("metadata '{key}': {reason}")]
    Metadata {
        /// Its key.
        key: String,
        /// What is wrong.
        reason: String,
    },
    /// A recipe that cannot be used, with the name of its file.
    #[error("{0}")]
    Recipe(String),
    /// A robot file that cannot be used.
    #[error("{0}")]
    Robot(String),
    /// The graph as a whole is no policy.
    #[error("the graph is no policy: {0}")]
    Graph(String),
    /// What is wrong with the graph of a file.
    #[error("'{file}': {error}")]
    In {
        /// Path as given.
        file: String,
        /// What it is.
        error: Box<ImportError>,
    },
}

impl ImportError {
    fn of(self, file: &str) -> Self {
        Self::In { file: file.into(), error: Box::new(self.in_one_line()) }
    }

    /// Names quoted from a file may hold line breaks and other signs that are not printed.
    fn in_one_line(self) -> Self {
        let plain = |text: String| text.replace(char::is_control, " ");
        match self {
            Self::Node { name, op, reason } => {
                Self::Node { name: plain(name), op: plain(op), reason: plain(reason) }
            }
            Self::Value { file, tensor, index, value } => {
                Self::Value { file, tensor: plain(tensor), index, value }
            }
            Self::Deviation { file, input, index } => Self::Deviation { file, input: plain(input), index },
            Self::Graph(reason) => Self::Graph(plain(reason)),
            other => other,
        }
    }
}
