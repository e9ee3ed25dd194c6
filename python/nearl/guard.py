"""A guard around any MuJoCo environment of Gymnasium: actions that would end outside the limits give way to near ones that do not."""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core

Floats = NDArray[np.float64]
PerJoint = float | Mapping[str, float]

ROUNDS = 4  # actions tried by linearised dynamics
DRAWS = 64  # actions drawn where these do not do
STEP = 0.01  # of the differences, as a share of an action's range
INSIDE = 1e-3  # how far inside the limits linearised dynamics aim, as a share of a limit's size
ROUNDING = 1e-9


class Guard(gymnasium.Wrapper[Any, Any, Any, Any]):
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
        ValueError: a key that is not known, a joint that the robot does not have, a limit that is no number, or an environment of another kind.
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

        super().__init__(env)
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
        self._seed = seed
        low, high = env.action_space.low.astype(float), env.action_space.high.astype(float)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise ValueError("the action space is unbounded; give the environment actuators with a ctrlrange")
        self._middle, self._half = (low + high) / 2, np.maximum((high - low) / 2, 1e-9)
        self._q, self._v, self._lower, self._upper = self._limits(constraints)
        size = self._upper - self._lower
        self._size = np.where(np.isfinite(size), np.maximum(size, 1e-6), 1.0)
        self._size[len(self._q) :] /= 2  # of a velocity, the limit

    def step(self, action: ArrayLike) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """A step under ``action``, or under the nearest one found that ends within the limits."""
        action, verdict = self.safe(action)
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated, truncated, {**info, "guard": verdict, "action": action}

    def safe(self, action: ArrayLike) -> tuple[NDArray[Any], str]:
        """The action that a step would use and what was found, ``"kept"``, ``"replaced"`` or ``"outside"``; nothing is stepped."""
        given = np.asarray(action)
        asked = np.clip((given.astype(float) - self._middle) / self._half, -1.0, 1.0)
        at = self._foresee(given.astype(float))
        first = self._excess(at)
        if first <= 0.0:
            return given, "kept"
        best, least = self._by_slopes(asked, at, first)
        if least > 0.0:
            best, least = self._by_draws(asked, best, least)
        if least >= first or (self._keeps and least > 0.0):
            return given, "outside"
        # What the space's own type makes of it is what the environment gets.
        safe = (self._middle + self._half * best).astype(self.env.action_space.dtype)
        inside = self._excess(self._foresee(safe.astype(float))) <= 0.0
        if self._keeps and not inside:
            return given, "outside"
        return safe, "replaced" if inside else "outside"

    @property
    def outside(self) -> bool:
        """Whether the state is outside the limits now."""
        data = self.env.unwrapped.data  # type: ignore[attr-defined]
        return self._excess(np.concatenate([data.qpos[self._q], data.qvel[self._v]])) > 0.0

    def _by_slopes(self, asked: Floats, at: Floats, least: float) -> tuple[Floats, float]:
        best = trial = asked
        for _ in range(ROUNDS):
            slope = np.empty((len(at), len(asked)))
            for k in range(len(asked)):
                step = -STEP if trial[k] > 0 else STEP
                beside = trial.copy()
                beside[k] += step
                slope[:, k] = (self._foresee(self._middle + self._half * beside) - at) / step
            inside = INSIDE * self._size
            trial = _core.nearest_action(asked, trial, slope, self._lower + inside - at, self._upper - inside - at)
            at = self._foresee(self._middle + self._half * trial)
            excess = self._excess(at)
            if excess < least:
                best, least = trial, excess
            if excess <= 0.0:
                break
        return best, least

    def _by_draws(self, asked: Floats, around: Floats, least: float) -> tuple[Floats, float]:
        rng, best, way = np.random.default_rng(self._seed), around, np.inf
        for draw in range(DRAWS):
            r = rng.uniform(-1.0, 1.0, len(asked))
            u = (np.clip(around + 0.5 * r**3, -1.0, 1.0), r, np.clip(around + 0.5 * r**3, -1.0, 1.0), np.sign(r))[draw % 4]
            excess = self._excess(self._foresee(self._middle + self._half * u))
            distance = float(((u - asked) ** 2).sum())
            if (excess <= 0.0 and distance < way) or (np.isinf(way) and excess < least):
                best, least, way = u, min(excess, least), distance if excess <= 0.0 else way
            if np.isfinite(way) and draw >= DRAWS // 4:
                break
        return best, least

    def _foresee(self, action: Floats) -> Floats:
        """Positions and velocities that have limits, after a step under ``action``."""
        mujoco, ahead = self._mujoco, self._ahead
        mujoco.mj_copyData(ahead, self._model, self.env.unwrapped.data)  # type: ignore[attr-defined]
        ahead.ctrl[:] = self._ctrl(action)
        mujoco.mj_step(self._model, ahead, nstep=self._frame_skip)
        return np.concatenate([ahead.qpos[self._q], ahead.qvel[self._v]])

    def _excess(self, at: Floats) -> float:
        beyond = np.maximum(self._lower - at, at - self._upper)
        return float(np.where(beyond > ROUNDING, beyond / self._size, 0.0).sum())

    def _limits(self, constraints: Mapping[str, Mapping[str, PerJoint]]) -> tuple[list[int], list[int], Floats, Floats]:
        keys = {"position": "margin", "velocity": "limit"}
        for name, settings in constraints.items():
            if name not in keys:
                raise ValueError(f"the guard of a simulator knows 'position' and 'velocity', not '{name}'; a task file has the others")
            if unknown := settings.keys() - {keys[name]}:
                raise ValueError(f"{name} has no '{min(unknown)}'; it has '{keys[name]}'")
        m, joint = self._model, self._mujoco.mjtJoint
        kinds = (int(joint.mjJNT_HINGE), int(joint.mjJNT_SLIDE))
        single = {m.joint(i).name: i for i in range(m.njnt) if int(m.jnt_type[i]) in kinds}
        ranged = {name: i for name, i in single.items() if m.jnt_limited[i]}
        q: dict[int, tuple[float, float]] = {}
        if "position" in constraints:
            margins = _per_joint(constraints["position"].get("margin", 0.0), ranged, "position margin")
            q = {int(m.jnt_qposadr[ranged[n]]): (m.jnt_range[ranged[n]][0] + x, m.jnt_range[ranged[n]][1] - x) for n, x in margins.items()}
        v: dict[int, float] = {}
        if "velocity" in constraints:
            if "limit" not in constraints["velocity"]:
                raise ValueError("velocity needs a 'limit': a number, or a table by joint")
            limit = constraints["velocity"]["limit"]
            named = single if isinstance(limit, Mapping) else ranged
            v = {int(m.jnt_dofadr[named[n]]): x for n, x in _per_joint(limit, named, "velocity limit").items()}
        lower = np.array([low for low, _ in q.values()] + [-x for x in v.values()])
        upper = np.array([high for _, high in q.values()] + list(v.values()))
        if (lower > upper).any():
            raise ValueError("a joint has no position or velocity left within its limits; give a smaller margin")
        return list(q), list(v), lower, upper


def _per_joint(value: PerJoint, joints: Mapping[str, int], what: str) -> dict[str, float]:
    values = dict(value) if isinstance(value, Mapping) else dict.fromkeys(joints, value)
    for name, number in values.items():
        if name not in joints:
            raise ValueError(f"{what}: the robot has no such joint '{name}'; it has {', '.join(joints)}")
        if not (np.isfinite(number) and number >= 0.0):
            raise ValueError(f"{what} of joint '{name}' is {number}; give a number of at least 0")
    return {name: float(number) for name, number in values.items()}
