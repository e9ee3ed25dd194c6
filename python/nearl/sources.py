"""What files of others hold, as arrays by name; or one sentence with the file, the place in it and what to do."""

import csv
import os
import zipfile
from array import array
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nearl.recorded import BadDemonstrations, numbers

Floats = NDArray[np.float64]
FilePath = str | os.PathLike[str]
# How files begin that are often taken for CSV.
_NO_TEXT = {
    b"PK": "a zip or .npz file, no CSV; give the text file",
    b"PAR1": "a parquet file, no CSV; give nearl.demos.from_columns what pandas.read_parquet makes of it, a table for each episode",
    b"\x1f\x8b": "compressed with gzip; unpack it first",
    b"\xff\xfe": "text in UTF-16; save it as UTF-8",
    b"\xfe\xff": "text in UTF-16; save it as UTF-8",
}


def once(names: Iterable[str], source: str) -> None:
    """Refuses a column that is there twice, of which nobody knows which one is meant."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise BadDemonstrations(f"{source}: column '{name}' is there twice; keep the one that is meant")
        seen.add(name)


def split(table: Mapping[str, Floats], of: NDArray[Any] | None, source: str) -> list[dict[str, Floats]]:
    """The rows of each episode, in their order; ``of`` (n) says of which one each row is, and all are one without it."""
    if of is None:
        return [dict(table)]
    begins = [0, *(np.flatnonzero(of[1:] != of[:-1]) + 1), len(of)] if len(of) else [0]
    seen: set[Any] = set()
    for row in begins[:-1]:
        if of[row] in seen:
            raise BadDemonstrations(
                f"{source}: episode {of[row]:g} goes on in row {row} after rows of episode {of[row - 1]:g}; put the rows of each episode together, "
                f"or give those from there another number"
            )
        seen.add(of[row])
    return [{name: values[a:b] for name, values in table.items()} for a, b in pairwise(begins)]


def unbraced(name: str) -> str:
    """A name without the braces around it that expressions ask for: ``{q.left-hip}`` is ``q.left-hip``."""
    return name[1:-1] if name.startswith("{") and name.endswith("}") and not {"{", "}"} & set(name[1:-1]) else name


def renamed(table: Mapping[str, Floats], columns: Any, source: str) -> dict[str, Floats]:
    """A table by the task's names, which ``columns`` maps to those of its heading; columns that are not in it keep theirs."""
    if columns is None:
        return dict(table)
    if not isinstance(columns, Mapping):
        raise BadDemonstrations(f"{source}: columns is {columns!r}; give the heading's name of each column, as {{'q.shoulder': 'Shoulder angle'}}")
    for name, given in columns.items():
        if not isinstance(given, str) or given not in table:
            raise BadDemonstrations(f"{source}: columns['{name}'] is {given!r}, and its heading has no such column; it has {', '.join(table)}")
    taken = set(columns.values())
    once([*map(unbraced, columns), *(name for name in table if name not in taken)], source)
    return {unbraced(name): table[given] for name, given in columns.items()} | {name: of for name, of in table.items() if name not in taken}


def csv_table(file: FilePath) -> dict[str, Floats]:
    """Columns (n) of a CSV file by the names of its heading."""
    source = f"'{os.fspath(file)}'"
    with open(file, "rb") as data:
        begin = data.read(4)
    for sign, what in _NO_TEXT.items():
        if begin.startswith(sign):
            raise BadDemonstrations(f"{source} is {what}")
    values = array("d")
    with open(file, newline="", encoding="utf-8-sig") as text:
        lines = csv.reader(text, skipinitialspace=True)
        try:
            heading = _heading(next(lines, []), source)
            for row in lines:
                if (len(row) < 2 and not "".join(row).strip()) or row[0].startswith("#"):
                    continue
                _take(values, row, heading, f"{source}, line {lines.line_num}")
        except UnicodeDecodeError as error:
            raise BadDemonstrations(f"{source} is no text in UTF-8 ({error.reason}, after line {lines.line_num}); save it as UTF-8") from None
        except csv.Error as error:
            raise BadDemonstrations(f"{source}, line {lines.line_num}: {error}; write a heading, then numbers between commas") from None
    if not values:
        raise BadDemonstrations(f"{source}: a heading and no row below it; give one row for each time step")
    return dict(zip(heading, np.frombuffer(values).reshape(-1, len(heading)).T))


