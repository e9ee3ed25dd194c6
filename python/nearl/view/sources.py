"""What the live view shows, and a running loop as where it comes from."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nearl import _core

Floats = NDArray[np.float64]


class ViewError(RuntimeError):
    """Nothing can be shown; the message says what is missing."""


@dataclass(frozen=True)
class Held:
    """A row that held targets back since the last picture.

    Attributes:
        row: Its number; those of the degrees of freedom come first.
        name: Its name.
        kind: Of the limit behind it.
        side: ``lower`` or ``upper``.
        multiplier: The largest.
        ticks: In so many of the ticks.
    """

    row: int
    name: str
    kind: str
    side: str
    multiplier: float
    ticks: int


@dataclass(frozen=True)
class Picture:
    """The newest tick, and what the ticks since the last picture did.

    Attributes:
        mode: Mode of the loop, or ``training``.
        reason: Why the loop is in it; None where there is none.
        tick, version, episode: Of the tick.
        ticks: Ticks since the last picture.
        q, v: Measured (nq, nv).
        proposal, target: Configuration and velocity (nq, nv) each; None in a tick that acts on nothing, or without a proposal.
        period: Control period [s].
        held: Rows that held a target back.
        ledger: What the projector said of the tick by name; None where it projected nothing.
        raw, broken: Ticks since the last picture whose proposal broke a limit, and that began within the limits and whose target broke one.
        raw_total, broken_total: The same since the start.
        latency: Time from when each tick was due until its action was handed over [s]; None where nothing keeps real time.
        overruns: Ticks for which the loop itself took longer than a period, from the state to the action; a plant that is late counts in
            ``latency`` alone. None as ``latency``.
        lost: Ticks that this view did not read in time.
        force: What the action makes the motors do on each degree of freedom (nv) [N m or N]; None in a tick without an action.
    """

    mode: str
    reason: str | None
    tick: int
    version: int
    episode: int
    ticks: int
    q: Floats
    v: Floats
    proposal: tuple[Floats, Floats] | None
    target: tuple[Floats, Floats] | None
    period: float
    held: Sequence[Held]
    ledger: dict[str, Any] | None
    raw: int
    broken: int
    raw_total: int
    broken_total: int
    latency: Floats | None = None
    overruns: int | None = None
    lost: int = 0
    force: Floats | None = None


@dataclass
class Robot:
    """What does not change from picture to picture.

    Attributes:
        env: The native environment, whose robot is drawn.
        joints: Names of the degrees of freedom (nv).
        rows: Names of all rows by number; the first are the joints.
        limits: By name (nv each), infinite where there is none.
    """

    env: _core.Env
    joints: list[str]
    rows: list[str]
    limits: dict[str, Floats]


def labels(names: Sequence[str], kinds: Sequence[str | None]) -> list[str]:
    """Names of rows that differ: those over several joints with their kind."""
    return [name if kind is None else f"{name} {kind.replace('_', ' ')}" for name, kind in zip(names, kinds)] + list(names[len(kinds) :])


class Source(Protocol):
    """Where pictures come from."""

    robot: Robot
    title: str

    def next(self, span: float) -> Picture | None:
        """What happened in the next ``span`` [s]; None where nothing did."""

    def curves(self) -> dict[str, tuple[Floats, Floats]]:
        """Steps and values by name, of a training."""

    def close(self) -> None:
        """Leaves."""


class Loop:
    """A running loop, over the link.

    Args:
        name: As in ``nearl run --plant NAME``.
        task: Name of the task or task file whose robot is drawn; None takes the name that the loop says.

    Raises:
        ViewError: the task's robot is not known here.
        ConnectionError: there is no loop.
    """

    def __init__(self, name: str, task: str | None, patience: float = 5.0):
        self.title = name
        self._client = _core.ViewClient(name, patience)
        self._told = self._client.told()
        wanted = task or self._told["task"]
        try:
            env = _core.Env(wanted)
        except (ValueError, OSError) as error:
            self._client.close()
            if task is not None and "[reward]" in str(error):
                raise ViewError(f"{error}. The page draws what a task simulates: give it a copy of the file with [reward] none = \"0\"") from error
            if task is not None:
                raise
            raise ViewError(f"the loop of `{name}` runs a policy of task '{wanted}', which is none of the bundled ones; give its file: --task FILE") from error
        joints = self._told["rows"][: len(self._told["velocity"])]
        if len(env.state()[1]) != len(joints):
            self._client.close()
            raise ViewError(f"the robot of '{wanted}' has {len(env.state()[1])} degrees of freedom, that of the loop of `{name}` {len(joints)}; give --task")
        self.robot = Robot(env, joints, self._rows(), self._limits())

    def next(self, span: float) -> Picture | None:
        seen = self._client.look(span)
        if seen is None:
            return None
        if self._told["snapshot"] != seen["snapshot"]:
            self._told = self._client.told()
            self.robot.rows, self.robot.limits = self._rows(), self._limits()
        names = self.robot.rows if self._told["snapshot"] == seen["snapshot"] else []
        held = [Held(r["row"], names[r["row"]], r["kind"], r["side"], r["multiplier"], r["ticks"]) for r in seen["active"] if r["row"] < len(names)]
        acts = seen["acts"]
        return Picture(
            mode=seen["mode"],
            reason=seen["reason"],
            tick=seen["tick"],
            version=seen["version"],
            episode=seen["episode"],
            ticks=seen["ticks"],
            q=seen["q"],
            v=seen["v"],
            proposal=(seen["proposal_q"], seen["proposal_v"]) if acts else None,
            target=(seen["target_q"], seen["target_v"]) if acts else None,
            period=seen["period_ns"] * 1e-9,
            held=held,
            ledger=seen["ledger"],
            raw=seen["raw"],
            broken=seen["target"],
            raw_total=seen["raw_total"],
            broken_total=seen["target_total"],
            latency=None if self._told["lockstep"] else seen["latency_ns"] * 1e-9,
            overruns=None if self._told["lockstep"] else seen["overruns"],
            lost=seen["lost"],
            force=self._force(seen["q"], seen["v"], seen["action"]) if acts else None,
        )

    def curves(self) -> dict[str, tuple[Floats, Floats]]:
        return {}

    def close(self) -> None:
        self._client.close()

    def _force(self, q: Floats, v: Floats, action: Floats) -> Floats | None:
        """None where the robot that is drawn takes no such action."""
        return self.robot.env.motor_forces(q, v, action) if len(action) == len(self.robot.env.actuator_names) else None

    def _rows(self) -> list[str]:
        return labels(self._told["rows"], self._told["kinds"])

    def _limits(self) -> dict[str, Floats]:
        return {k: v for k, v in self._told.items() if isinstance(v, np.ndarray)}
