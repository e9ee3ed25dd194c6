"""Constrained rollouts from a server on this machine, and a running loop's states and weights, over shared memory.

    # Terminal 1
    nearl serve panda.safetensors --name panda
    # Terminal 2
    with nearl.Link("panda") as link:
        for chunk in link.rollout(seed=0, n_steps=10_000):
            learn(chunk.obs, chunk.action, chunk.reward, chunk.terminated)

    # With `nearl plant` and `nearl run --plant arm` in other terminals
    with nearl.Link("arm") as link:
        states = link.states()                 # every tick since the last call, with its policy version
        receipt = link.push("better.safetensors")
        print(receipt.accepted, receipt.text)
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nearl import _core
from nearl.arguments import whole
from nearl.states import Receipt, States, from_arrays

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
LARGEST_SNAPSHOT = 256 << 20  # [bytes], as nearl_controller::snapshot::MAX_BYTES


class RolloutRefused(RuntimeError):
    """The server's refusal, or its end of a rollout; ``answer`` is the code that ``nearl explain`` knows."""

    def __init__(self, answer: str, text: str) -> None:
        super().__init__(f"{answer}: {text}")
        self.answer = answer


@dataclass(frozen=True)
class Chunk:
    """Some transitions in a row; n is their number.

    Attributes:
        sequence: Number of the chunk, from 0.
        first_step: Policy step of the first row.
        version: Version of the policy.
        constraints: Id of the server's constraint set, as ``rollout(constraints=...)`` takes it.
        obs: Observation the policy saw (n x n_obs).
        next_obs: Observation its step led to; before the reset where an episode ended (n x n_obs).
        proposal: Raw proposed state (n x n_state) [rad, rad/s].
        target: Projected state of the step's last control tick (n x n_state) [rad, rad/s].
        action: What the actuators were given in the last control tick (n x n_act).
        log_prob_proposal: log pi(proposal | obs) (n).
        log_prob_action: log I(action | obs, target) of the last control tick (n).
        reward: The task's own (n).
        cost: The task's own (n).
        terminated: The episode ended in a terminal state (n).
        truncated: The episode was cut by the time limit (n).
        ledger: Sums over the control ticks of each step by name (n each).
    """

    sequence: int
    first_step: int
    version: int
    constraints: int
    obs: Floats
    next_obs: Floats
    proposal: Floats
    target: Floats
    action: Floats
    log_prob_proposal: Floats
    log_prob_action: Floats
    reward: Floats
    cost: Floats
    terminated: Bools
    truncated: Bools
    ledger: dict[str, Floats]

    def __len__(self) -> int:
        return len(self.reward)


def _snapshot_of(path: Path) -> Path:
    """The snapshot file of a path: itself, or a run folder's final one, else its latest."""
    if not path.exists():
        raise FileNotFoundError(f"cannot read snapshot '{path}': it does not exist; give a snapshot file or a run folder")
    if not path.is_dir():
        return path
    for name in ("final", "latest"):
        if (file := path / "checkpoints" / f"{name}.safetensors").is_file():
            return file
    raise FileNotFoundError(f"cannot read snapshot '{path}': the folder has no checkpoints/final.safetensors or latest.safetensors; give a run folder with one")


def _content_of(file: Path) -> bytes:
    """What a file holds that a loop can take; a pipe or a device is not opened."""
    if not file.is_file():
        raise OSError(f"cannot read snapshot '{file}': it is not a regular file; give a snapshot file or a run folder")
    if (size := file.stat().st_size) > LARGEST_SNAPSHOT:
        raise OSError(f"cannot read snapshot '{file}': it has {size} bytes, more than the limit of {LARGEST_SNAPSHOT}; give a snapshot file or a run folder")
    return file.read_bytes()


def _check_finite(name: str, value: Any) -> None:
    """Refuses numbers that are none, which no message to a loop can carry."""
    if isinstance(value, Mapping):
        for key, of in value.items():
            _check_finite(f"{name} of '{key}'", of)
    elif isinstance(value, list | tuple | np.ndarray):
        for i, of in enumerate(value):
            _check_finite(f"{name}[{i}]", of)
    elif isinstance(value, float | np.floating) and not np.isfinite(value):
        raise ValueError(f"{name} is {value}; give a finite number, or leave it out for the limit of the build")


def _chunk(sequence: int, first_step: int, version: int, constraints: int, rows: Floats, columns: list[tuple[str, int]]) -> Chunk:
    parts, at = {}, 0
    for name, width in columns:
        parts[name] = rows[:, at : at + width]
        at += width
    ended, ledger = parts.pop("ended") != 0, parts.pop("ledger")
    for name in ("log_prob_proposal", "log_prob_action", "reward", "cost"):
        parts[name] = parts[name][:, 0]
    names = _core.rollout_ledger()
    return Chunk(
        sequence,
        first_step,
        version,
        constraints,
        **parts,
        terminated=ended[:, 0],
        truncated=ended[:, 1],
        ledger={name: ledger[:, i] for i, name in enumerate(names)},
    )


