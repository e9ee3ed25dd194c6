"""What a file of demonstrations holds: numbers, joints over time, and pictures of the robot."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from nearl import _core
from nearl.report.read import ReadError, regular
from nearl.report.style import MUTED, PROJECTED, image, strip
from nearl.runs import demonstrations_of
from nearl.sources import text

Floats = NDArray[np.float64]
COLUMNS_AT_MOST = 6
EPISODES_AT_MOST = 20
PICTURES = 6
NEEDED = ("observations", "qpos", "qvel", "lengths", "dt", "names")


@dataclass
class Demonstrations:
    """Episodes of an expert.

    Attributes:
        path: Of the file.
        task: Task file or name whose robot is drawn; None draws none.
        observations, qpos, qvel: States in a row, one more an episode than it has steps (n x n_obs, nq, nv).
        lengths: Steps of each episode.
        dt: Policy period [s].
        names: Of the observation's columns (n_obs).
        has_actions: The file holds them too.
    """

    path: Path
    task: str | None
    observations: Floats
    qpos: Floats
    qvel: Floats
    lengths: NDArray[np.int64]
    dt: float
    names: list[str]
    has_actions: bool

    def episodes(self) -> list[slice]:
        """The rows of each episode."""
        ends = np.cumsum(self.lengths + 1)
        return [slice(int(end - length - 1), int(end)) for end, length in zip(ends, self.lengths)]


def read_demonstrations(path: Path, task: str | None = None) -> Demonstrations:
    """A file as ``nearl demos record`` writes it."""
    try:
        with np.load(regular(path, "a file written by 'nearl demos record'"), allow_pickle=False) as data:
            missing = [name for name in NEEDED if name not in data.files]
            if missing:
                raise ReadError(f"'{path}' has no array '{missing[0]}'; give a file written by 'nearl demos record'")
            observations, qpos, qvel = (np.asarray(data[name], float) for name in NEEDED[:3])
            lengths, names = data["lengths"].astype(int), [text(n, "'names'", f"'{path}'") for n in data["names"]]
            found = Demonstrations(path, task, observations, qpos, qvel, lengths, float(data["dt"]), names, "actions" in data.files)
    except (zipfile.BadZipFile, ValueError, EOFError) as error:
        if isinstance(error, ReadError):
            raise
        raise ReadError(f"'{path}' are no demonstrations that can be read ({error}); give a file written by 'nearl demos record'") from error
    rows = int((found.lengths + 1).sum())
    if not len(found.lengths) or any(len(table) != rows for table in (observations, qpos, qvel)):
        raise ReadError(f"'{path}' has {len(observations)} rows, its lengths ask for {rows}; check it with 'nearl demos check'")
    return found


def of_run(run: Path) -> Demonstrations | None:
    """Those that a run folder learned from; None where it has none, or the file is gone."""
    file = demonstrations_of(run)
    return None if file is None or not file.is_file() else read_demonstrations(file, str(run / "task.toml"))


def facts(demos: Demonstrations) -> tuple[list[str], list[str]]:
    """Heads and cells of a table."""
    steps = demos.lengths
    length = f"{steps.min():,}" if steps.min() == steps.max() else f"{steps.min():,} .. {steps.max():,}"
    head = ["file", "episodes", "steps of an episode", "period [ms]", "together [s]", "actions"]
    return head, [demos.path.name, f"{len(steps):,}", length, f"{1e3 * demos.dt:g}", f"{steps.sum() * demos.dt:.1f}", "yes" if demos.has_actions else "no"]


def joints(demos: Demonstrations) -> str:
    """Positions over time of the joints that move most, every episode a line."""
    columns = [i for i, name in enumerate(demos.names) if name.startswith("q.")] or list(range(len(demos.names)))
    moves = np.nan_to_num(demos.observations[:, columns].std(axis=0))
    chosen = sorted(np.array(columns)[np.argsort(-moves, kind="stable")[:COLUMNS_AT_MOST]])
    episodes = demos.episodes()[:EPISODES_AT_MOST]
    rows = -(-len(chosen) // 2)
    figure, panels = plt.subplots(rows, min(2, len(chosen)), figsize=(10.2, 0.7 + 1.5 * rows), squeeze=False, sharex=True)
    for axes, column in zip(panels.flat, chosen):
        for k, rows_of in reversed(list(enumerate(episodes))):
            values = demos.observations[rows_of, column]
            look = {"color": PROJECTED, "linewidth": 1.6} if k == 0 else {"color": MUTED, "linewidth": 0.7, "alpha": 0.6}
            axes.plot(np.arange(len(values)) * demos.dt, values, **look)
        axes.set_title(demos.names[column].removeprefix("q."))
        axes.margins(x=0)
        axes.tick_params(labelbottom=True)
    for axes in panels.flat[len(chosen) :]:
        axes.remove()
    for axes in panels[-1, :]:
        axes.set_xlabel("time [s]")
    panels[0, 0].set_ylabel("[rad or m]" if demos.names[chosen[0]].startswith("q.") else "")
    shown = "all episodes" if len(episodes) == len(demos.lengths) else f"the first {len(episodes)} of {len(demos.lengths)} episodes"
    return image(figure, f"What moves most in {demos.path.name}, {shown}; the first in blue.")


def pictures(demos: Demonstrations) -> str:
    """The robot at even times of the first episode; a sentence where it cannot be drawn. Nothing without a task."""
    if demos.task is None:
        return ""
    from nearl.render import Renderer, VideoError

    env = _core.Env(demos.task)
    if (demos.qpos.shape[1], demos.qvel.shape[1]) != (env.nq, env.nv):
        raise ReadError(f"'{demos.path}' is of another robot than '{demos.task}': {demos.qpos.shape[1]} positions a state, not {env.nq}")
    try:
        renderer = Renderer(env, (320, 260))
    except VideoError as error:
        return f'<p class="lead">No pictures of the robot: {error}.</p>'
    first = demos.episodes()[0]
    rows = np.linspace(first.start, first.stop - 1, PICTURES).astype(int)
    frames = [renderer.frame(demos.qpos[row], demos.qvel[row]) for row in rows]
    renderer.close()
    times = ", ".join(f"{(row - first.start) * demos.dt:.2f}" for row in rows)
    return strip(frames, f"The first episode of {demos.path.name} at {times} s.")
