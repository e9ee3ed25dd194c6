//! What the losses of every algorithm share beside their Gaussians: advantages, entropy, sizes.

use super::gaussian::gather_one;
use super::optimise::Tile;
use nearl_runtime::net::kernel::{V, scalars_mut};

/// `widths` of a network from its ends and the hidden widths.
pub(super) fn widths(n_in: usize, hidden: &[usize], n_out: usize) -> Vec<usize> {
    [&[n_in], hidden, &[n_out]].concat()
}

/// The first `n` lanes of `p`.
pub(super) fn set_lanes(p: &mut [V], n: usize, value: f32) {
    scalars_mut(p)[..n].fill(value);
}

/// Mean standard deviation.
pub(super) fn mean_std(log_std: &[f32]) -> f64 {
    log_std.iter().map(|l| f64::from(l.exp())).sum::<f64>() / log_std.len().max(1) as f64
}

/// Tiles that one thread has done before another one has started.
const FEW_TILES: usize = 64;

/// Runs `f(first, part)` over `out` cut into parts of whole tiles of `tile` entries, a thread each: every entry must
/// depend on its own place alone.
pub(super) fn in_parts<T: Send>(
    out: &mut [T],
    tile: usize,
    threads: usize,
    f: impl Fn(usize, &mut [T]) + Sync,
) {
    let tiles = out.len().div_ceil(tile);
    let size = tiles.div_ceil(threads.max(1)).max(FEW_TILES) * tile;
    std::thread::scope(|scope| {
        let mut parts = out.chunks_mut(size).enumerate();
        let own = parts.next();
        for (k, part) in parts {
            let f = &f;
            scope.spawn(move || f(k * size, part));
        }
        if let Some((_, part)) = own {
            f(0, part);
        }
    });
}

/// Normalised advantages of the rows.
#[inline(always)]
pub(super) fn gather_advantage(to: &mut [V], t: &Tile<'_>) {
    gather_one(to, &t.batch.advantage, t.idx);
    let (mean, inverse) = t.advantage;
    for a in to {
        *a = (*a - V::splat(mean)) * V::splat(inverse);
    }
}

/// Entropy of a diagonal Gaussian is the sum of its log standard deviations plus a constant.
#[inline(always)]
pub(super) fn entropy_bonus(grad: &mut [V], n: usize, weight: f32) {
    for g in &mut scalars_mut(grad)[..n] {
        *g -= weight;
    }
}
