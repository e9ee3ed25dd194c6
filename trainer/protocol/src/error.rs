//! What can go wrong for a client: one sentence each, with the next step.

use super::Answer;
use nearl_runtime::link::{LinkError, RobotName};

/// Failure of a rollout client's call.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RequestError {
    /// The links.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// Nobody serves under this name.
    #[error(
        "no rollout server named `{0}` answers on this machine: start `nearl serve SNAPSHOT --name {0}` first"
    )]
    NoServer(RobotName),
    /// The server's buffer for this client stayed full.
    #[error(
        "the rollout server `{name}` has taken no request of this client for {seconds} s: look whether it is stopped, then ask again with a new client"
    )]
    Behind {
        /// Server.
        name: RobotName,
        /// Time given, in seconds.
        seconds: f64,
    },
    /// The server died or ended while it worked on a request.
    #[error(
        "the rollout server `{0}` is gone: start `nearl serve SNAPSHOT --name {0}` again and repeat the request"
    )]
    ServerGone(RobotName),
    /// A server is there, but works on the request no more.
    #[error(
        "the rollout server `{0}` gave this request up: it was started again, or this client read nothing for longer than its --patience; ask \
         again, and read sooner"
    )]
    GivenUp(RobotName),
    /// Nothing came in time.
    #[error("the rollout server `{name}` sent nothing for {seconds} s: wait longer, or ask for less at once")]
    Silent {
        /// Server.
        name: RobotName,
        /// Patience, in seconds.
        seconds: f64,
    },
    /// An explicit refusal or end.
    #[error("{}: {text}", answer.name())]
    Refused {
        /// Why.
        answer: Answer,
        /// The server's sentence.
        text: String,
    },
    /// Chunks out of order or of another shape.
    #[error("the rollout server `{name}` sent {what}: run client and server from the same nearl build")]
    Broken {
        /// Server.
        name: RobotName,
        /// What does not fit.
        what: String,
    },
    /// More bytes than a request may have.
    #[error("a request has at most {limit} bytes, this one {bytes}: send what `Request::message` gives")]
    TooLong {
        /// Bytes given.
        bytes: usize,
        /// Bytes allowed.
        limit: usize,
    },
    /// The client has too many requests under way.
    #[error("this client of `{0}` has as many rollouts under way as one may have: read or cancel one first")]
    TooMany(RobotName),
}
