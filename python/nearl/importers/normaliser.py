"""What normalises observations beside an actor."""

import re
from typing import Any

import numpy as np

from nearl.importers.layers import as_array, check_hooks, finite_array
from nearl.importers.modules import APART, EXPORT, export_instead, held_beside, network_name
from nearl.importers.running import SAME_PART, observations_of, rounding_of, rows_apart, run, ways_to_act

# What normalises observations is called so, itself or by its class; a normal distribution is not.
_NORMALISES = re.compile(
    r"norm(?!al(_|$|param|dist|tanh))|(^|_|obs)rms|running_?(mean|var|std)|standardi[sz]|whiten|scaler|"
    r"(obs|observations?|states?|inputs?)_(mean|std|var|loc|scale|shift|offset|stat)",
    re.IGNORECASE,
)


def moments_of_normaliser(module: Any, mean: Any, std: Any) -> tuple[Any, Any]:
    """Mean and standard deviation of what normalises observations beside an actor; what is not read exactly is refused, unless they are given."""
    if mean is not None or std is not None:
        return mean, std
    found = normalisers_beside(module)
    if not found:
        return None, None
    name, normaliser = next(iter(found.items()))
    kind, ways = type(normaliser).__name__, f"give mean= and std= where it computes (observation - mean) / std; else {export_instead(module)}"
    said = f"module {type(module).__name__} has {name} ({kind}) beside its {network_name(module)}"
    if len(found) > 1:
        raise ValueError(f"{said}, and {', '.join(list(found)[1:])}, of which nobody knows which one is meant; {ways}")
    check_hooks(name, normaliser)
    if all(hasattr(normaliser, of) for of in ("_mean", "_std", "eps")):  # of rsl_rl: (x - mean) / (std + eps)
        moments = normaliser._mean, as_array(normaliser._std, f"{name}._std") + float(normaliser.eps)
    elif kind == "BatchNorm1d" and normaliser.running_mean is not None:
        if normaliser.training:
            raise ValueError(f"{said}, which takes mean and standard deviation from each batch while it learns; call module.eval() first")
        moments = _of_batches(name, normaliser)
    else:
        raise ValueError(f"{said}, which is not read; {ways}")
    mean, std = (as_array(of, name).ravel() for of in moments)
    forward = dict(ways_to_act(normaliser)).get("forward")
    if forward is not None and np.isfinite(mean).all() and np.all(std > 0):
        try:
            seen, given, _ = run(normaliser, forward, observations_of(mean, std), mean.shape)
            is_read = rows_apart(given, (seen - mean) / std, max(SAME_PART, rounding_of([normaliser]))) is None
        except Exception:  # whatever the code of somebody else raises
            is_read = False
        if not is_read:
            raise ValueError(f"{said}, which computes something else than (observation - mean) / (std + eps) and is not read; {ways}")
    return mean, std


def normalisers_beside(module: Any) -> dict[str, Any]:
    """What normalises observations beside an actor, by name."""
    return {name: of for name, of in held_beside(module).items() if is_normaliser(name, of)}


def is_normaliser(name: str, of: Any) -> bool:
    return not APART.search(name.replace("std", "")) and any(_NORMALISES.search(said) for said in (name, type(of).__name__))


def _of_batches(name: str, norm: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of ``weight (x - mean) / sqrt(var + eps) + bias``."""
    mean, var = finite_array(norm.running_mean, f"{name}.running_mean"), finite_array(norm.running_var, f"{name}.running_var")
    std = np.sqrt(var + float(norm.eps))
    if norm.weight is None:
        return mean, std
    weight, bias = finite_array(norm.weight, f"{name}.weight"), finite_array(norm.bias, f"{name}.bias")
    if not np.all(weight > 0):
        at = int(np.flatnonzero(weight <= 0)[0])
        raise ValueError(f"the module's tensor '{name}.weight' is {weight[at]:g} at [{at}], and a standard deviation is above 0; {EXPORT}")
    return mean - bias * std / weight, std / weight
