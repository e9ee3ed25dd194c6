"""Figures of trainings: return, inverse-dynamics loss, broken constraints."""

from collections import defaultdict

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from nearl import curves
from nearl.report.read import Run
from nearl.report.style import CURVES, DEADLINE, MUTED, PROJECTED, PROPOSED, image, steps_axis

Groups = dict[str, dict[str, list[Run]]]


def grouped(runs: list[Run]) -> Groups:
    """Runs by task, then by algorithm."""
    groups: Groups = defaultdict(lambda: defaultdict(list))
    for run in runs:
        groups[run.task][run.algo].append(run)
    return groups


def learning_curves(runs: list[Run]) -> list[str]:
    """Return over steps, one panel a task, one colour an algorithm."""
    groups = {task: by for task, by in grouped(runs).items() if any(r.column("rollout/ep_rew_mean") for a in by.values() for r in a)}
    if not groups:
        return []
    figure, panels = plt.subplots(1, len(groups), figsize=(max(7.2, 5.0 * len(groups)), 3.6), squeeze=False)
    several = False
    for axes, (task, by_algo) in zip(panels[0], groups.items(), strict=True):
        for colour, (algo, members) in zip(CURVES * len(by_algo), by_algo.items()):
            several |= band(axes, members, "rollout/ep_rew_mean", colour, algo)
        axes.set_title(task)
        axes.legend(loc="upper left")
        steps_axis(axes)
    panels[0, 0].set_ylabel("return of an episode")
    caption = "Mean return of the last 100 training episodes, exploration included."
    if several:
        caption += " Line: interquartile mean over seeds; band: 95 % bootstrap interval; thin lines: the seeds."
    return [image(figure, caption)]


def band(axes: Axes, members: list[Run], metric: str, colour: str, label: str | None = None) -> bool:
    """Runs of one kind: thin lines for the seeds, their interquartile mean and its band. True where there is a band."""
    found = [c for c in (run.column(metric) for run in members) if c is not None]
    if not found:
        return False
    words = label and f"{label} ({len(found)} seed{'s' if len(found) > 1 else ''})"
    if len(found) == 1:
        axes.plot(*found[0], color=colour, label=words)
        return False
    for steps, values in found:
        axes.plot(steps, values, color=colour, alpha=0.28, linewidth=0.8)
    try:
        over = curves.over_seeds(found)
    except curves.NoCommonSteps:  # the thin lines are there
        axes.plot([], [], color=colour, label=words and f"{words}, no steps in common")
        return False
    axes.plot(over.steps, over.centre, color=colour, label=words)
    axes.fill_between(over.steps, over.low, over.high, color=colour, alpha=0.18, linewidth=0)
    return True


def idm_loss(runs: list[Run]) -> list[str]:
    """Error of the learned inverse model with the threshold below which it is left alone."""
    with_loss = [run for run in runs if run.column("idm/mse_after") or run.column("idm/mse_before")]
    if not with_loss:
        return []
    tasks = grouped(with_loss)
    figure, panels = plt.subplots(1, len(tasks), figsize=(max(7.2, 5.0 * len(tasks)), 3.3), squeeze=False)
    for axes, (task, by_algo) in zip(panels[0], tasks.items(), strict=True):
        members = [run for algo in by_algo.values() for run in algo]
        for colour, (algo, seeds) in zip(CURVES * len(by_algo), by_algo.items()):
            prefix = f"{algo}, " if len(by_algo) > 1 else ""
            for i, run in enumerate(seeds):
                for column, words, look in (("before", "before an update", {"alpha": 0.35, "linewidth": 0.8}), ("after", "after", {"linewidth": 1.3})):
                    if (found := run.column(f"idm/mse_{column}")) is not None:
                        axes.plot(*found, color=colour, label=prefix + words if i == 0 else None, **look)
        if (threshold := next((c for r in members if (c := r.column("idm/threshold"))), None)) is not None:
            axes.plot(*threshold, color=DEADLINE, linestyle=(0, (5, 3)), linewidth=1.3, label="threshold")
        axes.set(title=task, yscale="log")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=3)
        steps_axis(axes)
    panels[0, 0].set_ylabel("squared error of the action")
    caption = "Loss of the inverse model before and after each update. Above the threshold it is trained until it is below; below, it is left alone."
    return [image(figure, caption)]


def violations(runs: list[Run]) -> list[str]:
    """Share of control ticks in which a constraint was broken: as proposed, as projected, as reached."""
    rows = (
        ("constraints/raw_violations", "raw proposals", PROPOSED),
        ("constraints/reached_violations", "reached states", MUTED),
        ("constraints/target_violations", "projected targets", PROJECTED),
    )
    tasks = grouped([run for run in runs if run.column(rows[0][0])])
    if not tasks:
        return []
    figure, panels = plt.subplots(1, len(tasks), figsize=(max(7.2, 5.0 * len(tasks)), 3.0), squeeze=False)
    for axes, (task, by_algo) in zip(panels[0], tasks.items(), strict=True):
        members = [run for algo in by_algo.values() for run in algo]
        for column, label, colour in rows:
            found = [c for c in (run.column(column) for run in members) if c is not None]
            for i, (steps, share) in enumerate(found):
                alpha = 1.0 if len(found) == 1 else 0.65
                axes.plot(steps, 100 * share, color=colour, alpha=alpha, label=label if i == 0 else None, clip_on=False)
        axes.set_title(task)
        axes.set_ylim(0, max(1.0, min(100.0, axes.get_ylim()[1])))
        axes.legend(loc="best")
        steps_axis(axes)
    panels[0, 0].set_ylabel("ticks outside [%]")
    return [image(figure, "Share of control ticks in which at least one limit was broken. What is proposed may break limits; what is aimed at may not.")]


def final_return(run: Run) -> tuple[float, float] | None:
    """Mean return of the last 100 episodes, and steps at the end: the last point of the curve."""
    column = run.column("rollout/ep_rew_mean")
    return None if column is None else (float(column[1][-1]), float(column[0][-1]))
