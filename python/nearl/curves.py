"""Statistics of learning curves over seeds: interquartile mean and bootstrap band.

Source: Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class NoCommonSteps(ValueError):
    """Curves of which one ends before another begins."""


class Band(NamedTuple):
    """A curve over seeds: ``steps``, ``centre``, ``low`` and ``high``, each (n_points); ``seeds`` (n_seeds x n_points)."""

    steps: Floats
    centre: Floats
    low: Floats
    high: Floats
    seeds: Floats


def interquartile_mean(values: ArrayLike, axis: int = 0) -> Floats:
    """Mean of the middle half of the values along ``axis``.

    A quarter of the weight is cut at each end; where a quarter is not a whole number of values, the outermost that stay count in
    part. So it is the mean for one or two values, and continuous in the number cut.
    """
    x = np.sort(np.moveaxis(np.asarray(values, float), axis, 0), axis=0)
    n = len(x)
    if n == 0:
        raise ValueError("the interquartile mean of no values does not exist; give at least one")
    # Value i (sorted) covers [i, i + 1] of the axis 0..n, of which [n / 4, 3 n / 4] counts.
    edges = np.clip(np.arange(n + 1), n / 4, 3 * n / 4)
    weight = np.diff(edges) / (n / 2)
    return np.tensordot(weight, x, axes=1)


def bootstrap_band(
    values: ArrayLike, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> tuple[Floats, Floats]:
    """Percentile bootstrap interval of the interquartile mean over the first axis (seeds); same seed, same interval."""
    x = np.asarray(values, float)
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}; give a share between 0 and 1")
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(x), size=(resamples, len(x)))
    means = interquartile_mean(x[drawn], axis=1)
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail], axis=0)
    return low, high


def over_seeds(curves: Sequence[tuple[ArrayLike, ArrayLike]], points: int = 200) -> Band:
    """Curves of several seeds on common steps: from the latest start to the earliest end, where every seed has values.

    Args:
        curves: ``(steps, values)`` of each seed; points that are not finite are left out.
        points: Number of common steps.
    """
    cleaned = []
    for steps, values in curves:
        steps, values = np.asarray(steps, float), np.asarray(values, float)
        good = np.isfinite(steps) & np.isfinite(values)
        if good.any():
            cleaned.append((steps[good], values[good]))
    if not cleaned:
        raise ValueError("no curve has a finite point")
    start, end = max(s[0] for s, _ in cleaned), min(s[-1] for s, _ in cleaned)
    if end < start:
        raise NoCommonSteps(f"the curves have no steps in common: one begins at {start:g}, another ends at {end:g}")
    grid = np.linspace(start, end, points)
    seeds = np.stack([np.interp(grid, s, v) for s, v in cleaned])
    centre = interquartile_mean(seeds)
    low, high = bootstrap_band(seeds) if len(seeds) > 1 else (centre, centre)
    return Band(grid, centre, low, high, seeds)


def smooth(values: ArrayLike, window: int) -> Floats:
    """Running mean over up to ``window`` points before and including each."""
    x = np.asarray(values, float)
    sums = np.concatenate([[0.0], np.cumsum(x)])
    ends = np.arange(1, len(x) + 1)
    starts = np.maximum(0, ends - max(1, window))
    return (sums[ends] - sums[starts]) / (ends - starts)
