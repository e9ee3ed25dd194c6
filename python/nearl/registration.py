"""Gymnasium's ids of the bundled tasks, ``nearl/HalfCheetah-v5`` and its like, and of task files.

Importing ``nearl`` registers the bundled ones; so does ``gymnasium.make("nearl:nearl/HalfCheetah-v5")``. (Gymnasium 1.x loads no
plug-ins by itself: the ``gymnasium.envs`` entry point of earlier versions is not read any more.)
"""

import os
import re
import warnings

import gymnasium

from nearl import _core
from nearl.arguments import path_of

_ID = re.compile(r"[\w:.-]+")


def register(*task_files: str | os.PathLike[str]) -> list[str]:
    """Registers the bundled tasks, or the task files given; returns the ids, ``nearl/<name in the file>``.

        env = gymnasium.make(nearl.register("my_task.toml")[0])

    A file of a name that another file was registered under takes its id, with a warning; the same file is read anew.

    Raises:
        OSError: a task file or its robot cannot be read.
        ValueError: a task file is wrong; the message names the key.
    """
    if not task_files:
        return [_register(task, task, _core.max_episode_steps(task)) for task, _ in _core.tasks()]
    ids, bundled = [], {task for task, _ in _core.tasks()}
    for file in task_files:
        env = _core.Env(path_of("a task file", file))
        if env.task in bundled:
            raise ValueError(f"{os.fspath(file)} [name]: '{env.task}' is a bundled task, whose id it would take; give the file another name")
        if not _ID.fullmatch(env.task):
            raise ValueError(f"{os.fspath(file)} [name]: '{env.task}' is no name of an environment; take letters, digits, '-', '_', '.' and ':'")
        before = gymnasium.registry.pop(f"nearl/{env.task}", None)
        if before is not None and (other := before.kwargs["task"]) != os.path.abspath(file) and os.path.realpath(other) != os.path.realpath(file):
            warnings.warn(
                f"'{os.fspath(file)}' takes the id nearl/{env.task} of '{other}', whose [name] is the same: the id makes environments of the new file from now "
                f"on; give one of the two another name",
                stacklevel=2,
            )
        ids.append(_register(env.task, os.path.abspath(file), env.max_episode_steps))
    return ids


def _register(name: str, task: str, max_episode_steps: int | None) -> str:
    env_id = f"nearl/{name}"
    if env_id not in gymnasium.registry:
        gymnasium.register(
            id=env_id,
            entry_point="nearl.projected:make",
            vector_entry_point="nearl.vector:VecEnv",
            max_episode_steps=max_episode_steps,
            kwargs={"task": task},
        )
    return env_id
