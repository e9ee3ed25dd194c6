//! Constrained rollouts for other processes on this machine: what a client asks, what the server answers. A client needs neither MuJoCo nor
//! the trainer.
//!
//! One request-response service of iceoryx2 per server name. A request is the bytes of one [`RequestMessage`]; they are
//! checked by [`decode`], so anything may arrive. The answers are [`Answer::Accepted`] or a refusal, then numbered
//! chunks of transitions ([`Layout`] says which number is what), then the end: done, cancelled, failed or closing.
//!
//! A client that reads slowly fills its own buffer and nobody else's: the server keeps its next chunk and computes no
//! further one for it.
//!
//! A learner asks for [`Training`] instead: its environments go on from request to request, and it pushes the policy they act by over the
//! links of the same name, as it would to a loop. What it pushes must be of the server's own task.
//!
//! A request never holds a path: the server has one task and one snapshot.

mod client;
mod departed;
mod error;
mod layout;
mod messages;
mod request;
mod server;
mod service;

pub use client::{Chunk, RolloutClient, Rollouts};
pub use error::RequestError;
pub use layout::{LEDGER, Layout};
pub use messages::{Answer, MAX_CHUNK, MAX_REPLY_TEXT, MAX_REQUEST, ReplyMessage, RequestMessage};
pub use request::{Constraints, Malformed, Request, Training, constraint_set, decode};
pub use server::{Caller, Delivery, RolloutServer};
