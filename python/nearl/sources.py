"""What files of others hold, as arrays by name; or one sentence with the file, the place in it and what to do."""

import csv
import os
import re
import stat
import zipfile
from array import array
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nearl.arguments import unread
from nearl.recorded import BadDemonstrations, numbers

Floats = NDArray[np.float64]
FilePath = str | os.PathLike[str]
# Largest file of demonstrations that is read, and what is unpacked of one [bytes].
LARGEST = 4 << 30
# How files begin that are often taken for CSV.
_NO_TEXT = {
    b"PK": "a zip or .npz file, no CSV; give the text file",
    b"PAR1": "a parquet file, no CSV; give nearl.demos.from_columns what pandas.read_parquet makes of it, a table for each episode",
    b"\x1f\x8b": "compressed with gzip; unpack it first",
    b"\xff\xfe": "text in UTF-16; save it as UTF-8",
    b"\xfe\xff": "text in UTF-16; save it as UTF-8",
}


def regular(file: FilePath, give: str) -> None:
    """Refuses what is no regular file of at most `LARGEST` bytes, before it is opened: a pipe waits, and a device may be without end."""
    try:
        found = os.stat(file)
    except OSError as error:
        raise unread(error, file) from error
    if not stat.S_ISREG(found.st_mode):
        what = "is a folder, not a regular file" if stat.S_ISDIR(found.st_mode) else "is not a regular file"
        raise BadDemonstrations(f"'{os.fspath(file)}' {what}; give {give}")
    if found.st_size > LARGEST:
        raise BadDemonstrations(f"'{os.fspath(file)}' has {found.st_size} bytes, more than the limit of {LARGEST}; split it, and convert each part")


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


def text(name: Any, what: str, source: str) -> str:
    """A name, also as the bytes that HDF5 gives."""
    if not isinstance(name, bytes):
        return str(name)
    try:
        return name.decode()
    except UnicodeDecodeError:
        raise BadDemonstrations(f"{source}: {what} has {bytes(name)!r}, which is no text in UTF-8; give names as text") from None


def unbraced(name: str | bytes) -> str:
    """A name without the braces around it that expressions ask for: ``{q.left-hip}`` is ``q.left-hip``."""
    name = text(name, "the name of a column", "the columns") if isinstance(name, bytes) else name
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
    regular(file, "a CSV file")
    try:
        with open(file, "rb") as data:
            begin = data.read(4)
    except OSError as error:
        raise unread(error, file) from error
    for sign, what in _NO_TEXT.items():
        if begin.startswith(sign):
            raise BadDemonstrations(f"{source} is {what}")
    values = array("d")
    with open(file, newline="", encoding="utf-8-sig") as text:
        lines = csv.reader(text, skipinitialspace=True)
        try:
            commented: list[str] = []
            while (first := next(lines, [])) and first[0].startswith("#"):
                commented = first
            heading = _heading(first, commented, source)
            for row in lines:
                if (len(row) < 2 and not "".join(row).strip()) or row[0].startswith("#"):
                    continue
                _take(values, row, heading, f"{source}, line {lines.line_num}")
        except UnicodeDecodeError as error:
            raise BadDemonstrations(f"{source} is no text in UTF-8 ({error.reason}, after line {lines.line_num}); save it as UTF-8") from None
        except csv.Error as error:
            raise BadDemonstrations(f"{source}, line {lines.line_num}: {error}; write a heading, then numbers between commas") from None
        except MemoryError:
            raise BadDemonstrations(f"{source}, line {lines.line_num}: its numbers do not fit into memory; split it, and convert each part") from None
    if not values:
        raise BadDemonstrations(f"{source}: a heading and no row below it; give one row for each time step")
    return dict(zip(heading, np.frombuffer(values).reshape(-1, len(heading)).T))


