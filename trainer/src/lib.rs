//! MuJoCo environments, constrained rollouts and the PID^2 learner.
//!
//! [`train`] is the loop of every algorithm; [`learn::pid2`] is the paper's.

pub mod allocations;
pub mod blank;
pub mod checkpoint;
pub mod cli;
pub mod demos;
pub mod env;
pub mod evaluate;
pub mod export;
pub mod foresight;
mod hypot;
pub mod import;
pub mod learn;
pub mod many;
pub mod mj;
pub mod online;
pub mod plant;
pub mod preset;
pub mod ranks;
pub mod robot;
pub mod rollout;
pub mod run_folder;
pub mod scene;
pub mod serve;
pub mod settings;
pub mod stats;
pub mod sweep;
pub mod tasks;
pub mod train;
pub mod vector;
pub mod watch;

pub use nearl_rollout_protocol as rollout_protocol;
