//! What lies between the layers of a network.

use super::kernel::{V, tanh};
use serde::{Deserialize, Serialize};

/// The nonlinearity between layers. Each has `f(0) = 0` (padding stays zero) and a derivative that follows from its output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// Hyperbolic tangent.
    #[default]
    Tanh,
    /// `max(0, x)`; its derivative at 0 is taken as 0.
    Relu,
}

impl Activation {
    /// `f(x)`.
    #[inline(always)]
    pub fn apply(self, x: V) -> V {
        match self {
            Self::Tanh => tanh(x),
            Self::Relu => x.map(|v| if v > 0.0 { v } else { 0.0 }),
        }
    }

    /// `v f'(x)` from the output `h = f(x)`.
    #[inline(always)]
    pub fn times_derivative(self, v: V, h: V) -> V {
        match self {
            Self::Tanh => v - v * h * h,
            Self::Relu => v.zip(h, |v, h| if h > 0.0 { v } else { 0.0 }),
        }
    }
}
