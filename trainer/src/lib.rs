//! MuJoCo environments, constrained rollouts and the PID^2 learner.

pub mod mj;
