//! What can go wrong while connecting or sending: one sentence each, with the next step.

use super::RobotName;
use crate::codes::LinkCode;

/// Failure of a link call.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LinkError {
    /// The name cannot be used in file names.
    #[error(
        "robot name `{0}` is not usable: take 1 to 32 letters, digits, `-` or `_`, beginning with a letter or digit"
    )]
    Name(String),
    /// A vector does not fit into the messages.
    #[error(
        "robot `{name}` has {count} {what}, but a message holds {limit}: send fewer, as a policy with a recipe computes what follows from the state; or raise \
         the capacity in runtime/src/link/messages.rs and build plant and loop anew"
    )]
    Capacity {
        /// Robot.
        name: RobotName,
        /// What is counted.
        what: &'static str,
        /// How many there are.
        count: usize,
        /// How many fit.
        limit: usize,
    },
    /// A plant says of itself what no robot is.
    #[error(
        "the plant of robot `{name}` {reason}: give each joint once, in the order of v, as the robot file names it"
    )]
    Announced {
        /// Robot.
        name: RobotName,
        /// What it says.
        reason: String,
    },
    /// Nobody publishes as this plant.
    #[error(
        "no plant named `{0}` answers on this machine: start `nearl plant TASK --name {0}` first, or correct --plant"
    )]
    NoPlant(RobotName),
    /// Nobody runs the loop.
    #[error("no runtime for `{0}` answers on this machine: start `nearl run SNAPSHOT --plant {0}` first")]
    NoRuntime(RobotName),
    /// The loop there is asks nobody for proposals, or there is none.
    #[error("no loop of `{0}` asks for proposals: start `nearl run SNAPSHOT --plant {0} --proposer` first")]
    NoQuestion(RobotName),
    /// The single owner of a topic exists already.
    #[error("robot `{name}` already has a {role}: stop that process first, or take another name")]
    Taken {
        /// Robot.
        name: RobotName,
        /// `plant`, `runtime`, `trainer` or `proposer`.
        role: &'static str,
    },
    /// Too many readers.
    #[error(
        "robot `{name}` has no free place for another reader of `{topic}`: close a viewer or log reader first"
    )]
    Full {
        /// Robot.
        name: RobotName,
        /// Topic.
        topic: &'static str,
    },
    /// The other end was built from other sources.
    #[error(
        "`{topic}` of robot `{name}` is already in use with another message layout: run plant, runtime and trainer from the same nearl build"
    )]
    Schema {
        /// Robot.
        name: RobotName,
        /// Topic.
        topic: &'static str,
    },
    /// Shared memory cannot take the segments.
    #[error(
        "shared memory {path} has {available} MB free, the links of `{name}` need {needed} MB: free space there or remount it larger"
    )]
    Memory {
        /// Robot.
        name: RobotName,
        /// Folder.
        path: &'static str,
        /// Free \[MB\].
        available: u64,
        /// Needed \[MB\].
        needed: u64,
    },
    /// Shared memory cannot be written.
    #[error("shared memory {path} cannot be used for `{name}` ({reason}): mount a writable tmpfs there")]
    MemoryMissing {
        /// Robot.
        name: RobotName,
        /// Folder.
        path: &'static str,
        /// The system's reason.
        reason: String,
    },
    /// A file or folder of the links is another user's, or not what it should be.
    #[error(
        "the links of `{name}` are not opened, because of {path}: {reason}; find out who made it, then remove it"
    )]
    Foreign {
        /// Robot.
        name: RobotName,
        /// The file or folder.
        path: String,
        /// What is wrong with it.
        reason: String,
    },
    /// iceoryx2 failed for another reason.
    #[error(
        "the link of `{name}` could not {action} ({reason}): if no nearl process for it is alive, delete {files} and try again"
    )]
    Transport {
        /// Robot.
        name: RobotName,
        /// What was tried.
        action: String,
        /// The library's reason.
        reason: String,
        /// Files of the link.
        files: String,
    },
}

impl LinkError {
    /// Stable name of the reason, for logs, replies and `nearl explain`.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Name(_) => LinkCode::Name,
            Self::Capacity { .. } => LinkCode::Capacity,
            Self::Announced { .. } => LinkCode::Announced,
            Self::NoPlant(_) => LinkCode::NoPlant,
            Self::NoRuntime(_) => LinkCode::NoRuntime,
            Self::NoQuestion(_) => LinkCode::NoQuestion,
            Self::Taken { .. } => LinkCode::Taken,
            Self::Full { .. } => LinkCode::Full,
            Self::Schema { .. } => LinkCode::Schema,
            Self::Memory { .. } => LinkCode::Memory,
            Self::MemoryMissing { .. } => LinkCode::MemoryMissing,
            Self::Foreign { .. } => LinkCode::Foreign,
            Self::Transport { .. } => LinkCode::Transport,
        }
        .name()
    }
}
