"""The limits that a projector is built from.

Written from the registry of limits by
`NEARL_WRITE=1 cargo test --release --locked -p nearl-constraints --test suite written`;
a test fails when this file is old.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, final

from nearl._core import Limit, Model

__all__ = [
    "AccelerationLimit",
    "CollisionLimit",
    "EnergyLimit",
    "FrameLimit",
    "FrameSpeedLimit",
    "JerkLimit",
    "LockedJoints",
    "PositionLimit",
    "RowLimit",
    "TorqueLimit",
    "TorqueRateLimit",
    "TorqueSpeedLimit",
    "VelocityLimit",
    "VelocityProfileLimit",
]

# One number for all joints, numbers by joint, or one for each dof.
PerJoint = float | Mapping[str, float] | Sequence[float]

# What the rows of a ledger are called.
RowKind = Literal[
    "position",
    "velocity",
    "acceleration",
    "viability",
    "torque",
    "jerk",
    "torque_speed",
    "torque_rate",
    "frame",
    "frame_speed",
    "energy",
    "collision",
    "user",
    "locked",
    "velocity_profile",
]


@final
class AccelerationLimit(Limit):
    """Acceleration stays below `limit` [rad/s², m/s²]. `braking` is the deceleration that position limits count on, at most `limit`, which
    is also its default.

    In a task file:

        acceleration = { limit = 10.0 }
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        limit: PerJoint,
        braking: PerJoint | None = None,
        *,
        margin: PerJoint | None = None,
    ) -> AccelerationLimit:
        settings = {
            "limit": limit,
            "braking": braking,
            "margin": margin,
        }
        return super().__new__(cls, model, "acceleration", settings)


@final
class CollisionLimit(Limit):
    """Bodies keep `margin` apart, as far as `braking` [m/s²] can be delivered; `influence` [m] must exceed `margin + w² / (2 braking)` at
    closing speed w. A `half_space` is what lies at `z <= 0` of its own axes. `urdf` adds the robot file's own spheres, boxes, cylinders and
    capsules.

    In a task file:

        collision = { shapes = [{ frame = "panda_hand", shape = { sphere = { radius = 0.1 } } }, { name = "floor", shape = "half_space" }], braking = 2.0 }
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        shapes: Sequence[Mapping[str, Any]],
        braking: float,
        *,
        margin: float = 0.0,
        urdf: bool = False,
        ignore: Sequence[tuple[str, str]] = (),
        adjacent: bool = False,
        influence: float = 0.2,
        rows: int = 16,
        soft: tuple[float, float] | None = None,
    ) -> CollisionLimit:
        settings = {
            "shapes": shapes,
            "braking": braking,
            "margin": margin,
            "urdf": urdf,
            "ignore": ignore,
            "adjacent": adjacent,
            "influence": influence,
            "rows": rows,
            "soft": soft,
        }
        return super().__new__(cls, model, "collision", settings)


@final
class EnergyLimit(Limit):
    """The kinetic energy of the whole robot stays below `limit` [J]: a second-order cone.

    In a task file:

        energy = { limit = 2.0 }
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        limit: float,
        *,
        margin: float = 0.0,
        soft: tuple[float, float] | None = None,
    ) -> EnergyLimit:
        settings = {
            "limit": limit,
            "margin": margin,
            "soft": soft,
        }
        return super().__new__(cls, model, "energy", settings)


@final
class FrameLimit(Limit):
    """A point of a frame stops in front of a plane, `normal . (p - through) <= 0`, or inside a box of world axes, `box = { lower = [x, y,
    z], upper = [x, y, z] }`, or both, as far as `braking` [m/s²] can be delivered. `point` is in the frame's axes [m].

    In a task file:

        frame = [{ frame = "panda_hand", half_space = { normal = [0, 0, -1], through = [0, 0, 0.1] }, braking = 5.0 }]
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        frame: str,
        braking: float,
        *,
        normal: Sequence[float] | None = None,
        through: Sequence[float] | None = None,
        lower: Sequence[float] | None = None,
        upper: Sequence[float] | None = None,
        point: Sequence[float] = (0.0, 0.0, 0.0),
        margin: float = 0.0,
        soft: tuple[float, float] | None = None,
        name: str | None = None,
    ) -> FrameLimit:
        settings = {
            "frame": frame,
            "braking": braking,
            "normal": normal,
            "through": through,
            "lower": lower,
            "upper": upper,
            "point": point,
            "margin": margin,
            "soft": soft,
            "name": name,
        }
        return super().__new__(cls, model, "frame", settings)


@final
class FrameSpeedLimit(Limit):
    """The speed of a point of a frame stays below `limit` [m/s] in every direction: a second-order cone. `point` is in the frame's axes
    [m].

    In a task file:

        frame_speed = [{ frame = "panda_hand", limit = 0.25 }]
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        frame: str,
        limit: float,
        *,
        point: Sequence[float] = (0.0, 0.0, 0.0),
        name: str | None = None,
        margin: float = 0.0,
        soft: tuple[float, float] | None = None,
    ) -> FrameSpeedLimit:
        settings = {
            "frame": frame,
            "limit": limit,
            "point": point,
            "name": name,
            "margin": margin,
            "soft": soft,
        }
        return super().__new__(cls, model, "frame_speed", settings)


