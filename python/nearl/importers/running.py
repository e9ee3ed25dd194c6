"""A module, run as it acts and left as it was."""

import contextlib
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from nearl.importers.layers import as_array
from nearl.importers.modules import network_name

# Observations on which a module is held against what was read of it: so many of each size, in standard deviations.
_ROWS, _SIZES = 8, (1.0, 0.1, 10.0, 100.0)
# Part by which the two may differ of the largest output of observations of one size, and of all: sums in single precision.
SAME_PART, _SAME_REST = 1e-4, 1e-7
# How many roundings of one number an output of several layers may be off.
_ROUNDINGS = 12


def ways_to_act(module: Any) -> list[tuple[str, Callable[[Any], Any]]]:
    """How a module may say which action it takes, those that sample none first."""
    ways = [("act_inference", getattr(module, "act_inference", None)), ("forward", getattr(module, "forward", None))]
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(module, torch.nn.Module):
        ways[1] = ("forward", module)  # with its hooks
    return [(way, function) for way, function in ways if callable(function)]


def lacks_forward(module: Any) -> bool:
    """Whether a module of torch has none of its own; one that has one and raises in it is not without."""
    torch = sys.modules.get("torch")
    return torch is not None and getattr(module.forward, "__func__", None) is torch.nn.Module.forward


def observations_of(mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Seeded ones in single precision, of each size some."""
    z = np.random.default_rng(0).normal(size=(len(_SIZES), _ROWS, len(mean)))
    return np.asarray(mean + std * (np.array(_SIZES)[:, None, None] * z).reshape(-1, len(mean)), np.float32)


def _groups(n: int) -> list[slice]:
    """The rows of each size."""
    return [slice(at, at + _ROWS) for at in range(0, n, _ROWS)]


def rows_apart(a: np.ndarray, b: np.ndarray, part: float) -> slice | None:
    """The first group in which two outputs differ by more than rounding; None where they are the same."""
    size = np.abs(b)
    return next((rows for rows in _groups(len(a)) if not np.all(np.abs(a[rows] - b[rows]) <= part * size[rows].max() + _SAME_REST * size.max())), None)


def rounding_of(read: Iterable[Any]) -> float:
    """Part of the outputs that is lost by the precision of what was read; 0 where it is none of torch."""
    torch = sys.modules.get("torch")
    tensors = [of for part in read for table in ("parameters", "buffers") for of in getattr(part, table, list)()] if torch is not None else []
    return max((_ROUNDINGS * float(torch.finfo(of.dtype).eps) for of in tensors if of.is_floating_point()), default=0.0)  # type: ignore[union-attr]


def run(module: Any, function: Callable[[Any], Any], obs: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a function of a module saw (n x n_in), and what it gave twice (n x shape)."""
    with _acting(module) as tensor:
        groups = getattr(module, "obs_groups", None)
        names = next((groups[name] for name in ("policy", "actor") if name in groups), None) if isinstance(groups, Mapping) else groups
        given = []
        for _ in range(2):
            asked = tensor(obs)  # anew, as it may be changed in its place
            if isinstance(names, list | tuple) and names:  # rsl_rl joins the groups that its actor sees, of whatever size
                ends = [*range(len(names)), obs.shape[1]]
                asked = {name: asked[:, begin:end] for name, (begin, end) in zip(names, itertools.pairwise(ends))}
            given.append(_output(function(asked)).reshape(len(obs), *shape))
        return as_array(tensor(obs), "the observation"), given[0], given[1]


class Unreadable(ValueError):
    """What a module gave, in which nobody finds the action."""


def _output(given: Any) -> np.ndarray:
    """The action in what a module gives: the first of several things, the mean of a distribution.

    Raises:
        Unreadable: there is none, as in a distribution that has no mean, whose code may add anything to what it is made of.
    """
    try:
        if isinstance(given, tuple | list):
            given = given[0]
        if not hasattr(given, "shape") and not callable(getattr(given, "mean", print)):
            given = given.mean
        return as_array(given, "its output")
    except Exception as error:  # whatever the code of somebody else raises
        said = " ".join(str(error).split())[:200] or "no reason given"
        raise Unreadable(f"a {type(given).__name__}, of which the action cannot be read ({type(error).__name__}: {said})") from None


@contextlib.contextmanager
def _acting(module: Any) -> Iterator[Callable[[np.ndarray], Any]]:
    """A module as it is when it acts (no dropout, no statistics, no gradients), left as it was; gives what makes its input of an array."""
    torch = sys.modules.get("torch")
    held_by = [module, *vars(module).values()] if hasattr(module, "__dict__") else [module]
    modules = [of for of in held_by if torch is not None and isinstance(of, torch.nn.Module)]
    if torch is None or not modules:
        yield np.copy
        return
    parts = [(part, dict(vars(part)), dict(part._buffers)) for part in dict.fromkeys(part for of in modules for part in of.modules())]
    tensors = [(of, of.detach().clone()) for part, _, _ in parts for of in (*part._parameters.values(), *part._buffers.values()) if of is not None]
    actor = getattr(module, network_name(module) or "actor", None)
    of_actor = list(actor.parameters()) if isinstance(actor, torch.nn.Module) else []  # what is beside it may have another precision
    like = next((of for of in (*of_actor, *(of for of, _ in tensors)) if of.is_floating_point()), torch.zeros(1))
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        try:
            for part, _, _ in parts:
                part.training = False
            yield lambda obs: torch.tensor(obs).to(device=like.device, dtype=like.dtype)
        finally:
            for part, held, buffers in parts:
                for name in vars(part).keys() - held.keys():
                    del vars(part)[name]
                vars(part).update(held)
                part._buffers.update(buffers)
            for of, was in tensors:
                if not torch.equal(of, was):
                    of.copy_(was)
