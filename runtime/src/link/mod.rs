//! Links between plant, runtime and trainer over shared memory: state and action as the newest of each (`board`), everything else as
//! iceoryx2 publish-subscribe.
//!
//! Every robot name has its own segments and files, so robots (and tests) never meet. Messages are plain numbers with
//! a capacity fixed at compile time ([`MAX_JOINTS`], [`MAX_OBS`]); a robot that does not fit is refused at start with
//! the number. A message's layout is part of its type name, so ends from different builds refuse each other.
//!
//! None of the calls here belongs into the real-time thread: they allocate and may attach to new peers. The
//! [`crate::rt`] loop moves messages through rings instead.

mod access;
mod bench;
mod board;
#[cfg(feature = "cli")]
mod crossing;
mod debris;
mod error;
mod exchange;
mod home;
mod memory;
mod messages;
mod name;
mod operator;
mod owner;
mod plant;
mod port;
mod proposer;
mod remains;
mod runner;
mod runtime;
pub mod schema;
pub mod service;
pub(crate) mod torn;
mod trainer;
mod view;

pub use access::Verdict;
pub use bench::{RoundTrip, bench_round_trip};
#[cfg(feature = "cli")]
pub(crate) use crossing::{CROSSING, Crossing};
pub use error::LinkError;
pub use exchange::{Exchange, Turn};
#[cfg(feature = "cli")]
pub(crate) use home::of_user as home_of_user;
pub use memory::remove_files;
#[cfg(feature = "cli")]
pub(crate) use memory::{check as check_memory, free as free_memory};
pub use messages::*;
pub use name::RobotName;
pub use operator::OperatorLink;
pub use owner::Owner;
pub use plant::{PlantLink, Robot};
pub use port::{Outbox, Sequence, SnapshotBytes, SnapshotReader};
pub use proposer::{Asked, ProposerLink};
pub use remains::{Remains, remains};
pub use runner::{Pace, Plant, PlantReport, PlantRunner, PlantSettings};
pub use runtime::RuntimeLink;
pub use schema::{Header, Message, Queued, hash_names};
#[cfg(feature = "cli")]
pub(crate) use service::SHARED_MEMORY;
pub use trainer::TrainerLink;
pub use view::{LeanedOn, ViewLink, Watched};
