"""A guard around any MuJoCo environment of Gymnasium: actions that would end outside the limits give way to near ones that do not."""

from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core

Floats = NDArray[np.float64]
PerJoint = float | Mapping[str, float]


class Guard(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Keeps the joints of a ``MujocoEnv`` within position and velocity limits, as far as any single action can.

        env = nearl.Guard(gymnasium.make("HalfCheetah-v5"), {"position": {}, "velocity": {"limit": 25.0}})

    Before a step the environment's own simulation is stepped on a copy. Where that ends within the limits, contacts included, the action
    goes on as it is, bit for bit. Where it does not, the nearest action is sought whose step does: by dynamics linearised around the last one
    tried (a quadratic programme on a differenced Jacobian), confirmed by a step, then among drawn ones. One step is looked ahead: a state from
    which every action leads outside is possible, and is said. ``info["guard"]`` is ``"kept"``, ``"replaced"`` or ``"outside"``;
    ``info["action"]`` is what the environment got.

    Args:
        env: An environment whose ``unwrapped`` has ``model``, ``data`` and ``frame_skip``, as Gymnasium's MuJoCo environments have.
        constraints: ``position``: ``{"margin": 0.0}`` keeps every joint with a range inside it [rad or m], or a table by joint;
            ``velocity``: ``{"limit": 25.0}`` [rad/s or m/s], one number for all hinges and slides with a range, or a table by joint.
        ctrl: What the environment hands to its actuators for an action; the action itself by default.
        unavoidable: Where no action found ends inside: ``"least"`` takes the one that ends least far outside; ``"kept"`` leaves the action as it is, for a
            policy that was not trained behind the guard and rests on soft joint stops, from which nothing comes back in one step.
        seed: Of the drawn actions: the same state and action give the same result.

    Raises:
        ValueError: a key that is not known, a joint that the robot does not have, a limit that is no number, no limit at all, or an environment of
            another kind; in a step an action (n_act) of another shape, or with an entry that is not finite.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        constraints: Mapping[str, Mapping[str, PerJoint]],
        ctrl: Callable[[Floats], ArrayLike] | None = None,
        seed: int = 0,
        unavoidable: str = "least",
    ):
        import mujoco

        gymnasium.utils.RecordConstructorArgs.__init__(self, constraints=constraints, ctrl=ctrl, seed=seed, unavoidable=unavoidable)
        gymnasium.Wrapper.__init__(self, env)
        if unavoidable not in ("least", "kept"):
            raise ValueError(f"unavoidable is '{unavoidable}'; give 'least' or 'kept'")
        self._keeps = unavoidable == "kept"
        inner: Any = env.unwrapped
        missing = [name for name in ("model", "data", "frame_skip") if not hasattr(inner, name)]
        if missing or not isinstance(env.action_space, gymnasium.spaces.Box):
            lacks = ", ".join(missing) or "box of actions"
            raise ValueError(f"{inner} is no MuJoCo environment with continuous actions (no {lacks}); give one built on MujocoEnv")
        self._mujoco, self._model, self._frame_skip = mujoco, inner.model, inner.frame_skip
        self._ahead = mujoco.MjData(self._model)
        self._ctrl = ctrl or (lambda action: action)
        low, high = env.action_space.low.astype(float), env.action_space.high.astype(float)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise ValueError("the action space is unbounded; give the environment actuators with a ctrlrange")
        positions, velocities = self._limits(constraints)
        self._q, self._v = list(positions), list(velocities)
        if not (positions or velocities):
            raise ValueError(
                "no joint has a limit to be kept; give constraints that say which, e.g. {'position': {}, 'velocity': {'limit': 25.0}} for every joint with a "
                "range in the robot file, or {'velocity': {'limit': {'JOINT': 25.0}}}"
            )
        actions = list(zip(low.tolist(), high.tolist()))
        self._search = _core.ActionSearch(list(positions.values()), list(velocities.values()), actions, seed)

    def step(self, action: ArrayLike) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """A step under ``action``, or under the nearest one found that ends within the limits."""
        action, verdict = self.safe(action)
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated, truncated, {**info, "guard": verdict, "action": action}

    def safe(self, action: ArrayLike) -> tuple[NDArray[Any], str]:
        """The action that a step would use and what was found, ``"kept"``, ``"replaced"`` or ``"outside"``; nothing is stepped."""
        given = self._checked(action)
        verdict, found = self._search.find(given.astype(float).tolist(), self._foresee)
        if verdict == "kept" or (verdict == "outside" and (self._keeps or np.array_equal(found, given))):
            return given, verdict
        # What the space's own type makes of it is what the environment gets.
        safe = found.astype(self.env.action_space.dtype)
        inside = self._search.excess(self._foresee(safe.astype(float)).tolist()) <= 0.0
        if self._keeps and not inside:
            return given, "outside"
        return safe, "replaced" if inside else "outside"

    def _checked(self, action: ArrayLike) -> NDArray[Any]:
        """The action as it came, of the space's shape and finite."""
        given, shape = np.asarray(action), self.env.action_space.shape
        if given.shape != shape:
            raise ValueError(f"action has shape {given.shape}, expected {shape}")
        if not np.issubdtype(given.dtype, np.number) or np.iscomplexobj(given):
            raise ValueError(f"action is not an array of numbers but of {given.dtype}; pass a NumPy array")
        bad = np.flatnonzero(~np.isfinite(given))
        if len(bad):
            i = int(bad[0])
            raise ValueError(f"action[{i}] is {given.flat[i]}: every entry must be finite; check the policy's output")
        return given

    @property
    def outside(self) -> bool:
        """Whether the state is outside the limits now."""
        data = self.env.unwrapped.data  # type: ignore[attr-defined]
        return self._search.excess([*data.qpos[self._q], *data.qvel[self._v]]) > 0.0

    def _foresee(self, action: Floats) -> Floats:
        """Positions and velocities that have limits, after a step under ``action``."""
        mujoco, ahead = self._mujoco, self._ahead
        mujoco.mj_copyData(ahead, self._model, self.env.unwrapped.data)  # type: ignore[attr-defined]
        ahead.ctrl[:] = self._ctrl(action)
        mujoco.mj_step(self._model, ahead, nstep=self._frame_skip)
        return np.concatenate([ahead.qpos[self._q], ahead.qvel[self._v]])

    def _limits(self, constraints: Mapping[str, Mapping[str, PerJoint]]) -> tuple[dict[int, tuple[float, float]], dict[int, float]]:
        keys = {"position": "margin", "velocity": "limit"}
        if not isinstance(constraints, Mapping):
            raise ValueError(f"constraints is {constraints!r}; give a table, e.g. {{'position': {{}}, 'velocity': {{'limit': 25.0}}}}")
        for name, settings in constraints.items():
            if name not in keys:
                raise ValueError(f"the guard of a simulator knows 'position' and 'velocity', not '{name}'; a task file has the others")
            if not isinstance(settings, Mapping):
                raise ValueError(f"{name} is {settings!r}; give a table, {{'{keys[name]}': {settings!r}}}")
            if unknown := settings.keys() - {keys[name]}:
                raise ValueError(f"{name} has no '{min(unknown)}'; it has '{keys[name]}'")
        m, joint = self._model, self._mujoco.mjtJoint
        kinds = (int(joint.mjJNT_HINGE), int(joint.mjJNT_SLIDE))
        single = {m.joint(i).name: i for i in range(m.njnt) if int(m.jnt_type[i]) in kinds}
        ranged = {name: i for name, i in single.items() if m.jnt_limited[i]}
        q: dict[int, tuple[float, float]] = {}
        if "position" in constraints:
            margins = _per_joint(constraints["position"].get("margin", 0.0), ranged, "position margin")
            for name, x in margins.items():
                low, high = m.jnt_range[ranged[name]]
                if 2 * x > high - low:
                    most = (high - low) / 2
                    raise ValueError(f"position margin of joint '{name}' is {x:g}, which leaves nothing from {low:.3g} to {high:.3g}; give at most {most:.3g}")
                q[int(m.jnt_qposadr[ranged[name]])] = low + x, high - x
        v: dict[int, float] = {}
        if "velocity" in constraints:
            if "limit" not in constraints["velocity"]:
                raise ValueError("velocity needs a 'limit': a number, or a table by joint")
            limit = constraints["velocity"]["limit"]
            named = single if isinstance(limit, Mapping) else ranged
            v = {int(m.jnt_dofadr[named[n]]): x for n, x in _per_joint(limit, named, "velocity limit").items()}
        return q, v


def _per_joint(value: PerJoint, joints: Mapping[str, int], what: str) -> dict[str, float]:
    values = dict(value) if isinstance(value, Mapping) else dict.fromkeys(joints, value)
    for name, number in values.items():
        if name not in joints:
            raise ValueError(f"{what}: the robot has no such joint '{name}'; it has {', '.join(joints)}")
        if not isinstance(number, Real) or not (np.isfinite(float(number)) and float(number) >= 0.0):
            raise ValueError(f"{what} of joint '{name}' is {number!r}; give a number of at least 0")
    return {name: float(number) for name, number in values.items()}
