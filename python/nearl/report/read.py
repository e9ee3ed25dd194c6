"""Flight logs and JSON summaries as arrays."""

import io
import json
import re
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nearl import _core
from nearl.runs import ReadError, Run, json_of, read_run

Floats = NDArray[np.float64]
LARGEST = 1e20  # of numbers that are drawn: no robot has a larger one, and matplotlib computes none that are much larger
MOST_STAGES = 1e6  # of the projection, whose numbers are small
WITHOUT_END = "the loop was killed, or the copy was cut short, and what came after is not in the file; `nearl verify` tells what of it holds"
OFF_END = {
    "cut": "the copy was cut short, or its end was damaged; `nearl verify` tells what of it holds",
    "added to": "something stands behind its end, as a second log, which is not in this report; give the copy that was not added to",
}
__all__ = ["Log", "ReadError", "Run", "Summary", "read_json", "read_log", "read_run"]


@dataclass
class Log:
    """One flight, tick by tick (n). Rows of ticks without an action are NaN in proposal, target and action."""

    path: Path
    metadata: dict[str, str]
    columns: dict[str, Floats]
    q: Floats
    v: Floats
    proposal_q: Floats
    proposal_v: Floats
    target_q: Floats
    target_v: Floats
    mode: list[str]
    active: list[list[dict[str, Any]]] = field(default_factory=list)
    without_end: bool = False  # the loop was killed, or a copy was cut short
    off_end: str = ""  # its end, behind all ticks, is "cut" or "added to"
    acted: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))  # ticks with a target, drawn or not
    left_out: int = 0  # numbers beyond `LARGEST`, which are NaN in all of the above

    def __len__(self) -> int:
        return len(self.mode)

    @property
    def time(self) -> Floats:
        """Seconds since the first tick was due."""
        due = self.columns["due_ns"]
        return (due - due[0]) * 1e-9

    @cached_property
    def dt(self) -> float:
        """Control period [s]: the metadata's, else the bundled task's, else the median distance of ticks."""
        if "dt" in self.metadata:
            return float(self.metadata["dt"])
        if self.metadata.get("task") in dict(_core.tasks()):
            return _core.Env(self.metadata["task"]).dt
        gaps = np.diff(self.columns["due_ns"])
        return float(np.median(gaps)) * 1e-9 if len(gaps) else float("nan")

    def rungs(self) -> list[str]:
        """Names of the projection's stages, each at the place of its number in the log."""
        return [x for x in self.metadata.get("rungs", "").split(",") if x]

    def row_names(self) -> list[str]:
        """Names of the rows by number, as the metadata gives them; none where it does not."""
        return [str(name) for name in json.loads(self.metadata["rows"])] if "rows" in self.metadata else []

    def names(self, n: int) -> list[str]:
        """Names of the degrees of freedom: the metadata's ``joints``, else the bundled task's, else numbers."""
        given = [x for x in re.split(r"[,\s]+", self.metadata.get("joints", "")) if x]
        if not given and self.metadata.get("task") in dict(_core.tasks()):
            given = _core.Env(self.metadata["task"]).joint_names
        return given if len(given) == n else [f"joint {i}" for i in range(n)]


_NUMBERS = {
    "tick": ("tick",),
    "due_ns": ("due_ns",),
    "begin_ns": ("begin_ns",),
    "end_ns": ("end_ns",),
    "overruns": ("overruns",),
    "stale": ("stale",),
    "policy_version": ("policy_version",),
    "seq": ("state", "seq"),
    "episode": ("state", "episode"),
    "raw_violations": ("ledger", "raw_violations"),
    "target_violations": ("ledger", "target_violations"),
    "outside": ("ledger", "outside"),
    "moved": ("ledger", "moved"),
    "active": ("ledger", "active"),
    "iterations": ("ledger", "iterations"),
    "slack": ("ledger", "slack"),
    "rung": ("ledger", "rung"),
    "projection_ns": ("ledger", "duration_ns"),
}


