//! Sizes of the networks, from the task file.

use nearl_runtime::net::Activation;
use serde::{Deserialize, Serialize};

/// `[train.nets]`: hidden widths of each network, first to last, and what lies between their layers. An empty list is an
/// affine network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetSettings {
    /// Meta policy; for `ppo` the policy on actions.
    pub policy: Vec<usize>,
    /// Inverse dynamics model.
    pub idm: Vec<usize>,
    /// The inverse model is an affine map plus a network of these widths that begins at zero.
    pub idm_residual: bool,
    /// Value.
    pub value: Vec<usize>,
    /// Discriminator: the first half (rounded up) before the latent z, the rest behind it.
    pub discriminator: Vec<usize>,
    /// `tanh`, `relu`, `elu` or `silu`.
    pub activation: Activation,
}

impl Default for NetSettings {
    fn default() -> Self {
        let hidden = || vec![32, 32];
        Self {
            policy: hidden(),
            idm: hidden(),
            idm_residual: false,
            value: hidden(),
            discriminator: hidden(),
            activation: Activation::Tanh,
        }
    }
}

/// Widest hidden layer and deepest network taken: beyond them the kernels here are the wrong tool.
const WIDEST: usize = 4096;
const DEEPEST: usize = 16;

impl NetSettings {
    /// The sizes as accepted.
    ///
    /// # Errors
    /// One sentence naming the key.
    pub fn check(&self) -> Result<(), String> {
        let nets = [
            ("policy", &self.policy),
            ("idm", &self.idm),
            ("value", &self.value),
            ("discriminator", &self.discriminator),
        ];
        for (key, hidden) in nets {
            if hidden.len() > DEEPEST {
                return Err(format!(
                    "[train.nets.{key}]: {} hidden layers; give at most {DEEPEST}",
                    hidden.len()
                ));
            }
            if let Some(width) = hidden.iter().find(|w| !(1..=WIDEST).contains(*w)) {
                return Err(format!(
                    "[train.nets.{key}]: a hidden layer of width {width}; give widths from 1 to {WIDEST}"
                ));
            }
        }
        Ok(())
    }
}
