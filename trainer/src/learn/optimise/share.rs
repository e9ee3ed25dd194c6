//! Shards of a minibatch among the ranks of a training: rank `r` of `n` computes the shards `s` with `s mod n = r`.

use super::{Params, Phases, Run};
use nearl_runtime::net::kernel::{V, ZERO, scalars, scalars_mut};
use std::sync::PoisonError;

impl<P: Phases> Run<'_, P> {
    /// Shards that a thread of this rank computes.
    pub(super) fn own(&self, thread: usize) -> impl Iterator<Item = usize> + use<P> {
        (self.rank + self.n_ranks * thread..self.shards).step_by(self.n_ranks * self.threads)
    }

    /// Shards that a thread computes in place of ranks that are lost.
    pub(super) fn missing(&self, thread: usize) -> impl Iterator<Item = usize> + use<P> {
        let (rank, n_ranks, threads) = (self.rank, self.n_ranks, self.threads);
        let missing = (0..self.shards).filter(move |s| s % n_ranks != rank);
        missing.enumerate().filter_map(move |(i, s)| (i % threads == thread).then_some(s))
    }

    /// Whether another rank is lost, as it was at the last [`Run::share`].
    pub(super) fn is_alone(&self) -> bool {
        self.ranks.as_ref().is_some_and(|ranks| ranks.lost().is_some())
    }

    /// Hands the gradients of this rank's shards of the phase at `k` to the others, and takes in theirs.
    pub(super) fn share(&self, k: usize, odd: usize, params: &Params) {
        let Some(ranks) = &self.ranks else { return };
        let (range, last) = (self.algorithm.range(self.phases[k]), params.groups[self.group(k)].p.len());
        let longest = self.shards.div_ceil(self.n_ranks);
        let mut mine = Vec::with_capacity(longest * (range.len() + 1) * size_of::<V>());
        let put = |vectors: &[V], to: &mut Vec<u8>| {
            to.extend(scalars(vectors).iter().flat_map(|x| x.to_le_bytes()));
        };
        for s in (self.rank..self.shards).step_by(self.n_ranks) {
            let gradient = self.gradients[s][odd].read().unwrap_or_else(PoisonError::into_inner);
            put(&gradient[range.clone()], &mut mine);
            put(&gradient[last..=last], &mut mine);
        }
        // every rank hands in as much as the one with the most shards
        let empty = longest - (self.rank..self.shards).step_by(self.n_ranks).len();
        put(&vec![ZERO; empty * (range.len() + 1)], &mut mine);
        let Some(all) = ranks.even(&mine) else { return };
        for (rank, part) in all.chunks_exact(mine.len()).enumerate().filter(|(rank, _)| *rank != self.rank) {
            let shards = (rank..self.shards).step_by(self.n_ranks);
            for (s, bytes) in shards.zip(part.chunks_exact((range.len() + 1) * size_of::<V>())) {
                let mut gradient = self.gradients[s][odd].write().unwrap_or_else(PoisonError::into_inner);
                let (numbers, sums) = bytes.split_at(range.len() * size_of::<V>());
                take(numbers, &mut gradient[range.clone()]);
                take(sums, &mut gradient[last..=last]);
            }
        }
    }
}

fn take(bytes: &[u8], to: &mut [V]) {
    for (x, bytes) in scalars_mut(to).iter_mut().zip(bytes.as_chunks().0) {
        *x = f32::from_le_bytes(*bytes);
    }
}