def read_log(path: Path) -> Log:
    """A flight log (MCAP, topic ``tick``, JSON messages); of one without its end the ticks that are there, with a warning."""
    metadata, messages, without_end, off_end = _content(path)
    try:
        ticks, swapped = ([json.loads(data, parse_constant=_no_number) for data in messages.get(topic, [])] for topic in ("tick", "snapshot"))
    except (ValueError, RecursionError) as error:
        raise ReadError(_damaged(path, error)) from error
    if not ticks:
        why = "the loop ended, or the copy was cut, before the first; give another log" if without_end else "the loop never ran"
        raise ReadError(f"'{path}' holds no ticks; {why}")
    if without_end:
        warnings.warn(f"'{path}' is without its end, and {len(ticks):,} ticks of it are reported: {WITHOUT_END}", stacklevel=2)
    if off_end:
        warnings.warn(f"'{path}' is {off_end} at its end, behind its {len(ticks):,} ticks: {OFF_END[off_end]}", stacklevel=2)
    try:
        log = _log(path, metadata, ticks, swapped)
    except (ValueError, TypeError, AttributeError, KeyError, OverflowError) as error:
        raise ReadError(_damaged(path, error)) from error
    log.without_end, log.off_end = without_end, off_end
    if log.left_out:
        warnings.warn(f"'{path}' {beyond(log)}", stacklevel=2)
    return log


def beyond(log: Log) -> str:
    """What is said of a log with numbers that nobody can draw."""
    n = log.left_out
    return (
        f"has {n:,} number{'s' if n > 1 else ''} beyond {LARGEST:g}, which {'are' if n > 1 else 'is'} left out of pictures and tables; "
        f"`nearl verify` tells in which tick"
    )


def _log(path: Path, metadata: dict[str, str], ticks: list[dict[str, Any]], swapped: list[dict[str, Any]]) -> Log:
    """The log of these ticks; what another program than `nearl run` could not have written is some error of Python."""
    rows = json.loads(metadata.get("rows", "[]"))
    if "dt" in metadata and not 0.0 < float(metadata["dt"]) < LARGEST:
        raise ValueError(f"a control period of {metadata['dt']} s")
    lacks = next((i for i, tick in enumerate(ticks) if not {"tick", "mode", "state", "ledger"} <= tick.keys()), None)
    if lacks is not None:
        raise ValueError(f"tick {lacks + 1} of its {len(ticks):,} has no number, mode, state or ledger")
    if any("rows" in entry and json.dumps(entry["rows"]) != json.dumps(rows) for entry in swapped):
        metadata.pop("rows", None)  # a later snapshot numbers its rows otherwise
    columns = {name: np.array([_at(tick, keys) for tick in ticks]) for name, keys in _NUMBERS.items()}
    table = {key: _table([tick.get(key) for tick in ticks]) for key in ("proposal_q", "proposal_v", "target_q", "target_v")}
    state = {key: _table([tick["state"].get(key) for tick in ticks]) for key in ("q", "v")}
    active = [tick["ledger"].get("active_rows") or [] for tick in ticks]
    acted = np.array([table["target_v"].size > 0 and not np.isnan(row).any() for row in table["target_v"]], bool)
    left_out = sum(_left_out(values, LARGEST) for values in (*columns.values(), *table.values(), *state.values()))
    left_out += _left_out(columns["rung"], MOST_STAGES) + sum(_without_multiplier(row) for rows in active for row in rows)
    columns["target_violations"][columns["outside"] > 0] = 0.0  # from outside a target can only come nearer: `nearl run` counts these as recovering
    columns["due_ns"] = _filled(columns["due_ns"])
    mode = [str(tick["mode"]) for tick in ticks]
    proposals, targets = (table["proposal_q"], table["proposal_v"]), (table["target_q"], table["target_v"])
    log = Log(path, metadata, columns, state["q"], state["v"], *proposals, *targets, mode, active)
    log.acted, log.left_out = acted, left_out
    return log


def _left_out(values: Floats, most: float) -> int:
    """How many numbers are beyond ``most``; they are NaN from then on."""
    off = np.abs(values) > most
    values[off] = np.nan
    return int(off.sum())


def _without_multiplier(row: dict[str, Any]) -> int:
    """The same of an active row."""
    multiplier = np.array([_float(row["multiplier"])])
    n = _left_out(multiplier, LARGEST)
    row["multiplier"] = float(multiplier[0])
    return n


def _filled(times: Floats) -> Floats:
    """Times of which some were left out, between those before and after."""
    if np.isfinite(times).all():
        return times
    at, known = np.arange(len(times)), np.isfinite(times)
    if not known.any():
        raise ValueError("no tick has a time at which it was due")
    return np.interp(at, at[known], times[known])


def _float(value: Any) -> float:
    """A number of JSON, which may be larger than any of Python's floats."""
    try:
        return float("nan") if value is None else float(value)
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")


def _no_number(constant: str) -> float:
    raise ValueError(f"a number that is {constant}")


def _end(content: bytes) -> str:
    """Whether MCAP ends where the file does, and there for the first time: empty where it does, else the end is "cut" or "added to"."""
    magic, head, at = content[:8], struct.Struct("<BQ"), 8
    while at + head.size <= len(content):
        opcode, length = head.unpack_from(content, at)
        at += head.size + length
        if opcode == 2:  # the footer
            closed = content[at : at + len(magic)] == magic
            return "cut" if not closed else "added to" if len(content) > at + len(magic) else ""
    return "cut"