def _heading(cells: Sequence[str], source: str) -> list[str]:
    names = [name.strip() for name in cells]
    if not any(names):
        raise BadDemonstrations(f"{source}: its first line is empty; begin with a heading, as q.<joint>,v.<joint>")
    for sign, what in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and sign in names[0]:
            raise BadDemonstrations(f"{source}: its columns are separated by {what}; write commas between columns, and points in numbers")
    if all(_number(name) is not None for name in names):
        raise BadDemonstrations(f"{source}: its first line is numbers; begin with a heading, as q.<joint>,v.<joint>")
    once(names, source)
    return names


def _take(values: "array[float]", row: Sequence[str], heading: Sequence[str], where: str) -> None:
    if len(row) != len(heading):
        raise BadDemonstrations(f"{where}: {len(row)} cells below a heading of {len(heading)} columns; give one number for each column")
    try:
        values.extend(map(float, row))
    except ValueError:
        name, cell = next((name, cell) for name, cell in zip(heading, row) if _number(cell) is None)
        said = f"is '{cell}', which is no number" if cell.strip() else "is empty"
        raise BadDemonstrations(f"{where}: column '{name}' {said}; give a number, or leave the column out") from None


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def npz_arrays(file: FilePath, needed: Sequence[str], other: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The arrays ``needed`` of an ``.npz`` file, and of the ``other`` ones those that it has."""
    source = f"'{os.fspath(file)}'"
    os.stat(file)  # a file that is not there is said by the system
    if not zipfile.is_zipfile(file):
        raise BadDemonstrations(f"{source} is no .npz file, or was cut short; write it with numpy.savez")
    with np.load(file, allow_pickle=False) as data:
        missing = [name for name in needed if name not in data.files]
        if missing:
            raise BadDemonstrations(f"{source}: no array '{missing[0]}'; it has {', '.join(data.files)}")
        arrays = {}
        for name in (*needed, *(name for name in other if name in data.files)):
            try:
                arrays[name] = data[name]
            except (ValueError, OSError, zipfile.BadZipFile) as error:
                raise BadDemonstrations(f"{source}: array '{name}' cannot be read ({error}); write numbers or text, no objects, with numpy.savez") from None
    return arrays


def seconds_between(fps: Any, source: str) -> float:
    """The time between two frames [s], of how many there are in a second."""
    rate = numbers(fps, "fps", source).ravel()
    if len(rate) != 1 or not (np.isfinite(rate[0]) and rate[0] > 0):
        raise BadDemonstrations(f"{source}: fps is {fps}; give the frames a second, a number above 0")
    return 1 / float(rate[0])


def feature_names(feature: Mapping[str, Any]) -> list[str]:
    """Names of the entries of a feature of a LeRobot dataset; none where it has none."""
    names = feature.get("names") or []
    return list(names.get("motors", []) if isinstance(names, Mapping) else names)


def lerobot_column(name: str) -> str:
    """The column of an entry of a robot's state as LeRobot names it: ``shoulder.pos``, ``shoulder.vel``, ``shoulder``."""
    if name.startswith(("q.", "v.")):
        return name
    return "v." + name.removesuffix(".vel") if name.endswith(".vel") else "q." + name.removesuffix(".pos")


def minari_dataset(name: str) -> Any:
    """What Minari has under a name on this machine."""
    try:
        import minari  # type: ignore[import-not-found]  # an extra
    except ImportError as error:
        raise ImportError(f"reading the Minari dataset '{name}' needs minari: pip install 'nearl[minari]'") from error
    try:
        return minari.load_dataset(name)
    except FileNotFoundError:
        raise BadDemonstrations(f"Minari dataset '{name}' is not on this machine; get it with `minari download {name}`, or correct the name") from None
    except (OSError, ValueError) as error:
        raise BadDemonstrations(f"Minari dataset '{name}' cannot be read: {error}; correct the name, or give what minari.load_dataset returns") from None


def check_entries(columns: Any, source: str) -> None:
    """Refuses what does not say by name which entry of which observation is meant."""
    give = "give the observation's key and the entry from 0, as {'q.panda_joint1': ('robot0_joint_pos', 0)}"
    if not isinstance(columns, Mapping):
        raise BadDemonstrations(f"{source}: columns is {columns!r}; {give}")
    for name, of in columns.items():
        is_pair = isinstance(of, Sequence) and not isinstance(of, str) and len(of) == 2
        if not is_pair or not isinstance(of[0], str) or not isinstance(of[1], int | np.integer) or of[1] < 0:
            raise BadDemonstrations(f"{source}: columns['{name}'] is {of!r}; {give}")
