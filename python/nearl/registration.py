"""Gymnasium's ids of the bundled tasks, ``nearl/HalfCheetah-v5`` and its like.

Importing ``nearl`` registers them; so does ``gymnasium.make("nearl:nearl/HalfCheetah-v5")``. (Gymnasium 1.x loads no plug-ins by
itself: the ``gymnasium.envs`` entry point of earlier versions is not read any more.)
"""

import gymnasium

from nearl import _core

# Control periods in an episode. (The native environments know theirs, but making one compiles its robot.)
MAX_EPISODE_STEPS = {"Panda-reach": 2000}
MAX_EPISODE_STEPS_ELSE = 1000


def register() -> None:
    """Registers every task once, with its time limit."""
    for task, _ in _core.tasks():
        env_id = f"nearl/{task}"
        if env_id in gymnasium.registry:
            continue
        gymnasium.register(
            id=env_id,
            entry_point="nearl.env:Env",
            vector_entry_point="nearl.vector:VecEnv",
            max_episode_steps=MAX_EPISODE_STEPS.get(task, MAX_EPISODE_STEPS_ELSE),
            kwargs={"task": task},
        )