def _content(path: Path) -> tuple[dict[str, str], dict[str, list[bytes]], bool, str]:
    """Metadata of an MCAP file, its messages by topic in their order, whether ticks may be missing at its end, and what is the matter with its end where
    none are. What is damaged inside is refused."""
    try:
        from mcap.exceptions import EndOfFile, InvalidMagic, RecordLengthLimitExceeded
        from mcap.records import Channel, DataEnd, Message, Metadata
        from mcap.stream_reader import StreamReader
    except ImportError as error:
        raise ReadError("reading a flight log needs the mcap package: pip install 'nearl[viz]'") from error
    content = regular(path, "a file written by 'nearl run --log'").read_bytes()
    metadata: dict[str, str] = {}
    topics: dict[int, str] = {}
    messages: dict[str, list[tuple[int, bytes]]] = {}
    complete = False
    try:
        for record in StreamReader(io.BytesIO(content), validate_crcs=True).records:
            if isinstance(record, Message):
                messages.setdefault(topics[record.channel_id], []).append((record.log_time, record.data))
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata):
                metadata.update(record.metadata)
            complete |= isinstance(record, DataEnd)  # what follows are summaries
    except InvalidMagic as error:
        if not complete:
            raise ReadError(f"'{path}' is not a flight log that can be read ({error}); give a file written by 'nearl run --log'") from error
    except Exception as error:  # those of the decompressors among them
        closed = len(content) > 8 and content[8:].endswith(content[:8])  # as MCAP begins and ends
        if not complete and (closed or not isinstance(error, EndOfFile | RecordLengthLimitExceeded | struct.error)):
            raise ReadError(_damaged(path, error)) from error
    in_order = {topic: [data for _, data in sorted(found, key=lambda m: m[0])] for topic, found in messages.items()}
    return metadata, in_order, not complete, _end(content) if complete else ""


def regular(path: Path, wanted: str) -> Path:
    """The path if a regular file is there; a pipe or a device, which may be without end, is not opened."""
    if path.is_file():
        return path
    what = "does not exist" if not path.exists() else "is a folder, not a regular file" if path.is_dir() else "is not a regular file"
    raise ReadError(f"'{path}' {what}; give {wanted}")


def _damaged(path: Path, error: Exception) -> str:
    return (
        f"'{path}' is a flight log that is damaged ({str(error) or type(error).__name__}); neither a report nor `nearl verify` can tell what of it holds; "
        "give another copy of it"
    )


def _at(tick: dict[str, Any], keys: tuple[str, ...]) -> float:
    value: Any = tick
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return _float(value)


def _table(rows: list[list[float] | None]) -> Floats:
    width = max((len(row) for row in rows if row), default=0)
    table = np.full((len(rows), width), np.nan)
    for i, row in enumerate(rows):
        if row and len(row) == width:
            table[i] = [_float(x) for x in row]
    return table


@dataclass
class Summary:
    """What programs printed as JSON, with names: evaluations, reports of loops, receipts of pushed snapshots."""

    evaluations: list[tuple[str, dict[str, Any]]]
    loops: list[tuple[str, dict[str, Any]]]
    receipts: list[tuple[str, dict[str, Any]]]


def read_json(path: Path) -> Summary:
    """Everything known in a JSON file, whatever it is wrapped in: ``nearl eval|run|demo --json``."""
    content, name = json_of(regular(path, "the output of 'nearl eval --json', 'nearl run --json' or 'nearl demo'")), path.stem
    found = Summary(
        list(_find(content, {"mode", "returns"}, name)),
        list(_find(content, {"compute", "wake", "ticks"}, name)),
        list(_find(content, {"version", "accepted", "text"}, name)),
    )
    if not (found.evaluations or found.loops):
        raise ReadError(f"'{path}' holds neither evaluation nor report of a loop; give the output of 'nearl eval --json', 'nearl run --json' or 'nearl demo'")
    return found


def _find(node: Any, keys: set[str], name: str, task: str | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Objects that have ``keys``, named by the ``task`` they are under, else by their ``robot``, else by the file."""
    if isinstance(node, dict):
        if keys <= node.keys():
            yield task or node.get("robot") or name, node
            return
        task = node.get("task", task)
        for child in node.values():
            yield from _find(child, keys, name, task)
    elif isinstance(node, list):
        for child in node:
            yield from _find(child, keys, name, task)
