//! Where the layers of a network lie in one flat, padded parameter vector.

use super::activation::Activation;
use super::dense::{Dense, DenseLayer};
use super::kernel::{LANES, V, scalars, scalars_mut};

/// One affine layer: input k, output n; weight as k rows (padded to 8) of n lanes (padded to 16), then the bias.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layer {
    /// Inputs.
    pub k: usize,
    /// Outputs.
    pub n: usize,
    /// Where the weight starts, in vectors.
    pub w: usize,
    /// Where the bias starts, in vectors.
    pub b: usize,
}

impl Layer {
    /// Rows of the weight with padding.
    pub fn k_padded(&self) -> usize {
        self.k.next_multiple_of(8)
    }
    /// Vectors of an output row.
    pub fn n_vectors(&self) -> usize {
        self.n.div_ceil(LANES)
    }
    /// Vectors of an input row.
    pub fn k_vectors(&self) -> usize {
        self.k.div_ceil(LANES)
    }
    /// Vectors of the layer.
    pub fn len(&self) -> usize {
        self.k_padded() * self.n_vectors() + self.n_vectors()
    }
    /// Whether the layer has no parameters.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Shapes and offsets of a network; its last layer is linear.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mlp {
    /// First to last.
    pub layers: Vec<Layer>,
    /// What lies between the layers.
    pub activation: Activation,
    /// A linear map from input to output beside them; its bias is not used.
    pub skip: Option<Layer>,
}

impl Mlp {
    /// `widths` from input to output; `at` is the running length of the parameter vector, in vectors.
    pub fn new(widths: &[usize], activation: Activation, at: &mut usize) -> Self {
        let layers = widths.windows(2).map(|d| place(d[0], d[1], at)).collect();
        Self { layers, activation, skip: None }
    }

    /// The same with a linear map from input to output beside the layers.
    pub fn with_skip(widths: &[usize], activation: Activation, at: &mut usize) -> Self {
        let mut mlp = Self::new(widths, activation, at);
        mlp.skip = Some(place(mlp.n_in(), mlp.n_out(), at));
        mlp
    }

    /// Inputs.
    pub fn n_in(&self) -> usize {
        self.layers[0].k
    }
    /// Outputs.
    pub fn n_out(&self) -> usize {
        self.layers[self.layers.len() - 1].n
    }
    /// Widths from the input to the output.
    pub fn widths(&self) -> Vec<usize> {
        std::iter::once(self.n_in()).chain(self.layers.iter().map(|l| l.n)).collect()
    }

    /// Reads the network out of the parameter vector `p`.
    pub fn to_dense(&self, p: &[V]) -> Dense {
        let layers = self.layers.iter().map(|l| {
            let (w, b) = (scalars(&p[l.w..l.b]), scalars(&p[l.b..l.b + l.n_vectors()]));
            DenseLayer { n_in: l.k, n_out: l.n, weight: weight(l, w), bias: b[..l.n].to_vec() }
        });
        let skip = self.skip.map(|l| weight(&l, scalars(&p[l.w..l.b])));
        Dense { layers: layers.collect(), skip }
    }

    /// Writes a network of the same widths into the parameter vector `p`; padding becomes zero.
    ///
    /// # Panics
    /// When the widths differ.
    pub fn write_dense(&self, dense: &Dense, p: &mut [V]) {
        assert_eq!(self.widths(), dense.widths(), "the network has other widths");
        assert_eq!(
            self.skip.is_some(),
            dense.skip.is_some(),
            "one has a linear map beside its layers, the other not"
        );
        if let (Some(l), Some(weight)) = (&self.skip, &dense.skip) {
            write(l, weight, &mut p[l.w..l.w + l.len()]);
        }
        for (l, d) in self.layers.iter().zip(&dense.layers) {
            let own = &mut p[l.w..l.w + l.len()];
            write(l, &d.weight, own);
            scalars_mut(&mut own[l.b - l.w..])[..l.n].copy_from_slice(&d.bias);
        }
    }
}

/// A layer at the end of the parameter vector.
fn place(k: usize, n: usize, at: &mut usize) -> Layer {
    let mut layer = Layer { k, n, w: *at, b: 0 };
    layer.b = layer.w + layer.k_padded() * layer.n_vectors();
    *at += layer.len();
    layer
}

/// The weight of a layer (n x k) from its padded rows.
fn weight(l: &Layer, w: &[f32]) -> Vec<f32> {
    let row = l.n_vectors() * LANES;
    (0..l.n).flat_map(|n| (0..l.k).map(move |k| w[k * row + n])).collect()
}

/// The inverse of [`weight`]; padding and bias become zero.
fn write(l: &Layer, weight: &[f32], to: &mut [V]) {
    let (row, lanes) = (l.n_vectors() * LANES, scalars_mut(to));
    lanes.fill(0.0);
    for n in 0..l.n {
        for k in 0..l.k {
            lanes[k * row + n] = weight[n * l.k + k];
        }
    }
}
