"""Many environments in one call."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.arguments import constraints_of, numbers, seed_of, task_of, threads_of, whole
from nearl.outcome import Floats, Outcome, ask, check_outcomes

Step = tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


class VecEnv(VectorEnv[Floats, Floats, Floats]):
    """``num_envs`` environments of one task, stepped natively on all cores with the interpreter released.

    Environment ``i`` behaves as a single one that was seeded with ``seed + i``. ``info`` holds, where there is something to say and
    with the mask ``_<key>``: ``final_obs`` and ``final_info`` (same-step mode: what the last step of an episode gave), ``fault``; ``cost`` where the task
    has one, 0 and masked out where the row is the begin of an episode, as in Gymnasium's ``SyncVectorEnv``; and with ``constraints`` of every step that
    did not only begin an episode: ``raw_violations`` and ``target_violations`` (control ticks of the step in which the raw or the projected state broke a
    limit; of the latter those that began within the limits), ``recovering`` (those that began outside, where a robot can only brake or come back),
    ``executed`` (what the actuators got in the last of them, num_envs x n_act; not a number where the step only began an episode) and ``moved``.
    A vector cannot be pickled or copied: make it in the process that uses it.

    Args:
        max_episode_steps: Control periods after which an episode is cut; the task's own by default.

    The other arguments are those of :func:`make_vec`.
    """

    metadata: dict[str, Any]

    def __init__(
        self,
        task: str | os.PathLike[str],
        num_envs: int = 1,
        constraints: str | os.PathLike[str] | None = None,
        seed: int = 0,
        threads: int | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        reward: Outcome | None = None,
        termination: Outcome | None = None,
        actions: str = "state",
    ):
        try:
            mode = AutoresetMode(autoreset_mode)
        except ValueError:
            raise ValueError(f"autoreset_mode is {autoreset_mode!r}; give 'NextStep' or 'SameStep'") from None
        if mode is AutoresetMode.DISABLED:
            raise ValueError("autoreset_mode is Disabled, which is not offered; use NextStep or SameStep")
        if isinstance(num_envs, float):
            raise ValueError(f"num_envs is {num_envs!r}, no int; ask for at least one environment, as num_envs=4")
        num_envs = whole("num_envs", num_envs, 1, "ask for at least one environment")
        seed, threads = seed_of(seed, num_envs), threads_of(threads)
        if max_episode_steps is not None:
            max_episode_steps = whole("max_episode_steps", max_episode_steps, 1, "give at least one control period")
        check_outcomes(reward, termination)
        task = task_of(task)
        constraints = None if constraints is None else constraints_of(constraints)
        same_step = mode is AutoresetMode.SAME_STEP
        self._native = _core.VecEnv(task, num_envs, constraints, seed, threads, max_episode_steps, same_step, actions)
        self.num_envs = num_envs
        self.action_meaning = "actuators" if constraints is None else actions
        self._reward, self._termination = reward, termination
        self._obs = np.zeros((num_envs, self._native.n_obs))
        self._over = np.zeros(num_envs, bool)  # whose next step only begins an episode
        self._begun = np.zeros(num_envs, bool)  # who has an episode
        self.metadata = {"autoreset_mode": mode, "render_modes": []}
        # Torques as Gymnasium's float32; a proposed state keeps its digits.
        dtype: Any = np.float32 if constraints is None else np.float64
        low, high = self._native.action_low.astype(dtype), self._native.action_high.astype(dtype)
        self.single_action_space = Box(low, high, dtype=dtype)
        self.single_observation_space = Box(-np.inf, np.inf, (self._native.n_obs,), np.float64)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Begins an episode everywhere. ``seed``: one for all (environment ``i`` gets ``seed + i``) or one each. Returns the
        observations (num_envs x n_obs) and an empty info.
        """
        self._check_open()
        if options:
            raise ValueError(f"reset options {sorted(options)} are not known; this vector takes none")
        if seed is None:
            seeds = None
        elif isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
            seeds = [None if one is None else seed_of(one, name=f"seed[{i}]") for i, one in enumerate(seed)]
        else:
            first = seed_of(seed, self.num_envs)
            seeds = [first + i for i in range(self.num_envs)]
        obs = self._native.reset(seeds)
        self._obs, self._over, self._begun = obs.copy(), np.zeros(self.num_envs, bool), np.ones(self.num_envs, bool)
        return obs, {}

    def step(self, actions: ArrayLike) -> Step:  # type: ignore[override]  # flags are booleans
        """One action (num_envs x n_act) each; an environment whose episode ended begins a new one, see the autoreset mode."""
        self._check_open()
        if not self._begun.all():
            raise ResetNeeded(f"no episode has begun in environment {int(np.argmin(self._begun))}; call reset() before step()")
        began = self._over
        own = self._reward is None and self._termination is None
        stepped = self._native.step(actions) if own else self._scored(numbers("actions", actions))
        _, rewards, terminated, truncated, info = stepped
        if not np.isfinite(rewards).all():
            i = int(np.flatnonzero(~np.isfinite(rewards))[0])
            raise ValueError(
                f"the reward of environment {i} came out as {rewards[i]}, and nothing can be learned from it; look for actions that are far too large, "
                f"or for a logarithm, root or quotient in [reward] that leaves its domain"
            )
        ended, same_step = terminated | truncated, self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        self._over = ended & (not same_step)
        if same_step and ended.any():
            info["final_info"] = {name: of for key in list(info) if key[0] != "_" and key != "final_obs" for name, of in _final(info, key, ended)}
            info["_final_info"] = ended
        if "cost" in info:
            info["_cost"] = ~(ended if same_step else began)
            info["cost"] = np.where(info["_cost"], info["cost"], 0.0)
        for key in ("raw_violations", "target_violations", "recovering", "executed", "moved"):
            if key in info:
                info[f"_{key}"] = ~began
        return stepped

    def _scored(self, actions: Floats) -> Step:
        """A step whose reward or termination the caller's functions give."""
        obs, rewards, terminated, truncated, info = self._native.step(actions)
        reached = obs.copy()  # the states the actions led to, also where a new episode began at once
        for i in np.flatnonzero(info.get("_final_obs", ())):
            reached[i] = info["final_obs"][i]
        began = self._over
        if self._reward is not None:
            rewards = np.where(began, 0.0, ask("reward", self._reward, self._obs, actions, reached, float))
        if self._termination is not None:
            ends = ask("termination", self._termination, self._obs, actions, reached, bool) & ~began
            fresh = ends & ~terminated & ~truncated
            terminated, truncated = terminated | ends, truncated & ~ends
            if fresh.any():
                obs = self._native.end(fresh.tolist())
                if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
                    _add_final(info, fresh, reached)
        self._obs = obs.copy()
        return obs, rewards, terminated, truncated, info

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the vector was closed, and neither steps nor begins an episode any more; make another one with nearl.make_vec")

    def set_state(self, index: int, qpos: ArrayLike, qvel: ArrayLike) -> None:
        """Begins an episode of environment ``index`` at ``qpos`` (nq) and ``qvel`` (nv), MuJoCo's convention."""
        self._check_open()
        self._native.set_state(index, numbers("qpos", qpos).tolist(), numbers("qvel", qvel).tolist())
        self._obs[index] = self._native.end([False] * self.num_envs)[index]
        self._over[index], self._begun[index] = False, True

    @property
    def native(self) -> _core.VecEnv:
        """The Rust environments: names, ranges, states."""
        return self._native


