"""Many environments in one call."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from nearl import _core

Floats = NDArray[np.float64]
Step = tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


class VecEnv(VectorEnv[Floats, Floats, Floats]):
    """``num_envs`` environments of one task, stepped natively on all cores with the interpreter released.

    Environment ``i`` behaves as a single one that was seeded with ``seed + i``. ``info`` holds, where there is something to say and
    with the mask ``_<key>``: ``final_obs`` (same-step mode), ``fault``; and with ``constraints`` always: ``raw_violations`` and
    ``target_violations`` (control ticks of the step in which the raw or the projected state broke a limit) and ``moved``.

    Args: see :func:`make_vec`.
    """

    metadata: dict[str, Any]

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        constraints: str | os.PathLike[str] | None = None,
        seed: int = 0,
        threads: int | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        mode = AutoresetMode(autoreset_mode)
        if mode is AutoresetMode.DISABLED:
            raise ValueError("autoreset_mode is Disabled, which is not offered; use NextStep or SameStep")
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; ask for at least one environment")
        threads = threads or os.cpu_count() or 1
        constraints = None if constraints is None else os.fspath(constraints)
        same_step = mode is AutoresetMode.SAME_STEP
        self._native = _core.VecEnv(task, num_envs, constraints, seed, threads, max_episode_steps, same_step)
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": mode, "render_modes": []}
        # Torques as Gymnasium's float32; a proposed state keeps its digits.
        dtype = np.float32 if constraints is None else np.float64
        low, high = self._native.action_low.astype(dtype), self._native.action_high.astype(dtype)
        self.single_action_space = Box(low, high, dtype=dtype)
        self.single_observation_space = Box(-np.inf, np.inf, (self._native.n_obs,), np.float64)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begins an episode everywhere. ``seed``: one for all (environment ``i`` gets ``seed + i``) or one each."""
        if options:
            raise ValueError(f"reset options {sorted(options)} are not known; this vector takes none")
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + i for i in range(self.num_envs)]
        return self._native.reset(None if seed is None else list(seed)), {}

    def step(self, actions: ArrayLike) -> Step:
        """One action (num_envs x n_act) each; an environment whose episode ended begins a new one, see the autoreset mode."""
        return self._native.step(actions)

    def set_state(self, index: int, qpos: ArrayLike, qvel: ArrayLike) -> None:
        """Begins an episode of environment ``index`` at ``qpos`` (nq) and ``qvel`` (nv), MuJoCo's convention."""
        self._native.set_state(index, np.asarray(qpos, float).tolist(), np.asarray(qvel, float).tolist())

    @property
    def native(self) -> _core.VecEnv:
        """The Rust environments: names, ranges, states."""
        return self._native


def make_vec(
    task: str,
    num_envs: int,
    constraints: str | os.PathLike[str] | None = None,
    seed: int = 0,
    threads: int | None = None,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
) -> VecEnv:
    """A vector of native environments.

    Args:
        task: Name of the task, one of ``nearl.tasks()``.
        num_envs: Number of environments.
        constraints: None: an action is what the actuators get. ``"task"`` (tasks with analytic inverse dynamics) or the snapshot
            file of a trained agent: an action is the proposed next state, one entry per ``native.action_names``; it is projected
            onto the constraints and inverted to an action by the controller that also runs on the robot. A step then spans one
            policy period.
        seed: Environment ``i`` draws from the stream of ``seed + i`` until ``reset(seed=...)`` says otherwise.
        threads: Threads to step on; all cores by default. Results do not depend on it.
        autoreset_mode: When an ended episode is begun anew: ``"NextStep"`` (Gymnasium's default) or ``"SameStep"``.

    Raises:
        ValueError: unknown task, a task without analytic inverse dynamics and no snapshot, or a snapshot of another task.
        OSError: the snapshot cannot be read.
    """
    return VecEnv(task, num_envs, constraints, seed, threads, autoreset_mode=autoreset_mode)
