//! The value network V(s), in a parameter group of its own.

use super::gaussian::{gather, gather_one, heads, set_heads};
use super::init;
use super::losses::{in_parts, widths};
use super::net::{Net, Tape};
use super::nets::NetSettings;
use super::optimise::{Group, Rows, TILE, Tile, add_sums};
use super::ppo::PpoSettings;
use super::{Batch, Dims};
use nearl_runtime::multiversion;
use nearl_runtime::net::kernel::{LANES, V, ZERO};
use rand_chacha::ChaCha8Rng;

/// The network, and the weight of its loss.
pub(super) struct Value {
    pub(super) net: Net,
    /// Vectors of its parameters.
    pub(super) len: usize,
    /// Entries that it sees, the privileged ones included.
    n_obs: usize,
    weight: f32,
    /// Furthest step from what it was; 0: any.
    clip: f32,
}

/// Buffers of one thread.
pub(super) struct ValueScratch {
    tape: Tape,
    obs: Vec<V>,
    slope: Vec<V>,
    rows: [Vec<V>; 4],
}

impl Value {
    /// A fresh network and its parameter group.
    pub(super) fn new(
        dims: &Dims,
        nets: &NetSettings,
        ppo: &PpoSettings,
        rng: &mut ChaCha8Rng,
    ) -> (Self, Group) {
        let (mut at, mut transposed) = (0, 0);
        let net = Net::new(
            &widths(dims.n_obs + dims.n_privileged, &nets.value, 1),
            nets.activation,
            0,
            &mut at,
            &mut transposed,
        );
        let mut group = Group { p: vec![ZERO; at], transposed: vec![ZERO; transposed] };
        net.mlp.write_dense(&init::orthogonal(&net.mlp.widths(), 1.0, rng), &mut group.p);
        let value = Self {
            net,
            len: at,
            n_obs: dims.n_obs + dims.n_privileged,
            weight: ppo.vf_coef,
            clip: ppo.clip_value,
        };
        value.refresh(&mut group);
        (value, group)
    }

    /// Refreshes the transposed weights.
    pub(super) fn refresh(&self, group: &mut Group) {
        self.net.transpose(&group.p, &mut group.transposed);
    }

    /// Buffers for a tile.
    pub(super) fn scratch(&self) -> ValueScratch {
        ValueScratch {
            tape: self.net.tape(TILE),
            obs: vec![ZERO; TILE * self.n_obs.div_ceil(LANES)],
            slope: vec![ZERO; TILE],
            rows: std::array::from_fn(|_| vec![ZERO; TILE / LANES]),
        }
    }

    /// The rows that [`Value::tile`] reads.
    pub(super) fn rows<'b>(&self, batch: &'b Batch) -> Vec<Rows<'b>> {
        vec![Rows::new(batch.of_value(), self.n_obs)]
    }

    /// Squared error from the returns; its sum over rows is the tile's first sum.
    pub(super) fn tile(&self, group: &Group, t: &Tile<'_>, w: &mut ValueScratch, grad: &mut [V]) {
        squared_error(self, group, t, w, grad);
    }

    /// Value of each row of `x` (n x n_obs).
    pub(super) fn of(&self, group: &Group, x: &[f32], threads: usize) -> Vec<f32> {
        let (n_obs, vectors) = (self.n_obs, self.n_obs.div_ceil(LANES));
        let mut out = vec![0.0; x.len() / n_obs];
        in_parts(&mut out, TILE, threads, |first, out| {
            let mut w = self.scratch();
            for (start, out) in (first..).step_by(TILE).zip(out.chunks_mut(TILE)) {
                let idx: Vec<u32> = (start..start + out.len()).map(|i| i as u32).collect();
                gather(&mut w.obs, vectors, 0, x, n_obs, &idx);
                let y = self.net.forward(&group.p, &w.obs, &mut w.tape);
                out.iter_mut().zip(y).for_each(|(out, y)| *out = y.0[0]);
            }
        });
        out
    }
}

#[inline(always)]
fn body(v: &Value, group: &Group, t: &Tile<'_>, w: &mut ValueScratch, grad: &mut [V]) {
    gather(&mut w.obs, v.n_obs.div_ceil(LANES), 0, t.batch.of_value(), v.n_obs, t.idx);
    let value = v.net.forward(&group.p, &w.obs, &mut w.tape);
    let [value_of, target, slope, old] = &mut w.rows;
    heads(value_of, value);
    gather_one(target, &t.batch.returns, t.idx);
    let mut squares = ZERO;
    for i in 0..value_of.len() {
        let e = value_of[i] - target[i];
        squares = squares.fma(e, e);
        slope[i] = e * V::splat(2.0 * v.weight * t.scale);
    }
    if v.clip > 0.0 {
        hold(v.clip, value_of, target, old, t, slope);
    }
    set_heads(&mut w.slope, slope);
    v.net.backward(&group.transposed, &w.obs, &w.slope, &mut w.tape, Some(grad), false);
    add_sums(grad, &[squares.sum()]);
}
/// `max((V - R)^2, (clip(V, V_old +- range) - R)^2)`, as PPO's own code has it: no slope where the clipped error is larger.
/// What the value was is that under which advantages were estimated.
#[inline(always)]
fn hold(range: f32, value: &[V], target: &[V], old: &mut [V], t: &Tile<'_>, slope: &mut [V]) {
    gather_one(old, &t.batch.value, t.idx);
    for i in 0..value.len() {
        for l in 0..LANES {
            let (v, r) = (value[i].0[l], target[i].0[l]);
            let before = old[i].0[l];
            let held = v.clamp(before - range, before + range);
            if (held - r).abs() > (v - r).abs() {
                slope[i].0[l] = 0.0;
            }
        }
    }
}

multiversion!(fn squared_error(v: &Value, group: &Group, t: &Tile<'_>, w: &mut ValueScratch, grad: &mut [V]) = body);
