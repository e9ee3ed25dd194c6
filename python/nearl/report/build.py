"""The page: the promise in three numbers and a picture, then tables and figures of what was measured."""

import html
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nearl._core import __version__
from nearl.report import demonstrations, flight, sweep, training
from nearl.report.promise import promise
from nearl.report.read import OFF_END, WITHOUT_END, Log, ReadError, Run, Summary, beyond, read_json, read_log, read_run
from nearl.report.style import image

Paths = Iterable[str | Path]

CSS = """
:root { color-scheme: light dark; --ink: #1d2939; --soft: #475467; --page: #f9fafb; --card: #fff; --line: #e4e7ec; --good: #067647; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ef; --soft: #a3adbd; --page: #12161d; --card: #1b212b; --line: #333c4a; --good: #4cc38a; }
  figure.drawn img { filter: invert(1) hue-rotate(180deg); mix-blend-mode: screen; }
}
* { box-sizing: border-box; }
body { font: 15px/1.55 system-ui, "Segoe UI", Roboto, sans-serif; color: var(--ink); background: var(--page); margin: 0; }
main { max-width: 1120px; margin: 0 auto; padding: 2.2rem 1.4rem 4rem; overflow-wrap: anywhere; }
h1 { font-size: 1.7rem; margin: 0 0 .2rem; } h2 { font-size: 1.2rem; margin: 2.4rem 0 .6rem; }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; color: var(--soft); }
p.lead, figcaption, details { color: var(--soft); }
.promise { display: grid; grid-template-columns: repeat(auto-fit, minmax(220px, 1fr)); gap: .8rem; margin: 1rem 0; }
.promise div { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .7rem 1rem; }
.promise strong { display: block; font-size: 1.75rem; line-height: 1.25; } .promise .good { color: var(--good); }
figure { margin: .8rem 0 1.4rem; background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .8rem; }
figure img { max-width: 100%; height: auto; display: block; margin: 0 auto; } figcaption { font-size: .87rem; margin-top: .5rem; }
table { width: 100%; border-collapse: collapse; background: var(--card); font-variant-numeric: tabular-nums; font-size: .87rem; }
th, td { padding: .35rem .5rem; border-bottom: 1px solid var(--line); text-align: right; vertical-align: bottom; overflow-wrap: break-word; }
th:first-child, td:first-child { text-align: left; min-width: 9em; } th { color: var(--soft); font-weight: 600; border-bottom-width: 2px; }
th.words, td.words { text-align: left; }
.wide { overflow-x: auto; }
"""


def build(
    out: str | Path,
    *,
    runs: Paths = (),
    logs: Paths = (),
    evals: Paths = (),
    summaries: Paths = (),
    sweeps: Paths = (),
    demos: Paths = (),
    task: str | None = None,
    title: str = "NEARL report",
) -> Path:
    """Writes the report.

    Args:
        out: HTML file to write.
        runs: Run folders of ``nearl train``.
        logs: Flight logs of ``nearl run --log``.
        evals: Output files of ``nearl eval --json``.
        summaries: Output files of ``nearl run --json``, or ``summary.json`` of ``nearl demo``.
        sweeps: Folders of many runs, as ``nearl sweep`` makes them: drawn in one figure, which is also written as a PNG beside the page.
        demos: Demonstrations (``.npz``); those that a run of ``runs`` learned from are shown anyway.
        task: Name or file of the task whose robot ``demos`` are pictures of; None draws their joints alone.
        title: Heading.

    Raises:
        ReadError: an input is not what it was given as.
        OSError: an input cannot be read or ``out`` not written.
    """
    trained = [read_run(Path(p)) for p in runs]
    flights = [read_log(Path(p)) for p in logs]
    programs = [read_json(Path(p)) for p in (*evals, *summaries)]
    swept = [run for folder in sweeps for run in sweep.read_sweep(Path(folder))]
    shown = [demonstrations.read_demonstrations(Path(p), task) for p in demos]
    shown += {d.path.resolve(): d for run in trained if (d := demonstrations.of_run(run.path))}.values()
    if not (trained or flights or programs or swept or shown):
        raise ReadError("there is nothing to report; give a folder of runs, or at least one of --run, --log, --eval, --summary and --demos")
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    sections = [("All runs", _sweep(swept, out.with_suffix(".png")))] if swept else []
    picture, on_top = _picture(trained, flights)
    sections += _sections(trained, programs, flights, on_top)
    sections += [("Demonstrations", "".join(_demonstrations(d) for d in shown))] if shown else []
    body = "".join(f"<section><h2>{html.escape(name)}</h2>{content}</section>" for name, content in sections if content)
    first = _first_screen(trained + swept, programs, flights) + picture
    page = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{CSS}</style></head><body><main><h1>{html.escape(title)}</h1>"
        f'<p class="lead">{html.escape(_about(swept + trained, flights))}</p>{first}{body}</main></body></html>\n'
    )
    try:
        out.write_text(page, encoding="utf-8")
    except OSError as error:  # a full disk does not name the file
        raise OSError(error.errno, error.strerror, str(out)) from error
    return out


