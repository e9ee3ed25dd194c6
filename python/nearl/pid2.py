"""SB3's five lines on the Rust trainer.

agent = nearl.PID2("HalfCheetah-v5", algo="pid2-ib", seed=0)
agent.learn(1_000_000, progress_bar=True)
action, state = agent.predict(obs)
agent.save("cheetah.safetensors")
agent = nearl.PID2.load("cheetah.safetensors")
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.arguments import function_of, numbers, path_of, seed_of, task_of, threads_of, whole
from nearl.outcome import Outcome, ask, check_outcomes
from nearl.ranks import Gather

Floats = NDArray[np.float64]
Callback = Callable[["PID2", dict[str, float]], bool | None]
# Of a run folder: which of reward and termination came from Python, which the checkpoint does not tell apart.
FUNCTIONS = "functions.json"
# What the `nearl` command advises, and what does the same here.
_ARGUMENTS = {
    "go on with --resume": "go on with nearl.PID2.load(run)",
    "another folder with --out": "another folder as run=",
    "with --out": "with run=",
    " with --algo, or leave --demos out": " as algo=, or leave demos= out",
    "give a file with --demos": "give a file as demos=",
    "give it with --robot": "give a snapshot or the folder of a run",
}


class Memory(Sequence[_core.Controller]):
    """What each environment of a prediction remembers: its controller. They are made when the next prediction asks for them, from what the first one saw."""

    def __init__(self, of: _core.Controller, rows: Floats, noise: Floats | None):
        self._of, self._rows, self._noise = of, rows.copy(), noise
        self._made: list[_core.Controller] | None = None

    @property
    def _controllers(self) -> list[_core.Controller]:
        if self._made is None:
            made = [self._of.another() for _ in self._rows]
            for i, (controller, row) in enumerate(zip(made, self._rows)):
                controller.act(row, None if self._noise is None else self._noise[i])
            self._made = made
        return self._made

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: Any) -> Any:
        return self._controllers[index]


class PID2:
    """A policy that proposes states, its inverse dynamics and the constraints between them, trained in this process.

    It cannot be pickled or copied: another process gets what was learned by :meth:`save` and :meth:`load`.

    Args:
        task: Name of the task, one of ``nearl.tasks()``, or a task file (TOML).
        algo: Name of the algorithm, one of ``nearl.algorithms()``.
        seed: Of everything random; the same seed gives the same weights whatever the number of threads.
        threads: At least 1; all cores by default.
        settings: Overrides of the task file by dotted key, e.g. ``{"constraints.velocity.limit": 12.0}``.
        preset: Settings by name, ``"paper"``, ``"strong"`` or ``"long"``; ``settings`` come after them.
        demos: Demonstrations (``.npz``) for ``bc``, ``soil``, ``dapg``, ``pid2-il``, ``bco`` and ``gaifo``; ``nearl demos record RUN`` writes some.
        run: Run folder to write as ``nearl train`` does, from where the process is now; none by default. Of several ranks the first writes it.
        reward: ``reward(obs, actions, next_obs)``, arrays of n rows in, (n,) out, replaces the task's, as in :func:`nearl.make_vec`; here it is
            asked once a control period of each environment, with one row, from several threads in any order: the same arguments must give
            the same answer.
        termination: Likewise, true where an episode ends: beside the task's own.
        ranks: The other processes of a training on several hosts, ``nearl.Ranks()``. Every one makes the same agent and learns the same steps;
            without ``reward`` and ``termination``.
        start_from: Run folder whose networks it starts from in place of fresh ones, of the same or another algorithm, task or limits, as
            ``nearl train --start-from`` does.

    Raises:
        ValueError: unknown task, algorithm or setting, or networks that do not fit; the message names it.
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
        start_from: str | os.PathLike[str] | None = None,
    ):
        _check_names(algo, preset, settings)
        check_outcomes(reward, termination)
        overrides = [f"{key}={_toml(value)}" for key, value in (settings or {}).items()]
        if demos is not None:
            file = os.path.abspath(path_of("demos", demos, "a file of demonstrations, .npz"))
            overrides.append(f"train.demos.file={_toml(file)}")
        seed, threads = seed_of(seed), threads_of(threads)
        # What is written later goes there, wherever the process has gone meanwhile.
        run = None if run is None or (ranks is not None and ranks.rank != 0) else os.path.abspath(path_of("run", run, "a folder to write"))
        with _said_in_python():
            self._training: _core.Training | None = _core.Training(
                task_of(task),
                algo,
                seed,
                threads,
                overrides,
                run,
                preset,
                _scorer(reward, termination),
                reward is not None,
                ranks,
                None if start_from is None else os.path.abspath(path_of("start_from", start_from, "the folder of a run")),
            )
        self.task, self.algo, self.seed = self._training.task, algo, seed
        self._keep_functions(run, reward, termination)
        self._begin(self._training.controller())

    def _keep_functions(self, run: str | None, reward: Outcome | None, termination: Outcome | None) -> None:
        """What is told of the functions in the run folder once something is learned from them."""
        self._functions = None if run is None else Path(run) / FUNCTIONS
        self._given = {"reward": reward is not None, "termination": termination is not None}

    def _begin(self, controller: _core.Controller) -> None:
        self._controller = controller
        self._rng = np.random.default_rng(self.seed)

    @property
    def num_timesteps(self) -> int:
        """Environment steps learned from so far; of a policy loaded from a snapshot file those that the snapshot was learned from, 0 for an imported one."""
        return self._controller.steps if self._training is None else self._training.steps

    @property
    def controller(self) -> _core.Controller:
        """The controller with what was learned so far."""
        return self._controller

    def learn(self, total_timesteps: int, callback: Callback | list[Callback] | None = None, progress_bar: bool = False) -> PID2:
        """Learns from at least ``total_timesteps`` more environment steps.

        Args:
            total_timesteps: Rounded up to whole batches of ``n_envs * n_steps``. The learning rate falls towards zero at the number asked for,
                so one long call is not two short ones.
            callback: ``callback(agent, metrics)`` after each iteration, or several; the agent has what was learned so far, metrics are by SB3's tags.
                ``False``, of Python or NumPy, ends the learning; whatever else comes back, ``None`` and 0 too, does not.
            progress_bar: Draws a bar on standard error, if that is a terminal.

        A run folder is held against other trainings meanwhile, and has a checkpoint after every tenth of the steps and every two
        minutes. The interpreter runs other threads meanwhile. Ctrl-C raises ``KeyboardInterrupt`` between two iterations; what was learned
        stays, and is written where there is a run folder.
        """
        if self._training is None:
            raise ValueError(
                "a policy loaded from a snapshot file predicts and does not learn: the file has no optimiser state; load a run folder, or make a new PID2"
            )
        total_timesteps = whole("total_timesteps", total_timesteps, 1, "ask for at least one step, and at most 1e15", 10**15)
        callbacks = _callbacks(callback)
        bar = _Bar(sys.stderr, self.num_timesteps, total_timesteps) if progress_bar else None
        with _said_in_python():
            warning = self._training.begin(total_timesteps)
        try:
            if self._functions is not None and any(self._given.values()):
                self._functions.write_text(json.dumps(self._given))
            if warning is not None:
                warnings.warn(warning, stacklevel=2)
            while not self._training.done:
                metrics = self._training.iterate()
                if bar is not None:
                    bar.show(metrics)
                if callbacks:
                    self._controller = self._training.controller()
                if [answer for c in callbacks if isinstance(answer := c(self, metrics), bool | np.bool_) and not answer]:
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
        state: Sequence[_core.Controller] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Floats, Sequence[_core.Controller] | None]:
        """The action for one observation (n_obs) or several (n x n_obs), as the controller on the robot would give it.

        Args:
            observation: In the order of ``controller.obs_names``.
            state: What the last call returned. It matters where ``controller.remembers``: the policy runs every few ticks only
                (Panda-reach), a limit speaks of the tick before (jerk, torque rate), or a brake is stored. Each call is then one control
                tick, and without ``state`` the first of an episode. None elsewhere. It has a controller for each environment, made when it is given
                back: rows without ``state`` take no memory, however many they are.
            episode_start: (n) true where an episode begins, or one for all.
            deterministic: Without the noise of exploration.

        Returns:
            Action (n_act) or (n x n_act), within the actuators' range, and the state for the next call.
        """
        obs, n_obs = numbers("observation", observation), len(self._controller.obs_names)
        if obs.ndim not in (1, 2) or obs.shape[-1] != n_obs or obs.size == 0:
            raise ValueError(f"observation has shape {obs.shape}; give one observation, ({n_obs},), or at least one row of several, (n, {n_obs})")
        rows = np.atleast_2d(obs)
        begins = _begins(episode_start, len(rows))
        if state is not None and self._controller.remembers and len(state) != len(rows):
            raise ValueError(f"state is of {len(state)} environments, observation of {len(rows)}; give the state of the same environments")
        noise = None if deterministic else self._rng.standard_normal((len(rows), self._controller.n_noise))
        memory: Sequence[_core.Controller] | None = None
        if not self._controller.remembers:
            controllers: Sequence[_core.Controller] = (self._controller,) * len(rows)
            begins = np.zeros(len(rows), bool)
        elif state is None:
            # One is enough: it forgets from row to row.
            memory, controllers, begins = Memory(self._controller, rows, noise), (self._controller.another(),) * len(rows), np.ones(len(rows), bool)
        else:
            controllers = memory = state
        actions = []
        for i, (controller, row) in enumerate(zip(controllers, rows)):
            if begins[i]:
                controller.reset()
            actions.append(controller.act(row, None if noise is None else noise[i]))
        return (np.stack(actions) if obs.ndim > 1 else actions[0]), memory

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the snapshot: networks, normaliser, constraints, robot; ``nearl eval``, ``nearl run`` and :meth:`load` read it."""
        path = path_of("path", path, "a file to write, e.g. 'policy.safetensors'")
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
    ) -> PID2:
        """A policy to predict with, from a snapshot file; from a run folder, one that can also learn on, exactly where it stopped.

        With ``ranks`` it is a run folder, which rank 0 reads for all; the number of ranks may be another than before.

        A run that was asked for ``n`` steps and stopped after ``k`` gives, after ``learn(n - k)``, the same weights as one that was not stopped; ``n`` is
        the number asked for, not that of whole batches. One that learned from Python functions needs them again, as ``reward`` and ``termination``.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is not a snapshot, was damaged, or learned from a function that is not given again, by its name.
        """
        agent = cls.__new__(cls)
        agent._training, agent.seed = None, 0
        check_outcomes(reward, termination)
        path, threads = os.path.abspath(path_of("path", path, "a snapshot file or a run folder")), threads_of(threads)
        if ranks is not None or (Path(path) / "checkpoints" / "resume.safetensors").is_file():
            _ask_again(Path(path), reward, termination)
            with _said_in_python(path):
                agent._training = _core.Training.resume(path, threads, _scorer(reward, termination), reward is not None, ranks)
            agent._keep_functions(path, reward, termination)
        with _said_in_python(path):
            controller = _core.Controller.load(path) if agent._training is None else agent._training.controller()
        agent.task, agent.algo = controller.task, controller.algo
        agent._begin(controller)
        return agent


@contextmanager
def _said_in_python(path: str = "") -> Iterator[None]:
    """A refusal of a folder or file, with ``path`` in it, and arguments of this class in place of the command's."""
    try:
        yield
    except ValueError as error:
        said = str(error)
        for option, argument in _ARGUMENTS.items():
            said = said.replace(option, argument)
        said = said if path in said else f"'{path}': {said}"
        if said == str(error):
            raise
        raise ValueError(said) from None


