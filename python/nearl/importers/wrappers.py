"""What stands around an environment in which a model of Stable-Baselines3 learned."""

import warnings
from typing import Any

import numpy as np

from nearl.importers.layers import Layer, as_array

# Wrappers of Gymnasium that leave every number of an observation where it is.
_SAME = frozenset({"DtypeObservation", "FlattenObservation"})
# Wrappers of Gymnasium and Stable-Baselines3 that change neither observations nor how long an action lasts, nor actions beyond cutting them to their range.
_UNTOUCHED = frozenset({
    "Autoreset", "ClipAction", "HumanRendering", "Monitor", "NormalizeReward", "OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "RecordVideo",
    "RenderCollection", "TimeLimit",
})  # fmt: skip


# Wrappers of Stable-Baselines3's vectors that change nothing that a policy sees or does, and the one that is taken along.
_UNTOUCHED_VECTORS = frozenset({"VecCheckNan", "VecMonitor", "VecNormalize", "VecVideoRecorder"})


def _vectors(model: Any) -> tuple[list[Any], list[Any]]:
    """The wrappers around the vector that the model learned in, and its single environments with theirs; empty where it brings none."""
    env, around = getattr(model, "get_env", lambda: None)(), []
    while env is not None and not hasattr(env, "envs") and hasattr(env, "venv"):
        around.append(env)
        env = env.venv
    return around, list(getattr(env, "envs", None) or [])


def rescaling_wrappers(model: Any) -> list[Any]:
    """The wrappers that rescale the actions of the first environment, outermost first. Those that change observations otherwise than VecNormalize, or
    actions otherwise, are refused in each: the controller gives the observation of the task, and takes what the network puts out."""
    around, envs = _vectors(model)
    for kind in (type(wrapper).__name__ for wrapper in around):
        if kind not in _UNTOUCHED_VECTORS:
            raise ValueError(
                f"the model learned behind the wrapper {kind} of its vector, of which only its environment knows what it does to observations and actions; "
                f"learn without it, or give robot= and a recipe= that says how the policy sees each entry"
            )
    each = [_rescaling(one) for one in envs]
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


def rescaled(wrapper: Any, layers: list[Layer], low: np.ndarray, high: np.ndarray) -> tuple[list[Layer], np.ndarray, np.ndarray]:
    """The layers with what a RescaleAction does behind them, and the range of what comes out."""
    inner = wrapper.env.action_space
    inner_low, inner_high = as_array(inner.low, "action_space.low").ravel(), as_array(inner.high, "action_space.high").ravel()
    scale = (inner_high - inner_low) / (high - low)
    return [*layers, (np.diag(scale), inner_low - scale * low, "identity")], inner_low, inner_high


def native_env(model: Any) -> Any:
    """The environment of ours that the model learned in; None where it is another, or it brings none."""
    _, envs = _vectors(model)
    env = envs[0].unwrapped if envs else getattr(model, "get_env", lambda: None)()
    return getattr(env, "native", None)
