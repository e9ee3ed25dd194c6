"""One environment, as Gymnasium wants it."""

from __future__ import annotations

import os
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.arguments import seed_of, task_of
from nearl.render import Frame, Renderer


def check_open(closed: bool) -> None:
    """Refuses a closed environment, with the error of Gymnasium's vectors."""
    if closed:
        raise gymnasium.error.ClosedEnvironmentError("the environment was closed, and neither steps nor begins an episode any more; make another one")


class Env(gymnasium.Env[NDArray[np.float64], NDArray[np.float32]]):
    """A task on one simulated robot.

    Same spaces, observations, rewards and terminations as Gymnasium's environment of the same name (``Panda-reach`` is our own).
    The time limit is Gymnasium's wrapper, which ``gymnasium.make("nearl/...")`` adds. It cannot be pickled or copied: make it in the process that uses it.

    Args:
        task: Name of the task, one of ``nearl.tasks()``, or a task file (TOML).
        render_mode: ``"rgb_array"`` makes :meth:`render` draw the robot, also without a screen (EGL); None draws nothing.
        width: Of a picture [pixel].
        height: Of a picture [pixel].
        camera: A camera of the robot file; by default its ``track``, else one that follows the robot.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012  # as Gymnasium declares it

    def __init__(
        self,
        task: str | os.PathLike[str],
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str | None = None,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is '{render_mode}'; give 'rgb_array', or leave it out")
        self.render_mode = render_mode
        self._picture = (width, height), camera
        self._renderer: Renderer | None = None
        self._native = _core.Env(task_of(task))
        self._seeded = self._begun = self._closed = False
        low = self._native.action_low.astype(np.float32)
        high = self._native.action_high.astype(np.float32)
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        n_obs = len(self._native.obs_names)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (n_obs,), np.float64)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self._native.dt)}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: Restarts the random stream.
            options: ``qpos`` and ``qvel`` (MuJoCo's convention), or ``goal``, replace what would be drawn.

        Returns:
            Observation (n_obs) and an empty ``info``.
        """
        check_open(self._closed)
        seed = None if seed is None else seed_of(seed)
        super().reset(seed=seed)
        if seed is None and not self._seeded:
            seed = int(self.np_random.integers(2**63))
        self._seeded = self._begun = True
        obs = self._native.reset(seed)
        return (self._start(dict(options), obs) if options else obs), {}

    def _start(self, options: dict[str, Any], obs: NDArray[np.float64]) -> NDArray[np.float64]:
        unknown = options.keys() - {"qpos", "qvel", "goal"}
        if unknown:
            raise ValueError(f"reset options {sorted(unknown)} are not known; use 'qpos', 'qvel' or 'goal'")
        if "qpos" in options or "qvel" in options:
            qpos = options.get("qpos", self._native.qpos)
            obs = self._native.set_state(qpos, options.get("qvel", self._native.qvel))
        if "goal" in options:  # last, as a state begins an episode, which draws one
            self._native.goal = options["goal"]
            obs = self._native.observe()
        return obs

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Simulates one control period.

        ``info["cost"]`` is there where the task has a ``[cost]``, ``info["fault"]`` only if the physics could not be believed.
        """
        check_open(self._closed)
        if not self._begun:
            raise gymnasium.error.ResetNeeded("no episode has begun; call reset() before step()")
        obs, reward, cost, terminated, fault = self._native.step(action)
        info: dict[str, Any] = {"cost": cost} if self._native.has_cost else {}
        if fault is not None:
            info["fault"] = fault
        return obs, reward, terminated, False, info

    def render(self) -> Frame | None:  # type: ignore[override]
        """The robot as a picture (height x width x 3); None without ``render_mode="rgb_array"``.

        Raises:
            VideoError: MuJoCo cannot render on this machine; the message says what is missing.
        """
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = Renderer(self._native, *self._picture)
        return self._renderer.frame(self._native.qpos, self._native.qvel)

    def close(self) -> None:
        """Frees the renderer; what is closed neither steps nor begins an episode any more."""
        self._closed = True
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def set_state(self, qpos: ArrayLike, qvel: ArrayLike) -> NDArray[np.float64]:
        """Begins an episode at ``qpos`` (nq) and ``qvel`` (nv), MuJoCo's convention; returns the observation."""
        check_open(self._closed)
        obs = self._native.set_state(qpos, qvel)
        self._begun = True
        return obs

    @property
    def state(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """``q`` (nq) and ``v`` (nv) in Pinocchio's convention, as ``Projector`` and ``Controller`` take them."""
        return self._native.state()

    @property
    def native(self) -> _core.Env:
        """The Rust environment: names, ranges, state."""
        return self._native

    @property
    def qpos(self) -> NDArray[np.float64]:
        """Configuration (nq), MuJoCo's convention."""
        return self._native.qpos

    @property
    def qvel(self) -> NDArray[np.float64]:
        """Velocity (nv), MuJoCo's convention."""
        return self._native.qvel

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return self._native.dt