def _final(info: dict[str, Any], key: str, ended: NDArray[np.bool_]) -> list[tuple[str, NDArray[Any]]]:
    """An entry of the information and its mask, of the episodes that ended alone."""
    mask: NDArray[np.bool_] = info.get(f"_{key}", True) & ended
    values = info[key].copy()
    values[~mask] = None if values.dtype == object else 0
    return [(key, values), (f"_{key}", mask)] if mask.any() else []


def _add_final(info: dict[str, Any], ended: NDArray[np.bool_], reached: Floats) -> None:
    """Puts the last observations of the episodes that ended beside those that are there."""
    final = info.setdefault("final_obs", np.full(len(ended), None, dtype=object))
    mask = info.setdefault("_final_obs", np.zeros(len(ended), bool))
    for i in np.flatnonzero(ended):
        final[i], mask[i] = reached[i].copy(), True


def make_vec(
    task: str | os.PathLike[str],
    num_envs: int,
    constraints: str | os.PathLike[str] | None = None,
    seed: int = 0,
    threads: int | None = None,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    reward: Outcome | None = None,
    termination: Outcome | None = None,
    actions: str = "state",
) -> VecEnv:
    """A vector of native environments.

    Args:
        task: Name of the task, one of ``nearl.tasks()``, or a task file (TOML) with a robot of your own.
        num_envs: Number of environments.
        constraints: None: an action is what the actuators get. ``"task"`` (tasks with analytic inverse dynamics), or the snapshot
            file of a trained agent, or its run folder, of which the newest is taken: an action is the proposed next state, one entry
            per ``native.action_names``; it is projected onto the constraints and inverted to an action by the controller that also
            runs on the robot. A step then spans one policy period.
        actions: What an action is with ``constraints``. ``"state"``: the proposed next state. ``"change"``: its change in [-1, 1], in units of what
            the limits allow in a policy period (of a trained agent, of three standard deviations of its changes). ``"guarded"`` (with
            ``constraints="task"``): what the actuators get, which gives way where the state it leads to would break a limit; the robot model tells
            where the task has analytic inverse dynamics, else the simulator, for positions and velocities. ``"limited"`` (likewise): what the
            actuators get, replaced by the nearest action within the task's ``[constraints.action]``; limits on states are not kept then.
        seed: Environment ``i`` draws from the stream of ``seed + i`` until ``reset(seed=...)`` says otherwise.
        threads: Threads to step on; all cores by default. Results do not depend on it.
        reward: ``reward(obs, actions, next_obs)`` for all environments at once, arrays of num_envs rows in, (num_envs,) out: replaces
            the task's. ``next_obs`` is what the action led to, also where a new episode has begun since.
        termination: Likewise, true where an episode ends: beside the task's own.
        autoreset_mode: When an ended episode is begun anew: ``"NextStep"`` (Gymnasium's default) or ``"SameStep"``.

    Raises:
        ValueError: unknown task, a task without analytic inverse dynamics and no snapshot, or a snapshot of another task.
        OSError: the snapshot cannot be read.
    """
    return VecEnv(task, num_envs, constraints, seed, threads, autoreset_mode=autoreset_mode, reward=reward, termination=termination, actions=actions)
