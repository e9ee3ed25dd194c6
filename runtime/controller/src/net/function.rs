//! The function that the loop applies to the outputs of one layer of a network.

use super::activation::Activation;
use super::kernel::{V, ZERO, exp, tanh};
use serde::{Deserialize, Serialize};

/// An element's function after an affine layer. Training knows those of [`Activation`] alone; networks made elsewhere may have any of these,
/// another one after each layer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Function {
    /// `x`.
    #[default]
    Identity,
    /// Hyperbolic tangent.
    Tanh,
    /// `max(0, x)`.
    Relu,
    /// `x` above 0, `e^x - 1` below.
    Elu,
    /// `x / (1 + e^-x)`, also called swish.
    Silu,
    /// `ln(1 + e^x)`.
    Softplus,
    /// `1 / (1 + e^-x)`.
    Sigmoid,
}

impl From<Activation> for Function {
    fn from(activation: Activation) -> Self {
        match activation {
            Activation::Tanh => Self::Tanh,
            Activation::Relu => Self::Relu,
            Activation::Elu => Self::Elu,
            Activation::Silu => Self::Silu,
        }
    }
}

impl Function {
    /// Every one of them.
    pub const ALL: [Self; 7] =
        [Self::Identity, Self::Tanh, Self::Relu, Self::Elu, Self::Silu, Self::Softplus, Self::Sigmoid];

    /// `activation` between `layers` layers, nothing after the last.
    pub fn between(activation: Activation, layers: usize) -> Vec<Self> {
        (1..=layers).map(|i| if i < layers { activation.into() } else { Self::Identity }).collect()
    }

    /// `f(x)`; absolute error below 1e-6 (relative where `|f(x)| > 1`).
    #[inline(always)]
    pub fn apply(self, x: V) -> V {
        match self {
            Self::Identity => x,
            Self::Tanh => tanh(x),
            Self::Relu => x.map(|v| if v > 0.0 { v } else { 0.0 }),
            Self::Elu => x.zip(exp(x), |v, e| if v > 0.0 { v } else { e - 1.0 }),
            Self::Silu => x * sigmoid(x),
            Self::Softplus => softplus(x),
            Self::Sigmoid => sigmoid(x),
        }
    }
}

#[inline(always)]
fn sigmoid(x: V) -> V {
    let one = V::splat(1.0);
    one / (one + exp(ZERO - x))
}

/// `max(x, 0) + ln(1 + t)` with `t = e^-|x|` and `ln(1 + t) = 2 atanh(t / (2 + t))`; the series ends where its terms are below 1e-8.
#[inline(always)]
fn softplus(x: V) -> V {
    let t = exp(x.map(|v| -v.abs()));
    let s = t / (V::splat(2.0) + t);
    let z = s * s;
    let series = [1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 0.2, 1.0 / 3.0, 1.0]
        .into_iter()
        .fold(V::splat(1.0 / 15.0), |sum, c| V::splat(c).fma(sum, z));
    let positive = x.map(|v| if v > 0.0 { v } else { 0.0 });
    positive + V::splat(2.0) * s * series
}

#[cfg(test)]
mod tests {
    use super::*;

    fn exact(f: Function, x: f64) -> f64 {
        match f {
            Function::Identity => x,
            Function::Tanh => x.tanh(),
            Function::Relu => x.max(0.0),
            Function::Elu => {
                if x > 0.0 {
                    x
                } else {
                    x.exp_m1()
                }
            }
            Function::Silu => x / (1.0 + (-x).exp()),
            Function::Softplus => x.max(0.0) + (-x.abs()).exp().ln_1p(),
            Function::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        }
    }

    #[test]
    fn every_function_is_the_librarys() {
        for f in Function::ALL {
            for i in -40_000..=40_000 {
                let x = i as f32 * 2.5e-3;
                let (y, want) = (f.apply(V::splat(x)).0[3], exact(f, f64::from(x)));
                assert!((f64::from(y) - want).abs() < 1e-6 * want.abs().max(1.0), "{f:?}({x}): {y} {want}");
            }
            for x in [-1e6_f32, 1e6] {
                let (y, want) = (f.apply(V::splat(x)).0[0], exact(f, f64::from(x)));
                assert!((f64::from(y) - want).abs() < 1e-6 * want.abs().max(1.0), "{f:?}({x}): {y} {want}");
            }
        }
    }
}
