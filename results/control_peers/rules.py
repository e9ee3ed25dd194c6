"""Rules that turn a proposed next velocity into an allowed one, all on the same arm with the same limits.

A rule is a function of (q, v, q_hat, v_hat), which returns the velocity at the end of the period, or raises. NEARL, pink and mink are
the packages themselves; the limiters of ros2_control are written down again from its published sources.
"""

import io
import re
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import mink
import mujoco
import nearl
import numpy as np
import pink
import pinocchio as pin

FILE = Path(__file__).resolve().parents[2] / "examples" / "robots" / "panda" / "panda.urdf"
DT = 1e-3


@dataclass
class Limits:
    """Limits of the seven joints: rad, rad/s, rad/s², N m."""

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    braking: np.ndarray
    effort: np.ndarray


def panda() -> tuple[pin.Model, Limits]:
    """The arm, 60 % of its speed, three times the maker's accelerations (so that torque limits bind), braking the motors can give."""
    model = pin.buildModelFromUrdf(str(FILE))
    acceleration = 3 * np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
    braking = np.array([4.0, 2.0, 4.0, 4.0, 6.0, 6.0, 10.0])
    effort = model.upperEffortLimit.copy()
    speed = 0.6 * model.upperVelocityLimit
    return model, Limits(model.lowerPositionLimit.copy(), model.upperPositionLimit.copy(), speed, acceleration, braking, effort)


def ours(limits: Limits, braking: str = "certified"):
    model = nearl.Model.from_urdf(FILE)
    by_joint = lambda values: dict(zip(model.joint_names, values.tolist(), strict=True))  # noqa: E731
    constraints = [
        nearl.PositionLimit(model),
        nearl.VelocityLimit(model, scale=0.6),
        nearl.AccelerationLimit(model, by_joint(limits.acceleration), by_joint(limits.braking)),
        nearl.TorqueLimit(model),
    ]
    projector = nearl.Projector(model, constraints, dt=DT, sub_steps=1, braking=braking)
    return lambda q, v, q_hat, v_hat: projector.project(q, v, q_hat, v_hat).v


def posture_target(q, q_hat, v_hat):
    """The displacement a proposal asks for: the mean of what its position and its velocity ask for, as in ours."""
    return q + 0.5 * ((q_hat - q) + DT * v_hat)


def by_pink(model: pin.Model, limits: Limits, solver: str = "quadprog"):
    """pink's posture task with its configuration, velocity and acceleration limits; the last holds its braking bound."""
    model.upperVelocityLimit = limits.speed
    data = model.createData()
    acceleration = pink.limits.AccelerationLimit(model, limits.acceleration)
    bounds = [pink.limits.ConfigurationLimit(model), pink.limits.VelocityLimit(model, limits.speed), acceleration]
    task = pink.tasks.PostureTask(cost=1.0)

    def rule(q, v, q_hat, v_hat):
        configuration = pink.Configuration(model, data, q, copy_data=False)
        task.set_target(posture_target(q, q_hat, v_hat))
        acceleration.set_last_integration(v, DT)
        return pink.solve_ik(configuration, [task], DT, solver=solver, limits=bounds, safety_break=False)

    return rule


def by_mink(limits: Limits, solver: str = "quadprog"):
    """mink's posture task with its configuration and velocity limits; it has no acceleration limit."""
    model = mujoco.MjModel.from_xml_string(FILE.read_text())
    speed = {model.joint(j).name: limits.speed[j] for j in range(model.njnt)}
    bounds = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speed)]
    task = mink.PostureTask(model, cost=1.0)
    configuration = mink.Configuration(model)

    def rule(q, v, q_hat, v_hat):
        configuration.update(q)
        task.set_target(posture_target(q, q_hat, v_hat))
        return mink.solve_ik(configuration, [task], DT, solver, limits=bounds, safety_break=False)

    return rule


def by_saturation_limiter(limits: Limits):
    """ros2_control's JointSaturationLimiter for commands of position and velocity (joint_limits/src/joint_saturation_limiter.cpp,
    commit 07ebe9b). Its deceleration limit is our braking, its acceleration limit our acceleration."""

    def rule(q, v, q_hat, v_hat):
        position = np.clip(q_hat, limits.low, limits.high)
        velocity = v_hat.copy()
        undefined = np.isnan(velocity) | (np.abs(velocity) <= 1e-10)
        velocity[undefined] = ((position - q) / DT)[undefined]
        velocity = np.where(np.abs(velocity) > limits.speed, np.copysign(limits.speed, velocity), velocity)
        wanted = (velocity - v) / DT
        slowing = ((wanted < 0) & (v > 0)) | ((wanted > 0) & (v < 0))
        most = np.where(slowing, limits.braking, limits.acceleration)
        velocity = np.where(np.abs(wanted) > most, v + DT * np.copysign(most, wanted), velocity)
        room = np.where(velocity < 0, q - limits.low, limits.high - q)
        stopping, duration = velocity**2 / (2 * limits.braking), np.abs(velocity) / limits.braking
        if np.any((velocity != 0) & ((room < stopping) | (room < np.abs(velocity) * duration))):
            stop = -v / DT
            return v + DT * np.copysign(np.minimum(np.abs(stop), limits.braking), stop)
        return velocity

    return rule


def by_range_limiter(limits: Limits):
    """ros2_control's JointRangeLimiter for velocity commands (compute_velocity_limits in joint_limits/src/joint_limits_helpers.cpp,
    commit 057d367). The velocity commanded before is the measured one: the plant has no delay."""

    def rule(q, v, q_hat, v_hat):
        lower = np.maximum((limits.low - q) / DT, -limits.speed)
        upper = np.minimum((limits.high - q) / DT, limits.speed)
        outside = (q > limits.high) | (q < limits.low)
        lower, upper = np.where(outside, 0.0, lower), np.where(outside, 0.0, upper)
        lower = np.maximum(v - DT * limits.acceleration, lower)
        upper = np.minimum(v + DT * limits.acceleration, upper)
        lower, upper = np.minimum(lower, upper), np.maximum(lower, upper)
        return np.clip(v_hat, lower, upper)

    return rule


def plant() -> mujoco.MjModel:
    """MuJoCo at 1 kHz, Euler, without joint stops, contacts or clamps on motor forces."""
    model = mujoco.MjModel.from_xml_string(re.sub(r' (lower|upper)="[^"]*"', "", FILE.read_text()))
    model.opt.timestep = DT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return model


def rules(solver: str = "quadprog") -> dict:
    """The rules by name."""
    _, limits = panda()
    with redirect_stdout(io.StringIO()):
        return {
            "NEARL, certified braking": ours(limits),
            "NEARL, stored brake": ours(limits, "stored"),
            "pink, braking bound": by_pink(panda()[0], limits, solver),
            "mink": by_mink(limits, solver),
            "ros2_control, saturation": by_saturation_limiter(limits),
            "ros2_control, range": by_range_limiter(limits),
        }
