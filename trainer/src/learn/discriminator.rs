//! The variational discriminator bottleneck (Peng et al. 2019; Eq. 2 of the paper): an encoder `E(z | s, s')`, a decoder
//! `D(z)`, and the information they may pass.

use super::gaussian::{heads, set_heads, sigmoid};
use super::init;
use super::losses::widths;
use super::net::{Net, Tape};
use super::nets::NetSettings;
use super::optimise::TILE;
use nearl_runtime::net::kernel::{LANES, V, ZERO, exp};
use rand_chacha::ChaCha8Rng;

/// Size of the latent z.
pub(super) const LATENT: usize = LANES;

/// Encoder (`n_state + n_obs -> 2 LATENT`: mean and log variance) and decoder (`LATENT -> 1`: logit of being real).
pub(super) struct Discriminator {
    encoder: Net,
    decoder: Net,
    bottleneck: bool,
    /// Vectors of its parameters.
    pub(super) len: usize,
    /// Vectors of its transposed weights.
    pub(super) transposed: usize,
}

/// Buffers of one thread.
pub(super) struct DiscriminatorScratch {
    encoder: Tape,
    decoder: Tape,
    /// Input rows `[change, x]`.
    pub(super) input: Vec<V>,
    /// Latent noise rows.
    pub(super) noise: Vec<V>,
    z: Vec<V>,
    d_code: Vec<V>,
    d_logit: Vec<V>,
    /// Logit of each row, densely; the caller replaces it by `dL / d logit`.
    pub(super) logit: Vec<V>,
}

impl Discriminator {
    /// The first half of the hidden layers (rounded up) is the encoder's, the rest the decoder's.
    pub(super) fn new(n_state: usize, n_obs: usize, nets: &NetSettings, bottleneck: bool) -> Self {
        let (mut at, mut transposed) = (0, 0);
        let (hidden, f) = (&nets.discriminator, nets.activation);
        let (before, after) = hidden.split_at(hidden.len().div_ceil(2));
        let in_out = widths(n_state + n_obs, before, 2 * LATENT);
        let encoder = Net::new(&in_out, f, n_state, &mut at, &mut transposed);
        let decoder = Net::new(&widths(LATENT, after, 1), f, LATENT, &mut at, &mut transposed);
        Self { encoder, decoder, bottleneck, len: at, transposed }
    }

    /// Encoder and decoder.
    #[cfg(test)]
    pub(super) fn nets(&self) -> (&Net, &Net) {
        (&self.encoder, &self.decoder)
    }

    /// Orthogonal weights.
    pub(super) fn init(&self, p: &mut [V], rng: &mut ChaCha8Rng) {
        for net in [&self.encoder, &self.decoder] {
            net.mlp.write_dense(&init::orthogonal(&net.mlp.widths(), 1.0, rng), p);
        }
    }

    /// Refreshes the transposed weights.
    pub(super) fn refresh(&self, p: &[V], transposed: &mut [V]) {
        self.encoder.transpose(p, transposed);
        self.decoder.transpose(p, transposed);
    }

    /// Buffers for a tile.
    pub(super) fn scratch(&self) -> DiscriminatorScratch {
        let n_in = self.encoder.mlp.n_in().div_ceil(LANES);
        DiscriminatorScratch {
            encoder: self.encoder.tape(TILE),
            decoder: self.decoder.tape(TILE),
            input: vec![ZERO; TILE * n_in],
            noise: vec![ZERO; TILE],
            z: vec![ZERO; TILE],
            d_code: vec![ZERO; 2 * TILE],
            d_logit: vec![ZERO; TILE],
            logit: vec![ZERO; TILE / LANES],
        }
    }

    /// `z = mu + sigma noise`, then the decoder; logits are in `w.logit`. Returns the sum of KL[E || N(0, 1)] over rows:
    /// `sum (sigma^2 + mu^2 - 1) / 2 - log sigma`.
    #[inline(always)]
    pub(super) fn forward(&self, p: &[V], w: &mut DiscriminatorScratch) -> f32 {
        let code = self.encoder.forward(p, &w.input, &mut w.encoder);
        let mut kl = ZERO;
        for ((z, c), &noise) in w.z.iter_mut().zip(code.chunks_exact(2)).zip(&w.noise) {
            let (mean, log_var) = (c[0], c[1]);
            if self.bottleneck {
                *z = mean + exp(log_var * V::splat(0.5)) * noise;
                kl = kl + (exp(log_var) + mean * mean - V::splat(1.0) - log_var) * V::splat(0.5);
            } else {
                *z = mean;
            }
        }
        heads(&mut w.logit, self.decoder.forward(p, &w.z, &mut w.decoder));
        kl.sum()
    }

    /// From `dL / d logit` in `w.logit` and a weight on the KL: adds the parameters' gradient to `grad` if given; returns
    /// the gradient of the change if `input`.
    #[inline(always)]
    pub(super) fn backward<'w>(
        &self,
        transposed: &[V],
        w: &'w mut DiscriminatorScratch,
        kl_weight: f32,
        mut grad: Option<&mut [V]>,
        input: bool,
    ) -> &'w [V] {
        set_heads(&mut w.d_logit, &w.logit);
        let dz =
            self.decoder.backward(transposed, &w.z, &w.d_logit, &mut w.decoder, grad.as_deref_mut(), true);
        let (code, k, half) = (w.encoder.output(), V::splat(kl_weight), V::splat(0.5));
        for (i, dz) in dz.iter().enumerate() {
            let (mean, log_var) = (code[2 * i], code[2 * i + 1]);
            (w.d_code[2 * i], w.d_code[2 * i + 1]) = if self.bottleneck {
                let spread = *dz * (w.z[i] - mean) + k * (exp(log_var) - V::splat(1.0));
                (*dz + k * mean, spread * half)
            } else {
                (*dz, ZERO)
            };
        }
        self.encoder.backward(transposed, &w.input, &w.d_code, &mut w.encoder, grad, input)
    }
}

/// `-log sigmoid(sign x)` summed over lanes, for reports.
#[inline(always)]
pub(super) fn softplus_sum(logits: &[V], sign: f32) -> f32 {
    let mut sum = ZERO;
    for &l in logits {
        sum = sum + softplus(l * V::splat(-sign));
    }
    sum.sum()
}

/// `ln(1 + e^x) = max(x, 0) + ln(1 + e)` with `e = e^-|x|`, and `ln(1 + e) = 2 artanh(z)` with `z = e / (2 + e) <= 1/3`.
#[inline(always)]
fn softplus(x: V) -> V {
    const C: [f32; 7] = [1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0];
    let e = exp(ZERO - x.map(f32::abs));
    let z = e / (e + V::splat(2.0));
    let s = z * z;
    let mut series = V::splat(C[0]);
    for &c in &C[1..] {
        series = V::splat(c).fma(series, s);
    }
    x.map(|x| if x > 0.0 { x } else { 0.0 }).fma(z + z, series)
}

/// `d/dx -log sigmoid(sign x)`.
#[inline(always)]
pub(super) fn logit_slope(logits: &mut [V], sign: f32, weight: f32) {
    for l in logits {
        *l = sigmoid(*l * V::splat(-sign)) * V::splat(-sign * weight);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn softplus_equals_the_library() {
        for i in -400..=400 {
            let x = i as f32 * 0.1;
            let (got, want) = (f64::from(softplus(V::splat(x)).0[0]), f64::from(x).exp().ln_1p());
            assert!((got - want).abs() <= 1e-6 * want, "{x}: {got} {want}");
        }
    }
}
