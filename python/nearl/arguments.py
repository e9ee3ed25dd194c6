"""What a caller hands over, before Rust sees it: whole numbers, arrays, lists of names and functions, each refused in one sentence."""

import inspect
import operator
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_SEED = 2**64 - 1
MOST_ENTRIES = 2**32 - 1


def whole(name: str, value: Any, least: int, give: str, most: int | None = None) -> int:
    """``value`` as an integer; ``2e5`` is one, ``"200k"`` and ``None`` are none.

    Raises:
        ValueError: it is no whole number, below ``least`` or above ``most``; ``give`` says what to do.
    """
    if isinstance(value, float):
        if not value.is_integer():
            raise ValueError(f"{name} is {value!r}, no whole number; {give}")
        value = int(value)
    try:
        number = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} is {value!r}; {give}") from None
    if number < least or (most is not None and number > most):
        raise ValueError(f"{name} is {number}; {give}")
    return number


def numbers(name: str, value: Any) -> NDArray[np.float64]:
    """``value`` as an array of real numbers.

    Raises:
        ValueError: it holds anything else, complex numbers among it, whose imaginary part NumPy would drop.
    """
    try:
        if not np.iscomplexobj(value):
            return np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        check_numbers(name, value)
        raise ValueError(f"{name} is not an array of numbers but {type(value)}; pass a NumPy array") from None
    raise ValueError(f"{name} holds complex numbers, and a robot has none; give real ones, e.g. {name}.real")


def check_numbers(name: str, value: Any, called: Sequence[str] = ()) -> None:
    """Refuses a list in which an entry is no number; ``called`` are names of its entries.

    Raises:
        ValueError: it holds one, by its place.
    """
    for i, entry in enumerate(value if isinstance(value, list | tuple) else ()):
        place = f"{name}[{i}]" + (f" ('{called[i]}')" if i < len(called) else "")
        if isinstance(entry, list | tuple):
            check_numbers(place, entry)
        elif isinstance(entry, str | bytes) or entry is None:
            raise ValueError(f"{place} is {entry!r}; give a number")


def names_of(what: str, value: Any) -> list[str]:
    """A list of names; a single one is refused, whose letters would be taken for names.

    Raises:
        ValueError: it is one, or holds what is none.
    """
    if isinstance(value, str):
        raise ValueError(f"{what} is {value!r}, a single name; give a list of names, e.g. [{value!r}]")
    names = list(value)
    for i, name in enumerate(names):
        if not isinstance(name, str):
            raise ValueError(f"{what}[{i}] is {name!r}; give names")
    return names


def function_of(name: str, value: Any, arguments: str) -> None:
    """Refuses what cannot be called with ``arguments``, such as ``"obs, actions, next_obs"``; None is left out.

    Raises:
        ValueError: it is no function, or one whose signature has no place for them. Where there is none to be read only the call tells.
    """
    if value is None:
        return
    if not callable(value):
        raise ValueError(f"{name} is {value!r}; give a function, {name}({arguments})")
    if (signature := _signature(value)) is None:
        return
    try:
        signature.bind(*arguments.split(", "))
    except TypeError:
        takes = signature.replace(return_annotation=inspect.Signature.empty)
        raise ValueError(f"{name} is a function of {takes} and is called with ({arguments}); give one that takes them, {name}({arguments})") from None


def unwritten(error: OSError, place: Any) -> OSError:
    """What the system said of a place to write to, as a sentence of the same type."""
    return type(error)(f"cannot write '{os.fspath(place)}': {error.strerror or error}; give another place, or make room")


def unread(error: OSError, file: Any) -> OSError:
    """What the system said of a file to read, as a sentence of the same type."""
    return type(error)(f"cannot read '{os.fspath(file)}': {error.strerror or error}; correct the path")


def _signature(function: Callable[..., Any]) -> inspect.Signature | None:
    """Of the function itself, whatever it wraps or says of itself; None where none can be had."""
    if hasattr(function, "__signature__"):
        return None
    try:
        return inspect.signature(function, follow_wrapped=False)
    except (NameError, TypeError, ValueError):
        return None


def seed_of(value: Any, n: int = 1, name: str = "seed") -> int:
    """A seed of which ``n`` streams follow, ``seed + i``."""
    most = MOST_SEED + 1 - n
    return whole(name, value, 0, f"give a whole number from 0 to 2**64 - {n}", most)


def threads_of(value: Any) -> int:
    """Threads to work on; all cores for None."""
    if value is None:
        return os.cpu_count() or 1
    return whole("threads", value, 1, "give at least 1, or leave it out for all cores")


def path_of(name: str, value: Any, give: str = "a path") -> str:
    """``value`` as the path of a file, or a name that stands in its place.

    Raises:
        ValueError: it is none; ``give`` says what to give.
    """
    if isinstance(value, str | os.PathLike) and isinstance(path := os.fspath(value), str):
        return path
    raise ValueError(f"{name} is {value!r}; give {give}")


def task_of(value: Any) -> str:
    """The name of a task or a task file."""
    return path_of("task", value, "the name of a task, one of nearl.tasks(), or a task file")


def constraints_of(value: Any) -> str:
    """``"task"``, or a snapshot file; of a run folder the newest one, as ``nearl eval`` and ``nearl run`` take it."""
    path = path_of("constraints", value, "'task', a run folder of a training, or a snapshot file")
    if path == "task" or not os.path.isdir(path):
        return path
    for name in ("final", "latest"):
        if os.path.isfile(file := os.path.join(path, "checkpoints", f"{name}.safetensors")):
            return file
    raise ValueError(
        f"constraints is '{path}', a folder without checkpoints/final.safetensors or latest.safetensors; give a run folder of a training, or a snapshot file"
    )
