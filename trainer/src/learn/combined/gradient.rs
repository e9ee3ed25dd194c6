//! The policy gradient of the combined policy (Eq. 1) as PPO's surrogate, and its way back through the inverse model and
//! the projection into the meta policy.

use super::super::gaussian::{Gaussian, MOST_VECTORS, gather, inverse_sigma, likelihood_ratio, residuals};
use super::super::inverse::{CLIP, InverseModel, gather_input};
use super::super::optimise::{Group, Tile};
use super::{Combined, CombinedScratch, Proposing};
use nearl_runtime::multiversion;
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars, scalars_mut};
use std::ops::Range;

/// Sums over rows: loss, approximate KL, clipped rows, clamped entries.
pub(in super::super) type ActorSums = [f32; 4];

impl Combined {
    /// Output of the policy for the rows of the tile.
    #[inline(always)]
    pub(in super::super) fn propose(&self, group: &Group, t: &Tile<'_>, w: &mut CombinedScratch) {
        let n = self.dims.n_obs;
        gather(&mut w.obs, n.div_ceil(LANES), 0, &t.batch.obs, n, t.idx);
        let Proposing { policy, coordinates } = &mut w.policy;
        self.policy.forward(&group.p, &w.obs, policy);
        if let (Some(net), Some(tape)) = (&self.coordinates, coordinates) {
            net.forward(&group.p, policy.output(), tape);
        }
    }

    /// Policy gradient on the combined policy (Eq. 1). Leaves `dL / du` in `w.d_change`, where other
    /// losses of the policy may add to it before [`Combined::learn`].
    #[inline(always)]
    pub(in super::super) fn policy_gradient(
        &self,
        group: &Group,
        t: &Tile<'_>,
        w: &mut CombinedScratch,
        grad: &mut [V],
    ) -> ActorSums {
        self.propose(group, t, w);
        let ([loss, kl, clipped], clamped) = match (&self.policy_log_std, &self.inverse) {
            (None, Some((model, log_std))) => self.through_inverse(model, log_std, group, t, w, grad),
            (Some(pi), Some((model, log_std))) => {
                (self.through_both(pi, model, log_std, group, t, w, grad), 0.0)
            }
            (Some(pi), None) => (self.through_proposal(pi, group, t, w, grad), 0.0),
            (None, None) => unreachable!("refused in `new`"),
        };
        [loss, kl, clipped, clamped]
    }

    /// From `dL / du` in `w.d_change` to the policy's parameters.
    #[inline(always)]
    pub(in super::super) fn learn(&self, group: &Group, w: &mut CombinedScratch, grad: &mut [V]) {
        let Proposing { policy, coordinates } = &mut w.policy;
        let slope = match (&self.coordinates, coordinates) {
            (Some(net), Some(tape)) => {
                net.backward(&group.transposed, policy.output(), &w.d_change, tape, None, true)
            }
            _ => &w.d_change,
        };
        self.policy.backward(&group.transposed, &w.obs, slope, policy, Some(grad), false);
        self.unread.iter().for_each(|range| grad[range.clone()].fill(ZERO));
    }

    /// Ratio on `log I(a | s_c, w_c)` with `w = clamp(pi(s), lower, upper)`.
    #[inline(always)]
    fn through_inverse(
        &self,
        model: &InverseModel,
        log_std: &Range<usize>,
        group: &Group,
        t: &Tile<'_>,
        w: &mut CombinedScratch,
        grad: &mut [V],
    ) -> ([f32; 3], f32) {
        let a = self.dims.n_act;
        let av = a.div_ceil(LANES);
        let clamped = self.project_again(t, w);
        let Some(inv) = &mut w.inverse else { unreachable!("made with the model") };
        gather(&mut inv.action, av, 0, &t.batch.sampled, a, t.idx);
        let mean = model.net.forward(&group.p, &inv.input, &mut inv.tape);
        let action =
            Gaussian { log_std: log_std.clone(), n: a, sampled: &inv.action, mean, d: &mut inv.slope };
        let sums = likelihood_ratio([action], &self.ppo, t, &mut w.rows, &group.p, grad);
        let own = self.idm_policy_gradient.then_some(grad);
        let dx = model.net.backward(&group.transposed, &inv.input, &inv.slope, &mut inv.tape, own, true);
        self.reach_proposal(w.policy.output(), &inv.input, dx, &mut w.d_change);
        self.pull_inside(t, w);
        (sums, clamped as f32)
    }

    /// `dL / du` from the slope `dx` of the inverse model's input, through the projection.
    #[inline(always)]
    fn reach_proposal(&self, u: &[V], input: &[V], dx: &[V], d_change: &mut [V]) {
        let (d, seen) = (&self.dims, self.dims.seen_obs.len());
        let (xv, sv) = ((2 * seen).div_ceil(LANES), d.n_state.div_ceil(LANES));
        d_change.fill(ZERO);
        let rows =
            scalars_mut(d_change).chunks_exact_mut(sv * LANES).zip(scalars(u).chunks_exact(sv * LANES));
        let slopes = scalars(input).chunks_exact(xv * LANES).zip(scalars(dx).chunks_exact(xv * LANES));
        for ((du, u), (x, dx)) in rows.zip(slopes) {
            for ((&k, &x), &dx) in d.seen_state.iter().zip(&x[seen..]).zip(&dx[seen..]) {
                du[k] = if self.gradient.passes(u[k], x, dx) { dx } else { 0.0 };
            }
        }
    }

