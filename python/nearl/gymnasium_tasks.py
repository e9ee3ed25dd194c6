"""Gymnasium's own tasks in the words of task files: reward, termination and start of its MuJoCo environments.

The expressions are those of `gymnasium/envs/mujoco/*_v5.py`, with the weights of the environment at hand.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple


class Sections(NamedTuple):
    """What a task file says behind ``[state]``: tables by name, each a key and an expression; ``note`` where something differs."""

    reward: Mapping[str, Any]
    termination: Mapping[str, Any]
    reset: Mapping[str, Any]
    note: str = ""


def _distance(a: str, b: str) -> str:
    return f"sqrt((x.{a} - x.{b})^2 + (y.{a} - y.{b})^2 + (z.{a} - z.{b})^2)"


def _uniform(size: float) -> str:
    return f"{size!r} * uniform"


def _inverted_pendulum(env: Any) -> Sections:
    noise = _uniform(env._reset_noise_scale)
    return Sections({"alive": "if(abs(q.hinge) > 0.2, 0, 1)"}, {"fallen": "abs(q.hinge) > 0.2"}, {"position": noise, "velocity": noise})


def _inverted_double_pendulum(env: Any) -> Sections:
    tip = "z.pole2 + 0.6 * cos(q.hinge + q.hinge2)"  # the site `tip`, at the end of the second pole
    reward = {
        "alive": f"if({tip} <= 1, 0, {env._healthy_reward!r})",
        "distance": f"-0.01 * (x.pole2 + 0.6 * sin(q.hinge + q.hinge2))^2 - ({tip} - 2)^2",
        "speed": "-1e-3 * v.hinge^2 - 5e-3 * v.hinge2^2",
    }
    scale = env._reset_noise_scale
    return Sections(reward, {"fallen": f"{tip} <= 1"}, {"position": _uniform(scale), "velocity": f"{scale!r} * normal"})


def _swimmer(env: Any) -> Sections:
    noise = _uniform(env._reset_noise_scale)
    forward, effort = env._forward_reward_weight, env._ctrl_cost_weight
    return Sections({"forward": f"{forward!r} * dq.slider1 / dt", "effort": f"-{effort!r} * u.squared"}, {}, {"position": noise, "velocity": noise})


def _reacher(env: Any) -> Sections:
    reward = {"distance": f"-{env._reward_dist_weight!r} * {_distance('fingertip', 'target')}", "effort": f"-{env._reward_control_weight!r} * u.squared"}
    goal, rest = dict.fromkeys(("target_x", "target_y"), "0.2 * uniform"), {"target_x": 0.0, "target_y": 0.0}
    note = "The goal is drawn from a square of 0.4 m; Gymnasium draws again outside the circle in it."
    return Sections(reward, {}, {"position": "0.1 * uniform", "velocity": "0.005 * uniform", "q": goal, "v": rest}, note)


def _pusher(env: Any) -> Sections:
    reward = {
        "near": f"-{env._reward_near_weight!r} * {_distance('object', 'tips_arm')}",
        "distance": f"-{env._reward_dist_weight!r} * {_distance('object', 'goal')}",
        "effort": f"-{env._reward_control_weight!r} * u.squared",
    }
    places = {"obj_slidey": "-0.15 + 0.15 * uniform", "obj_slidex": "0.2 * uniform", "goal_slidey": 0.0, "goal_slidex": 0.0}
    note = "The object may begin within 0.17 m of the goal; Gymnasium draws again there."
    return Sections(reward, {}, {"velocity": "0.005 * uniform", "q": places, "v": dict.fromkeys(places, 0.0)}, note)


OWN = {
    "InvertedPendulumEnv": _inverted_pendulum,
    "InvertedDoublePendulumEnv": _inverted_double_pendulum,
    "SwimmerEnv": _swimmer,
    "ReacherEnv": _reacher,
    "PusherEnv": _pusher,
}


def own_sections(env: Any) -> Sections | None:
    """The sections of an unwrapped environment of Gymnasium's ``_v5`` modules; None where its reward is not known here."""
    kind = type(env)
    make = OWN.get(kind.__name__) if kind.__module__.startswith("gymnasium.envs.mujoco.") and kind.__module__.endswith("_v5") else None
    return None if make is None else make(env)


def as_toml(sections: Sections) -> str:
    """The tables as they stand in a task file."""
    tables = [("reward", sections.reward), ("termination", sections.termination), ("reset", sections.reset)]
    lines = [f"# {sections.note}"] if sections.note else []
    for name, table in tables:
        lines += ["", f"[{name}]", *(f"{key} = {_value(value)}" for key, value in table.items())]
    return "\n".join(lines).strip()


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + " }"
    return f'"{value}"' if isinstance(value, str) else repr(value)
