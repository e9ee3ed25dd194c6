"""Mean and standard deviation of observations, and the ranges of inputs and outputs, as they were given."""

import math
from typing import Any

import numpy as np

from nearl._core import Policy
from nearl.importers.layers import Layer, as_array

NO_LAYER = "the module has no linear layer; give the policy's network"


def policy_of(layers: list[Layer], mean: Any, std: Any, clip: float, output_clip: tuple[Any, Any]) -> Policy:
    if not layers:
        raise ValueError(NO_LAYER)
    mean, std = moments_of(mean, std, np.shape(layers[0][0])[1])
    return Policy.from_layers(layers, mean, std, (-clip, clip), output_clip)


def moments_of(mean: Any, std: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    mean = np.zeros(size) if mean is None else as_array(mean, "mean").ravel()
    std = np.ones(size) if std is None else as_array(std, "std").ravel()
    for name, values, is_good, give in (("mean", mean, np.isfinite(mean), "finite numbers"), ("std", std, np.isfinite(std) & (std > 0), "numbers above 0")):
        if len(bad := np.flatnonzero(~is_good)):
            raise ValueError(f"{name}[{bad[0]}] of the observation is {values[bad[0]]:g}; give {give}, one for each entry")
    return mean, std


def clip_of(clip: Any) -> float:
    try:
        number = math.nan if isinstance(clip, str | bytes | bool) else float(clip)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not number > 0:
        raise ValueError(f"clip is {clip!r}; give a number above 0, the standard deviations that inputs are cut to, or leave it out")
    return number


def range_of(output_clip: Any, n: int) -> tuple[Any, Any]:
    """Both ends, each a number or an array (n)."""
    give = f"give (low, high), each a number or one for each of the {n} outputs, and low not above high"
    try:
        low, high = (as_array(end, "it") for end in output_clip)
    except (TypeError, ValueError):
        raise ValueError(f"output_clip is {output_clip!r}; {give}") from None
    for i, end in enumerate((low, high)):
        if end.shape not in ((), (n,)):
            raise ValueError(f"output_clip[{i}] has shape {end.shape}; {give}")
    for k, (a, b) in enumerate(zip(*np.broadcast_arrays(np.atleast_1d(low), np.atleast_1d(high)))):
        if not (a <= b and a < math.inf and b > -math.inf):
            raise ValueError(f"output_clip is ({a:g}, {b:g}) for output[{k}]; {give}")
    return low if low.shape else float(low), high if high.shape else float(high)
