"""What a caller hands over, before Rust sees it: whole numbers, each refused in one sentence."""

import operator
import os
from typing import Any

MOST_SEED = 2**64 - 1


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


def seed_of(value: Any, n: int = 1, name: str = "seed") -> int:
    """A seed of which ``n`` streams follow, ``seed + i``."""
    most = MOST_SEED + 1 - n
    return whole(name, value, 0, f"give a whole number from 0 to 2**64 - {n}", most)


def threads_of(value: Any) -> int:
    """Threads to work on; all cores for None."""
    if value is None:
        return os.cpu_count() or 1
    return whole("threads", value, 1, "give at least 1, or leave it out for all cores")


def constraints_of(value: Any) -> str:
    """``"task"``, or a snapshot file; of a run folder the newest one, as ``nearl eval`` and ``nearl run`` take it."""
    path = os.fspath(value)
    if path == "task" or not os.path.isdir(path):
        return path
    for name in ("final", "latest"):
        if os.path.isfile(file := os.path.join(path, "checkpoints", f"{name}.safetensors")):
            return file
    raise ValueError(
        f"constraints is '{path}', a folder without checkpoints/final.safetensors or latest.safetensors; give a run folder of a training, or a snapshot file"
    )