def _heading(cells: Sequence[str], commented: Sequence[str], source: str) -> list[str]:
    """Names of the first line that is no comment; ``commented`` is the last comment above it."""
    names = [name.strip() for name in cells]
    if not any(names):
        raise BadDemonstrations(f"{source}: its first line is empty; begin with a heading, as q.<joint>,v.<joint>")
    for sign, what in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and sign in names[0]:
            raise BadDemonstrations(f"{source}: its columns are separated by {what}; write commas between columns, and points in numbers")
    if all(_number(name) is not None for name in names):
        meant = [name.strip() for name in ",".join(commented).lstrip("#").split(",")]
        if len(meant) == len(names) and all(meant) and None in map(_number, meant):
            raise BadDemonstrations(f"{source}: its heading begins with '#', '{commented[0]}'; save with comments='', or take the sign away")
        raise BadDemonstrations(f"{source}: its first line is numbers; begin with a heading, as q.<joint>,v.<joint>")
    once(names, source)
    return names


def _take(values: "array[float]", row: Sequence[str], heading: Sequence[str], where: str) -> None:
    if len(row) != len(heading):
        raise BadDemonstrations(f"{where}: {len(row)} cells below a heading of {len(heading)} columns; give one number for each column")
    try:
        if "_" in "".join(row):  # between digits Python takes it, and no other program
            raise ValueError
        values.extend([float(cell) for cell in row])
    except ValueError:
        for name, cell in zip(heading, row):
            if (number := _number(cell)) is None:
                said = f"is '{cell}', which is no number" if cell.strip() else "is empty"
                raise BadDemonstrations(f"{where}: column '{name}' {said}; give a number, or leave the column out") from None
            values.append(number)


def _number(cell: str) -> float | None:
    """Of a cell; a truth value, as pandas writes it, is 1 or 0."""
    try:
        return float(cell) if "_" not in cell else None
    except ValueError:
        return {"true": 1.0, "false": 0.0}.get(cell.strip().lower())


