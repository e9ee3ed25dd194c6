"""The layers of a network, with what follows each, in the order in which they run."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from nearl.importers.modules import EXPORT

Layer = tuple[np.ndarray, np.ndarray, str]
# What follows a layer, by the name of the module's class.
_FUNCTIONS = {"Identity": "identity", "Tanh": "tanh", "ReLU": "relu", "SiLU": "silu", "Sigmoid": "sigmoid", "ELU": "elu", "Softplus": "softplus"}
# Modules that do nothing when a policy acts.
_NOTHING = ("Identity", "Flatten", "Dropout", "FlattenExtractor")


def layers_of(modules: Iterable[tuple[str, Any]]) -> list[Layer]:
    """The linear layers of named modules with what follows each, in the order in which a Sequential runs them."""
    layers: list[Layer] = []
    for name, part in (flat for named in modules for flat in parts_in_order(*named)):
        kind = type(part).__name__
        if kind == "Linear":
            weight = finite_array(part.weight, f"{name}.weight".lstrip("."))
            bias = np.zeros(len(weight)) if part.bias is None else finite_array(part.bias, f"{name}.bias".lstrip("."))
            layers.append((weight, bias, "identity"))
        elif kind in _NOTHING:
            continue
        elif kind in _FUNCTIONS:
            if getattr(part, "alpha", 1.0) != 1.0 or getattr(part, "beta", 1.0) != 1.0:
                raise ValueError(f"module {part} has another alpha or beta than 1, which is not known; train it with 1")
            if not layers:
                raise ValueError(f"module {part} stands before the first linear layer; give the policy's network alone")
            layers = followed_by(layers, _FUNCTIONS[kind])
        elif kind == "Hardtanh" and layers:
            layers = _clipped(layers, float(part.min_val), float(part.max_val))
        else:
            known = ", ".join(["Linear", "Hardtanh", *(name for name in _FUNCTIONS if name != "Identity"), *_NOTHING])
            raise ValueError(
                f"module {kind} is none that a policy's layers consist of ({known}); let your own program compute the policy and propose beside the "
                "loop (docs/POLICIES.md, nearl.Proposer), or put nearl.Guard around the environment"
            )
    return layers


def followed_by(layers: list[Layer], function: str) -> list[Layer]:
    """The same with a function after the last of them."""
    *before, (weight, bias, last) = layers
    if last == "identity":
        return [*before, (weight, bias, function)]
    return [*layers, (np.eye(len(bias)), np.zeros(len(bias)), function)]


def _clipped(layers: list[Layer], low: float, high: float) -> list[Layer]:
    """The same with each output cut to a range: ``clip(x) = low + relu(x - low) - relu(x - high)``."""
    n = len(layers[-1][1])
    both = np.vstack([np.eye(n), np.eye(n)]), np.repeat([-low, -high], n), "relu"
    return [*layers, both, (np.hstack([np.eye(n), -np.eye(n)]), np.full(n, low), "identity")]


def parts_in_order(name: str, module: Any) -> Iterable[tuple[str, Any]]:
    """Parts in order, by the names that torch has for them. Only a Sequential says in which order its parts run."""
    kind = type(module).__name__
    check_hooks(name, module)
    if kind == "Sequential" or isinstance(module, list | tuple) or (kind == "MLP" and hasattr(module, "__iter__")):
        for i, part in enumerate(module):
            yield from parts_in_order(f"{name}.{i}".lstrip("."), part)
    else:
        yield name, module


def check_hooks(name: str, module: Any) -> None:
    for hooks in ("_forward_pre_hooks", "_forward_hooks"):
        for hook in (getattr(module, hooks, None) or {}).values():
            said = getattr(hook, "__name__", type(hook).__name__)
            raise ValueError(
                f"module {name or type(module).__name__} ({type(module).__name__}) has a hook at its forward ({said}), which is code and not read; remove it "
                f"(handle.remove(), torch.nn.utils.remove_weight_norm), or {EXPORT}"
            )


def finite_array(value: Any, name: str) -> np.ndarray:
    """A tensor of the module by its name, all of it finite."""
    numbers = as_array(value, name)
    if not np.isfinite(numbers).all():
        at = tuple(int(i) for i in np.argwhere(~np.isfinite(numbers))[0])
        raise ValueError(f"the module's tensor '{name}' is {numbers[at]} at {list(at)}; the training diverged: give the network of an earlier checkpoint")
    return numbers


def as_array(value: Any, name: str) -> np.ndarray:
    """A tensor of torch, or anything NumPy accepts, as an array."""
    for step in ("detach", "cpu", "numpy"):
        if step == "numpy" and str(getattr(value, "dtype", "")) == "torch.bfloat16":
            value = value.float()  # which NumPy has not
        if hasattr(value, step):
            value = getattr(value, step)()
    if np.iscomplexobj(value):
        raise ValueError(f"{name} holds complex numbers, and the layers of a policy are real; give a network of real numbers")
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is of {type(value).__name__} and holds what is no number; give an array of numbers") from None