@final
class JerkLimit(Limit):
    """Change of acceleration in a second [rad/s³, m/s³]. Soft, braking comes first. With `hard`, position, velocity, acceleration and jerk
    of a joint hold at once. It needs the tick before.

    In a task file:

        jerk = { limit = 500.0 }
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        limit: PerJoint,
        soft: tuple[float, float] | None = None,
        *,
        margin: PerJoint | None = None,
        hard: bool = False,
    ) -> JerkLimit:
        settings = {
            "limit": limit,
            "soft": soft,
            "margin": margin,
            "hard": hard,
        }
        return super().__new__(cls, model, "jerk", settings)


@final
class LockedJoints(Limit):
    """The joint brakes to standstill and stays.

    In a task file:

        locked = ["panda_joint7"]
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        joints: Sequence[str],
    ) -> LockedJoints:
        settings = {
            "joints": joints,
        }
        return super().__new__(cls, model, "locked", settings)


@final
class PositionLimit(Limit):
    """The joint can always stop in front of the limits of the robot file, at any period and number of physics steps. `margin` is kept
    inside them.

    In a task file:

        position = { margin = 0.01 }
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        margin: PerJoint = 0.0,
    ) -> PositionLimit:
        settings = {
            "margin": margin,
        }
        return super().__new__(cls, model, "position", settings)


@final
class RowLimit(Limit):
    """A linear row over `q.`, `v.` and `a.` of joints of the next state: `lower`, `upper` or `equals`. With `braking` a sum of positions
    stops in front of its bounds.

    In a task file:

        rows = [{ name = "elbow up", terms = { "q.panda_joint4" = 1.0 }, upper = -0.5, braking = 2.0 }]
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        name: str,
        terms: Mapping[str, float],
        *,
        lower: float | None = None,
        upper: float | None = None,
        equals: float | None = None,
        braking: float | None = None,
        soft: tuple[float, float] | None = None,
        margin: float = 0.0,
    ) -> RowLimit:
        settings = {
            "name": name,
            "terms": terms,
            "lower": lower,
            "upper": upper,
            "equals": equals,
            "braking": braking,
            "soft": soft,
            "margin": margin,
        }
        return super().__new__(cls, model, "rows", settings)


@final
class TorqueLimit(Limit):
    """Motor forces by Pinocchio, on average over the period, stay below `scale`, a share in (0, 1] of the robot file's limits. What is soft
    is nothing that a certified or stored brake may count on.

    In a task file:

        torque = { scale = 0.9 }
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        scale: float = 1.0,
        *,
        margin: PerJoint | None = None,
        soft: tuple[float, float] | None = None,
    ) -> TorqueLimit:
        settings = {
            "scale": scale,
            "margin": margin,
            "soft": soft,
        }
        return super().__new__(cls, model, "torque", settings)


@final
class TorqueRateLimit(Limit):
    """Change of motor forces in a second. Always soft: braking comes first. It needs the tick before.

    In a task file:

        torque_rate = { limit = 1000.0 }
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        limit: PerJoint,
        soft: tuple[float, float] | None = None,
        *,
        margin: PerJoint | None = None,
    ) -> TorqueRateLimit:
        settings = {
            "limit": limit,
            "soft": soft,
            "margin": margin,
        }
        return super().__new__(cls, model, "torque_rate", settings)


@final
class TorqueSpeedLimit(Limit):
    """The line of a direct-current motor: `|tau + stall / no_load v| <= stall - margin` in [N·m, N] and [rad/s, m/s], at the speeds with
    which a period begins and ends.

    In a task file:

        torque_speed = { stall = 80.0, no_load = 3.0 }
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        stall: PerJoint,
        no_load: PerJoint,
        soft: tuple[float, float] | None = None,
        *,
        margin: PerJoint | None = None,
    ) -> TorqueSpeedLimit:
        settings = {
            "stall": stall,
            "no_load": no_load,
            "soft": soft,
            "margin": margin,
        }
        return super().__new__(cls, model, "torque_speed", settings)


@final
class VelocityLimit(Limit):
    """Speed stays below `scale`, a share in (0, 1] of the robot file's limits, or below `limit` [rad/s, m/s]; the smaller holds where both
    are given.

    In a task file:

        velocity = { scale = 0.8 }
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        limit: PerJoint | None = None,
        *,
        scale: float | None = None,
        margin: PerJoint | None = None,
    ) -> VelocityLimit:
        settings = {
            "limit": limit,
            "scale": scale,
            "margin": margin,
        }
        return super().__new__(cls, model, "velocity", settings)


@final
class VelocityProfileLimit(Limit):
    """The speed limit falls in front of a position: Franka's published rule for a Research 3, or by joint `limit`, `offset` [rad/s],
    `squared` [rad/s²], `lower` and `upper` [rad] in `v <= min(limit, -offset + sqrt(squared (upper - q)))`.

    In a task file:

        velocity_profile = "fr3"
    """

    __slots__ = ()

    def __new__(
        cls,
        model: Model,
        profile: str | Mapping[str, Mapping[str, float]],
        *,
        margin: float = 0.0,
    ) -> VelocityProfileLimit:
        settings = {
            "profile": profile,
            "margin": margin,
        }
        return super().__new__(cls, model, "velocity_profile", settings)
