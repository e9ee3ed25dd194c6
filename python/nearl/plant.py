"""A robot's driver in Python, and the loop beside it.

with nearl.Plant("arm", joints=["slide"], observation=["q.slide", "v.slide"], dt=0.01, nu=1) as plant:
    while True:
        turn, action = plant.exchange(q, v, [*q, *v], patience=0.006)
        ...                                  # "act" and "hold" give an action; at "brake" the driver stops the robot

with nearl.Loop("policy.safetensors", "arm") as loop:     # in place of `nearl run` in another terminal
    ...
print(loop.report["counters"])
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.arguments import MOST_ENTRIES, check_numbers, names_of, whole


class Plant:
    """A robot or a simulator in front of a loop, up to a few hundred hertz.

    Args:
        name: As in ``nearl run SNAPSHOT --plant NAME``.
        joints: Names in the order of v.
        observation: Names of the observation's entries.
        dt: Control period [s].
        nu: Entries of an action.
        nq: Entries of a configuration; as many as joints if not given.
        nv: Entries of a velocity; as many as joints if not given.
        watchdog: Time without a fresh action after which :meth:`exchange` says "brake" [s].
        lockstep: Time stands still until an action comes, as for a simulator.

    Raises:
        ConnectionError: another plant has this name, or the links cannot be made.
        ValueError: there is no joint or no entry of an action.
    """

    def __init__(
        self,
        name: str,
        joints: Sequence[str],
        observation: Sequence[str],
        dt: float,
        nu: int,
        *,
        nq: int | None = None,
        nv: int | None = None,
        watchdog: float = 0.02,
        lockstep: bool = False,
    ) -> None:
        joints = names_of("joints", joints)
        if not joints or nu == 0:
            raise ValueError(f"a robot of {len(joints)} joints and {nu} entries of an action cannot be moved; give at least one of each")
        nu = whole("nu", nu, 1, "give the number of entries of an action", MOST_ENTRIES)
        nq = None if nq is None else whole("nq", nq, 1, "give the number of entries of a configuration", MOST_ENTRIES)
        nv = None if nv is None else whole("nv", nv, 1, "give the number of entries of a velocity", MOST_ENTRIES)
        self._plant = _core.Plant(name, joints, names_of("observation", observation), dt, nu, nq=nq, nv=nv, watchdog=watchdog, lockstep=lockstep)

    def exchange(
        self,
        q: ArrayLike,
        v: ArrayLike,
        obs: ArrayLike,
        patience: float,
        *,
        time: float = 0.0,
        episode: int = 0,
        begins: bool = False,
        braked: bool = False,
    ) -> tuple[str, NDArray[Any] | None]:
        """Gives a state to the loop and waits for its action.

        Args:
            q: Configuration (nq), in Pinocchio's convention.
            v: Velocity (nv).
            obs: Observation (n_obs).
            patience: Longest wait [s]; without a loop there is none, except in lockstep.
            time: The plant's own clock [s]; 0 where it has none.
            episode: Number of the episode.
            begins: This state begins an episode.
            braked: Since the last exchange the driver braked by itself, or something else held the robot, as an emergency stop does: set points begin
                where the robot is.

        Returns:
            ``("act", action)``, ``("hold", action)`` with the action of before as none came in time, or ``("brake", None)``: there is no loop, it
            is silent, or it leaves braking to the plant. Bring the robot to rest then.

        Raises:
            ValueError: there are more or fewer entries, or one is no number.
            RuntimeError: the plant is closed.
        """
        episode = whole("episode", episode, 0, "give its number, counted from 0 to 2**64 - 1", 2**64 - 1)
        for name, value in (("q", q), ("v", v), ("obs", obs)):
            check_numbers(name, value)
        return self._plant.exchange(q, v, obs, patience, time=time, episode=episode, begins=begins, braked=braked)

    @property
    def attached(self) -> bool:
        """Whether a loop answered the last exchange: it is told of the plant in an exchange alone, so that there is nothing to wait for before one."""
        return self._plant.attached

    def close(self) -> None:
        """Leaves; the loop sees that the plant is gone."""
        self._plant.close()

    def __enter__(self) -> Plant:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class Loop:
    """``nearl run`` on threads of this process; Python does not take part in its ticks, but shares its cores.

    What is left out is as ``nearl run --help`` says.

    Args:
        snapshot: File or run folder.
        name: Of the plant.
        seconds: Of ticks after which it stops by itself.
        log: Flight log (MCAP).
        patience: How long to wait for the plant [s].
        ramp: Time over which the first motion is let in [s].
        priority: SCHED_FIFO priority, 1 to 99, with memory locked; 0 or None keeps the normal scheduler.
        proposal_age: Another process proposes (:class:`nearl.Proposer`) in place of the policy; age at which a proposal is only held [s].
        proposal_hold: So long is it held before the loop brakes [s].
        rollback_window: Ticks after which a snapshot that was pushed is taken back if the robot stays three times further from its targets than
            before; 0 keeps it, for policies that are meant to do something else.
    """

    def __init__(
        self,
        snapshot: str | os.PathLike[str],
        name: str,
        *,
        seconds: float | None = None,
        log: str | os.PathLike[str] | None = None,
        patience: float | None = None,
        ramp: float | None = None,
        priority: int | None = None,
        proposal_age: float | None = None,
        proposal_hold: float | None = None,
        rollback_window: int | None = None,
    ) -> None:
        if priority is not None:
            priority = whole("priority", priority, -(2**31), "give 1 to 99, or 0 for the normal scheduler", 2**31 - 1)
        if rollback_window is not None:
            rollback_window = whole("rollback_window", rollback_window, -(2**63), "give 0 to 1000000 ticks", 2**63 - 1)
        self.report: dict[str, Any] | None = None
        self._refused: Exception | None = None
        self._thread = _core.LoopThread(
            snapshot,
            name,
            seconds=seconds,
            log=log,
            patience=patience,
            ramp=ramp,
            priority=priority,
            proposal_age=proposal_age,
            proposal_hold=proposal_hold,
            rollback_window=rollback_window,
        )

    @property
    def running(self) -> bool:
        """Whether it still runs."""
        return self._thread.running

    def stop(self) -> dict[str, Any]:
        """Brings the robot to rest, ends the loop and returns its report.

        Raises:
            RuntimeError: the snapshot or the plant was refused, with the sentence.
        """
        return self._end(wait=False)

    def wait(self) -> dict[str, Any]:
        """Waits until it has stopped by itself (``seconds``) and returns its report. Ctrl-C brings the robot to rest and ends the loop first."""
        return self._end(wait=True)

    def _end(self, wait: bool) -> dict[str, Any]:
        if self._refused is not None:
            raise self._refused
        if self.report is None:
            try:
                self.report = json.loads(self._thread.end(wait))
            except KeyboardInterrupt:
                try:
                    self.report = json.loads(self._thread.end(False))
                except RuntimeError as refused:
                    self._refused = refused
                raise
            except Exception as refused:
                self._refused = refused
                raise
        return self.report

    def __enter__(self) -> Loop:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.report is not None or self._refused is not None:
            return
        try:
            self.stop()
        except Exception as refused:
            if error is None:
                raise
            # The body's own exception is the one to see; what became of the loop is told beneath it.
            if hasattr(error, "add_note"):
                error.add_note(f"The loop beside it: {refused}")
