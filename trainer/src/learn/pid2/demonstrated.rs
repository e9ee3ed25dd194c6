//! What demonstrations add to PID^2: behaviour cloning before it, and a part of what the discriminator takes for real.
//!
//! Its real set is own and demonstrated transitions in equal parts: each row of the batch is left as it is or exchanged for a
//! demonstrated one, by a coin, anew for each update. What it sees beside a row is the proposal for that row's own state, `(s_demo,
//! pi(s_demo))` where it is demonstrated; otherwise the states alone would tell both apart, and nothing would be learned about `s'`.

use super::super::imitation::{Base, CLONED, Cloning, Wanted};
use super::super::inverse::CLIP;
use super::super::optimise::{Group, Params, Schedule, Tile, optimise};
use super::super::{Batch, Metrics};
use super::{ACTOR, COMBINED, CRITIC, DISCRIMINATOR, INVERSE, Nets, Phases, Pid2, VALUE};
use crate::demos::DemoSettings;
use nearl_runtime::normaliser::Normaliser;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

impl Nets {
    /// The rows that the adversary sees in place of those of the batch.
    pub(super) fn shown<'a>(&'a self, t: Tile<'a>) -> Tile<'a> {
        match &self.union {
            Some(union) => Tile { batch: union, ..t },
            None => t,
        }
    }

    /// New proposals for what the discriminator sees.
    pub(super) fn renew(&mut self, group: &Group, own: &Batch, threads: usize, rng: &mut ChaCha8Rng) {
        let Self { fakes, combined, union, .. } = self;
        fakes.renew(combined, group, union.as_ref().unwrap_or(own), threads, rng);
    }
}

impl Pid2 {
    /// Lets the discriminator take `demos` for real beside `own` in the next update.
    pub(in super::super) fn unite(&mut self, own: &Batch, demos: &Batch, rng: &mut ChaCha8Rng) {
        let (o, s) = (self.nets.combined.dims.n_obs, self.nets.combined.dims.n_state);
        let mut union = Batch { n: own.n, ..Batch::default() };
        for i in 0..own.n {
            let is_demo: bool = rng.random();
            let (from, k) = if is_demo { (demos, rng.random_range(0..demos.n)) } else { (own, i) };
            union.obs.extend_from_slice(&from.obs[k * o..][..o]);
            union.reached.extend_from_slice(&from.reached[k * s..][..s]);
            for (to, own, free) in
                [(&mut union.lower, &own.lower, -CLIP), (&mut union.upper, &own.upper, CLIP)]
            {
                match is_demo {
                    true => to.extend(std::iter::repeat_n(free, s)),
                    false => to.extend_from_slice(&own[i * s..][..s]),
                }
            }
        }
        self.nets.union = Some(union);
    }
}

impl Base for Pid2 {
    /// The meta policy takes on the demonstrated changes.
    fn clone_demos(&mut self, demos: &Batch, s: &DemoSettings, rng: &mut ChaCha8Rng) -> Metrics {
        let (c, group) = (&self.nets.combined, &mut self.params.groups[COMBINED]);
        assert!(c.coordinates.is_none(), "a policy that clones puts out a proposal");
        let cloning = Cloning { net: &c.policy, range: c.policy_range.clone(), wanted: Wanted::Change };
        vec![(CLONED, cloning.run(group, demos, s, self.threads, rng))]
    }

    /// Whatever the threshold of the inverse model.
    fn learn_inverse(&mut self, batch: &Batch, rng: &mut ChaCha8Rng) -> Metrics {
        let (c, threads) = (&self.nets.combined, self.threads);
        let before = c.idm_error(self.actor(), batch, threads);
        if before.is_some() {
            let (epochs, minibatch) = (c.ppo.n_epochs, c.ppo.batch_size);
            let schedule = Schedule { epochs, minibatch, threads, rate: 1.0, clip: 1.0 };
            optimise(&self.nets, &mut self.params, batch, &[INVERSE], schedule, rng);
        }
        let after = self.nets.combined.idm_error(self.actor(), batch, threads);
        super::super::idm_metrics(before, after, true, &batch.action, self.nets.combined.dims.n_act)
    }

    fn params_mut(&mut self) -> &mut Params {
        &mut self.params
    }

    /// All but the discriminator, which learns anew in each update.
    fn rescale(&mut self, from: &Normaliser, to: &Normaliser) {
        let groups = &mut self.params.groups;
        let (actor, rest) = groups.split_at_mut(CRITIC);
        self.nets.combined.rescale(&mut actor[COMBINED], &mut rest[0], from, to);
        for phase in [ACTOR, VALUE, DISCRIMINATOR] {
            self.nets.refresh(phase, &mut self.params);
        }
    }
}
