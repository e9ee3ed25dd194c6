//! The null space of the inverse model: directions in which a proposal may move while the mean action stays as it is.
//!
//! What the adversary asks of a proposal is the second task of a redundant robot: it may use what the first, the action that
//! the policy gradient chose, leaves free (Siciliano et al., *Robotics*, 2009, section 3.5.1). `d <- (1 - J+ J) d` with the
//! Jacobian `J = d I(s_c, w_c) / d u` of the row; its columns are zero where the projection clamped.

use super::super::Dims;
use super::super::inverse::{InverseModel, InverseWork};
use super::super::optimise::{Group, TILE};
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars, scalars_mut};

/// A gradient whose square shrinks below this part when what earlier actions cover is taken out depends on them.
const DEPENDENT: f32 = 1e-6;

/// Buffers of one thread.
pub(super) struct NullSpace {
    /// Gradients of the mean action's entries, each with a row of the inverse model's input for every row of the tile.
    jacobian: Vec<Vec<V>>,
    /// Gradient of the model's output that picks one entry.
    pick: Vec<V>,
    /// The same gradients for one row, made orthonormal.
    basis: Vec<V>,
    /// One for the entries that reach the inverse model unclamped.
    free: Vec<V>,
    /// The adversary's slope in those entries.
    slope: Vec<V>,
}

#[inline(always)]
fn dot(a: &[V], b: &[V]) -> f32 {
    a.iter().zip(b).fold(ZERO, |sum, (&a, &b)| sum.fma(a, b)).sum()
}

/// `to += c x`.
#[inline(always)]
fn add(to: &mut [V], c: f32, x: &[V]) {
    for (to, &x) in to.iter_mut().zip(x) {
        *to = to.fma(V::splat(c), x);
    }
}

impl NullSpace {
    /// Buffers for a tile.
    pub(super) fn new(d: &Dims) -> Self {
        let (xv, av) = ((2 * d.seen_obs.len()).div_ceil(LANES), d.n_act.div_ceil(LANES));
        Self {
            jacobian: vec![vec![ZERO; TILE * xv]; d.n_act],
            pick: vec![ZERO; TILE * av],
            basis: vec![ZERO; d.n_act * xv],
            free: vec![ZERO; xv],
            slope: vec![ZERO; xv],
        }
    }

    /// Takes back from `du` that part of the adversary's slope `dx` in it which would change the mean action. `u` are the proposals
    /// that the inverse model answered last; all three in rows of n_state entries, padded.
    #[inline(always)]
    pub(super) fn leave(
        &mut self,
        d: &Dims,
        model: &InverseModel,
        group: &Group,
        inverse: &mut InverseWork,
        u: &[V],
        dx: &[V],
        du: &mut [V],
    ) {
        let seen = d.seen_obs.len();
        let [xv, av, sv] = [2 * seen, d.n_act, d.n_state].map(|n| n.div_ceil(LANES));
        for (a, jacobian) in self.jacobian.iter_mut().enumerate() {
            self.pick.fill(ZERO);
            scalars_mut(&mut self.pick).chunks_exact_mut(av * LANES).for_each(|row| row[a] = 1.0);
            let (input, tape) = (&inverse.input, &mut inverse.tape);
            jacobian.copy_from_slice(model.net.backward(
                &group.transposed,
                input,
                &self.pick,
                tape,
                None,
                true,
            ));
        }
        let inputs = scalars(&inverse.input).chunks_exact(xv * LANES);
        let [u, dx] = [u, dx].map(|rows| scalars(rows).chunks_exact(sv * LANES));
        let rows = scalars_mut(du).chunks_exact_mut(sv * LANES).zip(dx).zip(u).zip(inputs);
        for (r, (((du, dx), u), x)) in rows.enumerate() {
            let (free, slope) = (scalars_mut(&mut self.free), scalars_mut(&mut self.slope));
            for (j, &k) in (seen..).zip(&d.seen_state) {
                (free[j], slope[j]) = if x[j] == u[k] { (1.0, dx[k]) } else { (0.0, 0.0) };
            }
            self.row(r, xv);
            let (free, slope) = (scalars(&self.free), scalars(&self.slope));
            for (j, &k) in (seen..).zip(&d.seen_state) {
                du[k] += free[j] * (slope[j] - dx[k]);
            }
        }
    }

    /// Gram-Schmidt on the gradients of row `r`, entry by entry of the action; what each adds is taken out of the slope.
    #[inline(always)]
    fn row(&mut self, r: usize, xv: usize) {
        for (a, jacobian) in self.jacobian.iter().enumerate() {
            let (before, own) = self.basis.split_at_mut(a * xv);
            let own = &mut own[..xv];
            for ((own, &j), &free) in own.iter_mut().zip(&jacobian[r * xv..]).zip(&self.free) {
                *own = j * free;
            }
            let size = dot(own, own);
            for b in before.chunks_exact(xv) {
                add(own, -dot(own, b), b);
            }
            let left = dot(own, own);
            let scale = if left > DEPENDENT * size { 1.0 / left.sqrt() } else { 0.0 };
            own.iter_mut().for_each(|v| *v = *v * V::splat(scale));
            let covered = dot(own, &self.slope);
            add(&mut self.slope, -covered, own);
        }
    }
}
