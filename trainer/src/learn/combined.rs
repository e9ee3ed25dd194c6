//! The combined policy `I o pi` in one parameter group. [`gradient`] is the surrogate on it.
//!
//! | meta policy | inverse dynamics | ratio on | the policy learns through |
//! |---|---|---|---|
//! | deterministic | learned | `log I(a, s_c, C(pi(s)))` | the inverse model's input and the projection |
//! | stochastic | learned | `log pi(u, s) + log I(a, s_c, w)` | its own likelihood; the target `w` is stored |
//! | stochastic | analytic | `log pi(u, s)` | its own likelihood |

mod coordinates;
mod gradient;

use super::Dims;
use super::batch::Batch;
use super::inverse::{InverseModel, InverseScratch};
use super::losses::{in_parts, mean_std, set_lanes, widths};
use super::net::Net;
use super::nets::NetSettings;
use super::optimise::{Group, PhaseReport, Rows, TILE, Tile};
use super::ppo::PpoSettings;
use super::rescale::{Inputs, carry, outputs};
use super::value::Value;
use super::{Metrics, init};
use coordinates::Proposing;
use nearl_runtime::Networks;
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars};
use nearl_runtime::normaliser::Normaliser;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// How the policy gradient passes the projection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Gradient {
    /// The projection's derivative: zero where it clamped.
    #[default]
    Projection,
    /// The same, but an entry beyond its bound may be drawn back towards it; the derivative alone leaves it where it is.
    Inward,
    /// As if the projection were not there.
    StraightThrough,
}

impl Gradient {
    /// True if the slope `dx` of the loss at the projected entry `x` reaches the proposed entry `u`.
    #[inline(always)]
    fn passes(self, u: f32, x: f32, dx: f32) -> bool {
        match self {
            Self::Projection => x == u,
            Self::Inward => x == u || (u - x) * dx > 0.0,
            Self::StraightThrough => true,
        }
    }
}

/// What of the combined policy is random and what is learned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kind {
    /// The meta policy is a Gaussian on proposals.
    pub stochastic: bool,
    /// The inverse model is a Gaussian network; otherwise it is analytic.
    pub learned: bool,
}

/// Policy and inverse model in one parameter group, and the value in its own.
pub(super) struct Combined {
    /// Sizes.
    pub(super) dims: Dims,
    /// Settings of the surrogate.
    pub(super) ppo: PpoSettings,
    /// How the gradient passes the projection.
    pub(super) gradient: Gradient,
    /// Weight of the squared distance between a proposal and its projection in the policy's loss.
    pub(super) bound_weight: f32,
    /// The policy gradient moves the inverse model too.
    pub(super) idm_policy_gradient: bool,
    /// Meta policy.
    pub(super) policy: Net,
    /// The layer that makes a proposal of what the policy puts out, where they differ. No phase changes it.
    pub(super) coordinates: Option<Net>,
    /// Spread of a stochastic meta policy.
    pub(super) policy_log_std: Option<Range<usize>>,
    /// The learned inverse model and its spread.
    pub(super) inverse: Option<(InverseModel, Range<usize>)>,
    /// Value.
    pub(super) value: Value,
    /// Where the policy's network lies in the group.
    pub(super) policy_range: Range<usize>,
    /// Weights of the linear map beside its layers, one range for each observation that the inverse model does not see. They stay zero: the map
    /// is for what the robot does by itself.
    pub(super) unread: Vec<Range<usize>>,
    /// Vectors of the group.
    pub(super) len: usize,
}

/// Buffers of one thread.
pub(super) struct CombinedScratch {
    pub(super) policy: Proposing,
    pub(super) inverse: Option<InverseScratch>,
    /// Observation rows.
    pub(super) obs: Vec<V>,
    /// Rows of a change of state.
    pub(super) change: Vec<V>,
    /// Gradient of the policy's output.
    pub(super) d_change: Vec<V>,
    rows: [Vec<V>; 3],
}

