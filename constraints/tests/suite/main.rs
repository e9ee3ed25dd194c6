//! The tests of the constraints, as one program.

#[path = "../../examples/attack/mod.rs"]
#[allow(dead_code, unreachable_pub)]
mod attack_scenes;
#[path = "../common/mod.rs"]
mod common;
#[path = "../../examples/coulomb/plant.rs"]
#[allow(dead_code, unreachable_pub)]
mod coulomb_plant;
#[path = "../common/counting.rs"]
mod counting;

mod action;
mod allocation;
mod attack;
mod certify;
mod conformance;
mod defaults;
mod drives;
mod errors;
mod frame_limits;
mod friction;
mod geometry;
mod gradient;
mod huge_proposals;
mod jerk;
mod kept;
mod kinds;
mod kinematics;
mod measured;
mod motors;
mod moving;
mod mujoco;
mod own_rows;
mod projector;
mod stages;
mod stored_brake;
mod viability;
mod written;