    /// `|(I(s, C(pi(s))) - kept) / sigma|² / 2`, the divergence from a policy of those mean actions (n x n_act): its gradient by the meta policy
    /// alone; returns its sum.
    #[inline(always)]
    pub(in super::super) fn keep_actions(
        &self,
        kept: &[f32],
        group: &Group,
        t: &Tile<'_>,
        w: &mut CombinedScratch,
        grad: &mut [V],
    ) -> f32 {
        self.propose(group, t, w);
        self.project_again(t, w);
        let (Some((model, spread)), Some(inv)) = (&self.inverse, &mut w.inverse) else { return 0.0 };
        let av = self.dims.n_act.div_ceil(LANES);
        let mut inverse = [ZERO; MOST_VECTORS];
        inverse_sigma(&mut inverse[..av], &group.p[spread.clone()], self.dims.n_act);
        gather(&mut inv.action, av, 0, kept, self.dims.n_act, t.idx);
        let mean = model.net.forward(&group.p, &inv.input, &mut inv.tape);
        let rows = inv.slope.chunks_exact_mut(av).zip(mean.chunks_exact(av)).zip(inv.action.chunks_exact(av));
        let mut sum = ZERO;
        for ((slope, mean), kept) in rows {
            for (((d, &y), &a), &by) in slope.iter_mut().zip(mean).zip(kept).zip(&inverse) {
                let e = (y - a) * by;
                sum = sum.fma(e, e);
                *d = e * by * V::splat(t.scale);
            }
        }
        let dx = model.net.backward(&group.transposed, &inv.input, &inv.slope, &mut inv.tape, None, true);
        self.reach_proposal(w.policy.output(), &inv.input, dx, &mut w.d_change);
        self.learn(group, w, grad);
        0.5 * sum.sum()
    }

    /// Adds the gradient of `bound_weight |u - C(u)|² / 2` to `dL / du`: what was clamped has no other way back.
    #[inline(always)]
    fn pull_inside(&self, t: &Tile<'_>, w: &mut CombinedScratch) {
        if self.bound_weight == 0.0 {
            return;
        }
        let s = self.dims.n_state;
        let sv = s.div_ceil(LANES);
        let u = scalars(w.policy.output()).chunks_exact(sv * LANES);
        let rows = scalars_mut(&mut w.d_change).chunks_exact_mut(sv * LANES).zip(u);
        for ((du, u), &i) in rows.zip(t.idx) {
            let of = i as usize * s..(i as usize + 1) * s;
            let (lower, upper) = (&t.batch.lower[of.clone()], &t.batch.upper[of]);
            for (((du, &u), &l), &h) in du.iter_mut().zip(u).zip(lower).zip(upper) {
                *du += self.bound_weight * t.scale * (u - u.max(l).min(h));
            }
        }
    }

    /// Input rows of the inverse model from the policy's current output, projected as when it was collected; returns how many
    /// entries were moved.
    #[inline(always)]
    fn project_again(&self, t: &Tile<'_>, w: &mut CombinedScratch) -> u32 {
        let (d, s, seen) = (&self.dims, self.dims.n_state, self.dims.seen_obs.len());
        let (xv, sv) = ((2 * seen).div_ceil(LANES), s.div_ceil(LANES));
        let Some(inv) = &mut w.inverse else { return 0 };
        let u = scalars(w.policy.output());
        let rows = scalars_mut(&mut inv.input).chunks_exact_mut(xv * LANES).zip(u.chunks_exact(sv * LANES));
        let mut clamped = 0u32;
        for ((row, u), &i) in rows.zip(t.idx) {
            let i = i as usize;
            let (lower, upper) = (&t.batch.lower[i * s..][..s], &t.batch.upper[i * s..][..s]);
            let obs = &t.batch.obs[i * d.n_obs..][..d.n_obs];
            let (x, w) = row.split_at_mut(seen);
            for (x, &o) in x.iter_mut().zip(&d.seen_obs) {
                *x = obs[o];
            }
            for (w, &k) in w.iter_mut().zip(&d.seen_state) {
                *w = u[k].max(lower[k]).min(upper[k]).clamp(-CLIP, CLIP);
                clamped += u32::from(*w != u[k]);
            }
        }
        clamped
    }

    /// Passes the projected proposals of [`Combined::propose`] through the inverse model.
    #[inline(always)]
    pub(in super::super) fn invert(&self, group: &Group, t: &Tile<'_>, w: &mut CombinedScratch) {
        self.project_again(t, w);
        if let (Some((model, _)), Some(inv)) = (&self.inverse, &mut w.inverse) {
            model.net.forward(&group.p, &inv.input, &mut inv.tape);
        }
    }

