//! Frames.

use crate::Model;

/// Scratch of one thread.
pub struct Kinematics {}

impl Kinematics {
    /// Scratch for `model`.
    pub fn new(_model: &Model) -> Kinematics {
        Kinematics {}
    }

    /// Frames.
    pub fn update(&mut self, _q: &[f64], _v: &[f64], _a: &[f64]) {}
}
