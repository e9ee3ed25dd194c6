"""Many runs in one figure: tasks side by side, return above the inverse model's loss, states outside the limits, and cost."""

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, PercentFormatter

from nearl import algorithms as all_algorithms
from nearl import curves
from nearl.report.read import ReadError, Run, read_run
from nearl.report.style import CURVES, DEADLINE, steps_axis
from nearl.report.training import band, grouped

# The order in which the paper lists them; others follow.
ORDER = [name for name, _ in all_algorithms()]
RETURN, LOSS, COST = "rollout/ep_rew_mean", "idm/mse_after", "rollout/ep_cost_mean"
RAW, TARGET, REACHED = (f"constraints/{kind}_violations" for kind in ("raw", "target", "reached"))
CAPTION = (
    "Columns: tasks. Return: mean of the last 100 training episodes, exploration included. Loss of the inverse model after each update, with the "
    "threshold above which it is trained. Outside: share of control periods that ended beyond a limit. "
    "Line: interquartile mean over seeds; band: 95 % bootstrap interval; thin lines: the seeds."
)


def read_sweep(folder: Path) -> list[Run]:
    """Every run below ``folder`` that has begun, in the order of task, algorithm and seed."""
    if not folder.is_dir():
        raise ReadError(f"'{folder}' is not a folder; give one written by 'nearl sweep', or a run folder")
    runs = []
    for file in sorted(folder.rglob("metrics.csv")):
        run = read_run(file.parent)
        if run.column("time/total_timesteps") is not None:
            runs.append(run)
    if not runs:
        raise ReadError(f"'{folder}' holds no run with metrics; give a folder written by 'nearl sweep' or 'nearl train'")
    return runs


def algorithms(runs: list[Run]) -> list[str]:
    """Algorithms in the paper's order; the place gives the colour, the same in every panel."""
    names = sorted({run.algo for run in runs})
    return [n for n in ORDER if n in names] + [n for n in names if n not in ORDER]


def figure(runs: list[Run]) -> Figure:
    """The paper's first figure from these runs."""
    tasks, names = grouped(runs), algorithms(runs)
    rows = [(RETURN, "return")]
    if any(run.column(LOSS) for run in runs):
        rows.append((LOSS, "inverse model's loss"))
    if any(run.column(REACHED) for run in runs):
        rows.append((REACHED, "reached states outside"))
    costly = {id(run) for run in runs if (found := run.column(COST)) is not None and found[1].max() > 0}
    if costly:
        rows.append((COST, "cost of an episode"))
    drawn, panels = plt.subplots(len(rows), len(tasks), figsize=(max(5.6, 3.4 * len(tasks)), 2.6 * len(rows)), squeeze=False, sharex="col")
    for column, (task, by_algo) in enumerate(tasks.items()):
        panels[0, column].set_title(task)
        for row, (metric, _) in enumerate(rows):
            if metric == COST and not any(id(run) in costly for members in by_algo.values() for run in members):
                _empty(panels[row, column], "no cost")
                continue
            for name, colour in zip(names, CURVES * len(names)):
                band(panels[row, column], by_algo.get(name, []), metric, colour)
            if metric == LOSS:
                _threshold(panels[row, column], [run for members in by_algo.values() for run in members])
            if metric == REACHED:
                panels[row, column].yaxis.set_major_formatter(PercentFormatter(1.0))
                panels[row, column].set_ylim(bottom=0)
        steps_axis(panels[-1, column])
    for row, (_, label) in enumerate(rows):
        panels[row, 0].set_ylabel(label)
    lines = [plt.Line2D([], [], color=colour, label=name) for name, colour in zip(names, CURVES * len(names))]
    if any(metric == LOSS for metric, _ in rows):
        lines.append(plt.Line2D([], [], color=DEADLINE, linestyle=(0, (5, 3)), label="threshold"))
    drawn.legend(handles=lines, loc="outside lower center", ncols=len(lines))
    return drawn


def _threshold(axes: Axes, members: list[Run]) -> None:
    """A log scale, as the losses of the algorithms are decades apart."""
    if not any(run.column(LOSS) for run in members):
        _empty(axes, "no inverse model")
        return
    axes.set_yscale("log")
    axes.yaxis.set_minor_formatter(NullFormatter())
    found = [c for c in (run.column("idm/threshold") for run in members) if c is not None]
    if found:
        axes.plot(*max(found, key=lambda c: c[0][-1]), color=DEADLINE, linestyle=(0, (5, 3)), linewidth=1.2)


def _empty(axes: Axes, words: str) -> None:
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center")
    axes.set_yticks([])


HEAD = [
    *("task, algorithm", "seeds", "steps", "return", "95 % interval", "seeds from .. to"),
    *("raw outside", "targets outside", "reached outside", "inverse model's loss", "cost"),
]


def table(runs: list[Run]) -> list[list[str]]:
    """One line a task and algorithm: where its curve ends, the interquartile mean over seeds, its interval, and the seeds' range."""
    lines, tasks = [], grouped(runs)
    for task, by_algo in tasks.items():
        for name in algorithms([run for members in by_algo.values() for run in members]):
            members = by_algo[name]
            words = ["–", "–", "–", "–"]
            if (end := _end(members, RETURN)) is not None:
                several = end.seeds.shape[0] > 1
                interval = f"{end.low[-1]:.1f} .. {end.high[-1]:.1f}" if several else "–"
                spread = f"{end.seeds[:, -1].min():.1f} .. {end.seeds[:, -1].max():.1f}" if several else "–"
                words = [f"{end.steps[-1]:,.0f}", f"{end.centre[-1]:.1f}", interval, spread]
            shares = [_number(members, metric, lambda x: f"{100 * x:.2f} %") for metric in (RAW, TARGET, REACHED)]
            loss, cost = _number(members, LOSS, lambda x: f"{x:.3f}"), _number(members, COST, lambda x: f"{x:.1f}")
            lines.append([f"{task}, {name}", str(len(members)), *words, *shares, loss, cost])
    return lines


def _end(members: list[Run], metric: str) -> curves.Band | None:
    """The curve over seeds, as the figure draws it; None where there is none, or none in common."""
    found = [c for c in (run.column(metric) for run in members) if c is not None]
    try:
        return curves.over_seeds(found) if found else None
    except curves.NoCommonSteps:
        return None


def _number(members: list[Run], metric: str, words: Callable[[float], str]) -> str:
    end = _end(members, metric)
    return "–" if end is None else words(float(end.centre[-1]))
