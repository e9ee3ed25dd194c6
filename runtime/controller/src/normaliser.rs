//! From observations to network inputs, and from network outputs to changes of state.

/// Observation normaliser and the scale of one policy step's change of state.
///
/// `x_i = clip((obs_i - mean_i) / std_i, -10, 10)`, `proposal_k = s_k + scale_k u_k`. A policy made elsewhere may be clipped elsewhere; its
/// normaliser's epsilon is part of `std`.
#[derive(Clone, Debug, PartialEq)]
pub struct Normaliser {
    /// Mean of each observation entry (n_obs).
    pub mean: Vec<f64>,
    /// Standard deviation of each observation entry (n_obs), positive.
    pub std: Vec<f64>,
    /// Standard deviation of `s' - s` for each proposed entry (n_state), positive.
    pub scale: Vec<f64>,
    /// Lowest and highest network input of each observation entry (n_obs), possibly infinite; empty is [`CLIP`] for all.
    pub clip: Vec<[f64; 2]>,
}

/// Network inputs are clipped to this many standard deviations.
pub const CLIP: f64 = 10.0;

impl Normaliser {
    /// Mean 0, standard deviation 1, scale 1.
    pub fn identity(n_obs: usize, n_state: usize) -> Self {
        Self::new(vec![0.0; n_obs], vec![1.0; n_obs], vec![1.0; n_state])
    }

    /// Clipped to [`CLIP`] standard deviations.
    pub fn new(mean: Vec<f64>, std: Vec<f64>, scale: Vec<f64>) -> Self {
        Self { mean, std, scale, clip: Vec::new() }
    }

    /// Writes the network input of `obs` (n_obs) to `x` (n_obs).
    pub fn observation(&self, obs: &[f64], x: &mut [f32]) {
        for (((x, &o), &m), &s) in x.iter_mut().zip(obs).zip(&self.mean).zip(&self.std) {
            *x = ((o - m) / s).clamp(-CLIP, CLIP) as f32;
        }
        if self.clip.is_empty() {
            return;
        }
        let moments = obs.iter().zip(&self.mean).zip(&self.std);
        for ((x, ((&o, &m), &s)), &[lower, upper]) in x.iter_mut().zip(moments).zip(&self.clip) {
            *x = ((o - m) / s).clamp(lower, upper) as f32;
        }
    }
}
