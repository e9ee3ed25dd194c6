"""SB3's five lines on the Rust trainer.

    agent = nearl.PID2("HalfCheetah-v5", algo="pid2-ib", seed=0)
    agent.learn(1_000_000, progress_bar=True)
    action, state = agent.predict(obs)
    agent.save("cheetah.safetensors")
    agent = nearl.PID2.load("cheetah.safetensors")
"""

import json
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.outcome import Outcome, ask
from nearl.ranks import Gather

Floats = NDArray[np.float64]
Callback = Callable[["PID2", dict[str, float]], bool | None]


class PID2:
    """A policy that proposes states, its inverse dynamics and the constraints between them, trained in this process.

    Args:
        task: Name of the task, one of ``nearl.tasks()``, or a task file (TOML).
        algo: Name of the algorithm, one of ``nearl.algorithms()``.
        seed: Of everything random; the same seed gives the same weights whatever the number of threads.
        threads: At least 1; all cores by default.
        settings: Overrides of the task file by dotted key, e.g. ``{"constraints.velocity.scale": 0.8}``.
        preset: Settings by name, ``"paper"`` or ``"strong"``; ``settings`` come after them.
        demos: Demonstrations (``.npz``) for ``bc``, ``soil``, ``dapg``, ``pid2-il``, ``bco`` and ``gaifo``; ``nearl demos record RUN`` writes some.
        run: Run folder to write as ``nearl train`` does; none by default. Of several ranks the first writes it.
        reward: ``reward(obs, actions, next_obs)``, arrays of n rows in, (n,) out, replaces the task's, as in :func:`nearl.make_vec`; here it is
            asked once a control period of each environment, with one row, from several threads in any order: the same arguments must give
            the same answer.
        termination: Likewise, true where an episode ends: beside the task's own.
        ranks: The other processes of a training on several hosts, ``nearl.Ranks()``. Every one makes the same agent and learns the same steps;
            without ``reward`` and ``termination``.

    Raises:
        ValueError: unknown task, algorithm or setting; the message names it.
        OSError: a file cannot be read, or ``run`` not written.
    """

    def __init__(
        self,
        task: str | os.PathLike[str],
        algo: str = "pid2-ib",
        *,
        seed: int = 0,
        threads: int | None = None,
        settings: Mapping[str, Any] | None = None,
        preset: str | None = None,
        demos: str | os.PathLike[str] | None = None,
        run: str | os.PathLike[str] | None = None,
        reward: Outcome | None = None,
        termination: Outcome | None = None,
        ranks: Gather | None = None,
    ):
        overrides = [f"{key}={_toml(value)}" for key, value in (settings or {}).items()]
        if demos is not None:
            overrides.append(f"train.demos.file={_toml(os.path.abspath(demos))}")
        if not 0 <= seed < 2**64:
            raise ValueError(f"seed is {seed}; give a whole number from 0 to 2**64 - 1")
        run = run if ranks is None or ranks.rank == 0 else None
        self._training: _core.Training | None = _core.Training(
            os.fspath(task), algo, seed, _threads(threads), overrides, run, preset, _scorer(reward, termination), reward is not None, ranks
        )
        self.task, self.algo, self.seed = self._training.task, algo, seed
        self._begin(self._training.controller())

    def _begin(self, controller: _core.Controller) -> None:
        self._controller = controller
        self._rng = np.random.default_rng(self.seed)

    @property
    def num_timesteps(self) -> int:
        """Environment steps learned from so far; 0 for a loaded policy."""
        return 0 if self._training is None else self._training.steps

    @property
    def controller(self) -> _core.Controller:
        """The controller with what was learned so far."""
        return self._controller

    def learn(self, total_timesteps: int, callback: Callback | list[Callback] | None = None, progress_bar: bool = False) -> "PID2":
        """Learns from at least ``total_timesteps`` more environment steps.

        Args:
            total_timesteps: Rounded up to whole batches of ``n_envs * n_steps``. The learning rate falls to zero at their end, so one
                long call is not two short ones.
            callback: ``callback(agent, metrics)`` after each iteration, or several; metrics by SB3's tags. ``False`` ends the learning.
            progress_bar: Draws a bar on standard error, if that is a terminal.

        A run folder is held against other trainings meanwhile, and has a checkpoint after every tenth of the steps and every two
        minutes. The interpreter runs other threads meanwhile. Ctrl-C raises ``KeyboardInterrupt`` between two iterations; what was learned
        stays, and is written where there is a run folder.
        """
        if self._training is None:
            raise ValueError(
                "a policy loaded from a snapshot file predicts and does not learn: the file has no optimiser state; load a run folder, or make a new PID2"
            )
        if total_timesteps < 1:
            raise ValueError(f"total_timesteps is {total_timesteps}; ask for at least one step")
        callbacks = [] if callback is None else callback if isinstance(callback, list) else [callback]
        bar = _Bar(sys.stderr, self.num_timesteps, total_timesteps) if progress_bar else None
        warning = self._training.begin(int(total_timesteps))
        try:
            if warning is not None:
                warnings.warn(warning, stacklevel=2)
            while not self._training.done:
                metrics = self._training.iterate()
                if bar is not None:
                    bar.show(metrics)
                if [c for c in callbacks if c(self, metrics) is False]:
                    break
        finally:
            self._controller = self._training.controller()
            self._training.end()
            if bar is not None:
                bar.close()
        return self

    def predict(
        self,
        observation: ArrayLike,
        state: tuple[_core.Controller, ...] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Floats, tuple[_core.Controller, ...] | None]:
        """The action for one observation (n_obs) or several (n x n_obs), as the controller on the robot would give it.

        Args:
            observation: In the order of ``controller.obs_names``.
            state: What the last call returned. It matters where ``controller.remembers``: the policy runs every few ticks only
                (Panda-reach), a limit speaks of the tick before (jerk, torque rate), or a brake is stored. Each call is then one control
                tick, and without ``state`` the first of an episode. None elsewhere.
            episode_start: (n) true where an episode begins.
            deterministic: Without the noise of exploration.

        Returns:
            Action (n_act) or (n x n_act), within the actuators' range, and the state for the next call.
        """
        obs = np.asarray(observation, float)
        rows = np.atleast_2d(obs)
        if not self._controller.remembers:
            memory: tuple[_core.Controller, ...] = (self._controller,) * len(rows)
        else:
            memory = state if state is not None else tuple(self._controller.another() for _ in rows)
            if len(memory) != len(rows):
                raise ValueError(f"state is of {len(memory)} environments, observation of {len(rows)}; give the state of the same environments")
            for controller, begins in zip(memory, np.broadcast_to(np.asarray(episode_start if episode_start is not None else False), len(rows))):
                if begins:
                    controller.reset()
        noise = None if deterministic else self._rng.standard_normal((len(rows), self._controller.n_noise))
        actions = np.stack([c.act(row, None if noise is None else noise[i]) for i, (c, row) in enumerate(zip(memory, rows))])
        return (actions if obs.ndim > 1 else actions[0]), (memory if self._controller.remembers else None)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the snapshot: networks, normaliser, constraints, robot; ``nearl eval``, ``nearl run`` and :meth:`load` read it."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        self._controller.save(path)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        threads: int | None = None,
        reward: Outcome | None = None,
        termination: Outcome | None = None,
        ranks: Gather | None = None,
    ) -> "PID2":
        """A policy to predict with, from a snapshot file; from a run folder, one that can also learn on, exactly where it stopped.

        With ``ranks`` it is a run folder, which rank 0 reads for all; the number of ranks may be another than before.

        A run that was stopped ``n`` steps before its end gives, after ``learn(n)``, the same weights as one that was not stopped. One that learned
        from Python functions needs them again, as ``reward`` and ``termination``.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is not a snapshot, was damaged, or learned from functions that are not given again.
        """
        agent = cls.__new__(cls)
        agent._training, agent.seed = None, 0
        if ranks is not None or (Path(path) / "checkpoints" / "resume.safetensors").is_file():
            agent._training = _core.Training.resume(path, _threads(threads), _scorer(reward, termination), reward is not None, ranks)
        controller = _core.Controller.load(path) if agent._training is None else agent._training.controller()
        agent.task, agent.algo = controller.task, controller.algo
        agent._begin(controller)
        return agent


