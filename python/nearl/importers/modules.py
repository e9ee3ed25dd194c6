"""What a module of somebody else is: its network, what it holds beside it, and what to do where it is not read."""

import os
import re
from collections.abc import Mapping
from typing import Any

# What works in the place of code, which is not read.
EXPORT = "export it, torch.onnx.export(module, (torch.zeros(1, n),), 'policy.onnx') with n inputs, and import that file (nearl.import_onnx, `nearl import`)"
# What of a module has no part in the action that its actor puts out: what judges, and what explores.
APART = re.compile(r"critic|value|return|reward|advantage|cost|(^|_)q\d*(_|$)|target|std|sigma|alpha|temperature|entropy|dist|discrim|memory_c", re.IGNORECASE)


def network_name(module: Any) -> str:
    """Name of the part of a module that is its network: its actor, or the mlp of a model of rsl_rl; empty where it is the network."""
    if hasattr(module, "actor"):
        return "actor"
    return "mlp" if is_model(module) else ""


def is_model(module: Any) -> bool:
    """Whether it is a model of rsl_rl, itself or as it exports it (as_onnx, as_jit): a normaliser, or an Identity in its place, and the network."""
    return hasattr(module, "obs_normalizer") and hasattr(module, "mlp")


def export_instead(module: Any, name: str = "module") -> str:
    """What works in the place of a module that is not read; a model of rsl_rl takes no tensor, and what it makes of itself for that does."""
    if not hasattr(module, "as_onnx"):
        return EXPORT
    return EXPORT.replace("(module,", f"({name}.as_onnx(False),").replace("'policy.onnx')", "'policy.onnx', dynamo=False)")


def held_beside(module: Any) -> dict[str, Any]:
    """What a module holds beside its actor, by name: parts, tensors and other objects, but no settings."""
    core, held = network_name(module), dict(getattr(module, "__dict__", {}))
    for table in ("_parameters", "_buffers", "_modules"):
        held |= held.pop(table, None) or {}
    held |= dict(getattr(module, "named_children", dict)())
    return {
        name: of
        for name, of in held.items()
        if of is not getattr(module, core)
        and not (of is None or isinstance(of, bool | int | float | str | type) or type(of).__name__ == "Identity")
        and not (isinstance(of, Mapping) and "mean" not in of)
    }


def check_live(model: Any, name: str, loader: str) -> None:
    """Refuses a file in the place of what a library makes of it."""
    if isinstance(model, str | os.PathLike):
        file = os.fspath(model)
        raise ValueError(
            f"'{file}' is a file, and files of PyTorch and Stable-Baselines3 are pickles, which are never opened here; load it with the library that wrote it, "
            f"e.g. {loader}({file!r}), and give nearl.{name} what it returns"
        )
    if isinstance(model, Mapping):
        raise ValueError(
            f"a table of weights (state_dict) does not say in which order layers run and what follows them; load it into the network it is of, "
            f"network.load_state_dict(...), and give nearl.{name} that"
        )
