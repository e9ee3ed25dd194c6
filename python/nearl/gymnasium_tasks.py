"""Gymnasium's own tasks in the words of task files: reward, termination and start of its MuJoCo environments.

The expressions are those of `gymnasium/envs/mujoco/*_v5.py`, with the weights of the environment at hand.
"""

import math
from collections.abc import Mapping, Sequence
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


def _half_cheetah(env: Any) -> Sections:
    return Sections(_forward(env, f"dq.{_joint(env, 0)} / dt"), {}, {"position": _uniform(env._reset_noise_scale), "velocity": _normal(env._reset_noise_scale)})


def _hopper(env: Any) -> Sections:
    x, z, angle = (_joint(env, i) for i in range(3))
    joints = [_joint(env, i) for i in range(env.model.njnt)]
    states = [f"q.{joint}" for joint in joints[2:]] + [f"v.{joint}" for joint in joints]
    healthy = [_within(f"q.{z}", env._healthy_z_range), _within(f"q.{angle}", env._healthy_angle_range)]
    healthy += [_within(state, env._healthy_state_range) for state in states]
    noise = _uniform(env._reset_noise_scale)
    return _while_healthy(env, healthy, _forward(env, f"dq.{x} / dt"), {"position": noise, "velocity": noise})


def _walker2d(env: Any) -> Sections:
    x, z, angle = (_joint(env, i) for i in range(3))
    healthy = [_within(f"q.{z}", env._healthy_z_range), _within(f"q.{angle}", env._healthy_angle_range)]
    noise = _uniform(env._reset_noise_scale)
    return _while_healthy(env, healthy, _forward(env, f"dq.{x} / dt"), {"position": noise, "velocity": noise})


def _ant(env: Any) -> Sections:
    healthy = [_within(f"q.{_joint(env, 0)}.z", env._healthy_z_range, "<=")]
    cut = _contacts(env, env._contact_force_range)
    reward = _forward(env, f"vx.{_body(env, env.model.body(env._main_body).id)}") | {"contact": f"-{env._contact_cost_weight!r} * ({cut})"}
    noise = env._reset_noise_scale
    return _while_healthy(env, healthy, reward, {"position": _uniform(noise), "velocity": _normal(noise)}, PLACES)


def _humanoid(env: Any) -> Sections:
    healthy = [_within(f"q.{_joint(env, 0)}.z", env._healthy_z_range)]
    contact = _clipped(f"{env._contact_cost_weight!r} * ({_contacts(env)})", env._contact_cost_range)
    noise = _uniform(env._reset_noise_scale)
    return _while_healthy(env, healthy, _forward(env, "com.vx") | {"contact": f"-{contact}"}, {"position": noise, "velocity": noise}, PLACES)


def _humanoid_standup(env: Any) -> Sections:
    impact = _clipped(f"{env._impact_cost_weight!r} * ({_contacts(env)})", env._impact_cost_range)
    reward = {
        "up": f"q.{_joint(env, 0)}.z / {float(env.model.opt.timestep)!r}",
        "effort": f"-{env._ctrl_cost_weight!r} * u.squared",
        "contact": f"-{impact}",
        "alive": "1",
    }
    noise = _uniform(env._reset_noise_scale)
    return Sections(reward, {}, {"position": noise, "velocity": noise})


PLACES = "Speeds are those between the states at both ends of a control period; Gymnasium's lag by a physics step."


def _joint(env: Any, k: int) -> str:
    return str(env.model.joint(k).name)


def _body(env: Any, k: int) -> str:
    """The name of a body in expressions: one without a name has that of its first joint."""
    joints = [env.model.joint(j).name for j in range(env.model.njnt) if env.model.jnt_bodyid[j] == k]
    return env.model.body(k).name or next(iter(joints), f"body{k}")


def _normal(size: float) -> str:
    return f"{size!r} * normal"


def _forward(env: Any, speed: str) -> dict[str, str]:
    return {"forward": f"{env._forward_reward_weight!r} * {speed}", "effort": f"-{env._ctrl_cost_weight!r} * u.squared"}


def _within(name: str, ends: Sequence[float], sign: str = "<") -> str:
    low, high = map(float, ends)
    both = [f"{low!r} {sign} {name}"] * math.isfinite(low) + [f"{name} {sign} {high!r}"] * math.isfinite(high)
    return " and ".join(both) or "1"


def _clipped(value: str, ends: Sequence[float]) -> str:
    low, high = map(float, ends)
    value = f"min({value}, {high!r})" if math.isfinite(high) else f"({value})"
    return f"max({value}, {low!r})" if math.isfinite(low) else value


def _contacts(env: Any, ends: Sequence[float] = (-math.inf, math.inf)) -> str:
    """The sum of the squares of MuJoCo's external forces and torques on all bodies, each cut to ``ends``."""
    entries = (f"cfrc.{name}.{entry}" for name in (_body(env, i) for i in range(1, env.model.nbody)) for entry in ("tx", "ty", "tz", "fx", "fy", "fz"))
    return " + ".join(f"{_clipped(entry, ends)}^2" for entry in entries)


def _while_healthy(env: Any, healthy: Sequence[str], reward: Mapping[str, str], reset: Mapping[str, str], note: str = "") -> Sections:
    """With what a state within its ranges earns, and the end of an episode outside them."""
    is_healthy = " and ".join(healthy)
    ends = {"fallen": f"not ({is_healthy})"} if env._terminate_when_unhealthy else {}
    return Sections({**reward, "alive": f"if({is_healthy}, {float(env._healthy_reward)!r}, 0)"}, ends, reset, note)


OWN = {
    "HalfCheetahEnv": _half_cheetah,
    "HopperEnv": _hopper,
    "Walker2dEnv": _walker2d,
    "AntEnv": _ant,
    "HumanoidEnv": _humanoid,
    "HumanoidStandupEnv": _humanoid_standup,
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
