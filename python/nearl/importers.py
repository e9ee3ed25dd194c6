"""Policies made elsewhere, as controllers of this package.

    controller = nearl.import_onnx("policy.onnx", robot="go1.xml", recipe="go1.toml")
    controller.save("go1.safetensors")                 # for nearl run, nearl doctor, nearl plant

    model = stable_baselines3.PPO("MlpPolicy", "nearl/HalfCheetah-v5").learn(1_000_000)
    controller = nearl.import_sb3(model, task="HalfCheetah-v5")

Live objects are read, never files of theirs: the library that wrote a file loads it, and its weights come over as arrays.
"""

import contextlib
import inspect
import itertools
import math
import os
import re
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from nearl._core import Controller, Env, Policy
from nearl.arguments import task_of

_Path = str | os.PathLike[str]
_Recipe = _Path | Sequence[_Path] | None
_Layer = tuple[np.ndarray, np.ndarray, str]

# What follows a layer, by the name of the module's class.
_FUNCTIONS = {"Identity": "identity", "Tanh": "tanh", "ReLU": "relu", "SiLU": "silu", "Sigmoid": "sigmoid", "ELU": "elu", "Softplus": "softplus"}
_NO_LAYER = "the module has no linear layer; give the policy's network"
# What works in the place of TorchScript.
_SCRIPT = (
    "of which nobody reads the layers; give nearl.import_torch the torch.nn.Sequential that it was made from, or export it, "
    "torch.onnx.export({}, (torch.zeros(1, n),), 'policy.onnx', dynamo=False) with n inputs, and import that file (nearl.import_onnx, `nearl import`)"
)
# What works in the place of code, which is not read.
_EXPORT = "export it, torch.onnx.export(module, (torch.zeros(1, n),), 'policy.onnx') with n inputs, and import that file (nearl.import_onnx, `nearl import`)"
# What normalises observations is called so, itself or by its class; a normal distribution is not.
_NORMALISES = re.compile(
    r"norm(?!al(_|$|param|dist|tanh))|(^|_|obs)rms|running_?(mean|var|std)|standardi[sz]|whiten|scaler|"
    r"(obs|observations?|states?|inputs?)_(mean|std|var|loc|scale|shift|offset|stat)",
    re.IGNORECASE,
)
# What of a module has no part in the action that its actor puts out: what judges, and what explores.
_APART = re.compile(r"critic|value|return|reward|advantage|cost|(^|_)q\d*(_|$)|target|std|sigma|alpha|temperature|entropy|dist|discrim|memory_c", re.IGNORECASE)
# What computes an action is called so.
_ACTS = re.compile(r"^(act|predict|infer|inference|sample|policy)$|^(act|predict)_|^(get|select|choose|sample|compute)_actions?(?!s?_log)|(^|_)actions?$")
# Observations on which a module is held against what was read of it: so many of each size, in standard deviations.
_ROWS, _SIZES = 8, (1.0, 0.1, 10.0, 100.0)
# Part by which the two may differ of the largest output of observations of one size, and of all: sums in single precision.
_SAME_PART, _SAME_REST = 1e-4, 1e-7
# How many roundings of one number an output of several layers may be off.
_ROUNDINGS = 12
# Modules that do nothing when a policy acts.
_NOTHING = ("Identity", "Flatten", "Dropout", "FlattenExtractor")


