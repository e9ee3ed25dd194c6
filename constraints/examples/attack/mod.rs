//! What the command and the tests attack with.

pub mod attacker;
pub mod meter;
pub mod run;
pub mod scene;

use crate::common::Random;
