//! The attacker, its meters and its scenes: the command and the tests share them.

pub mod attacker;
pub mod meter;
pub mod run;
pub mod scene;

use crate::common::Random;