def npz_arrays(file: FilePath, needed: Sequence[str], other: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The arrays ``needed`` of an ``.npz`` file, and of the ``other`` ones those that it has."""
    source = f"'{os.fspath(file)}'"
    regular(file, "an .npz file")
    try:
        data = np.load(file, allow_pickle=False) if zipfile.is_zipfile(file) else None
    except Exception as error:  # whatever zipfile says of a damaged one
        raise BadDemonstrations(f"{source} cannot be read as .npz ({error or type(error).__name__}); write it with numpy.savez") from None
    if not isinstance(data, np.lib.npyio.NpzFile):
        raise BadDemonstrations(f"{source} is no .npz file, or was cut short; write it with numpy.savez")
    with data:
        missing = [name for name in needed if name not in data.files]
        if missing:
            raise BadDemonstrations(f"{source}: no array '{missing[0]}'; it has {', '.join(data.files)}")
        wanted = [*needed, *(name for name in other if name in data.files)]
        entries = data.zip.infolist() if data.zip is not None else []
        unpacked = sum([int(of.file_size) for of in entries if of.filename.removesuffix(".npy") in wanted])
        if unpacked > LARGEST:
            raise BadDemonstrations(f"{source}: {', '.join(wanted)} have {unpacked} bytes, more than the limit of {LARGEST}; split it, and convert each part")
        arrays = {}
        for name in wanted:
            try:
                array = data[name]
            except Exception as error:  # of NumPy, zipfile and zlib, a MemoryError of what the array's head says among them
                said = " ".join(str(error).split()) or type(error).__name__
                raise BadDemonstrations(f"{source}: array '{name}' cannot be read ({said}); write numbers or text, no objects, with numpy.savez") from None
            if not isinstance(array, np.ndarray):  # but bytes, which do not begin as an array does
                raise BadDemonstrations(f"{source}: '{name}' is no array of NumPy; write it with numpy.savez")
            arrays[name] = array
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


def lerobot_rows(folder: FilePath, info: Mapping[str, Any], wanted: Sequence[str]) -> dict[str, list[Any]]:
    """The features ``wanted`` of a LeRobot dataset frame by frame, and its ``episode_index``; refuses one in which frames are missing.

    What there has to be say ``info``, which is meta/info.json, the lengths in meta/episodes, and the column ``frame_index``: each where it is there.
    """
    root, source = Path(folder), f"'{os.fspath(folder)}'"
    files = sorted((root / "data").rglob("*.parquet"))
    if not files:
        raise BadDemonstrations(f"{source}: its folder 'data' has no parquet file, in which the frames are; get the dataset again, the whole of it")
    parts: dict[str, list[Any]] = {name: [] for name in dict.fromkeys((*wanted, "episode_index"))}
    frames: list[int] = []
    begins = []
    for file in files:
        begins.append(len(parts["episode_index"]))
        table = _parquet(file, [*parts, "frame_index"])
        if missing := [name for name in parts if name not in table]:
            raise BadDemonstrations(f"'{file}': no column '{missing[0]}'; it has {', '.join(table) or 'none that is asked for'}: get the file again")
        for name, rows in parts.items():
            rows += table[name]
            _check_widths(table, name, np.shape(rows[:1])[1:], file)
        frames += table.get("frame_index", [])
    of = np.array(parts["episode_index"])
    split({}, of, source)  # refuses episodes whose rows are not together
    if (lack := _lack(root, info, of, frames, files, begins)) is not None:
        hint = f" ({', '.join(gone)} {'is' if len(gone) == 1 else 'are'} not there)" if (gone := _gone(root, info, files)) else ""
        raise BadDemonstrations(
            f"{source}: {lack}{hint}; get the dataset again, the whole of it, or give the episodes that are whole to nearl.demos.from_columns"
        )
    return parts


def _check_widths(table: Mapping[str, list[Any]], name: str, shape: tuple[int, ...], file: Path) -> None:
    """Refuses a row of a feature that has more or fewer entries than the dataset's first."""
    for row, entries in enumerate(table[name]):
        if (other := np.shape(entries)) != shape:
            raise BadDemonstrations(
                f"'{file}': '{name}' has shape {other} in row {row} (episode {table['episode_index'][row]}), and {shape} in the dataset's first row; get the "
                f"file again, or give the episodes that are whole to nearl.demos.from_columns"
            )


def _parquet(file: Path, names: Sequence[str]) -> dict[str, list[Any]]:
    """Those of the columns ``names`` that a parquet file has."""
    import pyarrow
    from pyarrow import parquet

    regular(file, "the folder of a dataset whose parquet files are files")
    try:
        with parquet.ParquetFile(file) as data:
            table = data.read([name for name in names if name in data.schema_arrow.names])
            if table.nbytes > LARGEST:
                raise BadDemonstrations(f"'{file}' unpacks to {table.nbytes} bytes, more than the limit of {LARGEST}; split it, and convert each part")
            return {name: table[name].to_pylist() for name in table.column_names}
    except BadDemonstrations:
        raise
    except (pyarrow.ArrowException, OSError, MemoryError) as error:
        said = " ".join(str(error).split()).rstrip(".")
        raise BadDemonstrations(f"'{file}' cannot be read as parquet ({said}); it was cut short or damaged: get the file again") from None


def _lack(root: Path, info: Mapping[str, Any], of: NDArray[Any], frames: list[int], files: list[Path], begins: list[int]) -> str | None:
    """What is missing in a LeRobot dataset whose rows are of the episodes ``of``; ``begins`` are the first rows of its ``files``."""
    where = lambda row: f"'{files[int(np.searchsorted(begins, row, 'right')) - 1].relative_to(root).as_posix()}'"  # noqa: E731
    episodes, first, lengths = np.unique(of, return_index=True, return_counts=True)
    there = f"the data has {len(episodes)} episodes with {len(of)} frames"
    total = [info.get(name) for name in ("total_episodes", "total_frames")]
    said = [f"{n} {what}" for n, what in zip(total, ("episodes", "frames")) if isinstance(n, int)]
    if said:
        there += f", and meta/info.json says {' with '.join(said)}"
    for episode, row, n in zip(episodes, first, lengths):
        own = np.array(frames[row : row + n]) if len(frames) == len(of) else np.arange(n)
        if len(off := np.flatnonzero(own != np.arange(n))):
            k = int(off[0])
            begins_at = f"begins with frame {own[0]}" if k == 0 else f"goes from frame {own[k - 1]} to frame {own[k]}"
            return f"episode {episode} {begins_at} in {where(row + k)}, so frames of it are missing; {there}"
    tables = [_parquet(file, ["episode_index", "length"]) for file in sorted((root / "meta" / "episodes").rglob("*.parquet"))]
    stated = {e: n for table in tables if len(table) == 2 for e, n in zip(table["episode_index"], table["length"])}
    for episode, row, n in zip(episodes, first, lengths):
        if (length := stated.get(int(episode), n)) != n:
            return f"episode {episode} has {n} frames up to {where(row + n - 1)}, and meta/episodes says {length}; {there}"
    if any(isinstance(n, int) and n != has for n, has in zip(total, (len(episodes), len(of)))):
        absent = sorted({*stated, *range(total[0] if isinstance(total[0], int) else 0)} - {int(e) for e in episodes})
        return there + (f"; the first that is missing is episode {absent[0]}" if absent else "")
    return None


def _gone(root: Path, info: Mapping[str, Any], files: list[Path]) -> list[str]:
    """Data files of a LeRobot dataset that its meta/episodes names, or that are left out in their numbers, and that are not there."""
    named: set[str] = set()
    for file in sorted((root / "meta" / "episodes").rglob("*.parquet")):
        table = _parquet(file, ["data/chunk_index", "data/file_index"])
        if len(table) == 2 and isinstance(info.get("data_path"), str):
            named |= {info["data_path"].format(chunk_index=c, file_index=f) for c, f in zip(table["data/chunk_index"], table["data/file_index"])}
    for folder in {file.parent for file in files}:
        numbers_of = [int(found[1]) for file in files if file.parent == folder and (found := re.fullmatch(r"file-(\d+)", file.stem))]
        named |= {(folder / f"file-{k:03d}.parquet").relative_to(root).as_posix() for k in range(max(numbers_of, default=0))}
    return [f"'{name}'" for name in sorted(named) if not (root / name).is_file()]


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
    root = Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")
    for file in sorted((root / name / "data").rglob("*")):
        if not file.is_dir():
            regular(file, f"what `minari download {name}` writes")
    try:
        return minari.load_dataset(name)
    except FileNotFoundError:
        raise BadDemonstrations(f"Minari dataset '{name}' is not on this machine; get it with `minari download {name}`, or correct the name") from None
    except (OSError, ValueError) as error:
        raise BadDemonstrations(f"Minari dataset '{name}' cannot be read: {error}; correct the name, or give what minari.load_dataset returns") from None


def hdf5_parts(group: Any, where: str) -> dict[str, Any]:
    """What a group of an HDF5 file holds, by name; a link is refused, and a part that is in another file, which may be a pipe or a device."""
    import h5py

    if not isinstance(group, h5py.Group):
        raise BadDemonstrations(f"{where}: '{getattr(group, 'name', group)}' is no group; give the file that robomimic wrote")
    parts = {}
    for name in group:
        is_own = isinstance(group.get(name, getlink=True), h5py.HardLink)
        part = group.get(name) if is_own else None
        if part is None or (isinstance(part, h5py.Dataset) and (part.external or part.is_virtual)):
            what = "is in another file" if is_own else "is a link"
            raise BadDemonstrations(f"{where}: '{name}' {what}, which is not followed; give a file that holds all of its data itself")
        parts[name] = part
    return parts


def hdf5_column(array: Any, k: int, what: str, where: str) -> Floats:
    """Column k of a dataset (n x any) of an HDF5 file."""
    if (size := array.shape[0] * array.dtype.itemsize) > LARGEST:
        raise BadDemonstrations(f"{where}: {what} has shape {array.shape}, {size} bytes a column, more than the limit of {LARGEST}; split it")
    try:
        return numbers(array[:, k], what, where)
    except (OSError, MemoryError, RuntimeError) as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise BadDemonstrations(f"{where}: {what} cannot be read ({said}); it was cut short or damaged: get the file again") from None


def check_entries(columns: Any, source: str) -> None:
    """Refuses what does not say by name which entry of which observation is meant."""
    give = "give the observation's key and the entry from 0, as {'q.panda_joint1': ('robot0_joint_pos', 0)}"
    if not isinstance(columns, Mapping):
        raise BadDemonstrations(f"{source}: columns is {columns!r}; {give}")
    for name, of in columns.items():
        is_pair = isinstance(of, Sequence) and not isinstance(of, str) and len(of) == 2
        if not is_pair or not isinstance(of[0], str) or not isinstance(of[1], int | np.integer) or of[1] < 0:
            raise BadDemonstrations(f"{source}: columns['{name}'] is {of!r}; {give}")