def _sweep(runs: list[Run], picture: Path) -> str:
    figure = sweep.figure(runs)
    figure.savefig(picture, dpi=170, facecolor="white")
    return image(figure, sweep.CAPTION) + _table("At the last step that all seeds have, where the curves end", sweep.HEAD, sweep.table(runs))


def _first_screen(trained: list[Run], programs: list[Summary], flights: list[Log]) -> str:
    """The promise in three measured numbers."""
    cards = "".join(
        f'<div><strong class="{"good" if good else ""}">{html.escape(number)}</strong>{html.escape(words)}</div>'
        for number, words, good in promise(trained, programs, flights)
    )
    return f'<div class="promise">{cards}</div>' if cards else ""


def _picture(trained: list[Run], flights: list[Log]) -> tuple[str, bool]:
    """The picture of the first screen: a flight in which the projection had work, else what the trainings' limits came to; whether it is
    the latter."""
    flown = next((drawn for log in flights if (drawn := flight.states(log, at_most=2))), "")
    broken = "" if flown else "".join(training.violations(trained))
    return flown or broken, bool(broken)


def _sections(trained: list[Run], programs: list[Summary], flights: list[Log], on_top: bool) -> list[tuple[str, str]]:
    """What was measured; a section without content is left out, and so is what stands ``on_top`` of the page."""
    return [
        ("Results", _results(trained, programs, flights)),
        ("Learning", "".join(training.learning_curves(trained))),
        ("Inverse dynamics", "".join(training.idm_loss(trained))),
        ("Constraints while training", "" if on_top else "".join(training.violations(trained))),
        *_flights(flights),
    ]


def _demonstrations(demos: demonstrations.Demonstrations) -> str:
    head, cells = demonstrations.facts(demos)
    return _table("", head, [cells]) + demonstrations.pictures(demos) + demonstrations.joints(demos)


def _about(runs: list[Run], logs: list[Log]) -> str:
    parts = []
    if runs:
        names = sorted({f"{r.task} with {r.algo}" for r in runs})
        parts.append(f"{len(runs)} training{'s' if len(runs) > 1 else ''}: {', '.join(names)}.")
    for log in logs:
        end = ", without its end" if log.without_end else f", {log.off_end} at its end" if log.off_end else ""
        parts.append(f"{log.path.name}: {len(log)} ticks of {1e3 * log.dt:g} ms{end}.")
    return " ".join(parts) + f" nearl {__version__}."


def _results(runs: list[Run], programs: list[Summary], logs: list[Log]) -> str:
    parts = []
    if evaluations := [e for p in programs for e in p.evaluations]:
        head = ["episodes without exploration", "mode", "return", "episodes", "raw proposals outside", "targets outside", "reached outside"]
        parts.append(_table("Return and broken limits [share of ticks]", head, [_evaluation_row(*e) for e in evaluations]))
    if runs:
        head = ["training", "seed", "steps", "return at the end", "raw proposals outside", "targets outside", "reached outside", "steps/s"]
        parts.append(_table("Trainings, where their curves end", head, [_run_row(run) for run in runs]))
    loops = [_loop_row(*loop) for p in programs for loop in p.loops] or [_log_row(log) for log in logs]
    if loops:
        head = ["loop", "ticks", "compute p50", "p99", "p99.9", "max", "wake p50", "p99", "overruns", "late on the robot"]
        parts.append(_table("Latency [µs]", head, loops))
    if broken := [_broken_row(*loop) for p in programs for loop in p.loops]:
        head = ["loop", "by raw proposals", "by projected targets", "by the robot", "robot's largest excess"]
        parts.append(_table("Limits broken in the loop [ticks; by the robot summed over kinds of limits]", head, broken))
    if receipts := [_receipt_row(*r) for p in programs for r in p.receipts]:
        parts.append(_table("Snapshots pushed while it ran", ["loop", "version", "verdict", "words"], receipts, words=3))
    return "".join(parts)


def _evaluation_row(name: str, e: dict[str, Any]) -> list[str]:
    returns = np.asarray(e["returns"], float)
    spread = f" ± {returns.std():.1f}" if len(returns) > 1 else ""
    mean = f"{returns.mean():.1f}{spread}" if len(returns) else "–"
    kinds = ("raw_violations", "target_violations", "reached_violations")
    return [name, str(e["mode"]), mean, str(len(returns)), *(_share(e.get(k), e.get("ticks")) for k in kinds)]


