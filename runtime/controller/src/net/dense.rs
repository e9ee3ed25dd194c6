//! Networks as plain tensors: what a snapshot stores.

/// One affine layer `y = W x + b`, as PyTorch's `Linear` stores it.
#[derive(Clone, Debug, PartialEq)]
pub struct DenseLayer {
    /// Inputs.
    pub n_in: usize,
    /// Outputs.
    pub n_out: usize,
    /// Weight, row-major (n_out x n_in).
    pub weight: Vec<f32>,
    /// Bias (n_out).
    pub bias: Vec<f32>,
}

/// Affine layers with an [`Activation`](super::Activation) between them; the last is linear.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Dense {
    /// First to last.
    pub layers: Vec<DenseLayer>,
    /// Linear map from input to output beside the layers, added to what they give (n_out x n_in, row-major).
    pub skip: Option<Vec<f32>>,
}

impl Dense {
    /// Inputs of the network; 0 without layers.
    pub fn n_in(&self) -> usize {
        self.layers.first().map_or(0, |l| l.n_in)
    }

    /// Outputs of the network; 0 without layers.
    pub fn n_out(&self) -> usize {
        self.layers.last().map_or(0, |l| l.n_out)
    }

    /// Widths from the input to the output.
    pub fn widths(&self) -> Vec<usize> {
        std::iter::once(self.n_in()).chain(self.layers.iter().map(|l| l.n_out)).collect()
    }
}