    /// Log probability of what was sampled, under the current networks.
    #[inline(always)]
    fn log_prob_body(&self, group: &Group, t: &Tile<'_>, w: &mut CombinedScratch, out: &mut [f32]) {
        let (d, s, a) = (&self.dims, self.dims.n_state, self.dims.n_act);
        self.propose(group, t, w);
        let mut constant = 0.0;
        let mut inverse = [[ZERO; MOST_VECTORS]; 2];
        let [log_prob, ..] = &mut w.rows;
        if let Some(pi) = &self.policy_log_std {
            constant += inverse_sigma(&mut inverse[0][..pi.len()], &group.p[pi.clone()], s);
        }
        if let Some((_, spread)) = &self.inverse {
            constant += inverse_sigma(&mut inverse[1][..spread.len()], &group.p[spread.clone()], a);
        }
        log_prob.fill(V::splat(constant as f32));
        if let Some(pi) = &self.policy_log_std {
            gather(&mut w.change, s.div_ceil(LANES), 0, &t.batch.change, s, t.idx);
            residuals(&mut w.d_change, &w.change, w.policy.output(), &inverse[0][..pi.len()], log_prob);
        }
        if let Some((model, spread)) = &self.inverse {
            match &self.policy_log_std {
                None => drop(self.project_again(t, w)),
                Some(_) => {
                    let Some(inv) = &mut w.inverse else { return };
                    gather_input(&mut inv.input, t.batch, &t.batch.target_change, t.idx, d);
                }
            }
            let (Some(inv), [log_prob, ..]) = (&mut w.inverse, &mut w.rows) else { return };
            gather(&mut inv.action, a.div_ceil(LANES), 0, &t.batch.sampled, a, t.idx);
            let mean = model.net.forward(&group.p, &inv.input, &mut inv.tape);
            residuals(&mut inv.slope, &inv.action, mean, &inverse[1][..spread.len()], log_prob);
        }
        out.copy_from_slice(&scalars(&w.rows[0])[..out.len()]);
    }

    /// Ratio on `log pi(u | s) + log I(a | s_c, w_c)` with the target `w` as it was.
    #[inline(always)]
    fn through_both(
        &self,
        pi: &Range<usize>,
        model: &InverseModel,
        log_std: &Range<usize>,
        group: &Group,
        t: &Tile<'_>,
        w: &mut CombinedScratch,
        grad: &mut [V],
    ) -> [f32; 3] {
        let (d, s, a) = (&self.dims, self.dims.n_state, self.dims.n_act);
        let Some(inv) = &mut w.inverse else { unreachable!("made with the model") };
        gather(&mut w.change, s.div_ceil(LANES), 0, &t.batch.change, s, t.idx);
        gather_input(&mut inv.input, t.batch, &t.batch.target_change, t.idx, d);
        gather(&mut inv.action, a.div_ceil(LANES), 0, &t.batch.sampled, a, t.idx);
        let mean = model.net.forward(&group.p, &inv.input, &mut inv.tape);
        let proposal = Gaussian {
            log_std: pi.clone(),
            n: s,
            sampled: &w.change,
            mean: w.policy.output(),
            d: &mut w.d_change,
        };
        let action =
            Gaussian { log_std: log_std.clone(), n: a, sampled: &inv.action, mean, d: &mut inv.slope };
        let sums = likelihood_ratio([proposal, action], &self.ppo, t, &mut w.rows, &group.p, grad);
        if self.idm_policy_gradient {
            model.net.backward(&group.transposed, &inv.input, &inv.slope, &mut inv.tape, Some(grad), false);
        }
        sums
    }

    /// Ratio on `log pi(u | s)`.
    #[inline(always)]
    fn through_proposal(
        &self,
        pi: &Range<usize>,
        group: &Group,
        t: &Tile<'_>,
        w: &mut CombinedScratch,
        grad: &mut [V],
    ) -> [f32; 3] {
        let s = self.dims.n_state;
        gather(&mut w.change, s.div_ceil(LANES), 0, &t.batch.change, s, t.idx);
        let proposal = Gaussian {
            log_std: pi.clone(),
            n: s,
            sampled: &w.change,
            mean: w.policy.output(),
            d: &mut w.d_change,
        };
        likelihood_ratio([proposal], &self.ppo, t, &mut w.rows, &group.p, grad)
    }
}

multiversion!(
    /// See [`Combined::log_prob_body`].
    pub(super) fn log_prob(c: &Combined, group: &Group, t: &Tile<'_>, w: &mut CombinedScratch, out: &mut [f32]) = body
);

#[inline(always)]
fn body(c: &Combined, group: &Group, t: &Tile<'_>, w: &mut CombinedScratch, out: &mut [f32]) {
    c.log_prob_body(group, t, w, out);
}
