"""Policies of Stable-Baselines3."""

import math
import warnings
from typing import Any

import numpy as np

from nearl._core import Controller, Env
from nearl.arguments import task_of
from nearl.importers.layers import as_array, followed_by, layers_of
from nearl.importers.modules import check_live
from nearl.importers.moments import policy_of
from nearl.importers.place import Path, Recipe, place
from nearl.importers.wrappers import native_env, rescaled, rescaling_wrappers


def import_sb3(
    model: Any,
    vec_normalize: Any = None,
    *,
    task: Path | None = None,
    actions: str | None = None,
    robot: Path | None = None,
    recipe: Recipe = None,
    name: str = "policy",
) -> Controller:
    """The controller of a Stable-Baselines3 model (PPO, A2C, SAC, TD3, DDPG): its mean action.

    Args:
        model: The live object.
        vec_normalize: The ``VecNormalize`` it was trained with; the model's own where it has one. A model that was loaded without its environment
            does not know of any, and a warning says so: load it with ``env=``, or give it here; ``False`` says that there was none.
        task: The task whose observation the model sees, a bundled one or a TOML file; or ``robot`` and ``recipe``.
        actions: What the model gives in its task, as for :func:`import_onnx`; by default what its environment says, ``"actuators"`` where it says nothing.
        robot: URDF or MJCF file.
        recipe: As for :func:`import_onnx`.
        name: Of the task made of robot and recipe.

    Raises:
        ValueError: a part of the policy that is no layer, by name; actions that are none of the task's actuators; or a file.
    """
    check_live(model, "import_sb3", "stable_baselines3.PPO.load")
    if missing := [name for name in ("action_space", "policy") if not hasattr(model, name)]:
        raise ValueError(f"model is {model!r}, no model of Stable-Baselines3 (no {missing[0]}); give the live object, e.g. what PPO.load(file) returns")
    space, policy = model.action_space, model.policy
    actions = _meaning(model, actions, task)
    if not hasattr(space, "low"):
        raise ValueError(f"the model chooses from {space}, and an imported policy gives numbers within a range; train it on a Box of actions")
    if hasattr(policy, "lstm_actor"):
        raise ValueError("the model's policy is recurrent (lstm_actor), which is none that layers consist of; train one without memory, or give it history")
    low, high = as_array(space.low, "action_space.low").ravel(), as_array(space.high, "action_space.high").ravel()
    actor = getattr(policy, "actor", None)
    if actor is None:  # PPO, A2C: the action is cut to its range, or with use_sde=True and squash_output=True squashed
        parts = [("mlp_extractor.policy_net", policy.mlp_extractor.policy_net), ("action_net", policy.action_net)]
        squashed = bool(getattr(policy, "squash_output", False))
        layers = layers_of([*_seen_by(policy), *parts])
        layers = followed_by(layers, "tanh") if squashed else layers
    elif hasattr(actor, "latent_pi"):  # SAC: the mean is squashed
        layers, squashed = followed_by(layers_of([*_seen_by(actor), ("actor.latent_pi", actor.latent_pi), ("actor.mu", actor.mu)]), "tanh"), True
    else:  # TD3, DDPG: the network ends with a tanh
        layers, squashed = layers_of([*_seen_by(actor), ("actor.mu", actor.mu)]), True
    if squashed:
        layers = [*layers, (np.diag((high - low) / 2), (high + low) / 2, "identity")]
    mean = std = None
    clip = math.inf
    if vec_normalize is None:
        vec_normalize = getattr(model, "get_vec_normalize_env", lambda: None)()
        if vec_normalize is None and getattr(model, "get_env", lambda: None)() is None:
            warnings.warn(
                "the model has no environment with it (PPO.load without env=), so nobody tells whether it learned behind a VecNormalize: observations are "
                "taken as they are; if there was one, give it as vec_normalize=VecNormalize.load(file, venv), and vec_normalize=False if there was none",
                stacklevel=2,
            )
    if vec_normalize is False:
        vec_normalize = None
    if vec_normalize is not None and not hasattr(vec_normalize, "norm_obs"):
        raise ValueError(f"vec_normalize is {vec_normalize!r} and no VecNormalize; give the live object, e.g. VecNormalize.load(file, env)")
    if vec_normalize is not None and vec_normalize.norm_obs:
        rms = vec_normalize.obs_rms
        mean, std = rms.mean, np.sqrt(as_array(rms.var, "obs_rms.var") + vec_normalize.epsilon)
        clip = float(vec_normalize.clip_obs)
    wrappers = rescaling_wrappers(model) if task is not None and robot is None else []
    for wrapper in wrappers:
        layers, low, high = rescaled(wrapper, layers, low, high)
    # What leaves the range of the space is cut there by the model, and by the motors of its task; a proposed state has no motor, and what a recipe makes
    # of an output has another range.
    is_cut = actions != "actuators" or wrappers or robot is not None
    made = policy_of(layers, mean, std, clip, (low, high) if is_cut else (-math.inf, math.inf))
    if task is not None and robot is None:
        _check_range(low, high, task_of(task), actions)
    settings = _rate(model, task) if task is not None and robot is None and recipe is None and actions == "actuators" else []
    controller = place(made, robot, recipe, task, name, actions, settings)
    if actions != "actuators":
        _check_task(model, controller)
    return controller


