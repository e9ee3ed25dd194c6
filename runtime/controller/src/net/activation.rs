//! Activation functions between the layers of a network.

use super::function::Function;
use super::kernel::{V, exp, tanh};
use serde::{Deserialize, Serialize};

/// The nonlinearity between layers of a network that is trained here. Each has `f(0) = 0` (padding stays zero); the derivative follows
/// from its output, or from its input where [`Activation::keeps_input`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// Hyperbolic tangent.
    #[default]
    Tanh,
    /// `max(0, x)`; its derivative at 0 is taken as 0.
    Relu,
    /// `x` above 0, `e^x - 1` below.
    Elu,
    /// `x / (1 + e^-x)`, also called swish.
    Silu,
}

impl Activation {
    /// `f(x)`.
    #[inline(always)]
    pub fn apply(self, x: V) -> V {
        match self {
            Self::Tanh => tanh(x),
            Self::Relu => x.map(|v| if v > 0.0 { v } else { 0.0 }),
            Self::Elu => Function::Elu.apply(x),
            Self::Silu => Function::Silu.apply(x),
        }
    }

    /// Whether the derivative needs the input `x`: another `x` may have the same `f(x)`.
    pub fn keeps_input(self) -> bool {
        self == Self::Silu
    }

    /// `v f'(x)` from the output `h = f(x)`, or from the input `h = x` where [`Activation::keeps_input`].
    #[inline(always)]
    pub fn times_derivative(self, v: V, h: V) -> V {
        match self {
            Self::Tanh => v - v * h * h,
            Self::Relu => v.zip(h, |v, h| if h > 0.0 { v } else { 0.0 }),
            Self::Elu => v.zip(h, |v, h| if h > 0.0 { v } else { v * (h + 1.0) }),
            Self::Silu => {
                let one = V::splat(1.0);
                let s = one / (one + exp(V::splat(0.0) - h));
                v * s * (one + h * (one - s))
            }
        }
    }
}