def _scorer(reward: Outcome | None, termination: Outcome | None) -> Callable[[Floats, Floats, Floats], tuple[float | None, bool]] | None:
    """Both functions as one, of a single control period (1 x n arrays)."""
    if reward is None and termination is None:
        return None

    def scorer(obs: Floats, actions: Floats, next_obs: Floats) -> tuple[float | None, bool]:
        worth = None if reward is None else float(ask("reward", reward, obs, actions, next_obs, float)[0])
        return worth, termination is not None and bool(ask("termination", termination, obs, actions, next_obs, bool)[0])

    return scorer


def _threads(threads: int | None) -> int:
    if threads is not None and threads < 1:
        raise ValueError(f"threads is {threads}; give at least 1, or leave it out for all cores")
    return threads or os.cpu_count() or 1


def _toml(value: Any) -> str:
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value) if isinstance(value, str) else str(value).lower()  # TOML writes true, nan and inf


class _Bar:
    """One line that overwrites itself."""

    def __init__(self, out: TextIO, begin: int, steps: int):
        self._out, self._begin, self._steps = out, begin, steps
        self._shown = out.isatty()

    def show(self, metrics: dict[str, float]) -> None:
        if not self._shown:
            return
        done = min(1.0, (metrics["time/total_timesteps"] - self._begin) / self._steps)
        words = f"return {metrics.get('rollout/ep_rew_mean', float('nan')):.0f}  {metrics['time/fps']:.0f} steps/s"
        self._out.write(f"\r{'#' * round(30 * done):30} {100 * done:3.0f} %  {words}   ")
        self._out.flush()

    def close(self) -> None:
        if self._shown:
            self._out.write("\n")
