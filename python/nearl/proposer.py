"""States or actions from any process, at its own rate, in place of a policy in the loop: a large network, a GPU, another framework.

    # Terminal 1 and 2: nearl plant Panda-reach --name arm; nearl blank Panda-reach --out arm.safetensors
    #                   nearl run arm.safetensors --plant arm --proposer
    with nearl.Proposer("arm") as proposer:
        for state in proposer.states():
            proposer.propose(model(state.obs))         # in the order of proposer.entries
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.arguments import check_numbers, numbers, task_of

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ProposerState:
    """A state of the plant.

    Attributes:
        q: Configuration (nq).
        v: Velocity (nv).
        obs: Observation (n_obs).
        time: Of the plant's own clock [s].
        tick: Of the plant.
        episode: Number of the episode.
    """

    q: Floats
    v: Floats
    obs: Floats
    time: float
    tick: int
    episode: int


@dataclass(frozen=True)
class Account:
    """What has become of the proposals, as the loop says about ten times a second.

    Attributes:
        mode: Of the loop: "hold", "active", "degraded", "braking" or "fault".
        taken: Proposals acted upon.
        overtaken: Proposals that a newer one overtook before the loop read them.
        refused: Proposals of other names or sizes, of another episode, or with numbers that are not finite.
        held: Ticks on a proposal older than the age limit.
        silent: Ticks without a usable proposal.
    """

    mode: str
    taken: int
    overtaken: int
    refused: int
    held: int
    silent: int


class Proposer:
    """The place of the policy in a loop that was started with ``nearl run --proposer``. Every limit holds for what is proposed.

    Args:
        name: As in ``nearl run SNAPSHOT --plant NAME --proposer``.
        patience: Longest wait for the loop [s].

    Attributes:
        kind: "states" (entries to be reached ``policy_every`` periods after the proposal came) or "actions" (commands of joints).
        entries: What is proposed, in order.
        dt: Control period [s].
        policy_every: Control periods in which a proposed state is to be reached.
        age_limit: Age of a proposal, from the state it answers, at which it is only held [s].
        hold: So long is it held before the loop brakes [s].

    Raises:
        ConnectionError: there is no such loop, or another process proposes to it.
    """

    def __init__(self, name: str, patience: float = 10.0) -> None:
        self._client = _core.ProposerClient(name, patience)
        is_action, self.entries, self.dt, self.policy_every, self.age_limit, self.hold = self._client.asked()
        self.kind = "actions" if is_action else "states"

    def state(self, patience: float = 1.0) -> ProposerState | None:
        """The newest state not read before; ``None`` if none comes within ``patience`` [s]. What is proposed next answers it."""
        found = self._client.state(patience)
        return None if found is None else ProposerState(*found)

    def states(self, patience: float = 10.0) -> Iterator[ProposerState]:
        """The newest state again and again, until none comes within ``patience`` [s]; those that came while the caller was busy are left out."""
        while (found := self.state(patience)) is not None:
            yield found

    def propose(self, values: ArrayLike | Mapping[str, float]) -> None:
        """Proposes a value for each of ``entries``, in their order or by name.

        Raises:
            ValueError: values are missing, there are others, or one is no finite number.
            ConnectionError: the proposer is closed.
        """
        if isinstance(values, Mapping):
            values = _in_order(values, self.entries)
        check_numbers("values", values, self.entries)
        given = numbers("values", values)
        if given.shape == (len(self.entries),) and not np.isfinite(given).all():
            i = int(np.flatnonzero(~np.isfinite(given))[0])
            raise ValueError(f"values[{i}] ('{self.entries[i]}') is {given[i]}; give a finite number, or propose nothing where there is none")
        self._client.propose(values)

    def account(self) -> Account:
        """What the loop said last of itself and of the proposals."""
        mode, counts = self._client.account()
        return Account(mode, *counts)

    def close(self) -> None:
        """Leaves: the loop holds the last proposal for a while, then brakes."""
        self._client.close()

    def __enter__(self) -> Proposer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _in_order(values: Mapping[str, float], entries: Sequence[str]) -> list[float]:
    missing = [name for name in entries if name not in values]
    others = [name for name in values if name not in entries]
    if missing or others:
        what = f"'{missing[0]}' is missing" if missing else f"'{others[0]}' is not asked for"
        raise ValueError(f"{what}; the entries are {', '.join(entries)}")
    return [values[name] for name in entries]


def blank(task: str | os.PathLike[str], path: str | os.PathLike[str], actions: bool = False) -> None:
    """Writes the robot and the limits of a task as a snapshot without a policy, for a loop whose proposals come from another process.

    Args:
        task: A bundled task or a TOML file.
        path: Where the snapshot goes.
        actions: Proposals are commands of the joints, guarded, in place of states.

    Raises:
        ValueError: the task cannot be used so.
    """
    _core.blank(task_of(task), os.fspath(path), actions)