impl Combined {
    /// Fresh networks, the parameter group of policy and inverse model, and that of the value. With `identified` the policy has
    /// [coordinates] for a proposal, and a linear map beside its layers.
    pub(super) fn new(
        dims: Dims,
        nets: &NetSettings,
        ppo: PpoSettings,
        gradient: Gradient,
        kind: Kind,
        identified: bool,
        rng: &mut ChaCha8Rng,
    ) -> (Self, [Group; 2]) {
        assert!(kind.stochastic || kind.learned, "a policy explores in its proposal or in its action");
        let (mut at, mut transposed) = (0, 0);
        let (o, s, f) = (dims.n_obs, dims.n_state, nets.activation);
        let vectors = |at: &mut usize, n: usize| {
            let range = *at..*at + n.div_ceil(LANES);
            *at = range.end;
            range
        };
        let make = if identified { Net::with_skip } else { Net::new };
        let policy = make(&widths(o, &nets.policy, s), f, 0, &mut at, &mut transposed);
        let policy_range = 0..at;
        let unseen = (0..o).filter(|k| !dims.seen_obs.contains(k));
        let unread = policy.mlp.skip.iter().flat_map(|map| {
            let n = map.n_vectors();
            unseen.clone().map(move |k| map.w + k * n..map.w + (k + 1) * n)
        });
        let unread = unread.collect();
        let policy_log_std = kind.stochastic.then(|| vectors(&mut at, s));
        let inverse = kind.learned.then(|| {
            let model = InverseModel::new(&dims, nets, &mut at, &mut transposed);
            let log_std = vectors(&mut at, dims.n_act);
            (model, log_std)
        });
        let coordinates = identified.then(|| Net::new(&[s, s], f, s, &mut at, &mut transposed));
        let mut group = Group { p: vec![ZERO; at], transposed: vec![ZERO; transposed] };
        let mut first = init::orthogonal(&policy.mlp.widths(), 0.01, rng);
        first.skip = identified.then(|| vec![0.0; o * s]);
        policy.mlp.write_dense(&first, &mut group.p);
        let (value, value_group) = Value::new(&dims, nets, &ppo, rng);
        if let Some(range) = &policy_log_std {
            set_lanes(&mut group.p[range.clone()], s, ppo.log_std);
        }
        if let Some((model, range)) = &inverse {
            model.init(&mut group.p, rng);
            set_lanes(&mut group.p[range.clone()], dims.n_act, ppo.log_std);
        }
        let combined = Self {
            dims,
            ppo,
            gradient,
            bound_weight: 0.0,
            idm_policy_gradient: true,
            policy,
            coordinates,
            policy_log_std,
            inverse,
            value,
            policy_range,
            unread,
            len: at,
        };
        combined.begin_coordinates(&mut group);
        combined.refresh(&mut group);
        (combined, [group, value_group])
    }

    /// Refreshes the transposed weights.
    pub(super) fn refresh(&self, group: &mut Group) {
        let Group { p, transposed } = group;
        self.policy.transpose(p, transposed);
        if let Some(net) = &self.coordinates {
            net.transpose(p, transposed);
        }
        self.refresh_inverse(group);
    }

    /// The same after a step of the inverse model alone.
    pub(super) fn refresh_inverse(&self, group: &mut Group) {
        if let Some((model, _)) = &self.inverse {
            model.net.transpose(&group.p, &mut group.transposed);
        }
    }

    /// Carries the networks over to other statistics; transposed weights are the caller's to refresh.
    pub(super) fn rescale(&self, actor: &mut Group, value: &mut Group, from: &Normaliser, to: &Normaliser) {
        let (d, obs, gain) = (&self.dims, Inputs::observation(from, to), outputs(from, to));
        match &self.coordinates {
            Some(net) => {
                carry(&self.policy, &mut actor.p, &obs, &[]);
                carry(net, &mut actor.p, &Inputs::same(d.n_state), &gain);
            }
            None => carry(&self.policy, &mut actor.p, &obs, &gain),
        }
        carry(&self.value.net, &mut value.p, &obs, &[]);
        if let Some((model, _)) = &self.inverse {
            carry(&model.net, &mut actor.p, &Inputs::seen(from, to, &d.seen_obs, &d.seen_state), &[]);
        }
    }

    /// Where the inverse model's network lies; empty with analytic inverse dynamics.
    pub(super) fn inverse_range(&self) -> Range<usize> {
        self.inverse.as_ref().map_or(0..0, |(model, _)| model.range())
    }

    /// Where log standard deviations of actions and proposals lie.
    pub(super) fn spreads(&self) -> Vec<Range<usize>> {
        let action = self.inverse.as_ref().map(|(_, spread)| spread.clone());
        action.into_iter().chain(self.policy_log_std.clone()).collect()
    }

    /// Where the policy's network and its spread lie.
    pub(super) fn proposal_range(&self) -> Range<usize> {
        0..self.policy_log_std.as_ref().map_or(self.policy_range.end, |spread| spread.end)
    }

