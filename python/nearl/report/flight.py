"""Figures of a flight log: active constraints, proposed / projected / reached state, latency."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

from nearl.report.read import Floats, Log
from nearl.report.rows import active_rows, tick_proposals
from nearl.report.style import DEADLINE, GRID, MUTED, PROJECTED, PROPOSED, REACHED, image

COLUMNS_AT_MOST = 900
ROWS_AT_MOST = 28
JOINTS_AT_MOST = 7
# A window is long enough to see a motion, and short enough to tell its curves apart.
TICKS_AT_MOST, TICKS_AT_LEAST, WINDOW_SECONDS = 600, 60, 2.0


def timeline(log: Log) -> tuple[str | None, str]:
    """Which rows were active when, and a sentence about the whole."""
    rows = active_rows(log)
    if rows is None:
        return None, "The log counts the active constraints, but does not hold enough to tell which they were."
    if not rows.names:
        return None, "No constraint was active in any tick."
    share = np.isfinite(rows.multiplier).mean(axis=1)
    if not share.any():
        return None, "Of no active constraint the multiplier can be drawn."
    busy = np.sort(np.argsort(-share, kind="stable")[:ROWS_AT_MOST])
    names, values = [rows.names[i] for i in busy], _binned(rows.multiplier[busy])
    edges = np.linspace(0, max(log.time[-1], log.dt), values.shape[1] + 1)
    figure, axes = plt.subplots(figsize=(10.2, 1.25 + 0.23 * len(names)))
    low, high = np.nanpercentile(values, [2, 99.5])
    low = max(low, high * 1e-4, 1e-12)
    high = max(high, low * 1.5)
    norm = LogNorm(low, high)
    mesh = axes.pcolormesh(edges, np.arange(len(names) + 1), values, cmap="viridis_r", norm=norm, rasterized=True)
    axes.set_yticks(np.arange(len(names)) + 0.5, names)
    axes.set(xlabel="time [s]", title="Active constraints")
    axes.grid(False)
    axes.hlines(np.arange(1, len(names)), edges[0], edges[-1], color=GRID, linewidth=0.6)
    axes.tick_params(axis="y", length=0)
    axes.invert_yaxis()
    bar = figure.colorbar(mesh, ax=axes, label=rows.meaning, pad=0.012, aspect=max(8, 1.6 * len(names)))
    bar.ax.yaxis.set_major_formatter(lambda x, _: f"{x:g}")
    bar.ax.yaxis.set_minor_formatter(lambda x, _: f"{x:g}" if high < 20 * low else "")
    left_out = f" The {len(rows.names) - len(busy)} least busy rows are left out." if len(busy) < len(rows.names) else ""
    caption = f"Rows that hold the target back, coloured by how hard they are leaned on (empty: not active; arrow: which bound).{left_out}"
    return image(figure, caption), ""


def _binned(values: Floats) -> Floats:
    """Largest of each bin of ticks, NaN where none was active."""
    rows, n = values.shape
    size = -(-n // COLUMNS_AT_MOST)
    padded = np.full((rows, -(-n // size) * size), -np.inf)
    padded[:, :n] = np.where(np.isfinite(values), values, -np.inf)
    binned = padded.reshape(rows, -1, size).max(axis=2)
    return np.where(np.isfinite(binned), binned, np.nan)


def has_targets(log: Log) -> bool:
    """Whether any tick of the flight had a target."""
    return bool(np.isfinite(log.target_v).any())


def states(log: Log, at_most: int = JOINTS_AT_MOST) -> str | None:
    """Proposed, projected and reached position and velocity of the joints that were moved most."""
    if not has_targets(log):
        return None
    chosen, window = _joints(log, at_most), _window(log)
    names = log.names(log.target_v.shape[1])
    shift = log.target_q.shape[1] - log.target_v.shape[1]
    figure, panels = plt.subplots(
        len(chosen), 2, figsize=(10.2, 1.0 + 1.35 * len(chosen)), sharex=True, squeeze=False
    )
    time = log.time[window]
    q_hat, v_hat = tick_proposals(log)
    for row, i in zip(panels, chosen, strict=True):
        k = i + shift if i >= 6 or shift == 0 else i
        _three(row[0], time, log.dt, q_hat[window, k], log.target_q[window, k], log.q[window, k])
        _three(row[1], time, log.dt, v_hat[window, i], log.target_v[window, i], log.v[window, i])
        row[0].set_ylabel(names[i].replace("panda_", ""), rotation=0, ha="right", va="center")
    panels[0, 0].set_title("Position [rad or m]")
    panels[0, 1].set_title("Velocity [rad/s or m/s]")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3)
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    caption = (
        "What the policy proposed for the end of each tick, what the projection made of it, and where the robot got to, "
        f"{time[0]:.2f} s to {time[-1]:.2f} s: the ticks in which the projection had most to do."
    )
    return image(figure, caption)


def _three(axes: plt.Axes, time: Floats, dt: float, proposed: Floats, projected: Floats, reached: Floats) -> None:
    """Proposals are for the end of a tick, measurements for its beginning. The proposal may leave the picture."""
    axes.plot(time + dt, proposed, color=PROPOSED, linewidth=1.0, alpha=0.85, label="proposed")
    axes.plot(time + dt, projected, color=PROJECTED, linewidth=2.6, alpha=0.55, label="projected")
    axes.plot(time, reached, color=REACHED, linewidth=1.0, linestyle=(0, (3, 1.5)), label="reached")
    kept, asked = (values[np.isfinite(values)] for values in (np.concatenate([projected, reached]), proposed))
    low, high = (kept.min(), kept.max()) if len(kept) else (0.0, 0.0)
    wide_low, wide_high = np.percentile(asked, [1, 99]) if len(asked) else (low, high)
    room = max(high - low, 0.3 * max(abs(low), abs(high)), 1e-3)
    axes.set_ylim(max(min(low, wide_low), low - room) - 0.08 * room, min(max(high, wide_high), high + room) + 0.08 * room)
    axes.margins(x=0)
    axes.locator_params(axis="y", nbins=4)
    axes.ticklabel_format(axis="y", useOffset=False)


def _moved(log: Log) -> Floats:
    """Distance the projection moved each velocity (n x nv), 0 where there was no target."""
    return np.nan_to_num(np.abs(log.proposal_v - log.target_v))


def _joints(log: Log, at_most: int) -> NDArray[np.intp]:
    """The busiest joints in their order; those that move where none was projected."""
    distance = _moved(log).mean(axis=0)
    if not distance.any():
        distance = np.nan_to_num(log.v).std(axis=0)
    return np.sort(np.argsort(-distance, kind="stable")[:at_most])


def _window(log: Log) -> slice:
    """The ticks with most to do, inside one episode where one is long enough."""
    total = _moved(log).sum(axis=1)
    length = min(TICKS_AT_MOST, max(TICKS_AT_LEAST, round(WINDOW_SECONDS / log.dt)))
    if len(total) <= length:
        return slice(0, len(total))
    sums = np.concatenate([[0.0], np.cumsum(total)])
    inside = sums[length:] - sums[:-length]
    episode = log.columns["episode"]
    whole = episode[: len(inside)] == episode[length - 1 :]
    if whole.any():
        inside = np.where(whole, inside, -1.0)
    start = int(np.argmax(inside))
    return slice(start, start + length)


def ledger(log: Log) -> str:
    """Which stage answered, how far it moved the proposal, by how much soft limits gave way, and its iterations, over time."""
    numbers = ("moved", "moved\n[rad/s]"), ("slack", "slack\n[share]"), ("iterations", "iterations")
    drawn = [(log.columns[key], label) for key, label in numbers if np.nan_to_num(log.columns[key]).any()]
    rung, names = log.columns["rung"], log.rungs()
    used = np.unique(rung[np.isfinite(rung)]).astype(int)
    share = [np.where(np.isfinite(rung), rung == k, False) for k in used]
    figure, panels = plt.subplots(
        1 + len(drawn), 1, figsize=(10.2, 1.0 + 0.3 * len(used) + 1.05 * len(drawn)), sharex=True, squeeze=False,
        height_ratios=[0.3 * max(len(used), 1), *[1.05] * len(drawn)],
    )  # fmt: skip
    first, *others = panels[:, 0]
    end = max(log.time[-1], log.dt)
    if share:
        seen = _binned(np.array(share, float))
        edges, shares = np.linspace(0, end, seen.shape[1] + 1), np.where(seen > 0, seen, np.nan)
        first.pcolormesh(edges, np.arange(len(used) + 1), shares, cmap="Blues", vmin=0, vmax=1.3, rasterized=True)
    label = [f"{names[k] if k < len(names) else f'stage {k}'} {100 * s.mean():.3g} %" for k, s in zip(used, share, strict=True)]
    first.set_yticks(np.arange(len(used)) + 0.5, label)
    first.set_title("Ledger of the projection")
    first.tick_params(axis="y", length=0)
    first.grid(False)
    first.invert_yaxis()
    for axes, (values, words) in zip(others, drawn, strict=True):
        largest = _binned(values[None, :])[0]
        axes.fill_between(np.linspace(0, end, len(largest)), np.nan_to_num(largest), color=PROJECTED, alpha=0.6, linewidth=0.5)
        axes.set_ylabel(words, rotation=0, ha="right", va="center")
        axes.set_ylim(bottom=0)
        axes.locator_params(axis="y", nbins=3)
    panels[-1, 0].set(xlabel="time [s]", xlim=(0, end))
    quiet = [key for key, _ in numbers if not np.nan_to_num(log.columns[key]).any()]
    zero = f" Always zero: {', '.join(quiet)}." if quiet else ""
    caption = (
        "Which stage of the projector answered (share of ticks), and the largest of each moment: distance between proposal and target, "
        f"excess of soft limits as a share of their size, iterations.{zero}"
    )
    return image(figure, caption)


def latency(log: Log) -> str | None:
    """Histograms of compute time and of due-to-action time with the deadline."""
    c = log.columns
    compute, total = (c["end_ns"] - c["begin_ns"]) * 1e-3, (c["end_ns"] - c["due_ns"]) * 1e-3
    deadline = log.dt * 1e6
    series = (("controller", compute, PROJECTED), ("from due to action", total, MUTED))
    values = np.concatenate([x[np.isfinite(x) & (x > 0)] for _, x, _ in series])
    if not len(values):
        return None
    low, high = max(values.min() * 0.8, 0.1), max(values.max(), deadline) * 1.4
    bins = np.geomspace(low, high, 90)
    figure, axes = plt.subplots(figsize=(10.2, 3.2))
    for name, x, colour in series:
        p50, p99, _, most = (f"{us:.1f}" if us < 1e9 else f"{us:.3g}" for us in percentiles(x))
        label = f"{name}: p50 {p50}, p99 {p99}, max {most} µs"
        axes.hist(x[np.isfinite(x)], bins=bins, color=colour, alpha=0.6, label=label)
    axes.axvline(deadline, color=DEADLINE, linewidth=1.5)
    place = {"xycoords": ("data", "axes fraction"), "xytext": (-5, -4), "textcoords": "offset points", "ha": "right", "va": "top"}
    axes.annotate(f"deadline {deadline:g} µs", (deadline, 1), color=DEADLINE, **place)
    axes.set(xscale="log", yscale="log", xlabel="time [µs]", ylabel="ticks", title="Latency", xlim=(low, high))
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    figure.legend(loc="outside upper right", ncols=2)
    late = int(np.sum(total > deadline))
    return image(figure, f"{len(log)} ticks; {late} action{'' if late == 1 else 's'} later than the control period of {deadline:g} µs.")


def percentiles(values: Floats) -> list[float]:
    """p50, p99, p99.9 and the largest, of finite values."""
    x = values[np.isfinite(values)]
    return [float(p) for p in np.percentile(x, [50, 99, 99.9, 100])] if len(x) else [float("nan")] * 4
