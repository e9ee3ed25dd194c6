"""One environment whose actions pass the constraints, as Gymnasium wants it: what ``gymnasium.make("nearl/...", constraints=...)`` gives."""

from __future__ import annotations

import os
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.arguments import constraints_of, numbers, seed_of, task_of, whole
from nearl.env import Env, check_open
from nearl.render import Frame, Renderer


class ProjectedEnv(gymnasium.Env[NDArray[np.float64], NDArray[np.float64]]):
    """A task behind the controller that also runs on the robot; one step is one policy period.

    ``info`` has ``raw_violations`` and ``target_violations`` (control ticks in which what was asked for, and what was done about it, broke a
    limit; of the latter those that began within the limits), ``recovering`` (those that began outside, where a robot can only brake or come back),
    ``executed`` (what the actuators got in the last control period), ``cost`` where the task has one, and ``fault`` if the physics
    could not be believed.

    Args:
        task: A bundled task or a TOML file.
        constraints: See :func:`nearl.make_vec`.
        actions: See :func:`nearl.make_vec`.
        render_mode: ``"rgb_array"``, or none.
        max_episode_steps: Control periods after which an episode is cut, the task's own by default. What ``gymnasium.make`` takes under this
            name it keeps for itself, counts in steps, and can only make episodes shorter.
        width: Of a picture [pixel].
        height: Of a picture [pixel].
        camera: Of the robot file; one that follows the robot by default.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012  # as Gymnasium declares it

    def __init__(
        self,
        task: str | os.PathLike[str],
        constraints: str | os.PathLike[str] = "task",
        actions: str = "state",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        width: int = 480,
        height: int = 480,
        camera: str | None = None,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is '{render_mode}'; give 'rgb_array', or leave it out")
        if max_episode_steps is not None:
            max_episode_steps = whole("max_episode_steps", max_episode_steps, 1, "give at least one control period")
        self.render_mode = render_mode
        self._picture = (width, height), camera
        self._renderer: Renderer | None = None
        self._task = task_of(task)
        self._native = _core.VecEnv(self._task, 1, constraints_of(constraints), 0, 1, max_episode_steps, False, actions)
        self.action_meaning = actions
        low, high = self._native.action_low, self._native.action_high
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self._native.n_obs,), np.float64)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self._native.dt)}
        self._seeded = self._closed = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Begins an episode; ``seed`` restarts the random stream. Returns the observation (n_obs) and info."""
        check_open(self._closed)
        if options:
            raise ValueError(f"reset options {sorted(options)} are not known; this environment takes none")
        seed = None if seed is None else seed_of(seed)
        super().reset(seed=seed)
        if seed is None and not self._seeded:
            seed = int(self.np_random.integers(2**63))
        self._seeded = True
        return self._native.reset([seed])[0], {}

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """One policy period under ``action`` (n_act): observation (n_obs), reward, terminated, truncated, info."""
        check_open(self._closed)
        if not self._seeded:
            raise gymnasium.error.ResetNeeded("no episode has begun; call reset() before step()")
        obs, rewards, terminated, truncated, infos = self._native.step(numbers("action", action)[None])
        info = {key: values[0] for key, values in infos.items() if not key.startswith("_")}
        return obs[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> Frame | None:  # type: ignore[override]
        """The robot as a picture (height x width x 3); None without ``render_mode="rgb_array"``.

        Raises:
            VideoError: MuJoCo cannot render on this machine; the message says what is missing.
        """
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = Renderer(_core.Env(self._task), *self._picture)
        return self._renderer.frame(self._native.qpos[0], self._native.qvel[0])

    def close(self) -> None:
        """Frees the renderer; what is closed neither steps nor begins an episode any more."""
        self._closed = True
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    @property
    def native(self) -> _core.VecEnv:
        """The Rust environment: names and ranges of the action."""
        return self._native


def make(task: str | os.PathLike[str], constraints: str | os.PathLike[str] | None = None, actions: str = "state", **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """The environment of a registered task: with ``constraints`` a :class:`ProjectedEnv`."""
    if constraints is not None:
        return ProjectedEnv(task, constraints, actions, **kwargs)
    if actions != "state":
        raise ValueError(f"actions is '{actions}' without constraints; give constraints='task' too")
    return Env(task, **kwargs)
