//! The adversary of PID^2 (Eq. 2): reached transitions are real, proposed ones are not.

use super::super::discriminator::{logit_slope, softplus_sum};
use super::super::gaussian::{copy, gather};
use super::super::optimise::{Params, Tile, add_sums};
use super::{COMBINED, JUDGE, Nets, Pass, Work};
use nearl_runtime::multiversion;
use nearl_runtime::net::kernel::{LANES, V, scalars, scalars_mut};

#[inline(always)]
fn gather_noise(n: &Nets, pass: Pass, t: &Tile<'_>, to: &mut [V]) {
    for (row, &i) in to.iter_mut().zip(t.idx) {
        copy(&mut row.0, n.noise(pass, i as usize));
    }
}

/// Non-saturating loss `-log D(E(s, pi(s)))`: adds its gradient to `dL / du`; returns its sum.
#[inline(always)]
pub(super) fn fool_discriminator(n: &Nets, params: &Params, t: &Tile<'_>, w: &mut Work) -> f32 {
    let judge = &params.groups[JUDGE];
    let (o, s) = (n.combined.dims.n_obs, n.combined.dims.n_state);
    let (xv, sv) = ((o + s).div_ceil(LANES), s.div_ceil(LANES));
    let d = &mut w.discriminator;
    gather(&mut d.input, xv, s, &t.batch.obs, o, t.idx);
    gather_noise(n, Pass::Generator, t, &mut d.noise);
    let u = scalars(w.actor.policy.output()).chunks_exact(sv * LANES);
    for (x, u) in scalars_mut(&mut d.input).chunks_exact_mut(xv * LANES).zip(u) {
        copy(&mut x[..s], &u[..s]);
    }
    n.discriminator.forward(&judge.p, d);
    let loss = softplus_sum(&d.logit, 1.0);
    logit_slope(&mut d.logit, 1.0, n.settings.generator_weight * t.scale);
    let dx = n.discriminator.backward(&judge.transposed, d, 0.0, None, true);
    let rows = scalars_mut(&mut w.actor.d_change)
        .chunks_exact_mut(sv * LANES)
        .zip(scalars(dx).chunks_exact(sv * LANES));
    for (du, dx) in rows {
        for (du, dx) in du[..s].iter_mut().zip(dx) {
            *du += dx;
        }
    }
    if let (Some(null_space), Some((model, _)), Some(inverse)) =
        (&mut w.null_space, &n.combined.inverse, &mut w.actor.inverse)
    {
        let (dims, group, u) = (&n.combined.dims, &params.groups[COMBINED], w.actor.policy.output());
        null_space.leave(dims, model, group, inverse, u, dx, &mut w.actor.d_change);
    }
    loss
}

/// Real transitions against proposed ones through the bottleneck (Eq. 2).
#[inline(always)]
fn discriminator_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) {
    let (o, s) = (n.combined.dims.n_obs, n.combined.dims.n_state);
    let xv = (o + s).div_ceil(LANES);
    let (group, d) = (&params.groups[JUDGE], &mut w.discriminator);
    let (mut loss, mut kl, mut right) = (0.0, 0.0, 0.0);
    gather(&mut d.input, xv, s, &t.batch.obs, o, t.idx);
    for (real, sign) in [(true, 1.0), (false, -1.0)] {
        let (change, pass) =
            if real { (&t.batch.reached, Pass::Real) } else { (&t.batch.proposal, Pass::Proposed) };
        gather(&mut d.input, xv, 0, change, s, t.idx);
        gather_noise(n, pass, &t, &mut d.noise);
        kl += 0.5 * n.discriminator.forward(&group.p, d);
        loss += softplus_sum(&d.logit, sign);
        right += scalars(&d.logit).iter().filter(|&&l| l * sign > 0.0).count() as f32 * 0.5;
        logit_slope(&mut d.logit, sign, t.scale);
        // the mixture of real and proposed transitions bears the bottleneck: half each
        n.discriminator.backward(&group.transposed, d, 0.5 * params.beta * t.scale, Some(grad), false);
    }
    add_sums(grad, &[loss, kl, right]);
}

multiversion!(
    /// The discriminator's loss, its bottleneck included.
    pub(super) fn judge(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Work, grad: &mut [V]) = discriminator_body
);
