"""A guard around any MuJoCo environment of Gymnasium: actions that would end outside the limits give way to near ones that do not."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core

Floats = NDArray[np.float64]
PerJoint = float | Mapping[str | int, float]
# Part of its range by which a control may be off: actions are often of 32 bits.
_SAME = 1e-6
# Steps under the controls of the step before, which are no reason yet to refuse an environment.
_REPEATS = 4
# By which a state may be off, of its value and of 1 rad, m, rad/s or m/s: a contact solver ends where it began from.
_NEAR = 1e-4


class Guard(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Keeps the joints of a ``MujocoEnv`` within position and velocity limits, as far as any single action can.

        env = nearl.Guard(gymnasium.make("HalfCheetah-v5"), {"position": {}, "velocity": {"limit": 25.0}})

    Before a step the environment's own simulation is stepped on a copy. Where that ends within the limits, contacts included, the action
    goes on as it is, bit for bit. Where it does not, the nearest action is sought whose step does: by dynamics linearised around the last one
    tried (a quadratic programme on a differenced Jacobian), confirmed by a step, then among drawn ones. One step is looked ahead: a state from
    which every action leads outside is possible, and is said. ``info["guard"]`` is ``"kept"``, ``"replaced"`` or ``"outside"``, by the state that
    the step ended in; ``info["action"]`` is what the environment got.

    After a step the controls that the actuators got are compared with those that were foreseen. An environment that makes others of an action from
    the first one on, and whose ``ctrl`` is not given, is refused; where they differ now and then, as behind ``StickyAction``, a warning says so once.

    Args:
        env: An environment whose ``unwrapped`` has ``model``, ``data`` and ``frame_skip``, as Gymnasium's MuJoCo environments have. Where its actions
            are unbounded they have the ranges of the actuators.
        constraints: ``position``: ``{"margin": 0.0}`` keeps every joint with a range inside it [rad or m], or a table by joint;
            ``velocity``: ``{"limit": 25.0}`` [rad/s or m/s], one number for all hinges and slides with a range, or a table by joint. A joint without
            a name is in a table by its number in the model.
        ctrl: What the environment hands to its actuators for an action, all of ``data.ctrl``; the action itself by default. An environment that
            doubles its actions needs ``ctrl=lambda action: 2 * action``, and so does a wrapper below the guard that changes them.
        unavoidable: Where no action found ends inside: ``"least"`` takes the one that ends least far outside; ``"kept"`` leaves the action as it is, for a
            policy that was not trained behind the guard and rests on soft joint stops, from which nothing comes back in one step.
        seed: Of the drawn actions: the same state and action give the same result.

    Raises:
        ValueError: a key that is not known, a joint that the robot does not have, a limit that is no number, no limit at all, or an environment of
            another kind; in a step an action (n_act) of another shape, or with an entry that is not finite; after one, controls that are not those of
            ``ctrl``.
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
        self._last: Floats | None = None
        self._trusted, self._warned, self._repeats = False, False, 0
        low, high = self._range(env.action_space, ctrl is None)
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
        safe, verdict = self.safe(action)
        if self._last is None or not np.array_equal(self._last, safe):
            self._foresee(safe.astype(float))
        data: Any = self.env.unwrapped.data  # type: ignore[attr-defined]
        before, held = data.time, data.ctrl.copy()
        obs, reward, terminated, truncated, info = self.env.step(safe)
        # An environment that was begun anew within its step shows nothing of where the action led.
        if data.time > before:
            self._compare(data, safe, held)
            verdict = "outside" if self.outside else "kept" if np.array_equal(safe, action) else "replaced"
        return obs, reward, terminated, truncated, {**info, "guard": verdict, "action": safe}

    def safe(self, action: ArrayLike) -> tuple[NDArray[Any], str]:
        """The action that a step would use and what is foreseen of it, ``"kept"``, ``"replaced"`` or ``"outside"``; nothing is stepped."""
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
        return self._search.excess(self._limited(data).tolist()) > 0.0

    def _limited(self, data: Any) -> Floats:
        """Positions and velocities that have limits."""
        return np.concatenate([data.qpos[self._q], data.qvel[self._v]])

    def _compare(self, data: Any, action: NDArray[Any], held: Floats) -> None:
        """Says where a step under ``action`` was another one than the one foreseen; ``held`` are the controls of the step before."""
        ahead = self._ahead
        got, meant = self._clipped(data.ctrl), self._clipped(ahead.ctrl)
        off = np.abs(got - meant) > _SAME * np.maximum(1.0, np.abs(meant))
        later = abs(data.time - ahead.time) > _SAME * self._model.opt.timestep
        near = np.allclose(self._limited(data), self._limited(ahead), rtol=_NEAR, atol=_NEAR)
        if not (off.any() or later):
            self._trusted |= bool(action.any())  # where nothing is asked for, a factor shows nothing
            if not near and self.outside and self._search.excess(self._limited(ahead).tolist()) <= 0.0:
                self._warn("a step ended outside under the controls that were foreseen to end inside: the environment moves the robot by something else too")
            return
        if near and not later:  # controls that move nothing that has a limit, or are set back after the step
            return
        if later:
            skip = self._frame_skip * self._model.opt.timestep
            what = (
                f"a step of the environment took {data.time - ahead.time + skip:.4g} s and its frame_skip says {skip:.4g} s; put the wrapper that repeats "
                "actions around the guard"
            )
        else:
            i = int(np.argmax(off))
            what = (
                f"actuator '{self._model.actuator(i).name or i}' got {got[i]:.4g} where the guard had foreseen {meant[i]:.4g}: the environment, or a wrapper "
                "below the guard, changes the action; put the wrapper around the guard, or give ctrl=, the function from an action to data.ctrl"
            )
        if self._trusted:
            self._warn(what)
        elif self._repeats < _REPEATS and not later and np.array_equal(data.ctrl, held):
            self._repeats += 1
        else:
            raise ValueError(what)

    def _warn(self, what: str) -> None:
        if not self._warned:
            warnings.warn(f"{what}; limits do not hold in such steps, and info['guard'] says 'outside' of those that end there", stacklevel=4)
        self._warned = True

    def _clipped(self, ctrl: Floats) -> Floats:
        """Controls as MuJoCo uses them."""
        low, high = self._model.actuator_ctrlrange.T
        return np.where(self._model.actuator_ctrllimited, np.clip(ctrl, low, high), ctrl)

    def _foresee(self, action: Floats) -> Floats:
        """Those of :meth:`_limited` after a step under ``action``."""
        mujoco, ahead = self._mujoco, self._ahead
        mujoco.mj_copyData(ahead, self._model, self.env.unwrapped.data)  # type: ignore[attr-defined]
        ctrl = np.asarray(self._ctrl(action), float)
        if ctrl.shape != ahead.ctrl.shape:
            raise ValueError(f"ctrl gives shape {ctrl.shape} for an action, expected {ahead.ctrl.shape}, one number for each actuator")
        ahead.ctrl[:] = ctrl
        mujoco.mj_step(self._model, ahead, nstep=self._frame_skip)
        self._last = action
        return self._limited(ahead)

    def _range(self, space: gymnasium.spaces.Box, is_ctrl: bool) -> tuple[Floats, Floats]:
        """The least and the largest action (n_act)."""
        low, high = space.low.astype(float), space.high.astype(float)
        nu = self._model.nu
        if is_ctrl and space.shape != (nu,):
            raise ValueError(
                f"the action has shape {space.shape} and the robot {nu} actuators; give ctrl=, the function from an action to data.ctrl ({nu} numbers)"
            )
        if is_ctrl:
            of_actuator = np.where(self._model.actuator_ctrllimited[:, None], self._model.actuator_ctrlrange, [-np.inf, np.inf])
            low, high = np.where(np.isfinite(low), low, of_actuator[:, 0]), np.where(np.isfinite(high), high, of_actuator[:, 1])
        unbounded = np.flatnonzero(~(np.isfinite(low) & np.isfinite(high)))
        if len(unbounded):
            i = int(unbounded[0])
            way = f"actuator '{self._model.actuator(i).name or i}' has no ctrlrange; give it one" if is_ctrl else "ctrl= makes others of them"
            raise ValueError(f"the action space is unbounded in entry {i} and {way}, or an action space with finite bounds")
        return low, high

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
        single = [i for i in range(m.njnt) if int(m.jnt_type[i]) in kinds]
        ranged = [i for i in single if m.jnt_limited[i]]
        names = {i: m.joint(i).name or i for i in single}  # many joints may have none
        q: dict[int, tuple[float, float]] = {}
        if "position" in constraints:
            for i, x in _per_joint(constraints["position"].get("margin", 0.0), ranged, names, "position margin").items():
                low, high = m.jnt_range[i]
                if 2 * x > high - low:
                    most = (high - low) / 2
                    raise ValueError(
                        f"position margin of joint '{names[i]}' is {x:g}, which leaves nothing from {low:.3g} to {high:.3g}; give at most {most:.3g}"
                    )
                q[int(m.jnt_qposadr[i])] = low + x, high - x
        v: dict[int, float] = {}
        if "velocity" in constraints:
            if "limit" not in constraints["velocity"]:
                raise ValueError("velocity needs a 'limit': a number, or a table by joint")
            limit = constraints["velocity"]["limit"]
            joints = single if isinstance(limit, Mapping) else ranged
            v = {int(m.jnt_dofadr[i]): x for i, x in _per_joint(limit, joints, names, "velocity limit").items()}
        return q, v


def _per_joint(value: PerJoint, joints: list[int], names: Mapping[int, str | int], what: str) -> dict[int, float]:
    """Numbers by the joint's number in the model."""
    ids = {names[i]: i for i in joints}
    values = dict(value) if isinstance(value, Mapping) else {names[i]: value for i in joints}
    for name, number in values.items():
        if name not in ids:
            raise ValueError(f"{what}: the robot has no such joint '{name}'; it has {', '.join(map(str, ids))}")
        if not isinstance(number, Real) or not (np.isfinite(float(number)) and float(number) >= 0.0):
            raise ValueError(f"{what} of joint '{name}' is {number!r}; give a number of at least 0")
    return {ids[name]: float(number) for name, number in values.items()}
