//! The null space of the inverse model: directions in which a proposal may move while the mean action stays as it is.
//!
//! What the adversary asks of a proposal is the second task of a redundant robot: it may use what the first, the action that
//! the policy gradient chose, leaves free (Siciliano et al., *Robotics*, 2009, section 3.5.1). `d <- (1 - J+ J) d` with the
//! Jacobian `J = d I(s_c, w_c) / d u` of the row; its columns are zero where the projection clamped.

use super::super::Dims;
use super::super::inverse::{InverseModel, InverseScratch};
use super::super::optimise::{Group, TILE};
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars, scalars_mut};

/// A gradient whose square shrinks below this part when what earlier actions cover is taken out depends on them.
const DEPENDENT: f32 = 1e-6;

/// Buffers of one thread: for a tile of rows, then for sixteen of them at a time, a lane each.
pub(super) struct NullSpace {
    /// Gradients of the mean action's entries, each with a row of the inverse model's input for every row of the tile.
    jacobian: Vec<Vec<V>>,
    /// Gradient of the model's output that picks one entry.
    pick: Vec<V>,
    /// The same gradients made orthonormal: n_act rows of the entries that the inverse model sees.
    basis: Vec<V>,
    /// One for the entries that reach the inverse model unclamped.
    free: Vec<V>,
    /// The adversary's slope in those entries.
    slope: Vec<V>,
}

/// Sum of products, in each lane.
#[inline(always)]
fn dot(a: &[V], b: &[V]) -> V {
    a.iter().zip(b).fold(ZERO, |sum, (&a, &b)| sum.fma(a, b))
}

/// `from -= c x`, in each lane.
#[inline(always)]
fn take(from: &mut [V], c: V, x: &[V]) {
    let c = ZERO - c;
    for (from, &x) in from.iter_mut().zip(x) {
        *from = from.fma(c, x);
    }
}

impl NullSpace {
    /// Buffers for a tile.
    pub(super) fn new(d: &Dims) -> Self {
        let seen = d.seen_obs.len();
        let (xv, av) = ((2 * seen).div_ceil(LANES), d.n_act.div_ceil(LANES));
        Self {
            jacobian: vec![vec![ZERO; TILE * xv]; d.n_act],
            pick: vec![ZERO; TILE * av],
            basis: vec![ZERO; d.n_act * seen],
            free: vec![ZERO; seen],
            slope: vec![ZERO; seen],
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
        inverse: &mut InverseScratch,
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
            let rows = model.net.backward(&group.transposed, input, &self.pick, tape, None, true);
            jacobian.copy_from_slice(rows);
        }
        let (x, u, dx, du) = (scalars(&inverse.input), scalars(u), scalars(dx), scalars_mut(du));
        for first in (0..TILE).step_by(LANES) {
            let input = |lane: usize| (first + lane) * xv * LANES + seen;
            let state = |lane: usize| (first + lane) * sv * LANES;
            for (j, &k) in d.seen_state.iter().enumerate() {
                for lane in 0..LANES {
                    let free = x[input(lane) + j] == u[state(lane) + k];
                    self.free[j].0[lane] = f32::from(u8::from(free));
                    self.slope[j].0[lane] = if free { dx[state(lane) + k] } else { 0.0 };
                }
            }
            for (own, rows) in self.basis.chunks_exact_mut(seen).zip(&self.jacobian) {
                let rows = scalars(rows);
                for (j, (own, &free)) in own.iter_mut().zip(&self.free).enumerate() {
                    for lane in 0..LANES {
                        own.0[lane] = rows[input(lane) + j];
                    }
                    *own = *own * free;
                }
            }
            self.take_out();
            for (j, &k) in d.seen_state.iter().enumerate() {
                for lane in 0..LANES {
                    let at = state(lane) + k;
                    du[at] += self.free[j].0[lane] * (self.slope[j].0[lane] - dx[at]);
                }
            }
        }
    }

    /// Gram-Schmidt on the gradients, one entry of the action after another; what each adds is taken out of the slope.
    #[inline(always)]
    fn take_out(&mut self) {
        let seen = self.slope.len();
        for a in 0..self.jacobian.len() {
            let (before, own) = self.basis.split_at_mut(a * seen);
            let own = &mut own[..seen];
            let least = dot(own, own) * V::splat(DEPENDENT);
            for b in before.chunks_exact(seen) {
                take(own, dot(own, b), b);
            }
            let scale =
                dot(own, own).zip(least, |left, least| if left > least { 1.0 / left.sqrt() } else { 0.0 });
            own.iter_mut().for_each(|v| *v = *v * scale);
            let covered = dot(own, &self.slope);
            take(&mut self.slope, covered, own);
        }
    }
}
