"""A run folder whose training goes on, as what the live view shows."""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nearl import _core
from nearl.runs import ReadError, read_run
from nearl.view.sources import Held, Picture, Robot, ViewError, labels

Floats = NDArray[np.float64]
REREAD = 2.0  # [s] between two looks at a run folder
CURVES = {"rollout/ep_rew_mean": "return", "constraints/raw_violations": "proposals outside", "constraints/reached_violations": "reached outside"}


@dataclass
class _Totals:
    raw: int = 0
    broken: int = 0
    tick: int = 0
    episode: int = 0


@dataclass
class _Window:
    raw: int = 0
    broken: int = 0
    held: dict[tuple[int, str, str], Held] = field(default_factory=dict)


class Training:
    """The newest policy of a run folder in its task, in real time and without exploration; a newer one takes over when it is written.

    Args:
        folder: As ``nearl train --out FOLDER``.
        wait: Longest wait for the first snapshot [s].

    Raises:
        ViewError: there is no run folder, or no snapshot in time.
    """

    def __init__(self, folder: Path, wait: float = 60.0):
        self.title, self._folder, self._looked = str(folder), folder, 0.0
        self._stamp: tuple[str, int] | None = None
        self._totals = _Totals()
        self._curves: dict[str, tuple[Floats, Floats]] = {}
        self._names: list[str] = []
        end = time.monotonic() + wait
        while not self._newer():
            if not (folder / "task.toml").is_file():
                raise ViewError(f"'{folder}' is not a run folder: it has no task.toml; give one of `nearl train --out FOLDER`")
            if time.monotonic() >= end:
                raise ViewError(f"'{folder}' has no snapshot after {wait:g} s; a training writes the first with its first checkpoint")
            time.sleep(0.2)
        self._env = _core.Env.of_snapshot(folder)
        self._obs, self._step = self._env.reset(0), 0
        self.robot = Robot(self._env, self._names[: len(self._env.state()[1])], self._names, self._controller.limits)

    def next(self, span: float) -> Picture | None:
        start, window = time.monotonic(), _Window()
        if start - self._looked > REREAD and self._newer():
            self.robot.rows, self.robot.limits = self._names, self._controller.limits
        n = max(1, round(span / self._env.dt))
        for _ in range(n):
            self._begin_where_it_ended()
            q, v = self._env.state()
            action, ledger = self._controller.update(q, v, self._obs)
            self._count(window, ledger)
            self._obs, _, _, self._over, _ = self._env.step(action)
            self._step += 1
        time.sleep(max(0.0, start + span - time.monotonic()))
        proposal, target = (self._state(q, v, x) for x in (self._controller.proposal, self._controller.target))
        told = {
            "status": ledger.status, "rung": ledger.rung, "active": len(ledger.active), "iterations": ledger.iterations, "moved": ledger.moved,
            "slack": ledger.slack, "residual": ledger.residual, "duration_ns": ledger.duration_ns,
        }  # fmt: skip
        t = self._totals
        return Picture(
            "training", None, t.tick, self._controller.version, t.episode, n, q, v, proposal, target, self._env.dt, list(window.held.values()),
            told if proposal else None, window.raw, window.broken, t.raw, t.broken, force=self._env.motor_forces(q, v, action),
        )  # fmt: skip

    def curves(self) -> dict[str, tuple[Floats, Floats]]:
        return self._curves

    def close(self) -> None:
        pass

    def _newer(self) -> bool:
        """Reads the metrics, and the snapshot where it changed; true then."""
        self._looked = time.monotonic()
        try:
            run = read_run(self._folder)
            found = {words: run.column(name) for name, words in CURVES.items()}
            self._curves = {name: curve for name, curve in found.items() if curve is not None}
        except ReadError:
            pass  # not written yet
        files = [self._folder / "checkpoints" / f"{name}.safetensors" for name in ("final", "latest")]
        stamps = [(f.name, f.stat().st_mtime_ns) for f in files if f.is_file()]
        if not stamps or stamps[0] == self._stamp:
            return False
        self._controller, self._stamp, self._over = _core.Controller.load(self._folder), stamps[0], True
        self._names = labels(self._controller.row_names, self._controller.row_kinds)
        return True

    def _begin_where_it_ended(self) -> None:
        if self._over or self._step >= self._env.max_episode_steps:
            self._obs, self._step, self._over = self._env.reset(self._totals.episode), 0, False
            self._controller.reset()
            self._totals.episode += 1

    def _count(self, window: _Window, ledger: _core.Ledger) -> None:
        raw, broken = any(ledger.raw_violations.values()), ledger.target_breaks
        window.raw, window.broken = window.raw + raw, window.broken + broken
        self._totals.raw, self._totals.broken, self._totals.tick = self._totals.raw + raw, self._totals.broken + broken, self._totals.tick + 1
        for row in ledger.active:
            key = (row["row"], row["kind"], row["side"])
            before = window.held.get(key)
            multiplier, ticks = max(row["multiplier"], before.multiplier if before else 0.0), 1 + (before.ticks if before else 0)
            window.held[key] = Held(row["row"], self._names[row["row"]], row["kind"], row["side"], multiplier, ticks)

    def _state(self, q: Floats, v: Floats, entries: Floats) -> tuple[Floats, Floats] | None:
        """The state with the proposed entries in their places; None without any."""
        if not len(entries):
            return None
        q, v = q.copy(), v.copy()
        for name, value in zip(self._controller.state_names, entries):
            what, _, joint = name.partition(".")
            if what in ("q", "v") and joint in self._names:
                dof = self._names.index(joint)
                (q if what == "q" else v)[dof + (len(q) - len(v) if what == "q" else 0)] = value
        return q, v