def import_onnx(
    path: _Path,
    robot: _Path | None = None,
    recipe: _Recipe = None,
    output: str | None = None,
    name: str = "policy",
    *,
    task: _Path | None = None,
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
        return _place(policy, robot, recipe, task, name, actions)
    except ValueError as error:
        if not str(error).startswith("metadata '"):
            raise
        raise ValueError(f"'{os.fspath(path)}': {error}") from None


def import_torch(
    module: Any,
    robot: _Path | None = None,
    recipe: _Recipe = None,
    *,
    task: _Path | None = None,
    actions: str = "actuators",
    mean: Any = None,
    std: Any = None,
    clip: float = math.inf,
    output_clip: tuple[float, float] = (-math.inf, math.inf),
    name: str = "policy",
) -> Controller:
    """The controller of a policy that is a ``torch.nn.Sequential`` of linear layers, or that has one as its ``actor``, or of a model of rsl_rl (``MLPModel``).

    Of a module with a ``forward`` of its own, give the Sequential inside (``module.net``) where that is all it runs; else export it with
    ``torch.onnx.export`` and read the file with :func:`import_onnx`. A module with an ``actor``, and a model, is run on some observations (``act_inference``,
    else ``forward``), and refused where that gives anything else than what was read.

    Args:
        module: The live object. What normalises observations beside its ``actor``, or a model's ``mlp``, is read with it: an ``EmpiricalNormalization``
            of rsl_rl, or a ``BatchNorm1d`` that does not learn. The ``mlp`` alone is the network without its normaliser.
        robot: URDF or MJCF file; or ``task``.
        recipe: As for :func:`import_onnx`.
        task: In place of robot and recipe, the task whose observation the policy sees: a bundled one or a TOML file.
        actions: What the policy gives in its task, as for :func:`import_onnx`.
        mean: Of each observation entry; 0 if not given.
        std: Of each observation entry, with the normaliser's epsilon; 1 if not given.
        clip: Network inputs are cut to this many standard deviations.
        output_clip: Outputs are cut to this range before scale and offset; each end is one number, or one for each output.
        name: Of the task made of robot and recipe.

    Raises:
        ValueError: a module that is no layer of a policy, by name; one that does more than its layers; or a file.
    """
    if isinstance(module, str | os.PathLike) and _is_torchscript(module):
        raise ValueError(f"'{os.fspath(module)}' is a file of TorchScript, {_SCRIPT.format(f'torch.jit.load({os.fspath(module)!r})')}")
    _live(module, "import_torch", "torch.load")
    if type(module).__name__ == "OptimizedModule" and _network_name(module):
        module = module._orig_mod  # as torch.compile wraps it
    core = _network_name(module)
    if getattr(module, "is_recurrent", False) is True:
        kind = type(module).__name__
        raise ValueError(f"module {kind} is recurrent, and only networks without memory are read; train one without, and give it the history as observations")
    network = [(core, getattr(module, core))] if core else [("", module)]
    _check_order(*network[0])
    layers = _layers(network)
    if not layers:
        raise ValueError(_NO_LAYER)
    n_in, n_out = np.shape(layers[0][0])[1], len(layers[-1][1])
    bounds = _clip_of(clip), _range_of(output_clip, n_out)
    moments = _moments(*(_normaliser(module, mean, std) if network[0][0] else (mean, std)), n_in)
    # Who gives a normaliser or a clip may mean one that stands around the module, or the one in it.
    normalisers = [moments, _moments(None, None, n_in)] if mean is not None or std is not None else [moments]
    clips, ranges = dict.fromkeys((bounds[0], math.inf)), (bounds[1], (-math.inf, math.inf))
    parts = [network[0][1], *(_normalisers(module).values() if network[0][0] and mean is None and std is None else ())]
    _check_run(module, moments, [_policy(layers, m, s, c, o) for m, s in normalisers for c in clips for o in ranges], _rounding(parts))
    return _place(_policy(layers, *moments, *bounds), robot, recipe, task, name, actions)


def import_sb3(
    model: Any,
    vec_normalize: Any = None,
    *,
    task: _Path | None = None,
    actions: str | None = None,
    robot: _Path | None = None,
    recipe: _Recipe = None,
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
    _live(model, "import_sb3", "stable_baselines3.PPO.load")
    if missing := [name for name in ("action_space", "policy") if not hasattr(model, name)]:
        raise ValueError(f"model is {model!r}, no model of Stable-Baselines3 (no {missing[0]}); give the live object, e.g. what PPO.load(file) returns")
    space, policy = model.action_space, model.policy
    actions = _meaning(model, actions, task)
    if not hasattr(space, "low"):
        raise ValueError(f"the model chooses from {space}, and an imported policy gives numbers within a range; train it on a Box of actions")
    if hasattr(policy, "lstm_actor"):
        raise ValueError("the model's policy is recurrent (lstm_actor), which is none that layers consist of; train one without memory, or give it history")
    low, high = _numbers(space.low, "action_space.low").ravel(), _numbers(space.high, "action_space.high").ravel()
    actor = getattr(policy, "actor", None)
    if actor is None:  # PPO, A2C: the action is cut to its range, or with use_sde=True and squash_output=True squashed
        parts = [("mlp_extractor.policy_net", policy.mlp_extractor.policy_net), ("action_net", policy.action_net)]
        squashed = bool(getattr(policy, "squash_output", False))
        layers = _layers([*_seen_by(policy), *parts])
        layers = _followed(layers, "tanh") if squashed else layers
    elif hasattr(actor, "latent_pi"):  # SAC: the mean is squashed
        layers, squashed = _followed(_layers([*_seen_by(actor), ("actor.latent_pi", actor.latent_pi), ("actor.mu", actor.mu)]), "tanh"), True
    else:  # TD3, DDPG: the network ends with a tanh
        layers, squashed = _layers([*_seen_by(actor), ("actor.mu", actor.mu)]), True
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
        mean, std = rms.mean, np.sqrt(_numbers(rms.var, "obs_rms.var") + vec_normalize.epsilon)
        clip = float(vec_normalize.clip_obs)
    wrappers = _wrappers(model) if task is not None and robot is None else []
    for wrapper in wrappers:
        layers, low, high = _rescaled(wrapper, layers, low, high)
    # What leaves the range of the space is cut there by the model, and by the motors; a proposed state has no motor.
    made = _policy(layers, mean, std, clip, (low, high) if actions != "actuators" or wrappers else (-math.inf, math.inf))
    if task is not None and robot is None:
        _check_range(low, high, task_of(task), actions)
    settings = _rate(model, task) if task is not None and robot is None and recipe is None and actions == "actuators" else []
    controller = _place(made, robot, recipe, task, name, actions, settings)
    if actions != "actuators":
        _check_task(model, controller)
    return controller


def _meaning(model: Any, actions: str | None, task: _Path | None) -> str:
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


# Wrappers of Gymnasium that leave every number of an observation where it is.
_SAME = frozenset({"DtypeObservation", "FlattenObservation"})
# Wrappers of Gymnasium and Stable-Baselines3 that change neither observations nor how long an action lasts, nor actions beyond cutting them to their range.
_UNTOUCHED = frozenset({
    "Autoreset", "ClipAction", "HumanRendering", "Monitor", "NormalizeReward", "OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "RecordVideo",
    "RenderCollection", "TimeLimit",
})  # fmt: skip


def _envs(model: Any) -> list[Any]:
    """The single environments that the model learned in, with their wrappers; empty where it brings none."""
    env = getattr(model, "get_env", lambda: None)()
    while env is not None and not hasattr(env, "envs") and hasattr(env, "venv"):
        env = env.venv
    return list(getattr(env, "envs", None) or [])


def _wrappers(model: Any) -> list[Any]:
    """The wrappers that rescale the actions of the first environment, outermost first. Those that change observations otherwise than VecNormalize, or
    actions otherwise, are refused in each: the controller gives the observation of the task, and takes what the network puts out."""
    each = [_rescaling(one) for one in _envs(model)]
    return each[0] if each else []


def _rescaling(one: Any) -> list[Any]:
    import gymnasium

    rescaling = []
    while isinstance(one, gymnasium.Wrapper):
        kind = type(one).__name__
        if isinstance(one, gymnasium.ObservationWrapper) and kind not in _SAME:
            raise ValueError(
                f"the model learned behind the wrapper {kind}, which changes observations, and the controller gives it those of the task; "
                f"learn with VecNormalize, which is taken along, or give robot= and a recipe= that says how the policy sees each entry"
            )
        if kind == "RescaleAction":
            rescaling.append(one)
        elif isinstance(one, gymnasium.ActionWrapper) and kind != "ClipAction":
            raise ValueError(
                f"the model learned behind the wrapper {kind}, which changes actions, and the controller takes what the network puts out; learn without it, "
                f"or with RescaleAction, which is taken along"
            )
        elif kind not in _UNTOUCHED | _SAME and not isinstance(one, gymnasium.RewardWrapper):
            warnings.warn(
                f"the model learned behind the wrapper {kind}, of which only its environment knows what it does: should it repeat actions or change "
                f"observations, the controller does neither",
                stacklevel=5,
            )
        one = one.env
    return rescaling


def _rescaled(wrapper: Any, layers: list[_Layer], low: np.ndarray, high: np.ndarray) -> tuple[list[_Layer], np.ndarray, np.ndarray]:
    """The layers with what a RescaleAction does behind them, and the range of what comes out."""
    inner = wrapper.env.action_space
    inner_low, inner_high = _numbers(inner.low, "action_space.low").ravel(), _numbers(inner.high, "action_space.high").ravel()
    scale = (inner_high - inner_low) / (high - low)
    return [*layers, (np.diag(scale), inner_low - scale * low, "identity")], inner_low, inner_high


def _native(model: Any) -> Any:
    """The environment of ours that the model learned in; None where it is another, or it brings none."""
    envs = _envs(model)
    env = envs[0].unwrapped if envs else getattr(model, "get_env", lambda: None)()
    return getattr(env, "native", None)


def _rate(model: Any, task: _Path) -> list[str]:
    """What a task has to be set to so that its policy acts as often as the model did where it learned."""
    if (native := _native(model)) is None:
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
    if (native := _native(model)) is None:
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


def _place(
    policy: Policy, robot: _Path | None, recipe: _Recipe, task: _Path | None, name: str, actions: str, settings: Sequence[str] = ()
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


def _recipes(recipe: Any) -> Sequence[_Path]:
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


def _policy(layers: list[_Layer], mean: Any, std: Any, clip: float, output_clip: tuple[Any, Any]) -> Policy:
    if not layers:
        raise ValueError(_NO_LAYER)
    mean, std = _moments(mean, std, np.shape(layers[0][0])[1])
    return Policy.from_layers(layers, mean, std, (-clip, clip), output_clip)


def _moments(mean: Any, std: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    mean = np.zeros(size) if mean is None else _numbers(mean, "mean").ravel()
    std = np.ones(size) if std is None else _numbers(std, "std").ravel()
    for name, values, is_good, give in (("mean", mean, np.isfinite(mean), "finite numbers"), ("std", std, np.isfinite(std) & (std > 0), "numbers above 0")):
        if len(bad := np.flatnonzero(~is_good)):
            raise ValueError(f"{name}[{bad[0]}] of the observation is {values[bad[0]]:g}; give {give}, one for each entry")
    return mean, std


def _clip_of(clip: Any) -> float:
    try:
        number = math.nan if isinstance(clip, str | bytes | bool) else float(clip)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not number > 0:
        raise ValueError(f"clip is {clip!r}; give a number above 0, the standard deviations that inputs are cut to, or leave it out")
    return number


def _range_of(output_clip: Any, n: int) -> tuple[Any, Any]:
    """Both ends, each a number or an array (n)."""
    give = f"give (low, high), each a number or one for each of the {n} outputs, and low not above high"
    try:
        low, high = (_numbers(end, "it") for end in output_clip)
    except (TypeError, ValueError):
        raise ValueError(f"output_clip is {output_clip!r}; {give}") from None
    for i, end in enumerate((low, high)):
        if end.shape not in ((), (n,)):
            raise ValueError(f"output_clip[{i}] has shape {end.shape}; {give}")
    for k, (a, b) in enumerate(zip(*np.broadcast_arrays(np.atleast_1d(low), np.atleast_1d(high)))):
        if not (a <= b and a < math.inf and b > -math.inf):
            raise ValueError(f"output_clip is ({a:g}, {b:g}) for output[{k}]; {give}")
    return low if low.shape else float(low), high if high.shape else float(high)


def _network_name(module: Any) -> str:
    """Name of the part of a module that is its network: its actor, or the mlp of a model of rsl_rl; empty where it is the network."""
    if hasattr(module, "actor"):
        return "actor"
    return "mlp" if _is_model(module) else ""


def _is_model(module: Any) -> bool:
    """Whether it is a model of rsl_rl, itself or as it exports it (as_onnx, as_jit): a normaliser, or an Identity in its place, and the network."""
    return hasattr(module, "obs_normalizer") and hasattr(module, "mlp")


def _export(module: Any, name: str = "module") -> str:
    """What works in the place of a module that is not read; a model of rsl_rl takes no tensor, and what it makes of itself for that does."""
    if not hasattr(module, "as_onnx"):
        return _EXPORT
    return _EXPORT.replace("(module,", f"({name}.as_onnx(False),").replace("'policy.onnx')", "'policy.onnx', dynamo=False)")


def _beside(module: Any) -> dict[str, Any]:
    """What a module holds beside its actor, by name: parts, tensors and other objects, but no settings."""
    core, held = _network_name(module), dict(getattr(module, "__dict__", {}))
    for table in ("_parameters", "_buffers", "_modules"):
        held |= held.pop(table, None) or {}
    held |= dict(getattr(module, "named_children", dict)())
    return {
        name: of
        for name, of in held.items()
        if of is not getattr(module, core)
        and not (of is None or isinstance(of, bool | int | float | str | type) or type(of).__name__ == "Identity")
        and not (isinstance(of, Mapping) and "mean" not in of)
    }


def _normaliser(module: Any, mean: Any, std: Any) -> tuple[Any, Any]:
    """Mean and standard deviation of what normalises observations beside an actor; what is not read exactly is refused, unless they are given."""
    if mean is not None or std is not None:
        return mean, std
    found = _normalisers(module)
    if not found:
        return None, None
    name, normaliser = next(iter(found.items()))
    kind, ways = type(normaliser).__name__, f"give mean= and std= where it computes (observation - mean) / std; else {_export(module)}"
    said = f"module {type(module).__name__} has {name} ({kind}) beside its {_network_name(module)}"
    if len(found) > 1:
        raise ValueError(f"{said}, and {', '.join(list(found)[1:])}, of which nobody knows which one is meant; {ways}")
    _check_hooks(name, normaliser)
    if all(hasattr(normaliser, of) for of in ("_mean", "_std", "eps")):  # of rsl_rl: (x - mean) / (std + eps)
        moments = normaliser._mean, _numbers(normaliser._std, f"{name}._std") + float(normaliser.eps)
    elif kind == "BatchNorm1d" and normaliser.running_mean is not None:
        if normaliser.training:
            raise ValueError(f"{said}, which takes mean and standard deviation from each batch while it learns; call module.eval() first")
        moments = _of_batches(name, normaliser)
    else:
        raise ValueError(f"{said}, which is not read; {ways}")
    mean, std = (_numbers(of, name).ravel() for of in moments)
    forward = dict(_ways(normaliser)).get("forward")
    if forward is not None and np.isfinite(mean).all() and np.all(std > 0):
        try:
            seen, given, _ = _ran(normaliser, forward, _observations(mean, std), mean.shape)
            is_read = _apart(given, (seen - mean) / std, max(_SAME_PART, _rounding([normaliser]))) is None
        except Exception:  # whatever the code of somebody else raises
            is_read = False
        if not is_read:
            raise ValueError(f"{said}, which computes something else than (observation - mean) / (std + eps) and is not read; {ways}")
    return mean, std


def _normalisers(module: Any) -> dict[str, Any]:
    """What normalises observations beside an actor, by name."""
    return {name: of for name, of in _beside(module).items() if _is_normaliser(name, of)}


def _is_normaliser(name: str, of: Any) -> bool:
    return not _APART.search(name.replace("std", "")) and any(_NORMALISES.search(said) for said in (name, type(of).__name__))


def _of_batches(name: str, norm: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of ``weight (x - mean) / sqrt(var + eps) + bias``."""
    mean, var = _finite(norm.running_mean, f"{name}.running_mean"), _finite(norm.running_var, f"{name}.running_var")
    std = np.sqrt(var + float(norm.eps))
    if norm.weight is None:
        return mean, std
    weight, bias = _finite(norm.weight, f"{name}.weight"), _finite(norm.bias, f"{name}.bias")
    if not np.all(weight > 0):
        at = int(np.flatnonzero(weight <= 0)[0])
        raise ValueError(f"the module's tensor '{name}.weight' is {weight[at]:g} at [{at}], and a standard deviation is above 0; {_EXPORT}")
    return mean - bias * std / weight, std / weight


def _check_run(module: Any, moments: tuple[np.ndarray, np.ndarray], read: Sequence[Policy], rounding: float) -> None:
    """Holds what a module itself gives against what was ``read`` of it, of which the first is imported and the others lack what may stand around the module.
    One that has nothing to run may have nothing beside its actor that nobody knows. `rounding` is the part that the precision of what was read loses."""
    core = _network_name(module)
    kind, of = type(module).__name__, f"module.{core}" if core else "its layers"
    around = f"give nearl.import_torch({of}), with mean=, std=, clip= and output_clip= for what stands around it"
    give = f"where the {core} is all of the policy, {around}; else {_export(module)}" if core else _EXPORT
    part = max(_SAME_PART, rounding)
    for way, function in _ways(module):
        if way == "forward" and _lacks_forward(module):
            continue
        try:
            seen, given, again = _ran(module, function, _observations(*moments), (read[0].n_out,))
        except _Unreadable as error:
            raise ValueError(f"module {kind} gives what nobody can hold {of} against: its {way} gives {error}; {give}") from None
        except Exception as error:
            said = " ".join(str(error).split()) or "no reason given"
            raise ValueError(
                f"module {kind} cannot be run on observations of {read[0].n_in} entries ({way}: {type(error).__name__}: {said[:200]}), so nobody knows "
                f"whether it does more than {of}; {give}"
            ) from None
        if not np.array_equal(given, again, equal_nan=True):
            why = f"{way}: it draws, or remembers"
            raise ValueError(f"module {kind} gives two outputs for the same observation ({why}), so nobody can hold {of} against it; {give}")
        wanted = None
        for policy in read:
            found = np.stack([policy(obs) for obs in seen])
            wanted = found if wanted is None else wanted
            if _apart(given, found, part) is None:
                return
        assert wanted is not None
        row = _apart(given, wanted, part)
        assert row is not None
        off = np.abs(given[row] - wanted[row])
        i, k = np.unravel_index(np.argmax(np.where(np.isnan(off), np.inf, off)), off.shape)
        raise ValueError(
            f"module {kind} does more than {of}: its {way} gives {given[row][i, k]:.4g} as output[{k}] where the layers that are read give "
            f"{wanted[row][i, k]:.4g}, off by {off[i, k]:.3g} on the same observation; {give}"
        )
    if core:
        _check_apart(module, core, give)


def _check_apart(module: Any, core: str, give: str) -> None:
    """Refuses parts, tensors and functions beside an actor that may have a part in the action, where the module cannot be asked."""
    functions = {name: getattr(type(module), name, None) for name in dir(type(module))} | getattr(module, "__dict__", {})
    if acts := sorted(name for name, of in functions.items() if inspect.isroutine(of) and _ACTS.search(name)):
        said = f"its own {', '.join(acts)} {'is' if len(acts) == 1 else 'are'} not read"
        raise ValueError(
            f"module {type(module).__name__} has neither forward nor act_inference, and {said}, so nobody knows whether the action is what module.{core} "
            f"gives; {give}"
        )
    for name, of in _beside(module).items():
        is_part = any(hasattr(of, what) for what in ("named_children", "forward", "detach")) or isinstance(of, np.ndarray)
        if is_part and not _APART.search(name) and not _is_normaliser(name, of):
            said = f"module {type(module).__name__} has {name} ({type(of).__name__}) beside its {core}"
            raise ValueError(f"{said}, and no forward that tells whether the action depends on it; {give}")


def _ways(module: Any) -> list[tuple[str, Callable[[Any], Any]]]:
    """How a module may say which action it takes, those that sample none first."""
    ways = [("act_inference", getattr(module, "act_inference", None)), ("forward", getattr(module, "forward", None))]
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(module, torch.nn.Module):
        ways[1] = ("forward", module)  # with its hooks
    return [(way, function) for way, function in ways if callable(function)]


def _lacks_forward(module: Any) -> bool:
    """Whether a module of torch has none of its own; one that has one and raises in it is not without."""
    torch = sys.modules.get("torch")
    return torch is not None and getattr(module.forward, "__func__", None) is torch.nn.Module.forward


def _observations(mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Seeded ones in single precision, of each size some."""
    z = np.random.default_rng(0).normal(size=(len(_SIZES), _ROWS, len(mean)))
    return np.asarray(mean + std * (np.array(_SIZES)[:, None, None] * z).reshape(-1, len(mean)), np.float32)


def _groups(n: int) -> list[slice]:
    """The rows of each size."""
    return [slice(at, at + _ROWS) for at in range(0, n, _ROWS)]


def _apart(a: np.ndarray, b: np.ndarray, part: float) -> slice | None:
    """The first group in which two outputs differ by more than rounding; None where they are the same."""
    size = np.abs(b)
    return next((rows for rows in _groups(len(a)) if not np.all(np.abs(a[rows] - b[rows]) <= part * size[rows].max() + _SAME_REST * size.max())), None)


def _rounding(read: Iterable[Any]) -> float:
    """Part of the outputs that is lost by the precision of what was read; 0 where it is none of torch."""
    torch = sys.modules.get("torch")
    tensors = [of for part in read for table in ("parameters", "buffers") for of in getattr(part, table, list)()] if torch is not None else []
    return max((_ROUNDINGS * float(torch.finfo(of.dtype).eps) for of in tensors if of.is_floating_point()), default=0.0)  # type: ignore[union-attr]


def _ran(module: Any, function: Callable[[Any], Any], obs: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a function of a module saw (n x n_in), and what it gave twice (n x shape)."""
    with _acting(module) as tensor:
        groups = getattr(module, "obs_groups", None)
        names = next((groups[name] for name in ("policy", "actor") if name in groups), None) if isinstance(groups, Mapping) else groups
        given = []
        for _ in range(2):
            asked = tensor(obs)  # anew, as it may be changed in its place
            if isinstance(names, list | tuple) and names:  # rsl_rl joins the groups that its actor sees, of whatever size
                ends = [*range(len(names)), obs.shape[1]]
                asked = {name: asked[:, begin:end] for name, (begin, end) in zip(names, itertools.pairwise(ends))}
            given.append(_output(function(asked)).reshape(len(obs), *shape))
        return _numbers(tensor(obs), "the observation"), given[0], given[1]


class _Unreadable(ValueError):
    """What a module gave, in which nobody finds the action."""


def _output(given: Any) -> np.ndarray:
    """The action in what a module gives: the first of several things, the mean of a distribution.

    Raises:
        _Unreadable: there is none, as in a distribution that has no mean, whose code may add anything to what it is made of.
    """
    try:
        if isinstance(given, tuple | list):
            given = given[0]
        if not hasattr(given, "shape") and not callable(getattr(given, "mean", print)):
            given = given.mean
        return _numbers(given, "its output")
    except Exception as error:  # whatever the code of somebody else raises
        said = " ".join(str(error).split())[:200] or "no reason given"
        raise _Unreadable(f"a {type(given).__name__}, of which the action cannot be read ({type(error).__name__}: {said})") from None


@contextlib.contextmanager
def _acting(module: Any) -> Iterator[Callable[[np.ndarray], Any]]:
    """A module as it is when it acts (no dropout, no statistics, no gradients), left as it was; gives what makes its input of an array."""
    torch = sys.modules.get("torch")
    held_by = [module, *vars(module).values()] if hasattr(module, "__dict__") else [module]
    modules = [of for of in held_by if torch is not None and isinstance(of, torch.nn.Module)]
    if torch is None or not modules:
        yield np.copy
        return
    parts = [(part, dict(vars(part)), dict(part._buffers)) for part in dict.fromkeys(part for of in modules for part in of.modules())]
    tensors = [(of, of.detach().clone()) for part, _, _ in parts for of in (*part._parameters.values(), *part._buffers.values()) if of is not None]
    actor = getattr(module, _network_name(module) or "actor", None)
    of_actor = list(actor.parameters()) if isinstance(actor, torch.nn.Module) else []  # what is beside it may have another precision
    like = next((of for of in (*of_actor, *(of for of, _ in tensors)) if of.is_floating_point()), torch.zeros(1))
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        try:
            for part, _, _ in parts:
                part.training = False
            yield lambda obs: torch.tensor(obs).to(device=like.device, dtype=like.dtype)
        finally:
            for part, held, buffers in parts:
                for name in vars(part).keys() - held.keys():
                    del vars(part)[name]
                vars(part).update(held)
                part._buffers.update(buffers)
            for of, was in tensors:
                if not torch.equal(of, was):
                    of.copy_(was)


def _check_hooks(name: str, module: Any) -> None:
    for hooks in ("_forward_pre_hooks", "_forward_hooks"):
        for hook in (getattr(module, hooks, None) or {}).values():
            said = getattr(hook, "__name__", type(hook).__name__)
            raise ValueError(
                f"module {name or type(module).__name__} ({type(module).__name__}) has a hook at its forward ({said}), which is code and not read; remove it "
                f"(handle.remove(), torch.nn.utils.remove_weight_norm), or {_EXPORT}"
            )


def _live(model: Any, name: str, loader: str) -> None:
    """Refuses a file in the place of what a library makes of it."""
    if isinstance(model, str | os.PathLike):
        file = os.fspath(model)
        raise ValueError(
            f"'{file}' is a file, and files of PyTorch and Stable-Baselines3 are pickles, which are never opened here; load it with the library that wrote it, "
            f"e.g. {loader}({file!r}), and give nearl.{name} what it returns"
        )
    if isinstance(model, Mapping):
        raise ValueError(
            f"a table of weights (state_dict) does not say in which order layers run and what follows them; load it into the network it is of, "
            f"network.load_state_dict(...), and give nearl.{name} that"
        )


def _is_torchscript(file: _Path) -> bool:
    """By the names in the archive; nothing of it is unpickled."""
    if not os.path.isfile(file) or not zipfile.is_zipfile(file):
        return False
    with zipfile.ZipFile(file) as archive:
        return any("/code/" in name for name in archive.namelist())


def _check_order(name: str, module: Any) -> None:
    """Refuses modules that run their parts in an order of their own, with what can be given in their place."""
    for at, part in _flat(name, module):
        kind = type(part).__name__
        if kind.endswith("ScriptModule") or kind == "TopLevelTracedModule":
            raise ValueError(f"module {getattr(part, 'original_name', kind)} is TorchScript ({kind}), {_SCRIPT.format('module')}")
        if at and _is_model(part):
            whole = f"module.{at}"
            raise ValueError(
                f"{whole} ({kind}) has a normaliser of its own, and nobody knows what else stands around it; where it is all of the policy, give "
                f"nearl.import_torch({whole}); else {_export(part, whole)}"
            )
        parts = list(getattr(part, "named_children", lambda: ())())
        if not parts:
            continue
        inner = [f"module.{at}.{of}".replace("..", ".") for of, child in parts if type(child).__name__ == "Sequential"]
        give = f"where that runs nothing but {' or '.join(inner)}, give nearl.import_torch this; else " if inner else ""
        raise ValueError(f"module {kind} runs its parts ({', '.join(of for of, _ in parts)}) in its own forward, which is code and not read; {give}{_EXPORT}")


def _seen_by(policy: Any) -> list[tuple[str, Any]]:
    """What SB3 makes of the observation before the first layer: nothing but flattening, or it is named."""
    parts = [(name, getattr(policy, name, None)) for name in ("pi_features_extractor", "features_extractor")]
    return [(name, part) for name, part in parts if part is not None][:1]


def _layers(modules: Iterable[tuple[str, Any]]) -> list[_Layer]:
    """The linear layers of named modules with what follows each, in the order in which a Sequential runs them."""
    layers: list[_Layer] = []
    for name, part in (flat for named in modules for flat in _flat(*named)):
        kind = type(part).__name__
        if kind == "Linear":
            weight = _finite(part.weight, f"{name}.weight".lstrip("."))
            bias = np.zeros(len(weight)) if part.bias is None else _finite(part.bias, f"{name}.bias".lstrip("."))
            layers.append((weight, bias, "identity"))
        elif kind in _NOTHING:
            continue
        elif kind in _FUNCTIONS:
            if getattr(part, "alpha", 1.0) != 1.0 or getattr(part, "beta", 1.0) != 1.0:
                raise ValueError(f"module {part} has another alpha or beta than 1, which is not known; train it with 1")
            if not layers:
                raise ValueError(f"module {part} stands before the first linear layer; give the policy's network alone")
            layers = _followed(layers, _FUNCTIONS[kind])
        elif kind == "Hardtanh" and layers:
            layers = _clipped(layers, float(part.min_val), float(part.max_val))
        else:
            known = ", ".join(["Linear", "Hardtanh", *(name for name in _FUNCTIONS if name != "Identity"), *_NOTHING])
            raise ValueError(
                f"module {kind} is none that a policy's layers consist of ({known}); let your own program compute the policy and propose beside the "
                "loop (docs/POLICIES.md, nearl.Proposer), or put nearl.Guard around the environment"
            )
    return layers


def _followed(layers: list[_Layer], function: str) -> list[_Layer]:
    """The same with a function after the last of them."""
    *before, (weight, bias, last) = layers
    if last == "identity":
        return [*before, (weight, bias, function)]
    return [*layers, (np.eye(len(bias)), np.zeros(len(bias)), function)]


def _clipped(layers: list[_Layer], low: float, high: float) -> list[_Layer]:
    """The same with each output cut to a range: ``clip(x) = low + relu(x - low) - relu(x - high)``."""
    n = len(layers[-1][1])
    both = np.vstack([np.eye(n), np.eye(n)]), np.repeat([-low, -high], n), "relu"
    return [*layers, both, (np.hstack([np.eye(n), -np.eye(n)]), np.full(n, low), "identity")]


def _flat(name: str, module: Any) -> Iterable[tuple[str, Any]]:
    """Parts in order, by the names that torch has for them. Only a Sequential says in which order its parts run."""
    kind = type(module).__name__
    _check_hooks(name, module)
    if kind == "Sequential" or isinstance(module, list | tuple) or (kind == "MLP" and hasattr(module, "__iter__")):
        for i, part in enumerate(module):
            yield from _flat(f"{name}.{i}".lstrip("."), part)
    else:
        yield name, module


def _finite(value: Any, name: str) -> np.ndarray:
    """A tensor of the module by its name, all of it finite."""
    numbers = _numbers(value, name)
    if not np.isfinite(numbers).all():
        at = tuple(int(i) for i in np.argwhere(~np.isfinite(numbers))[0])
        raise ValueError(f"the module's tensor '{name}' is {numbers[at]} at {list(at)}; the training diverged: give the network of an earlier checkpoint")
    return numbers


def _numbers(value: Any, name: str) -> np.ndarray:
    """A tensor of torch, or anything NumPy accepts, as an array."""
    for step in ("detach", "cpu", "numpy"):
        if step == "numpy" and str(getattr(value, "dtype", "")) == "torch.bfloat16":
            value = value.float()  # which NumPy has not
        if hasattr(value, step):
            value = getattr(value, step)()
    if np.iscomplexobj(value):
        raise ValueError(f"{name} holds complex numbers, and the layers of a policy are real; give a network of real numbers")
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is of {type(value).__name__} and holds what is no number; give an array of numbers") from None
