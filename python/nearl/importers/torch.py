"""Policies that are modules of PyTorch."""

import math
import os
import zipfile
from typing import Any

import numpy as np

from nearl._core import Controller
from nearl.importers.held_against import check_run
from nearl.importers.layers import layers_of, parts_in_order
from nearl.importers.modules import EXPORT, check_live, export_instead, is_model, network_name
from nearl.importers.moments import NO_LAYER, clip_of, moments_of, policy_of, range_of
from nearl.importers.normaliser import moments_of_normaliser, normalisers_beside
from nearl.importers.place import Path, Recipe, place
from nearl.importers.running import rounding_of

# What works in the place of TorchScript.
_SCRIPT = (
    "of which nobody reads the layers; give nearl.import_torch the torch.nn.Sequential that it was made from, or export it, "
    "torch.onnx.export({}, (torch.zeros(1, n),), 'policy.onnx', dynamo=False) with n inputs, and import that file (nearl.import_onnx, `nearl import`)"
)


def import_torch(
    module: Any,
    robot: Path | None = None,
    recipe: Recipe = None,
    *,
    task: Path | None = None,
    actions: str = "actuators",
    mean: Any = None,
    std: Any = None,
    clip: float = math.inf,
    output_clip: tuple[float, float] = (-math.inf, math.inf),
    name: str = "policy",
) -> Controller:
    """The controller of a policy that is a ``torch.nn.Sequential`` of linear layers, or that has one as its ``actor``, or of a model of rsl_rl (``MLPModel``).

    Of a module with a ``forward`` of its own, give the Sequential inside (``module.net``) where that is all it runs; else export it with
    ``torch.onnx.export`` and read the file with :func:`import_onnx`. A module with an ``actor``, and a model, is run on some observations (``act_inference``,
    else ``forward``), and refused where that gives anything else than what was read.

    Args:
        module: The live object. What normalises observations beside its ``actor``, or a model's ``mlp``, is read with it: an ``EmpiricalNormalization``
            of rsl_rl, or a ``BatchNorm1d`` that does not learn. The ``mlp`` alone is the network without its normaliser.
        robot: URDF or MJCF file; or ``task``.
        recipe: As for :func:`import_onnx`.
        task: In place of robot and recipe, the task whose observation the policy sees: a bundled one or a TOML file.
        actions: What the policy gives in its task, as for :func:`import_onnx`.
        mean: Of each observation entry; 0 if not given.
        std: Of each observation entry, with the normaliser's epsilon; 1 if not given.
        clip: Network inputs are cut to this many standard deviations.
        output_clip: Outputs are cut to this range before scale and offset; each end is one number, or one for each output.
        name: Of the task made of robot and recipe.

    Raises:
        ValueError: a module that is no layer of a policy, by name; one that does more than its layers; or a file.
    """
    if isinstance(module, str | os.PathLike) and _is_torchscript(module):
        raise ValueError(f"'{os.fspath(module)}' is a file of TorchScript, {_SCRIPT.format(f'torch.jit.load({os.fspath(module)!r})')}")
    check_live(module, "import_torch", "torch.load")
    if type(module).__name__ == "OptimizedModule" and network_name(module):
        module = module._orig_mod  # as torch.compile wraps it
    core = network_name(module)
    if getattr(module, "is_recurrent", False) is True:
        kind = type(module).__name__
        raise ValueError(f"module {kind} is recurrent, and only networks without memory are read; train one without, and give it the history as observations")
    network = [(core, getattr(module, core))] if core else [("", module)]
    _check_order(*network[0])
    layers = layers_of(network)
    if not layers:
        raise ValueError(NO_LAYER)
    n_in, n_out = np.shape(layers[0][0])[1], len(layers[-1][1])
    bounds = clip_of(clip), range_of(output_clip, n_out)
    moments = moments_of(*(moments_of_normaliser(module, mean, std) if network[0][0] else (mean, std)), n_in)
    # Who gives a normaliser or a clip may mean one that stands around the module, or the one in it.
    normalisers = [moments, moments_of(None, None, n_in)] if mean is not None or std is not None else [moments]
    clips, ranges = dict.fromkeys((bounds[0], math.inf)), (bounds[1], (-math.inf, math.inf))
    parts = [network[0][1], *(normalisers_beside(module).values() if network[0][0] and mean is None and std is None else ())]
    check_run(module, moments, [policy_of(layers, m, s, c, o) for m, s in normalisers for c in clips for o in ranges], rounding_of(parts))
    return place(policy_of(layers, *moments, *bounds), robot, recipe, task, name, actions)


def _is_torchscript(file: Path) -> bool:
    """By the names in the archive; nothing of it is unpickled."""
    if not os.path.isfile(file) or not zipfile.is_zipfile(file):
        return False
    with zipfile.ZipFile(file) as archive:
        return any("/code/" in name for name in archive.namelist())


def _check_order(name: str, module: Any) -> None:
    """Refuses modules that run their parts in an order of their own, with what can be given in their place."""
    for at, part in parts_in_order(name, module):
        kind = type(part).__name__
        if kind.endswith("ScriptModule") or kind == "TopLevelTracedModule":
            raise ValueError(f"module {getattr(part, 'original_name', kind)} is TorchScript ({kind}), {_SCRIPT.format('module')}")
        if at and is_model(part):
            whole = f"module.{at}"
            raise ValueError(
                f"{whole} ({kind}) has a normaliser of its own, and nobody knows what else stands around it; where it is all of the policy, give "
                f"nearl.import_torch({whole}); else {export_instead(part, whole)}"
            )
        parts = list(getattr(part, "named_children", lambda: ())())
        if not parts:
            continue
        inner = [f"module.{at}.{of}".replace("..", ".") for of, child in parts if type(child).__name__ == "Sequential"]
        give = f"where that runs nothing but {' or '.join(inner)}, give nearl.import_torch this; else " if inner else ""
        raise ValueError(f"module {kind} runs its parts ({', '.join(of for of, _ in parts)}) in its own forward, which is code and not read; {give}{EXPORT}")
