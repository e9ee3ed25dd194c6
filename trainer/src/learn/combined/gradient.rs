//! The policy gradient of the combined policy (Eq. 1) as PPO's surrogate, and its way back through the inverse model and
//! the projection into the meta policy.

use super::super::gaussian::{Gaussian, gather, likelihood_ratio};
use super::super::inverse::{CLIP, InverseModel, gather_input};
use super::super::optimise::{Group, TILE, Tile};
use super::{Combined, CombinedWork};
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars, scalars_mut};
use std::ops::Range;

/// Sums over rows: loss, approximate KL, clipped rows, clamped entries.
pub(in super::super) type ActorSums = [f32; 4];

impl Combined {
    /// Output of the policy for the rows of the tile.
    #[inline(always)]
    pub(in super::super) fn propose(&self, group: &Group, t: &Tile<'_>, w: &mut CombinedWork) {
        let n = self.dims.n_obs;
        gather(&mut w.obs, n.div_ceil(LANES), 0, &t.batch.obs, n, t.idx);
        self.policy.forward(&group.p, &w.obs, &mut w.policy);
    }

    /// Policy gradient on the combined policy (Eq. 1). Leaves `dL / du` in `w.d_change`, where other
    /// losses of the policy may add to it before [`Combined::learn`].
    #[inline(always)]
    pub(in super::super) fn policy_gradient(
        &self,
        group: &Group,
        t: &Tile<'_>,
        w: &mut CombinedWork,
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
    pub(in super::super) fn learn(&self, group: &Group, w: &mut CombinedWork, grad: &mut [V]) {
        self.policy.backward(&group.transposed, &w.obs, &w.d_change, &mut w.policy, Some(grad), false);
    }

    /// Ratio on `log I(a | s_c, w_c)` with `w = clamp(pi(s), lower, upper)`.
    #[inline(always)]
    fn through_inverse(
        &self,
        model: &InverseModel,
        log_std: &Range<usize>,
        group: &Group,
        t: &Tile<'_>,
        w: &mut CombinedWork,
        grad: &mut [V],
    ) -> ([f32; 3], f32) {
        let (d, a) = (&self.dims, self.dims.n_act);
        let seen = d.seen_obs.len();
        let (xv, av, sv) = ((2 * seen).div_ceil(LANES), a.div_ceil(LANES), d.n_state.div_ceil(LANES));
        let Some(inv) = &mut w.inverse else { unreachable!("made with the model") };
        // project again with the current policy
        let u = scalars(w.policy.output());
        let (x, mut clamped) = (scalars_mut(&mut inv.input), 0.0);
        for (r, &i) in t.idx.iter().enumerate() {
            let i = i as usize;
            for j in 0..seen {
                let k = d.seen_state[j];
                let raw = u[r * sv * LANES + k];
                let held = raw.max(t.batch.lower[i * d.n_state + k]).min(t.batch.upper[i * d.n_state + k]);
                let held = held.clamp(-CLIP, CLIP);
                x[r * xv * LANES + j] = t.batch.obs[i * d.n_obs + d.seen_obs[j]];
                x[r * xv * LANES + seen + j] = held;
                clamped += if held == raw { 0.0 } else { 1.0 };
            }
        }
        gather(&mut inv.action, av, 0, &t.batch.sampled, a, t.idx);
        let mean = model.net.forward(&group.p, &inv.input, &mut inv.tape);
        let action =
            Gaussian { log_std: log_std.clone(), n: a, sampled: &inv.action, mean, d: &mut inv.slope };
        let sums = likelihood_ratio([action], &self.ppo, t, &mut w.rows, &group.p, grad);
        let dx =
            model.net.backward(&group.transposed, &inv.input, &inv.slope, &mut inv.tape, Some(grad), true);
        // through the projection into the proposal
        let (dx, x) = (scalars(dx), scalars(&inv.input));
        w.d_change.fill(ZERO);
        let du = scalars_mut(&mut w.d_change);
        for r in 0..TILE {
            for j in 0..seen {
                let (at, k) = (r * xv * LANES + seen + j, r * sv * LANES + d.seen_state[j]);
                if self.gradient.passes(u[k], x[at], dx[at]) {
                    du[k] = dx[at];
                }
            }
        }
        (sums, clamped)
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
        w: &mut CombinedWork,
        grad: &mut [V],
    ) -> [f32; 3] {
        let (d, s, a) = (&self.dims, self.dims.n_state, self.dims.n_act);
        let Some(inv) = &mut w.inverse else { unreachable!("made with the model") };
        gather(&mut w.change, s.div_ceil(LANES), 0, &t.batch.proposal, s, t.idx);
        gather_input(&mut inv.input, t.batch, &t.batch.target, t.idx, d);
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
        model.net.backward(&group.transposed, &inv.input, &inv.slope, &mut inv.tape, Some(grad), false);
        sums
    }

    /// Ratio on `log pi(u | s)`.
    #[inline(always)]
    fn through_proposal(
        &self,
        pi: &Range<usize>,
        group: &Group,
        t: &Tile<'_>,
        w: &mut CombinedWork,
        grad: &mut [V],
    ) -> [f32; 3] {
        let s = self.dims.n_state;
        gather(&mut w.change, s.div_ceil(LANES), 0, &t.batch.proposal, s, t.idx);
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