def _run_row(run: Run) -> list[str]:
    def last(column: str) -> float | None:
        found = run.column(column)
        return None if found is None else float(found[1][-1])

    end = training.final_return(run)
    shares = [last(f"constraints/{kind}_violations") for kind in ("raw", "target", "reached")]
    fps = last("time/fps")
    return [
        f"{run.task}, {run.algo}",
        "–" if run.seed is None else str(run.seed),
        "–" if end is None else f"{end[1]:,.0f}",
        "–" if end is None else f"{end[0]:.1f}",
        *("–" if x is None else f"{100 * x:.2f} %" for x in shares),
        "–" if fps is None else f"{fps:,.0f}",
    ]


def _loop_row(name: str, s: dict[str, Any]) -> list[str]:
    us = [f"{s[what][p] * 1e-3:.1f}" for what, p in (*(("compute", p) for p in ("p50", "p99", "p999", "max")), ("wake", "p50"), ("wake", "p99"))]
    return [name, f"{s['ticks']:,}", *us, _count(s.get("counters", {}).get("overruns")), _count(s.get("plant", {}).get("late"))]


def _log_row(log: Log) -> list[str]:
    c = log.columns
    us = [f"{p:.1f}" for p in flight.percentiles((c["end_ns"] - c["begin_ns"]) * 1e-3)]
    wake = [f"{p:.1f}" for p in flight.percentiles((c["begin_ns"] - c["due_ns"]) * 1e-3)[:2]]
    return [log.path.stem, f"{len(log):,}", *us, *wake, _count(np.nanmax(c["overruns"], initial=0.0)), "–"]


def _broken_row(name: str, s: dict[str, Any]) -> list[str]:
    counters, plant = s.get("counters", {}), s.get("plant", {})
    broken = plant.get("violations", {})
    excess = [f"{kind} {x:.2g}" for kind, x in plant.get("worst", {}).items() if x > 0]
    return [
        name,
        _count(counters.get("raw_violations")),
        _count(counters.get("target_violations")),
        _count(sum(broken.values()) if broken else None),
        ", ".join(excess) or "–",
    ]


def _receipt_row(name: str, receipt: dict[str, Any]) -> list[str]:
    words = str(receipt["text"])
    return [name, str(receipt["version"]), "swapped in" if receipt["accepted"] else "refused", words]


def _share(part: float | None, whole: float | None) -> str:
    return "–" if part is None or not whole else f"{100 * part / whole:.2f} %"


def _count(n: float | None) -> str:
    return "–" if n is None or not np.isfinite(n) else f"{int(n):,}"


def _table(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], words: int | None = None) -> str:
    """A table; the column ``words`` holds sentences."""

    def line(row: Sequence[str], tag: str) -> str:
        cells = "".join(f'<{tag} class="words">{html.escape(c)}</{tag}>' if i == words else f"<{tag}>{html.escape(c)}</{tag}>" for i, c in enumerate(row))
        return f"<tr>{cells}</tr>"

    lines = "".join(line(row, "td") for row in rows)
    heading = f"<h3>{html.escape(caption)}</h3>" if caption else ""
    return f'{heading}<div class="wide"><table><thead>{line(head, "th")}</thead><tbody>{lines}</tbody></table></div>'


def _flights(logs: list[Log]) -> list[tuple[str, str]]:
    sections = []
    for log in logs:
        picture, sentence = flight.timeline(log)
        parts = [picture or f'<p class="lead">{html.escape(sentence)}</p>', flight.states(log) or "", flight.ledger(log), flight.latency(log) or ""]
        modes = {mode: log.mode.count(mode) for mode in sorted(set(log.mode))}
        words = ", ".join(f"{n:,} {mode}" for mode, n in modes.items())
        lead = f'<p class="lead">The end of this log is missing: {html.escape(WITHOUT_END)}.</p>' if log.without_end else ""
        if log.off_end:
            lead = f'<p class="lead">The end of this log, behind its ticks, is {log.off_end}: {html.escape(OFF_END[log.off_end])}.</p>'
        if log.left_out:
            lead += f'<p class="lead">This log {html.escape(beyond(log))}.</p>'
        lead += f'<p class="lead">Ticks by mode: {html.escape(words)}.</p>{_commands(log)}'
        sections.append((f"Flight {log.path.name}", lead + "".join(parts) + _settings(log)))
    return sections


def _commands(log: Log) -> str:
    """What the joints are sent: those that are sent the same in one sentence."""
    joints: dict[str, list[str]] = {}
    for joint, command in json.loads(log.metadata.get("commands", "{}")).items():
        joints.setdefault(command, []).append(joint)
    said = "".join(f" {html.escape(', '.join(names))}: {html.escape(command)}." for command, names in joints.items())
    return f'<p class="lead">Commanded:{said}</p>' if said else ""


def _settings(log: Log) -> str:
    """What the loop was started with, folded away."""
    if not log.metadata:
        return ""
    rows = [[key, value if len(value) <= 300 else value[:300] + " …"] for key, value in sorted(log.metadata.items())]
    return f"<details><summary>Settings of the loop</summary>{_table('', ['name', 'value'], rows, words=1)}</details>"
