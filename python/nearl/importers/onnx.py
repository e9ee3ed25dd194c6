"""Policies in ONNX files."""

import os

from nearl._core import Controller, Policy
from nearl.importers.place import Path, Recipe, place


def import_onnx(
    path: Path,
    robot: Path | None = None,
    recipe: Recipe = None,
    output: str | None = None,
    name: str = "policy",
    *,
    task: Path | None = None,
    actions: str = "actuators",
) -> Controller:
    """The controller of the policy in an ONNX file.

    Args:
        path: The file; external data lies beside it.
        robot: URDF or MJCF file; or ``task``.
        recipe: What the policy sees and what its outputs mean, where the file's metadata does not say it: a TOML file, unitree's ``deploy.yaml``,
            or several of them, of which a later one comes before those before it.
        output: Which of several outputs is the action.
        name: Of the task made of robot and recipe.
        task: In place of robot and recipe, the task whose observation the policy sees: a bundled one or a TOML file.
        actions: What the policy gives in its task: ``"actuators"``, what the motors get; ``"state"``, the next state, entry by entry; ``"change"``, its
            change in units of what the limits allow in a policy period, as environments have them (:func:`nearl.make_vec`).

    Raises:
        ValueError: the file is no policy, names a node that is not read, or something does not fit robot or recipe.
    """
    try:
        policy = Policy.from_onnx(path, output)
    except ValueError as error:
        if os.fspath(path) in str(error):
            raise
        raise ValueError(f"'{os.fspath(path)}': {error}") from None
    try:
        return place(policy, robot, recipe, task, name, actions)
    except ValueError as error:
        if not str(error).startswith("metadata '"):
            raise
        raise ValueError(f"'{os.fspath(path)}': {error}") from None