def _check_names(algo: Any, preset: Any, settings: Any) -> None:
    """Refuses what Rust would call an instance of another type."""
    if not isinstance(algo, str):
        raise ValueError(f"algo is {algo!r}; give one of {', '.join(name for name, _ in _core.algorithms())}")
    if preset is not None and not isinstance(preset, str):
        raise ValueError(f"preset is {preset!r}; give 'paper', 'strong' or 'long', or leave it out")
    if settings is not None and not isinstance(settings, Mapping):
        raise ValueError(f"settings is {settings!r}; give a table by dotted key of the task file, e.g. {{'constraints.velocity.limit': 12.0}}")


def _callbacks(callback: Any) -> list[Callback]:
    """All of them, each a function of ``(agent, metrics)``."""
    callbacks = callback if isinstance(callback, list) else [] if callback is None else [callback]
    for i, one in enumerate(callbacks):
        name = f"callback[{i}]" if isinstance(callback, list) else "callback"
        if not callable(one):
            raise ValueError(f"{name} is {one!r}; give a function, callback(agent, metrics), or a list of them")
        function_of(name, one, "agent, metrics")
    return callbacks


def _scorer(reward: Outcome | None, termination: Outcome | None) -> Callable[[Floats, Floats, Floats], tuple[float | None, bool]] | None:
    """Both functions as one, of a single control period (1 x n arrays)."""
    if reward is None and termination is None:
        return None

    def scorer(obs: Floats, actions: Floats, next_obs: Floats) -> tuple[float | None, bool]:
        worth = None if reward is None else float(ask("reward", reward, obs, actions, next_obs, float)[0])
        return worth, termination is not None and bool(ask("termination", termination, obs, actions, next_obs, bool)[0])

    return scorer


def _ask_again(run: Path, reward: Outcome | None, termination: Outcome | None) -> None:
    """Refuses to go on without a function that the run has learned from; the others may take the task's place from here on."""
    if not (run / FUNCTIONS).is_file():
        return
    learned = json.loads((run / FUNCTIONS).read_text())
    missing = [name for name, given in (("reward", reward), ("termination", termination)) if learned[name] and given is None]
    if missing:
        give = ", ".join(f"{name}=..." for name, was in learned.items() if was)
        raise ValueError(
            f"the training in '{run}' has its {' and its '.join(missing)} from Python functions, which no file holds; go on in Python with "
            f"nearl.PID2.load(run, {give})"
        )


def _begins(episode_start: Any, n: int) -> NDArray[np.bool_]:
    """Where of ``n`` rows an episode begins; nowhere for None."""
    begins = np.asarray(False if episode_start is None else episode_start, bool)
    if begins.ndim > 1 or begins.size not in (1, n):
        raise ValueError(f"episode_start has shape {begins.shape}, and observation is of {n} environments; give one true or false for each, ({n},)")
    return np.broadcast_to(begins, n)


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
