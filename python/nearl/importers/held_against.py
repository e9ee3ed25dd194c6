"""A module held against what was read of it."""

import inspect
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from nearl._core import Policy
from nearl.importers.modules import APART, EXPORT, export_instead, held_beside, network_name
from nearl.importers.normaliser import is_normaliser
from nearl.importers.running import SAME_PART, Unreadable, lacks_forward, observations_of, rows_apart, run, ways_to_act

# What computes an action is called so.
_ACTS = re.compile(r"^(act|predict|infer|inference|sample|policy)$|^(act|predict)_|^(get|select|choose|sample|compute)_actions?(?!s?_log)|(^|_)actions?$")


def check_run(module: Any, moments: tuple[np.ndarray, np.ndarray], read: Sequence[Policy], rounding: float) -> None:
    """Holds what a module itself gives against what was ``read`` of it, of which the first is imported and the others lack what may stand around the module.
    One that has nothing to run may have nothing beside its actor that nobody knows. `rounding` is the part that the precision of what was read loses."""
    core = network_name(module)
    kind, of = type(module).__name__, f"module.{core}" if core else "its layers"
    around = f"give nearl.import_torch({of}), with mean=, std=, clip= and output_clip= for what stands around it"
    give = f"where the {core} is all of the policy, {around}; else {export_instead(module)}" if core else EXPORT
    part = max(SAME_PART, rounding)
    for way, function in ways_to_act(module):
        if way == "forward" and lacks_forward(module):
            continue
        try:
            seen, given, again = run(module, function, observations_of(*moments), (read[0].n_out,))
        except Unreadable as error:
            raise ValueError(f"module {kind} gives what nobody can hold {of} against: its {way} gives {error}; {give}") from None
        except Exception as error:
            said = " ".join(str(error).split()) or "no reason given"
            raise ValueError(
                f"module {kind} cannot be run on observations of {read[0].n_in} entries ({way}: {type(error).__name__}: {said[:200]}), so nobody knows "
                f"whether it does more than {of}; {give}"
            ) from None
        if not np.array_equal(given, again, equal_nan=True):
            why = f"{way}: it draws, or remembers"
            raise ValueError(f"module {kind} gives two outputs for the same observation ({why}), so nobody can hold {of} against it; {give}")
        wanted = None
        for policy in read:
            found = np.stack([policy(obs) for obs in seen])
            wanted = found if wanted is None else wanted
            if rows_apart(given, found, part) is None:
                return
        assert wanted is not None
        row = rows_apart(given, wanted, part)
        assert row is not None
        off = np.abs(given[row] - wanted[row])
        i, k = np.unravel_index(np.argmax(np.where(np.isnan(off), np.inf, off)), off.shape)
        raise ValueError(
            f"module {kind} does more than {of}: its {way} gives {given[row][i, k]:.4g} as output[{k}] where the layers that are read give "
            f"{wanted[row][i, k]:.4g}, off by {off[i, k]:.3g} on the same observation; {give}"
        )
    if core:
        _check_apart(module, core, give)


def _check_apart(module: Any, core: str, give: str) -> None:
    """Refuses parts, tensors and functions beside an actor that may have a part in the action, where the module cannot be asked."""
    functions = {name: getattr(type(module), name, None) for name in dir(type(module))} | getattr(module, "__dict__", {})
    if acts := sorted(name for name, of in functions.items() if inspect.isroutine(of) and _ACTS.search(name)):
        said = f"its own {', '.join(acts)} {'is' if len(acts) == 1 else 'are'} not read"
        raise ValueError(
            f"module {type(module).__name__} has neither forward nor act_inference, and {said}, so nobody knows whether the action is what module.{core} "
            f"gives; {give}"
        )
    for name, of in held_beside(module).items():
        is_part = any(hasattr(of, what) for what in ("named_children", "forward", "detach")) or isinstance(of, np.ndarray)
        if is_part and not APART.search(name) and not is_normaliser(name, of):
            said = f"module {type(module).__name__} has {name} ({type(of).__name__}) beside its {core}"
            raise ValueError(f"{said}, and no forward that tells whether the action depends on it; {give}")
