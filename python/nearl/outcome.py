"""Rewards and terminations that are functions of the caller."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl.arguments import function_of

Floats = NDArray[np.float64]
# (obs, actions, next_obs), arrays of n rows, to (n,)
Outcome = Callable[[Floats, Floats, Floats], ArrayLike]


def check_outcomes(reward: Any, termination: Any) -> None:
    """Refuses what is no function of ``(obs, actions, next_obs)``, where it is given and not where it is first asked."""
    for name, function in (("reward", reward), ("termination", termination)):
        function_of(name, function, "obs, actions, next_obs")


def ask(name: str, function: Outcome, obs: Floats, actions: Floats, next_obs: Floats, dtype: type) -> NDArray[Any]:
    """What the function gives for each row.

    Raises:
        ValueError: not one value a row, a reward that is not finite, or a termination that is no truth value.
    """
    given = function(obs, actions, next_obs)
    answer = np.asarray(given)
    if given is None:
        raise ValueError(f"{name}(obs, actions, next_obs) gave None; give one value an environment, ({len(obs)},): does it end without return?")
    if answer.shape != (len(obs),):
        raise ValueError(f"{name}(obs, actions, next_obs) gave shape {answer.shape}; give one value an environment, ({len(obs)},)")
    if dtype is bool and answer.dtype != bool:
        raise ValueError(f"{name}(obs, actions, next_obs) gave {answer.dtype} values, such as {answer[0]!r}; give True or False, e.g. `next_obs[:, 0] > 1`")
    if dtype is float and answer.dtype.kind not in "fiub":
        raise ValueError(f"{name}(obs, actions, next_obs) gave {answer.dtype} values, such as {answer[0]!r}; give real numbers")
    if dtype is float and not np.isfinite(answer.astype(float)).all():
        i = int(np.flatnonzero(~np.isfinite(answer.astype(float)))[0])
        raise ValueError(f"{name}(obs, actions, next_obs)[{i}] is {answer[i]}: every entry must be finite")
    return answer.astype(dtype)
