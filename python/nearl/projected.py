"""One environment whose actions pass the constraints, as Gymnasium wants it: what ``gymnasium.make("nearl/...", constraints=...)`` gives."""

import os
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.env import Env


class ProjectedEnv(gymnasium.Env[NDArray[np.float64], NDArray[np.float64]]):
    """A task behind the controller that also runs on the robot; one step is one policy period.

    ``info`` has ``raw_violations`` and ``target_violations`` (control ticks in which what was asked for, and what was done about it, broke a
    limit), ``cost`` where the task has one, and ``fault`` if the physics could not be believed.

    Args: see :func:`nearl.make_vec`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as Gymnasium declares it

    def __init__(
        self, task: str | os.PathLike[str], constraints: str | os.PathLike[str] = "task", actions: str = "state", render_mode: str | None = None
    ):
        if render_mode is not None:
            raise ValueError(f"render_mode is '{render_mode}', but projected environments do not render; leave it out")
        # The time limit, in control ticks, is the task's own; that of Gymnasium's wrapper, in steps, is never shorter.
        self._native = _core.VecEnv(os.fspath(task), 1, os.fspath(constraints), 0, 1, None, False, actions)
        low, high = self._native.action_low, self._native.action_high
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self._native.n_obs,), np.float64)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self._native.dt)}
        self._seeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Begins an episode; ``seed`` restarts the random stream."""
        if options:
            raise ValueError(f"reset options {sorted(options)} are not known; this environment takes none")
        super().reset(seed=seed)
        if seed is None and not self._seeded:
            seed = int(self.np_random.integers(2**63))
        self._seeded = True
        return self._native.reset([seed])[0], {}

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """One policy period."""
        obs, rewards, terminated, truncated, infos = self._native.step(np.asarray(action, float)[None])
        info = {key: values[0] for key, values in infos.items() if not key.startswith("_")}
        return obs[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    @property
    def native(self) -> _core.VecEnv:
        """The Rust environment: names and ranges of the action."""
        return self._native


def make(task: str, constraints: str | os.PathLike[str] | None = None, actions: str = "state", **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """The environment of a registered task: with ``constraints`` a :class:`ProjectedEnv`."""
    if constraints is not None:
        return ProjectedEnv(task, constraints, actions, **kwargs)
    if actions != "state":
        raise ValueError(f"actions is '{actions}' without constraints; give constraints='task' too")
    return Env(task, **kwargs)
