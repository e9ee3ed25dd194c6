"""What a running loop sends and answers: the arrays of ``nearl.Link.states`` and the receipt of ``nearl.Link.push``."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from nearl import _core

Floats = NDArray[np.float64]
Integers = NDArray[np.uint64]
Bools = NDArray[np.bool_]

_RESET, _TERMINATED, _TRUNCATED = 1, 2, 4


@dataclass(frozen=True)
class States:
    """Ticks of a loop in order, each with the state it acted on; n is their number.

    Attributes:
        tick: Tick of the loop (n); a step of more than one is a gap.
        version: Version of the snapshot that acted (n).
        epoch: Changes when the plant was started again (n).
        sequence: Number of the state (n).
        next_sequence: Number of the state that followed; more than one ahead where states were lost (n).
        episode: Number of the episode (n).
        mode: ``hold``, ``active``, ``degraded``, ``braking`` or ``fault`` (n).
        time: The plant's own clock (n) [s].
        q: Configuration (n x nq).
        v: Velocity (n x nv).
        obs: Observation (n x n_obs).
        proposal_q, proposal_v: Raw proposal (n x nq, n x nv).
        target_q, target_v: Its projection (n x nq, n x nv).
        action: What the actuators were given (n x n_act).
        period_tick: Ticks since the policy ran (n).
        log_prob_proposal, log_prob_action: As sampled (n).
        moved: Distance between proposal and target (n).
        raw_violations, target_violations: Limits broken by proposal and target (n).
        terminated, truncated, reset: The next state ends the episode, is cut by time, or begins the next one (n).
        lost: Ticks lost since the link was opened, because they were not read in time.
    """

    tick: Integers
    version: Integers
    epoch: Integers
    sequence: Integers
    next_sequence: Integers
    episode: Integers
    mode: NDArray[np.str_]
    time: Floats
    q: Floats
    v: Floats
    obs: Floats
    proposal_q: Floats
    proposal_v: Floats
    target_q: Floats
    target_v: Floats
    action: Floats
    period_tick: Integers
    log_prob_proposal: Floats
    log_prob_action: Floats
    moved: Floats
    raw_violations: Integers
    target_violations: Integers
    terminated: Bools
    truncated: Bools
    reset: Bools
    lost: int

    def __len__(self) -> int:
        return len(self.tick)


@dataclass(frozen=True)
class Receipt:
    """The loop's answer to a snapshot.

    Attributes:
        accepted: It is in use.
        code: Why not, as ``nearl explain`` knows it; ``accepted`` otherwise.
        text: The loop's sentence.
        tick: First tick of the snapshot, 0 if it was refused.
    """

    accepted: bool
    code: str
    text: str
    tick: int


def from_arrays(arrays: dict[str, NDArray], lost: int) -> States:
    """The arrays of ``_core.LoopClient.transitions`` by their names."""
    bits, modes = arrays.pop("next_bits"), np.array(_core.loop_modes())
    arrays["mode"] = modes[arrays["mode"].astype(int).clip(max=len(modes) - 1)]
    arrays["time"] = arrays["time"].reshape(-1)
    for name, bit in (("reset", _RESET), ("terminated", _TERMINATED), ("truncated", _TRUNCATED)):
        arrays[name] = bits & np.uint64(bit) != 0
    assert arrays.keys() | {"lost"} == {field.name for field in fields(States)}
    return States(**arrays, lost=lost)
