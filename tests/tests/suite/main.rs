//! What crosses crates, within one process.

mod architecture;
mod demos;
mod determinism;
mod drives;
mod env_mujoco;
mod env_parity;
mod env_suite;
mod friction;
mod guard;
mod imitation;
mod import;
mod leg;
mod limits_in_simulator;
mod meters;
mod networks;
mod own_draws;
mod own_robots;
mod prior_in_training;
mod ranks;
mod recipe;
mod resume;
mod robots;
mod schedules;
mod user_tasks;
