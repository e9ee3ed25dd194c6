//! The adversary of PID^2 (Eq. 2): reached transitions are real, proposed ones are not.

use super::super::discriminator::{DiscriminatorScratch, logit_slope, softplus_sum};
use super::super::gaussian::MOST_OUTPUTS;
use super::super::gaussian::{copy, gather};
use super::super::optimise::{Group, Params, TILE, Tile, add_sums};
use super::fakes::within;
use super::{ADVERSARY, COMBINED, Nets, Pass, Scratch};
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
pub(super) fn fool_discriminator(
    n: &Nets,
    params: &Params,
    t: &Tile<'_>,
    w: &mut Scratch,
    grad: &mut [V],
) -> f32 {
    let adversary = &params.groups[ADVERSARY];
    let (o, s) = (n.combined.dims.n_obs, n.combined.dims.n_state);
    let (xv, sv) = ((o + s).div_ceil(LANES), s.div_ceil(LANES));
    let d = &mut w.discriminator;
    gather(&mut d.input, xv, s, &t.batch.obs, o, t.idx);
    gather_noise(n, Pass::Generator, t, &mut d.noise);
    let u = scalars(w.actor.policy.output()).chunks_exact(sv * LANES);
    let spread = n.combined.policy_log_std.clone();
    let log_std = spread.as_ref().map_or(&[][..], |r| &scalars(&params.groups[COMBINED].p[r.clone()])[..s]);
    for ((x, u), &i) in scalars_mut(&mut d.input).chunks_exact_mut(xv * LANES).zip(u).zip(t.idx) {
        copy(&mut x[..s], &u[..s]);
        for ((x, z), l) in x.iter_mut().zip(n.fakes.normal(i as usize)).zip(log_std) {
            *x += l.exp() * z;
        }
        for (x, r) in x.iter_mut().zip(n.fakes.residual(i as usize)) {
            *x += r;
        }
        x[..s].iter_mut().for_each(|x| *x = within(*x));
    }
    n.discriminator.forward(&adversary.p, d);
    let loss = softplus_sum(&d.logit, 1.0);
    logit_slope(&mut d.logit, 1.0, n.settings.generator_weight * t.scale);
    let dx = n.discriminator.backward(&adversary.transposed, d, 0.0, None, true);
    let rows = scalars_mut(&mut w.actor.d_change)
        .chunks_exact_mut(sv * LANES)
        .zip(scalars(dx).chunks_exact(sv * LANES));
    for (du, dx) in rows {
        for (du, dx) in du[..s].iter_mut().zip(dx) {
            *du += dx;
        }
    }
    if let Some(range) = spread {
        let to = &mut scalars_mut(&mut grad[range])[..s];
        for (dx, &i) in scalars(dx).chunks_exact(sv * LANES).zip(t.idx) {
            let noise = n.fakes.normal(i as usize).iter().zip(log_std);
            for ((g, dx), (z, l)) in to.iter_mut().zip(dx).zip(noise) {
                *g += dx * l.exp() * z;
            }
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
fn discriminator_body(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) {
    let (o, s) = (n.combined.dims.n_obs, n.combined.dims.n_state);
    let xv = (o + s).div_ceil(LANES);
    let (group, d) = (&params.groups[ADVERSARY], &mut w.discriminator);
    let (mut loss, mut kl, mut right) = (0.0, 0.0, 0.0);
    gather(&mut d.input, xv, s, &t.batch.obs, o, t.idx);
    for (real, sign) in [(true, 1.0), (false, -1.0)] {
        let (change, pass) = match real {
            true => (&t.batch.reached[..], Pass::Real),
            false => (n.fakes.shown(t.batch), Pass::Proposed),
        };
        gather(&mut d.input, xv, 0, change, s, t.idx);
        if !real {
            for x in scalars_mut(&mut d.input).chunks_exact_mut(xv * LANES) {
                x[..s].iter_mut().for_each(|x| *x = within(*x));
            }
        }
        gather_noise(n, pass, &t, &mut d.noise);
        kl += 0.5 * n.discriminator.forward(&group.p, d);
        loss += softplus_sum(&d.logit, sign);
        right += scalars(&d.logit).iter().filter(|&&l| l * sign > 0.0).count() as f32 * 0.5;
        logit_slope(&mut d.logit, sign, t.scale);
        // the mixture of real and proposed transitions bears the bottleneck: half each
        n.discriminator.backward(&group.transposed, d, 0.5 * params.beta * t.scale, Some(grad), false);
        if real && n.settings.gradient_penalty > 0.0 {
            flatten(n, group, &t, d, grad);
        }
    }
    add_sums(grad, &[loss, kl, right]);
}

/// Length of the step by which the slope's own slope is taken, in units of the change.
const STEP: f32 = 0.05;

/// Adds the gradient of `gamma |d D / d s'|^2 / 2` on the reached changes in `d` (Mescheder et al. 2018, R1): the slope of `v . d D / d s'`
/// with `v` held is `(D'(s' + h v) - D'(s' - h v)) / 2 h`, with `D'` the gradient by the parameters.
#[inline(always)]
fn flatten(n: &Nets, group: &Group, t: &Tile<'_>, d: &mut DiscriminatorScratch, grad: &mut [V]) {
    let (o, s) = (n.combined.dims.n_obs, n.combined.dims.n_state);
    let (xv, sv) = ((o + s).div_ceil(LANES), s.div_ceil(LANES));
    n.discriminator.forward(&group.p, d);
    d.logit.fill(V::splat(1.0));
    let mut slope = [0.0f32; TILE * MOST_OUTPUTS];
    let rows =
        scalars(n.discriminator.backward(&group.transposed, d, 0.0, None, true)).chunks_exact(sv * LANES);
    let mut step = [0.0f32; TILE];
    for ((to, row), step) in slope.chunks_exact_mut(s).zip(rows).zip(&mut step) {
        to.copy_from_slice(&row[..s]);
        *step = STEP / (row[..s].iter().map(|x| x * x).sum::<f32>().sqrt() + 1e-6);
    }
    for sign in [1.0, -2.0] {
        let inputs = scalars_mut(&mut d.input).chunks_exact_mut(xv * LANES);
        for ((x, v), h) in inputs.zip(slope.chunks_exact(s)).zip(&step) {
            x[..s].iter_mut().zip(v).for_each(|(x, v)| *x += sign * h * v);
        }
        n.discriminator.forward(&group.p, d);
        for (l, h) in scalars_mut(&mut d.logit).iter_mut().zip(&step) {
            *l = f32::signum(sign) * n.settings.gradient_penalty * t.scale / (2.0 * h);
        }
        n.discriminator.backward(&group.transposed, d, 0.0, Some(&mut *grad), false);
    }
    // the other half of the loop reads observations only; the changes there are written anew
}

multiversion!(
    /// The discriminator's loss, its bottleneck included.
    pub(super) fn discriminate(n: &Nets, params: &Params, t: Tile<'_>, w: &mut Scratch, grad: &mut [V]) = discriminator_body
);
