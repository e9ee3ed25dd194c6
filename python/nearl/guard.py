"""A guard around any MuJoCo environment of Gymnasium: actions that would end outside the limits give way to near ones that do not."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Mapping
from numbers import Integral, Real
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
# By which a state may be off, of its value and of its limit, or of 1 rad, m, rad/s or m/s where that is less: a contact solver ends where it began from.
_NEAR = 1e-4
# How far outside a step without a state counts, in sizes of each limit: farther than one that has a state.
_NOWHERE = 1e6
# Of levers: a joint that an actuator moves by less is not driven by it.
_LEVER = 1e-9
# What limits are read from.
_RANGES = ("jnt_range", "jnt_limited", "actuator_ctrlrange", "actuator_ctrllimited", "actuator_gear")


class Guard(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Keeps the joints of a ``MujocoEnv`` within position and velocity limits, as far as any single action can.

        env = nearl.Guard(gymnasium.make("HalfCheetah-v5"), {"position": {}, "velocity": {"limit": 25.0}})

    Before a step the environment's own simulation is stepped on a copy. Where that ends within the limits, contacts included, the action
    goes on as it is, bit for bit. Where it does not, the nearest action is sought whose step does: by dynamics linearised around the last one
    tried (a quadratic programme on a differenced Jacobian), confirmed by a step, then among drawn ones, and all that again from where it ended and from
    the middle of the range. One step is looked ahead: a state from which every action leads outside is possible, and is said. ``info["guard"]`` is
    ``"kept"``, ``"replaced"`` or ``"outside"``, by the state that the step ended in; ``info["action"]`` is what the environment got.

    After a step the controls that the actuators got are compared with those that were foreseen. An environment that makes others of an action from
    the first one on, and whose ``ctrl`` is not given, is refused; where they differ now and then, as behind ``StickyAction``, a warning says so once.
    A state with an entry that is not finite is outside, and so is a step in which MuJoCo gave up. Model and ranges are those of the moment.

    Args:
        env: An environment whose ``unwrapped`` has ``model``, ``data`` and ``frame_skip``, as Gymnasium's MuJoCo environments have. Where its actions
            are unbounded they have the ranges of the actuators.
        constraints: ``position``: ``{"margin": 0.0}`` keeps every joint with a range inside it [rad or m], or a table by joint;
            ``velocity``: ``{"limit": 25.0}`` [rad/s or m/s], one number for all hinges and slides that have an actuator or a range, or a table by
            joint. A joint without a name is in a table by its number in the model.
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
        gymnasium.utils.RecordConstructorArgs.__init__(self, constraints=constraints, ctrl=ctrl, seed=seed, unavoidable=unavoidable)
        if not isinstance(env, gymnasium.Env):
            raise ValueError(f"{type(env).__name__} is no gymnasium.Env; in a vector put a guard around each environment, by wrappers= of gymnasium.make_vec")
        gymnasium.Wrapper.__init__(self, env)
        if unavoidable not in ("least", "kept"):
            raise ValueError(f"unavoidable is '{unavoidable}'; give 'least' or 'kept'")
        self._keeps = unavoidable == "kept"
        inner: Any = env.unwrapped
        if ctrl is not None and not callable(ctrl):
            raise ValueError(f"ctrl is {ctrl!r}; give the function from an action to data.ctrl")
        number: Any = seed
        if not isinstance(number, Integral) or not 0 <= int(number) < 2**64:
            raise ValueError(f"seed is {seed!r}; give a whole number from 0 to 2^64 - 1")
        missing = [name for name in ("model", "data", "frame_skip") if getattr(inner, name, None) is None]
        if missing or not isinstance(env.action_space, gymnasium.spaces.Box):
            lacks = ", ".join(missing) or "box of actions"
            raise ValueError(f"{inner} is no MuJoCo environment with continuous actions (no {lacks}); give one built on MujocoEnv")
        self._constraints, self._ctrl, self._seed = copy.deepcopy(constraints), ctrl, int(number)
        self._trusted, self._repeats, self._begun = False, 0, False
        self._warned: set[str] = set()
        # Whether the last step ended an episode, and whether the clock went forward in it.
        self._ended, self._forth = False, False
        self._model: Any = None
        self._ranges = b""
        self._read()

    def __getstate__(self) -> dict[str, Any]:
        """Without what is read from the model."""
        return {**self.__dict__, "_mujoco": None, "_model": None, "_ahead": None, "_search": None, "_last": None}

    def _read(self) -> None:
        """Reads joints and limits from the model, where it is another one than before, or its ranges are."""
        model = self.env.unwrapped.model  # type: ignore[attr-defined]
        ranges = b"".join(getattr(model, name).tobytes() for name in _RANGES)
        if model is self._model and ranges == self._ranges:
            return
        import mujoco

        self._mujoco, self._model, self._ahead = mujoco, model, mujoco.MjData(model)
        self._ranges = b""  # as long as they are not read to the end
        self._late(model)
        kinds = mujoco.mjtWarning
        self._given_up = [int(kinds.mjWARN_BADQPOS), int(kinds.mjWARN_BADQVEL), int(kinds.mjWARN_BADQACC)]
        self._last: Floats | None = None
        space: Any = self.env.action_space
        low, high = self._range(space, self._ctrl is None)
        positions, velocities = self._limits(self._constraints)
        self._q, self._v = list(positions), list(velocities)
        if not (positions or velocities):
            raise ValueError(
                "no joint has a limit to be kept; give constraints that say which, e.g. {'position': {}, 'velocity': {'limit': 25.0}} for every joint with a "
                "range or an actuator, or {'velocity': {'limit': {'JOINT': 25.0}}}"
            )
        sizes = [(upper, upper - lower) for lower, upper in positions.values()] + [(most, most) for most in velocities.values()]
        self._nowhere = np.array([upper + _NOWHERE * max(size, _NEAR) for upper, size in sizes])
        self._sizes = np.minimum([size for _, size in sizes], 1.0)
        actions = list(zip(low.ravel().tolist(), high.ravel().tolist()))
        self._search = _core.ActionSearch(list(positions.values()), list(velocities.values()), actions, self._seed)
        self._ranges = ranges

    def set_constraints(self, constraints: Mapping[str, Mapping[str, PerJoint]]) -> None:
        """Keeps other limits from the next step on, as a curriculum has them; in a vector ``envs.call("set_constraints", {...})``.

        Args:
            constraints: As of the constructor.

        Raises:
            ValueError: as of the constructor; the limits of before stay then.
        """
        before = self._constraints
        self._constraints, self._ranges = copy.deepcopy(constraints), b""
        try:
            self._read()
        except ValueError:
            self._constraints, self._ranges = before, b""
            raise

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; the environment may have changed its model for it."""
        result = self.env.reset(seed=seed, options=options)
        self._ended, self._forth, self._begun = False, False, True
        self._read()
        return result

    def step(self, action: ArrayLike) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """A step under ``action``, or under the nearest one found that ends within the limits."""
        self._check_begun()
        safe, verdict = self.safe(action)
        if self._last is None or not np.array_equal(self._last, safe.ravel()):
            self._foresee(safe.astype(float).ravel())
        sent, word = safe.copy(), "kept" if np.array_equal(safe, action) else "replaced"
        inner: Any = self.env.unwrapped
        before, held, resets = inner.data.time, inner.data.ctrl.copy(), self._resets(inner.data)
        obs, reward, terminated, truncated, info = self.env.step(safe)
        data, foreseen, ended = inner.data, self._foreseen, bool(terminated or truncated)
        self._read()
        forth = bool(data.time > before)
        late = not abs(data.time - foreseen[2]) <= _SAME * self._model.opt.timestep
        # An environment that was begun anew within its step shows nothing of where the action led. Some set their clock back in every step.
        anew = late and (ended or self._ended or (self._forth and not forth))
        self._ended, self._forth = ended, forth
        # Where MuJoCo gives up for a second time its count is 1 again.
        unstable = self._unstable(data, resets if foreseen[3] else 0)
        if unstable:
            self._warn("unstable", unstable)
        elif not anew and data.ctrl.shape == held.shape and len(foreseen[1]) == len(self._q) + len(self._v):
            self._warn("other", self._compare(data, sent, held, foreseen, before if forth and late else None))
        outside = bool(unstable) or self._is_outside(data) or (anew and verdict == "outside")
        return obs, reward, terminated, truncated, {**info, "guard": "outside" if outside else word, "action": sent}

    def _check_begun(self) -> None:
        """Refuses a step before an episode, also of an environment that ``gymnasium.make`` did not put into its order."""
        if not self._begun:
            self._begun = self.env.has_wrapper_attr("has_reset") and bool(self.env.get_wrapper_attr("has_reset"))
        if not self._begun:
            raise gymnasium.error.ResetNeeded("no episode has begun; call reset() of the guard before step()")

    def safe(self, action: ArrayLike) -> tuple[NDArray[Any], str]:
        """The action that a step would use and what is foreseen of it, ``"kept"``, ``"replaced"`` or ``"outside"``; nothing is stepped."""
        self._read()
        given = self._checked(action)
        if not _finite(self.env.unwrapped.data):  # type: ignore[attr-defined]
            self._last = None
            return given, "outside"  # no action leads back from there
        verdict, found = self._search.find(given.astype(float).ravel().tolist(), self._foresee)
        found = found.reshape(given.shape)
        if verdict == "kept" or (verdict == "outside" and (self._keeps or np.array_equal(found, given))):
            return given, verdict
        # What the space's own type makes of it is what the environment gets.
        safe = found.astype(self.env.action_space.dtype)
        inside = self._search.excess(self._foresee(safe.astype(float).ravel()).tolist()) <= 0.0
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
        """Whether the state is outside the limits now; one with an entry that is not finite is."""
        self._read()
        data = self.env.unwrapped.data  # type: ignore[attr-defined]
        return self._is_outside(data)

    def _is_outside(self, data: Any) -> bool:
        return not _finite(data) or self._search.excess(self._limited(data).tolist()) > 0.0

    def _limited(self, data: Any) -> Floats:
        """Positions and velocities that have limits."""
        return np.concatenate([data.qpos[self._q], data.qvel[self._v]])

    def _resets(self, data: Any) -> int:
        """How often MuJoCo has given up a state."""
        counts = data.warning.number
        return sum(int(counts[kind]) for kind in self._given_up)

    def _unstable(self, data: Any, resets: int) -> str | None:
        """What is wrong with the state; ``resets`` are those of before the step."""
        if _finite(data):
            if self._resets(data) <= resets:
                return None
            return (
                "MuJoCo gave up in the middle of a step, as positions, velocities or accelerations had become too large, and went on from the state that the "
                "model begins in: make its timestep or the ranges of its actuators smaller"
            )
        m = self._model
        if np.isfinite(data.qpos).all():
            what, values, joints = "velocity", data.qvel, m.dof_jntid
        else:
            what, values, joints = "position", data.qpos, np.repeat(np.arange(m.njnt), np.diff(np.append(m.jnt_qposadr, m.nq)))
        k = int(np.argmin(np.isfinite(values)))
        name = m.joint(int(joints[k])).name or joints[k]
        return f"the {what} of joint '{name}' is {values[k]}, from which no action leads back: reset the environment"

    def _compare(self, data: Any, action: NDArray[Any], held: Floats, foreseen: tuple[Floats, Floats, float, bool], before: float | None) -> str | None:
        """Says in a sentence where a step under ``action`` was another one than the one foreseen: its controls, state and time.

        ``held`` are the controls of the step before, ``before`` its time, where the step did not take as long as was foreseen.
        """
        ctrl, state, time, _ = foreseen
        got, meant = self._clipped(data.ctrl), self._clipped(ctrl)
        off = ~(np.abs(got - meant) <= _SAME * np.maximum(1.0, np.abs(meant)))
        near = bool((np.abs(self._limited(data) - state) <= _NEAR * (self._sizes + np.abs(state))).all())
        if not (off.any() or before is not None):
            self._trusted |= bool(action.any())  # where nothing is asked for, a factor shows nothing
            if not near and self._is_outside(data) and self._search.excess(state.tolist()) <= 0.0:
                return "a step ended outside under the controls that were foreseen to end inside: the environment moves the robot by something else too"
            return None
        if near and before is None:  # controls that move nothing that has a limit, or are set back after the step
            return None
        if before is not None:
            what = (
                f"a step of the environment took {data.time - before:.4g} s and its frame_skip says {time - before:.4g} s; put the wrapper that repeats "
                "actions around the guard"
            )
        else:
            i = int(np.argmax(off))
            what = (
                f"actuator '{self._model.actuator(i).name or i}' got {got[i]:.4g} where the guard had foreseen {meant[i]:.4g}: the environment, or a wrapper "
                "below the guard, changes the action; put the wrapper around the guard, or give ctrl=, the function from an action to data.ctrl"
            )
        if self._trusted:
            return what
        if self._repeats < _REPEATS and before is None and np.array_equal(data.ctrl, held):
            self._repeats += 1
            return None
        raise ValueError(what)

    def _warn(self, kind: str, what: str | None) -> None:
        """Once of each kind."""
        if what and kind not in self._warned:
            warnings.warn(f"{what}; limits do not hold in such steps, and info['guard'] says 'outside' of those that end there", stacklevel=3)
            self._warned.add(kind)

    def _clipped(self, ctrl: Floats) -> Floats:
        """Controls as MuJoCo uses them."""
        low, high = self._model.actuator_ctrlrange.T
        return np.where(self._model.actuator_ctrllimited, np.clip(ctrl, low, high), ctrl)

    def _foresee(self, action: Floats) -> Floats:
        """Those of :meth:`_limited` after a step under ``action`` (n_act); far outside where MuJoCo gives up."""
        mujoco, ahead = self._mujoco, self._ahead
        inner: Any = self.env.unwrapped
        mujoco.mj_copyData(ahead, self._model, inner.data)
        shaped = action.reshape(self.env.action_space.shape)
        ctrl = np.array(shaped if self._ctrl is None else self._ctrl(shaped.copy()), float)
        if ctrl.shape != ahead.ctrl.shape:
            raise ValueError(f"ctrl gives shape {ctrl.shape} for an action, expected {ahead.ctrl.shape}, one number for each actuator")
        bad = np.flatnonzero(~np.isfinite(ctrl))
        if len(bad):
            i = int(bad[0])
            raise ValueError(f"ctrl gives {ctrl[i]} for actuator '{self._model.actuator(i).name or i}': every entry must be finite; check the function")
        ahead.ctrl[:] = ctrl
        ahead.warning.number[:] = 0  # beginning anew sets it back to 1, whatever it was
        mujoco.mj_step(self._model, ahead, nstep=inner.frame_skip)
        self._last = action
        stands = _finite(ahead) and not self._resets(ahead)
        state = self._limited(ahead) if stands else self._nowhere.copy()
        self._foreseen = ctrl, state, float(ahead.time), stands
        return state

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
                is_number = isinstance(settings, int | float) and not isinstance(settings, bool)
                example = {keys[name]: settings} if is_number else {"position": {}, "velocity": {"limit": 25.0}}[name]
                raise ValueError(f"{name} is {settings!r}; give a table, e.g. {example}")
            if unknown := settings.keys() - {keys[name]}:
                raise ValueError(f"{name} has no '{min(unknown)}'; it has '{keys[name]}'")
        m, joint = self._model, self._mujoco.mjtJoint
        kinds = (int(joint.mjJNT_HINGE), int(joint.mjJNT_SLIDE))
        single = [i for i in range(m.njnt) if int(m.jnt_type[i]) in kinds]
        ranged = {i for i in range(m.njnt) if m.jnt_limited[i]}
        names = {i: m.joint(i).name or i for i in range(m.njnt)}  # many joints may have none
        q: dict[int, tuple[float, float]] = {}
        if "position" in constraints:
            margin = constraints["position"].get("margin", 0.0)
            if not isinstance(margin, Mapping):
                self._left_out("position", ranged.difference(single), names)
            for i, x in _per_joint(margin, [i for i in single if i in ranged], names, "position margin").items():
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
            joints = single
            if not isinstance(limit, Mapping):
                every = ranged | self._driven()
                self._left_out("velocity", every.difference(single), names)
                joints = [i for i in single if i in every]
            v = {int(m.jnt_dofadr[i]): x for i, x in _per_joint(limit, joints, names, "velocity limit").items()}
        return q, v

    def _left_out(self, what: str, joints: set[int], names: Mapping[int, str | int]) -> None:
        """Says of joints that one number is meant for as well that the guard cannot hold them."""
        kind = f"{what} of a ball"
        if joints and kind not in self._warned:
            which = ", ".join(f"'{names[i]}'" for i in sorted(joints))
            warnings.warn(f"the guard keeps the {what} of hinges and slides alone; of {which}, a ball or free joint each, nothing is kept", stacklevel=5)
            self._warned.add(kind)

    def _late(self, model: Any) -> None:
        """Says of actuators that an action reaches later that a step ahead is not far enough."""
        delays = {model.actuator(i).name or i: float(x) for i, x in enumerate(model.actuator_delay) if x > 0}
        if delays and "late" not in self._warned:
            which = ", ".join(f"'{name}' ({delay:g} s)" for name, delay in delays.items())
            warnings.warn(f"actuators act with a delay: {which}; the guard looks one step ahead, and what was sent before may leave limits", stacklevel=4)
            self._warned.add("late")

    def _driven(self) -> set[int]:
        """Joints that an actuator moves, directly or through tendons and sites."""
        mujoco, m = self._mujoco, self._model
        data = mujoco.MjData(m)
        # Anywhere but where the model begins: there a lever may be zero.
        mujoco.mj_integratePos(m, data.qpos, np.random.default_rng(0).uniform(-1.0, 1.0, m.nv), 1.0)
        for step in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_transmission):
            step(m, data)
        used = np.abs(data.actuator_moment) > _LEVER
        rows = [slice(adr, adr + n) for adr, n in zip(data.moment_rowadr, data.moment_rownnz)]
        return {int(m.dof_jntid[dof]) for row in rows for dof in data.moment_colind[row][used[row]]}


def _per_joint(value: PerJoint, joints: list[int], names: Mapping[int, str | int], what: str) -> dict[int, float]:
    """Numbers by the joint's number in the model."""
    ids = {names[i]: i for i in joints}
    values = dict(value) if isinstance(value, Mapping) else {names[i]: value for i in joints}
    for name, number in values.items():
        if name not in ids:
            if name in names.values():
                no = "no range in the robot file" if what.startswith("position") else "more than one degree of freedom"
                raise ValueError(f"{what}: joint '{name}' has {no}; take it out of the table, which may have {', '.join(map(str, ids))}")
            raise ValueError(f"{what}: the robot has no such joint '{name}'; it has {', '.join(map(str, ids))}")
        if not isinstance(number, Real) or not (np.isfinite(float(number)) and float(number) >= 0.0):
            raise ValueError(f"{what} of joint '{name}' is {number!r}; give a finite number of at least 0")
    return {ids[name]: float(number) for name, number in values.items()}


def _finite(data: Any) -> bool:
    """Whether positions and velocities are numbers."""
    return bool(np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all())
