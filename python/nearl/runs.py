"""Run folders of ``nearl train`` and ``nearl sweep`` as arrays."""

import csv
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Floats = NDArray[np.float64]


class ReadError(ValueError):
    """A file that is not what it was given as."""


@dataclass
class Run:
    """One training."""

    path: Path
    task: str
    algo: str
    seed: int | None
    metrics: dict[str, Floats]

    def column(self, name: str) -> tuple[Floats, Floats] | None:
        """Steps and values of a metric where it has values; None where it has none."""
        steps, values = self.metrics.get("time/total_timesteps"), self.metrics.get(name)
        if steps is None or values is None:
            return None
        good = np.isfinite(steps) & np.isfinite(values)
        return (steps[good], values[good]) if good.any() else None


def read_run(path: Path) -> Run:
    """``task.toml``, ``env.json`` and ``metrics.csv`` of a run folder; the first two may be missing."""
    file = path / "metrics.csv"
    if not file.is_file():
        raise ReadError(f"'{path}' is not a run folder: it has no metrics.csv; give a folder written by 'nearl train'")
    with file.open(newline="") as text:
        rows = list(csv.reader(text))
    if not rows or not rows[0]:
        raise ReadError(f"'{file}' is empty; the training stopped before its first update")
    header, rows = rows[0], [row for row in rows[1:] if len(row) == len(rows[0])]  # the last row may be half written
    metrics = {name: np.array([_number(row[i]) for row in rows]) for i, name in enumerate(header)}
    host = json_of(path / "env.json") if (path / "env.json").is_file() else {}
    task = path.parent.name
    if (path / "task.toml").is_file():
        task = tomllib.loads((path / "task.toml").read_text()).get("name", task)
    named = re.fullmatch(r"(.+)_(\d+)", path.name)
    algo = host.get("algo") or (named[1] if named else path.name)
    seed = host.get("seed", int(named[2]) if named else None)
    return Run(path, task or "task", algo, seed, metrics)


def demonstrations_of(path: Path) -> Path | None:
    """The file of demonstrations that a run folder learned from, as its task file says; None where there is none."""
    if not (path / "task.toml").is_file():
        return None
    task = tomllib.loads((path / "task.toml").read_text())
    file = task.get("train", {}).get("demos", {}).get("file")
    return path / file if file else None


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def json_of(path: Path) -> Any:
    """Content of a JSON file; ``ReadError`` where it is none."""
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ReadError(f"'{path}' is not JSON: {error}") from error