def _meaning(model: Any, actions: str | None, task: Path | None) -> str:
    """What the model gives: as its environment says where it is one of ours, which has to be what the caller says."""
    env = getattr(model, "get_env", lambda: None)()
    told = None
    if env is not None and hasattr(env, "has_attr") and env.has_attr("action_meaning"):
        meanings = sorted({meaning if meaning in ("state", "change") else "actuators" for meaning in env.get_attr("action_meaning")})
        told = meanings[0]
        if meanings != [told] or actions not in (None, told):
            raise ValueError(f"the model learned with actions {' and '.join(map(repr, meanings))}, and it is imported with actions={actions!r}; leave it out")
    actions = actions or told or "actuators"
    if actions != "actuators" and task is None:
        raise ValueError(
            f"the model gives {'proposed states' if actions == 'state' else 'changes of the state'} (actions='{actions}'), and a recipe is of a policy that "
            f"gives actions of the actuators; give the task that it learned, task=FILE"
        )
    return actions


def _rate(model: Any, task: Path) -> list[str]:
    """What a task has to be set to so that its policy acts as often as the model did where it learned."""
    if (native := native_env(model)) is None:
        return []
    dt = Env(task_of(task)).dt
    every = round(native.dt / dt)
    if every < 1 or abs(every * dt - native.dt) > 1e-9 * native.dt:
        raise ValueError(
            f"the model acted every {native.dt:g} s where it learned, and the control period of '{task_of(task)}' is {dt:g} s, of which that is no multiple; "
            f"give the task that it learned"
        )
    return [f"time.policy_every={every}"]


def _check_task(model: Any, controller: Controller) -> None:
    """Refuses a task that takes proposals for other entries, of other observations or for another time than that which the model learned in."""
    if (native := native_env(model)) is None:
        return
    for what, theirs, ours in (
        ("proposes", list(native.action_names), controller.state_names),
        ("sees", list(native.obs_names), controller.obs_names),
        ("proposes for", f"{native.dt:g} s", f"{controller.dt * controller.policy_every:g} s"),
    ):
        if theirs != ours:
            of, at = next(((a, b) for a, b in zip(theirs, ours) if a != b), (theirs, ours)) if isinstance(theirs, list) else (theirs, ours)
            raise ValueError(f"the model {what} {of} where the task has {at}; give the task that it learned")


def _check_range(low: np.ndarray, high: np.ndarray, task: str, actions: str) -> None:
    """Refuses actions in another range than the motors have, which would be taken for theirs; changes are shares, and states have their units."""
    if actions == "state":
        return
    if actions == "change":
        if not (np.allclose(low, -1.0) and np.allclose(high, 1.0)):
            raise ValueError(
                f"the model's actions range from {low.min():g} to {high.max():g}, and changes of the state from -1 to 1, in units of what the limits allow; "
                f"train it in that range (nearl.make_vec, actions='change')"
            )
        return
    env = Env(task)
    for which, given, want in (("smallest", low, env.action_low), ("largest", high, env.action_high)):
        if given.shape != want.shape:
            return  # the task says how many there are
        for i in np.flatnonzero(~np.isclose(given, want, rtol=1e-5, atol=1e-9)):
            raise ValueError(
                f"the {which} action[{i}] of the model is {given[i]:g}, and that of actuator '{env.actuator_names[i]}' of '{task}' is {want[i]:g}; "
                f"train the model on actions of the actuators' range, or give robot= and a recipe= that says what its outputs mean"
            )


def _seen_by(policy: Any) -> list[tuple[str, Any]]:
    """What SB3 makes of the observation before the first layer: nothing but flattening, or it is named."""
    parts = [(name, getattr(policy, name, None)) for name in ("pi_features_extractor", "features_extractor")]
    return [(name, part) for name, part in parts if part is not None][:1]
