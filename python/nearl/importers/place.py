"""A policy in a task, or with a robot and a recipe."""

import os
import warnings
from collections.abc import Sequence
from typing import Any

from nearl._core import Controller, Policy
from nearl.arguments import task_of

Path = str | os.PathLike[str]
Recipe = Path | Sequence[Path] | None


def place(
    policy: Policy, robot: Path | None, recipe: Recipe, task: Path | None, name: str, actions: str, settings: Sequence[str] = ()
) -> Controller:
    if task is not None and robot is None and recipe is None:
        return _told(policy.in_task(task_of(task), list(settings), actions))
    if robot is None or task is not None:
        raise ValueError("give either task=, or robot= and recipe=")
    if actions != "actuators":
        raise ValueError(f"actions={actions!r} is what a policy gives in a task; give task=FILE in place of robot= and recipe=")
    recipes = _recipes(recipe)
    if not isinstance(robot, str | os.PathLike):
        raise ValueError(f"robot is {robot!r}; give the path of a URDF or MJCF file")
    for what, kind, file in (("robot", "a URDF or MJCF file", robot), *(("recipe", "a TOML file or unitree's deploy.yaml", one) for one in recipes)):
        if not os.path.isfile(file):
            reason = "it is no file" if os.path.exists(file) else "it does not exist"
            raise ValueError(f"cannot read {what} '{os.fspath(file)}': {reason}; give {kind}")
    return _told(policy.controller(robot, recipe, name))


def _recipes(recipe: Any) -> Sequence[Path]:
    """The files of a recipe, one after the other."""
    recipes = [] if recipe is None else [recipe] if isinstance(recipe, str | os.PathLike) else recipe
    if not isinstance(recipes, Sequence) or not all(isinstance(one, str | os.PathLike) for one in recipes):
        raise ValueError(f"recipe is {recipe!r}; give the path of a TOML file or of unitree's deploy.yaml, or a list of paths")
    return recipes


def _told(controller: Controller) -> Controller:
    """Says what `nearl import` says of robot and limits, at the line of whoever imports."""
    for note in controller.notes:
        warnings.warn(note, stacklevel=4)
    return controller