class Rollout(Iterator[Chunk]):
    """Chunks of one request, in order. Leaving the loop early: ``cancel`` and read on to the end, or ``close``."""

    def __init__(self, rollouts: _core.Rollouts, patience: float) -> None:
        self._rollouts = rollouts
        self._patience = patience

    def __next__(self) -> Chunk:
        """The next chunk.

        Raises:
            RolloutRefused: the server refuses or ends the request.
            TimeoutError: nothing came in time; asking again goes on.
            ConnectionError: the server is gone.
        """
        given = self._rollouts.next(self._patience)
        if given is None:
            raise StopIteration
        return _chunk(*given)

    def cancel(self) -> None:
        """Asks the server to stop; chunks under way still come, then the iteration ends."""
        self._rollouts.cancel()

    def close(self) -> None:
        """Leaves at once; the server's place is free again."""
        self._rollouts.close()


class Link:
    """Connection to the rollout server, or to the running loop, of one name on this machine.

    Args:
        name: As in ``nearl serve SNAPSHOT --name NAME`` or ``nearl run SNAPSHOT --plant NAME``.
        patience: Longest wait for server or loop, and for each chunk, state or receipt [s].
    """

    def __init__(self, name: str, patience: float = 10.0) -> None:
        self.name = name
        self._patience = patience
        self._client: _core.RolloutClient | None = None
        self._loop: _core.LoopClient | None = None

    def rollout(
        self, seed: int, n_steps: int, noise: bool = True, version: int | None = None, constraints: bool | int = True
    ) -> Rollout:
        """Policy steps on the server's task. The same arguments give the same bits, whoever else asks.

        Args:
            seed: Of initial states and noise, from 0.
            n_steps: Policy steps, over as many episodes as it takes.
            noise: Sample as the policy does; without, its mean.
            version: Of the policy; refused if the server has another. None takes the server's.
            constraints: True projects onto the server's, False onto none; a number is refused by a server with others.

        Raises:
            ValueError: a number is out of range.
            ConnectionError: there is no server.
            RuntimeError: two rollouts of this link are under way already.
        """
        give = "give a whole number from {} to 2**64 - 1".format
        seed, n_steps = whole("seed", seed, 0, give(0), 2**64 - 1), whole("n_steps", n_steps, 1, give(1), 2**64 - 1)
        version = None if version is None else whole("version", version, 0, give(0), 2**64 - 1)
        if isinstance(constraints, bool):
            wanted = None if constraints else 0
        elif 0 < constraints < 2**64:
            wanted = constraints
        else:
            raise ValueError(f"constraints is {constraints}; give True, False or the number of a chunk's constraints")
        if self._client is None:
            self._client = _core.RolloutClient(self.name, self._patience)
        return Rollout(self._client.request(seed, n_steps, noise, version, wanted), self._patience)

    def states(self) -> States:
        """Every tick of the loop since the last call (the first call begins now), at least one.

        The loop keeps 1024 ticks for a reader that is behind; ``lost`` counts older ones.

        Raises:
            ConnectionError: there is no loop.
            TimeoutError: the loop acts on nothing: it holds, or it is gone.
        """
        arrays, lost = self._running().transitions(self._patience)
        if not len(arrays["tick"]):
            raise TimeoutError(f"the loop of `{self.name}` sent nothing for {self._patience} s; see its mode with nearl run --json")
        return from_arrays(arrays, lost)

    def push(self, snapshot: str | os.PathLike[str] | bytes) -> Receipt:
        """Puts a snapshot (a file, a run folder or bytes) into the running loop; what does not fit the robot is refused.

        Raises:
            OSError: the file cannot be read, is not a regular file, or is larger than 256 MiB.
            ConnectionError: there is no loop, no answer came, or another trainer pushes to it.
        """
        if isinstance(snapshot, bytes):
            return Receipt(*self._running().push(snapshot, self._patience))
        file = _snapshot_of(Path(snapshot))
        content = _content_of(file)
        receipt = Receipt(*self._running().push(content, self._patience))
        return receipt if receipt.accepted else replace(receipt, text=f"'{file}': {receipt.text}")

    def move_limits(self, **moved: Any) -> Receipt:
        """Moves the limits of the running loop inside those it was started with, or back to them; without arguments, back.

        The arguments are those of ``Projector.move_limits``: ``speed``, ``velocity``, ``acceleration``, ``lower``, ``upper``, ``frame``,
        ``frame_speed``, ``energy``, ``plane``, ``body``; and ``payload``, what the robot carries from then on, a tuple: frame, mass [kg], centre of
        mass in the frame's axes (3) [m] and inertia about it (``xx, xy, xz, yy, yz, zz``) [kg·m²]. They hold until others are asked for, whoever leaves.

        Raises:
            ValueError: a number is not finite.
            ConnectionError: there is no loop, no answer came, or another operator moves its limits.
        """
        for name, value in moved.items():
            _check_finite(name, value)
        return Receipt(*self._running().move_limits(self._patience, **moved))

    def _running(self) -> _core.LoopClient:
        if self._loop is None:
            self._loop = _core.LoopClient(self.name, self._patience)
        return self._loop

    def close(self) -> None:
        """Leaves; rollouts under way can still be read."""
        if self._loop is not None:
            self._loop.close()
            self._loop = None
        if self._client is not None:
            self._client.close()
            self._client = None

    def __enter__(self) -> "Link":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