    /// Buffers for a tile.
    pub(super) fn scratch(&self) -> CombinedScratch {
        let (ov, sv) = (self.dims.n_obs.div_ceil(LANES), self.dims.n_state.div_ceil(LANES));
        CombinedScratch {
            policy: Proposing {
                policy: self.policy.tape(TILE),
                coordinates: self.coordinates.as_ref().map(|net| net.tape(TILE)),
            },
            inverse: self.inverse.as_ref().map(|(m, _)| m.scratch()),
            obs: vec![ZERO; TILE * ov],
            change: vec![ZERO; TILE * sv],
            d_change: vec![ZERO; TILE * sv],
            rows: std::array::from_fn(|_| vec![ZERO; TILE / LANES]),
        }
    }

    /// The current networks for a controller.
    pub(super) fn networks(&self, p: &[V], normaliser: &Normaliser) -> Networks {
        let lanes = |r: &Range<usize>, n: usize| scalars(&p[r.clone()])[..n].to_vec();
        Networks {
            normaliser: normaliser.clone(),
            policy: self.in_changes(p),
            policy_log_std: self.policy_log_std.as_ref().map_or(Vec::new(), |r| lanes(r, self.dims.n_state)),
            idm: self.inverse.as_ref().map(|(m, r)| (m.net.mlp.to_dense(p), lanes(r, self.dims.n_act))),
            margins: Vec::new(),
        }
    }

