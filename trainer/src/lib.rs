//! MuJoCo environments, constrained rollouts and the PID^2 learner.

pub mod env;
pub mod mj;
