"""Many runs in one figure: tasks side by side, return above the inverse model's loss, and the cost where a task has one."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from nearl import curves
from nearl.report.read import ReadError, Run, read_run
from nearl.report.style import CURVES, DEADLINE, steps_axis
from nearl.report.training import band, final_return, grouped

# The order in which the paper lists them; others follow.
ORDER = ["ppo", "nearl", "pid2-gan", "pid2-ib"]
RETURN, LOSS, COST = "rollout/ep_rew_mean", "idm/mse_after", "rollout/ep_cost_mean"
CAPTION = (
    "Columns: tasks. Return: mean of the last 100 training episodes, exploration included. Loss of the inverse model after each update, "
    "with the threshold above which it is trained. Line: interquartile mean over seeds; band: 95 % bootstrap interval; thin lines: the seeds."
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
    rows = [(RETURN, "return"), (LOSS, "inverse model's loss")]
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
        _threshold(panels[1, column], [run for members in by_algo.values() for run in members])
        steps_axis(panels[-1, column])
    for row, (_, label) in enumerate(rows):
        panels[row, 0].set_ylabel(label)
    lines = [plt.Line2D([], [], color=colour, label=name) for name, colour in zip(names, CURVES * len(names))]
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


HEAD = ["task, algorithm", "seeds", "steps", "return, interquartile mean", "95 % interval", "inverse model's loss", "cost"]


def table(runs: list[Run]) -> list[list[str]]:
    """One line a task and algorithm: means over the last ten rows of each run, then the interquartile mean over seeds."""
    lines, tasks = [], grouped(runs)
    for task, by_algo in tasks.items():
        for name in algorithms([run for members in by_algo.values() for run in members]):
            ends = [end for end in (final_return(run) for run in by_algo[name]) if end is not None]
            returns = np.array([value for value, _ in ends])
            words = ["–", "–", "–"]
            if len(returns):
                low, high = curves.bootstrap_band(returns) if len(returns) > 1 else (np.nan, np.nan)
                interval = f"{low:.1f} .. {high:.1f}" if len(returns) > 1 else "–"
                words = [f"{min(steps for _, steps in ends):,.0f}", f"{curves.interquartile_mean(returns):.1f}", interval]
            lines.append([f"{task}, {name}", str(len(by_algo[name])), *words, _end(by_algo[name], LOSS, 3), _end(by_algo[name], COST, 1)])
    return lines


def _end(members: list[Run], metric: str, digits: int) -> str:
    found = [c for c in (run.column(metric) for run in members) if c is not None]
    return f"{curves.interquartile_mean([values[-10:].mean() for _, values in found]):.{digits}f}" if found else "–"
