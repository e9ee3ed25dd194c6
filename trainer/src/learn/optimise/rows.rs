//! Prefetches the rows of a batch: a minibatch reads them in random order, which the processor cannot predict.

use super::{Batch, Phases};
use nearl_runtime::net::kernel::LANES;

/// Rows of one array of the batch, `width` numbers each; sample `i` reads row `i + shift`, counted round.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'b> {
    values: &'b [f32],
    width: usize,
    shift: usize,
}

impl<'b> Rows<'b> {
    /// Sample `i` reads row `i`.
    pub fn new(values: &'b [f32], width: usize) -> Self {
        Self { values, width, shift: 0 }
    }

    /// Sample `i` reads row `i + shift`, counted round.
    pub fn shifted(values: &'b [f32], width: usize, shift: usize) -> Self {
        Self { values, width, shift }
    }

    fn row(&self, i: usize) -> &[f32] {
        let at = (i + self.shift) * self.width;
        let at = if at >= self.values.len() { at - self.values.len() } else { at };
        self.values.get(at..at + self.width).unwrap_or(&[])
    }
}

/// Bytes that stay in a core's cache from one pass over the batch to the next.
const CACHED: usize = 1 << 20;

/// The rows worth fetching ahead in each phase: all that `algorithm` reads, or none where they stay in the cache.
pub(super) fn scattered<'b, P: Phases>(
    algorithm: &'b P,
    phases: &[usize],
    batch: &'b Batch,
) -> Vec<Vec<Rows<'b>>> {
    let rows: Vec<Vec<Rows<'b>>> = phases.iter().map(|&phase| algorithm.rows(phase, batch)).collect();
    let bytes: usize = rows.iter().flatten().map(|r| 4 * r.width * batch.n).sum();
    if bytes > CACHED { rows } else { vec![Vec::new(); phases.len()] }
}

/// Fetches the rows of samples `idx` into the cache; only a hint, which no result depends on.
pub(super) fn prefetch(rows: &[Rows<'_>], idx: &[u32]) {
    for rows in rows {
        for &i in idx {
            let row = rows.row(i as usize);
            row.iter().step_by(LANES).chain(row.last()).for_each(touch);
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn touch(entry: &f32) {
    use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
    // SAFETY: a hint on an address of our own; nothing is read or written.
    unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(entry).cast()) }
}

#[cfg(not(target_arch = "x86_64"))]
#[inline(always)]
fn touch(_: &f32) {}