    /// The rows that [`Combined::policy_gradient`] reads.
    pub(super) fn rows<'b>(&self, batch: &'b Batch) -> Vec<Rows<'b>> {
        let d = &self.dims;
        let mut rows = vec![Rows::new(&batch.obs, d.n_obs)];
        if self.inverse.is_some() {
            rows.push(Rows::new(&batch.sampled, d.n_act));
        }
        match self.policy_log_std {
            None => rows.extend([&batch.lower, &batch.upper].map(|b| Rows::new(b, d.n_state))),
            Some(_) => rows.extend([&batch.change, &batch.target_change].map(|b| Rows::new(b, d.n_state))),
        }
        rows
    }

    /// Mean squared error of the inverse model over a batch; none with analytic inverse dynamics.
    pub(super) fn idm_error(&self, p: &[V], batch: &Batch, threads: usize) -> Option<f64> {
        self.inverse.as_ref().map(|(model, _)| model.error(p, batch, &self.dims, threads))
    }

    /// The rows that [`Combined::idm_tile`] reads.
    pub(super) fn idm_rows<'b>(&self, batch: &'b Batch) -> Vec<Rows<'b>> {
        self.inverse.as_ref().map_or(Vec::new(), |(model, _)| model.rows(&self.dims, batch))
    }

    /// The supervised loss of the inverse model (Eq. 4).
    pub(super) fn idm_tile(&self, group: &Group, t: &Tile<'_>, w: &mut CombinedScratch, grad: &mut [V]) {
        if let (Some((model, _)), Some(scratch)) = (&self.inverse, &mut w.inverse) {
            model.tile(group, t, &self.dims, scratch, grad);
        }
    }

    /// Log probability of what was sampled in each row of the batch, under the current networks.
    pub(super) fn log_probs(&self, group: &Group, batch: &Batch, threads: usize) -> Vec<f32> {
        let mut out = vec![0.0f32; batch.n];
        in_parts(&mut out, TILE, threads, |first, out| {
            let (mut w, mut idx) = (self.scratch(), [0u32; TILE]);
            for (start, out) in (first..).step_by(TILE).zip(out.chunks_mut(TILE)) {
                for (k, i) in idx.iter_mut().enumerate() {
                    *i = (start + k).min(batch.n - 1) as u32;
                }
                let tile = Tile { batch, idx: &idx, scale: 1.0, advantage: (0.0, 1.0), clip: 1.0 };
                gradient::log_prob(self, group, &tile, &mut w, out);
            }
        });
        out
    }

    /// Mean proposal of each row of the batch (n x n_state), in the order of the rows.
    pub(super) fn proposals(&self, group: &Group, batch: &Batch, threads: usize, out: &mut Vec<f32>) {
        self.each_row(self.dims.n_state, batch, threads, out, |tile, w, take| {
            self.propose(group, tile, w);
            take(w.policy.output());
        });
    }

    /// Mean action of each row of the batch (n x n_act), in the order of the rows; nothing with analytic inverse dynamics.
    pub(super) fn mean_actions(&self, group: &Group, batch: &Batch, threads: usize, out: &mut Vec<f32>) {
        self.each_row(self.dims.n_act, batch, threads, out, |tile, w, take| {
            self.propose(group, tile, w);
            self.invert(group, tile, w);
            if let Some(inv) = &w.inverse {
                take(inv.tape.output());
            }
        });
    }

    /// Divergence of two policies of the current spread and these mean actions (n x n_act), averaged over the rows \[nat\].
    pub(super) fn divergence(&self, p: &[V], a: &[f32], b: &[f32]) -> f64 {
        let n_act = self.dims.n_act;
        let sigma: Vec<f64> = self.log_std(p).iter().map(|s| f64::from(*s).exp()).collect();
        let away = a.iter().zip(b).zip(sigma.iter().cycle());
        let sum: f64 = away.map(|((a, b), sigma)| (f64::from(a - b) / sigma).powi(2)).sum();
        0.5 * sum * n_act as f64 / a.len().max(1) as f64
    }

    /// Rows of `width` numbers, as `of` hands them over for each tile of the batch.
    fn each_row(
        &self,
        width: usize,
        batch: &Batch,
        threads: usize,
        out: &mut Vec<f32>,
        of: impl Fn(&Tile<'_>, &mut CombinedScratch, &mut dyn FnMut(&[V])) + Sync,
    ) {
        let padded = width.div_ceil(LANES) * LANES;
        out.resize(batch.n * width, 0.0);
        in_parts(out, TILE * width, threads, |first, out| {
            let (mut w, mut idx) = (self.scratch(), [0u32; TILE]);
            for (start, out) in (first / width..).step_by(TILE).zip(out.chunks_mut(TILE * width)) {
                for (k, i) in idx.iter_mut().enumerate() {
                    *i = (start + k).min(batch.n - 1) as u32;
                }
                let tile = Tile { batch, idx: &idx, scale: 1.0, advantage: (0.0, 1.0), clip: 1.0 };
                of(&tile, &mut w, &mut |rows| {
                    let rows = scalars(rows).chunks_exact(padded);
                    out.chunks_exact_mut(width)
                        .zip(rows)
                        .for_each(|(to, row)| to.copy_from_slice(&row[..width]));
                });
            }
        });
    }

    /// Log standard deviations of what explores: the action's where it is Gaussian, else the proposal's.
    pub(super) fn log_std(&self, p: &[V]) -> Vec<f32> {
        let (range, n) = match (&self.inverse, &self.policy_log_std) {
            (Some((_, range)), _) => (range, self.dims.n_act),
            (None, Some(range)) => (range, self.dims.n_state),
            (None, None) => return Vec::new(),
        };
        scalars(&p[range.clone()])[..n].to_vec()
    }

    /// What the phases of actor and value report, under SB3's names.
    pub(super) fn metrics(&self, p: &[V], actor: &PhaseReport, value: &PhaseReport) -> Metrics {
        let mean = &actor.mean;
        let mut metrics = vec![
            ("train/policy_gradient_loss", mean[0]),
            ("train/approx_kl", mean[1]),
            ("train/clip_fraction", mean[2]),
            ("train/value_loss", value.mean[0]),
            ("train/clamped_fraction", mean[3] / self.dims.seen_state.len().max(1) as f64),
            ("train/grad_norm", actor.norm),
            ("train/std", mean_std(&self.log_std(p))),
        ];
        if let Some(range) = &self.policy_log_std {
            let spread = &scalars(&p[range.clone()])[..self.dims.n_state];
            metrics.push(("train/proposal_std", mean_std(spread)));
        }
        metrics
    }
}

#[cfg(test)]
mod tests {
    use super::Gradient;

    /// Descending along the slope moves the proposal against its sign.
    #[test]
    fn inward_lets_a_proposal_come_back_and_never_go_further() {
        let passes = |g: Gradient| {
            [(0.5, 0.5, 1.0), (2.0, 1.0, 1.0), (2.0, 1.0, -1.0), (-2.0, -1.0, 1.0), (-2.0, -1.0, -1.0)]
                .map(|(u, x, dx)| g.passes(u, x, dx))
        };
        assert_eq!(passes(Gradient::Projection), [true, false, false, false, false]);
        assert_eq!(passes(Gradient::Inward), [true, true, false, false, true]);
        assert_eq!(passes(Gradient::StraightThrough), [true; 5]);
    }
}
