//! What demonstrations add to PPO on actions: behaviour cloning before it, and a part in its gradient (Rajeswaran et al. 2018).
//!
//! ```text
//! g = sum_own A grad log pi(a | s) + sum_demo lambda0 lambda1^k grad log pi(a | s)
//! ```
//!
//! Divided by the rows of the batch that is `lambda0 lambda1^k (N_demo / N_own)` times the mean over the demonstrations. Each row of the
//! batch is given a row of the demonstrations at random, anew for each update, so that a minibatch estimates both means.

use super::super::gaussian::{MOST_VECTORS, gather, inverse_sigma, residuals, residuals_back};
use super::super::imitation::{Base, CLONED, Cloning, Wanted};
use super::super::inverse::gather_input;
use super::super::optimise::{Schedule, TILE, Tile, optimise};
use super::super::rescale::{Inputs, carry};
use super::super::{Batch, Metrics};
use super::{ACTOR, INVERSE, Nets, Ppo, Scratch, VALUE};
use crate::demos::DemoSettings;
use crate::learn::optimise::Params;
use nearl_runtime::net::kernel::{LANES, V, ZERO, scalars};
use nearl_runtime::normaliser::Normaliser;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Demonstrations in the policy gradient of one update.
pub(super) struct Term {
    /// Their rows, with actions.
    demos: Batch,
    /// What their mean weighs.
    pub(super) weight: f32,
    /// The row of the demonstrations that goes with each row of the batch.
    pub(super) with: Vec<u32>,
}

impl Ppo {
    /// Gives demonstrations, with actions, a part in the next update of `n` rows: each weighs `weight` of an own one.
    pub(in super::super) fn augment(&mut self, demos: Batch, weight: f64, n: usize, rng: &mut ChaCha8Rng) {
        let with = (0..n).map(|_| rng.random_range(0..demos.n as u32)).collect();
        let weight = (weight * demos.n as f64 / n as f64) as f32;
        self.nets.term = Some(Term { demos, weight, with });
    }

    /// Writes into each row the action that the inverse model infers from its transition.
    pub(in super::super) fn relabel(&self, demos: &mut Batch) {
        let (n, group) = (&self.nets, &self.params.groups[INVERSE]);
        let (a, av) = (n.dims.n_act, n.dims.n_act.div_ceil(LANES));
        let mut w = n.inverse.scratch();
        demos.action.clear();
        for start in (0..demos.n).step_by(TILE) {
            let idx: [u32; TILE] = std::array::from_fn(|k| (start + k).min(demos.n - 1) as u32);
            gather_input(&mut w.input, demos, &demos.reached, &idx, &n.dims);
            let rows = scalars(n.inverse.net.forward(&group.p, &w.input, &mut w.tape));
            let rows = rows.chunks_exact(av * LANES).take(demos.n - start);
            rows.for_each(|row| demos.action.extend_from_slice(&row[..a]));
        }
    }
}

impl Base for Ppo {
    fn learn_inverse(&mut self, batch: &Batch, rng: &mut ChaCha8Rng) -> Metrics {
        let (s, threads) = (&self.nets.settings, self.threads);
        let before = self.nets.idm_error(&self.params, batch, threads);
        let (epochs, minibatch) = (s.n_epochs, s.batch_size);
        let schedule = Schedule { epochs, minibatch, threads, rate: 1.0, clip: 1.0 };
        optimise(&self.nets, &mut self.params, batch, &[INVERSE], schedule, rng);
        let after = self.nets.idm_error(&self.params, batch, threads);
        super::super::idm_metrics(before, after, true, &batch.action, self.nets.dims.n_act)
    }

    /// The mean of the policy takes on the demonstrations' actions.
    fn clone_demos(&mut self, demos: &Batch, s: &DemoSettings, rng: &mut ChaCha8Rng) -> Metrics {
        let n = &self.nets;
        let cloning = Cloning { net: &n.policy, range: 0..n.log_std.start, wanted: Wanted::Action };
        vec![(CLONED, cloning.run(&mut self.params.groups[ACTOR], demos, s, self.threads, rng))]
    }

    fn params_mut(&mut self) -> &mut Params {
        &mut self.params
    }

    fn rescale(&mut self, from: &Normaliser, to: &Normaliser) {
        let (n, groups) = (&self.nets, &mut self.params.groups);
        let obs = Inputs::observation(from, to);
        carry(&n.policy, &mut groups[ACTOR].p, &obs, &[]);
        carry(&n.value.net, &mut groups[VALUE].p, &obs, &[]);
        let seen = Inputs::seen(from, to, &n.dims.seen_obs, &n.dims.seen_state);
        carry(&n.inverse.net, &mut groups[INVERSE].p, &seen, &[]);
        let refresh = |phase: &usize, params: &mut Params| super::Phases::refresh(n, *phase, params);
        [ACTOR, VALUE, INVERSE].iter().for_each(|phase| refresh(phase, &mut self.params));
    }
}

/// `-weight mean log pi(a | s)` over the demonstrations that go with the rows of the tile; returns its sum.
#[inline(always)]
pub(super) fn demonstrated(n: &Nets, params: &Params, t: &Tile<'_>, w: &mut Scratch, grad: &mut [V]) -> f32 {
    let Some(term) = &n.term else { return 0.0 };
    let (group, o, a) = (&params.groups[ACTOR], n.dims.n_obs, n.dims.n_act);
    let mut idx = [0u32; TILE];
    idx.iter_mut().zip(t.idx).for_each(|(to, &i)| *to = term.with[i as usize]);
    gather(&mut w.obs, o.div_ceil(LANES), 0, &term.demos.obs, o, &idx);
    gather(&mut w.action, a.div_ceil(LANES), 0, &term.demos.action, a, &idx);
    let mut inverse = [ZERO; MOST_VECTORS];
    let inverse = &mut inverse[..n.log_std.len()];
    let constant = inverse_sigma(inverse, &group.p[n.log_std.clone()], a);
    let [log_prob, ..] = &mut w.rows;
    log_prob.fill(V::splat(constant as f32));
    let mean = n.policy.forward(&group.p, &w.obs, &mut w.policy);
    residuals(&mut w.d_action, &w.action, mean, inverse, log_prob);
    let sum: f32 = scalars(log_prob).iter().sum();
    log_prob.fill(V::splat(-term.weight * t.scale));
    residuals_back(&mut w.d_action, inverse, log_prob, Some(&mut grad[n.log_std.clone()]), a);
    n.policy.backward(&group.transposed, &w.obs, &w.d_action, &mut w.policy, Some(grad), false);
    -term.weight * sum
}
