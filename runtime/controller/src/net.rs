//! Small fully connected networks: padded f32 kernels, shapes, and a forward pass of one sample without allocation.

pub mod kernel;

mod activation;
mod dense;
mod forward;
mod function;
mod mlp;

pub use activation::Activation;
pub use dense::{Dense, DenseLayer};
pub use forward::Forward;
pub use function::Function;
pub use mlp::{Layer, Mlp};
