"""Rules that turn a proposed next velocity into an allowed one, all on the same arm with the same limits.

A rule is a function of (q, v, q_hat, v_hat), which returns the velocity at the end of the period, or raises. NEARL, pink, mink,
placo, klimits and cbfpy are the packages themselves; tsid and the limiters of ros2_control are written down again from their published sources.
Each imports its package when it is made: placo needs another Pinocchio and runs in a process of its own (`Remote`).
"""

import io
import os
import pickle
import re
import subprocess
import sys
import tempfile
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin

DT = 1e-3
ROBOTS = ("panda", "z1")
# Another Python, with placo, where it is asked for.
OTHER_PYTHON = os.environ.get("PLACO_PYTHON")


@dataclass
class Limits:
    """Limits of the seven joints: rad, rad/s, rad/s², N m."""

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    braking: np.ndarray
    effort: np.ndarray


def text(robot: str) -> str:
    """The robot file without meshes, joint friction and joint damping: every rule and the plant have the same model."""
    if robot == "panda":
        return (Path(__file__).resolve().parents[2] / "examples" / "robots" / "panda" / "panda.urdf").read_text()
    found = sorted(Path(sys.prefix).glob("lib/python3*/site-packages/cmeel.prefix/share/example-robot-data/robots/z1_description/urdf/z1.urdf"))
    if not found:
        raise FileNotFoundError("z1.urdf: pip install example-robot-data")
    return re.sub(r"<(visual|collision|transmission|gazebo)\b.*?</\1>|<dynamics[^>]*/>", "", found[0].read_text(), flags=re.S)


def arm(robot: str) -> tuple[pin.Model, Limits]:
    """The arm, 60 % of its speed, accelerations so large that torque limits bind, and braking that the motors can give: for the Panda
    three times the maker's accelerations."""
    model = pin.buildModelFromXML(text(robot))
    if robot == "panda":
        acceleration = 3 * np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
        braking = np.array([4.0, 2.0, 4.0, 4.0, 6.0, 6.0, 10.0])
    else:
        acceleration, braking = np.full(7, 60.0), np.array([4.0, 4.0, 4.0, 6.0, 8.0, 10.0, 10.0])
    # Pinocchio 4 has two names for what Pinocchio 3, which placo has, calls by one.
    effort = getattr(model, "upperEffortLimit", getattr(model, "effortLimit", None)).copy()
    speed = 0.6 * getattr(model, "upperVelocityLimit", getattr(model, "velocityLimit", None))
    return model, Limits(model.lowerPositionLimit.copy(), model.upperPositionLimit.copy(), speed, acceleration, braking, effort)


def written(robot: str) -> Path:
    """A file that holds `text`, for packages that read files only."""
    path = Path(tempfile.gettempdir()) / f"nearl-peers-{os.getpid()}-{robot}.urdf"
    path.write_text(text(robot))
    return path


def ours(robot: str, limits: Limits, braking: str = "certified"):
    import nearl

    path = written(robot)
    model = nearl.Model.from_urdf(path)
    path.unlink()
    by_joint = lambda values: dict(zip(model.joint_names, values.tolist(), strict=True))  # noqa: E731
    constraints = [
        nearl.PositionLimit(model),
        nearl.VelocityLimit(model, scale=0.6),
        nearl.AccelerationLimit(model, by_joint(limits.acceleration), by_joint(limits.braking)),
        nearl.TorqueLimit(model),
    ]
    projector = nearl.Projector(model, constraints, dt=DT, sub_steps=1, braking=braking)

    def rule(q, v, q_hat, v_hat):
        return projector.project(q, v, q_hat, v_hat).v

    rule.projector = projector
    return rule


def posture_target(q, q_hat, v_hat):
    """The displacement a proposal asks for: the mean of what its position and its velocity ask for, as in ours."""
    return q + 0.5 * ((q_hat - q) + DT * v_hat)


def by_pink(model: pin.Model, limits: Limits, most: np.ndarray, solver: str):
    """pink's posture task with its configuration, velocity and acceleration limits; the last holds its braking bound. It has one
    number for both: `most`."""
    import pink

    model.upperVelocityLimit = limits.speed
    data = model.createData()
    acceleration = pink.limits.AccelerationLimit(model, most)
    bounds = [pink.limits.ConfigurationLimit(model), pink.limits.VelocityLimit(model, limits.speed), acceleration]
    task = pink.tasks.PostureTask(cost=1.0)

    def rule(q, v, q_hat, v_hat):
        configuration = pink.Configuration(model, data, q, copy_data=False)
        task.set_target(posture_target(q, q_hat, v_hat))
        acceleration.set_last_integration(v, DT)
        return pink.solve_ik(configuration, [task], DT, solver=solver, limits=bounds, safety_break=False)

    return rule


def by_mink(robot: str, limits: Limits, solver: str):
    """mink's posture task with its configuration and velocity limits; it has no acceleration limit."""
    import mink

    model = mujoco.MjModel.from_xml_string(text(robot))
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


def by_tsid(model: pin.Model, limits: Limits):
    """tsid's posture task with its `TaskJointPosVelAccBounds` (src/tasks/task-joint-posVelAcc-bounds.cpp, commit 591f737: bounds on position,
    velocity and acceleration with viability) and `TaskActuationBounds`, solved by quadprog. Written down again: the wheels of tsid 1.10.0
    end in the allocator beside Pinocchio 4.0 and 4.1. Its one number for acceleration and braking is the braking."""
    from quadprog import solve_qp

    data, n, most = model.createData(), len(limits.low), limits.braking

    def bounds(q, v):
        stop, reach = -v / DT, lambda room: 2 / DT**2 * room
        high, low = reach(limits.high - q - DT * v), reach(limits.low - q - DT * v)
        with np.errstate(divide="ignore", invalid="ignore"):
            late_low = np.where(q == limits.low, 0.0, np.maximum(v**2 / (2 * (q - limits.low)), stop))
            late_high = np.where(q == limits.high, 0.0, np.minimum(-(v**2) / (2 * (limits.high - q)), stop))
        position_low = np.where((v > 0) | (low < stop), low, late_low)
        position_high = np.where((v <= 0) | (high > stop), high, late_high)
        half = 2 * DT * v
        after = q + DT * v
        b_high, b_low = half + most * DT**2, half - most * DT**2
        d_high = b_high**2 - 4 * DT**2 * (v**2 - 2 * most * (limits.high - after))
        d_low = b_low**2 - 4 * DT**2 * (v**2 - 2 * most * (after - limits.low))
        via_high = np.where(d_high >= 0, (-b_high + np.sqrt(np.maximum(d_high, 0))) / (2 * DT**2), stop)
        via_low = np.where(d_low >= 0, (-b_low - np.sqrt(np.maximum(d_low, 0))) / (2 * DT**2), stop)
        lows = [position_low, np.minimum(via_low, stop), (-limits.speed - v) / DT, -most]
        highs = [position_high, np.maximum(via_high, stop), (limits.speed - v) / DT, most]
        lower, upper = np.max(lows, axis=0), np.min(highs, axis=0)
        conflict, by_position = upper < lower, upper == position_high
        return np.where(conflict & by_position, upper, lower), np.where(conflict & ~by_position, lower, upper)

    def rule(q, v, q_hat, v_hat):
        wanted = ((posture_target(q, q_hat, v_hat) - q) / DT - v) / DT
        lower, upper = bounds(q, v)
        mass = pin.crba(model, data, q)
        mass = np.triu(mass) + np.triu(mass, 1).T
        rest = pin.nonLinearEffects(model, data, q, v)
        rows = np.vstack([np.eye(n), -np.eye(n), mass, -mass])
        least = np.concatenate([lower, -upper, -limits.effort - rest, rest - limits.effort])
        # In units of a velocity change, as quadprog's tolerance wants it.
        return v + solve_qp(np.eye(n), DT * wanted, rows.T, DT * least)[0]

    return rule


def by_placo(robot: str, limits: Limits):
    """placo: joints task in its dynamics solver, with its limits on positions (braking as `qdd_safe`), velocities and motor forces."""
    import placo

    path = written(robot)
    wrapper = placo.RobotWrapper(str(path), placo.Flags.ignore_collisions)
    path.unlink()
    solver = placo.DynamicsSolver(wrapper)
    solver.dt = DT
    solver.mask_fbase(True)
    names = list(wrapper.joint_names())
    task = solver.add_joints_task()
    task.configure("joints", "soft", 1.0)
    solver.enable_joint_limits(True)
    solver.enable_velocity_limits(True)
    solver.enable_torque_limits(True)
    wrapper.set_velocity_limits(1.0)
    for k, name in enumerate(names):
        solver.set_qdd_safe(name, limits.braking[k])
        wrapper.set_velocity_limit(name, limits.speed[k])
    solver.set_kp(0.0)
    solver.set_kd(0.0)

    def rule(q, v, q_hat, v_hat):
        wanted = ((posture_target(q, q_hat, v_hat) - q) / DT - v) / DT
        for k, name in enumerate(names):
            wrapper.set_joint(name, q[k])
            wrapper.set_joint_velocity(name, v[k])
            task.set_joint(name, q[k], v[k], wanted[k])
        wrapper.update_kinematics()
        answer = solver.solve(False)
        if not answer.success:
            raise RuntimeError("placo: no answer")
        return v + DT * np.array(answer.qdd)[-len(names) :]

    return rule


def by_klimits(limits: Limits, jerk: np.ndarray):
    """klimits: the range of accelerations at the end of the period that keeps position, velocity, acceleration and jerk; the wish is cut
    to it. Within a period its acceleration is a line; what it was at the period's start is remembered from the answer before."""
    import klimits

    both = lambda x: np.stack([-x, x], axis=1).tolist()  # noqa: E731
    braking = np.minimum(limits.acceleration, limits.braking)
    ranges = klimits.PosVelJerkLimitation(
        time_step=DT, pos_limits=np.stack([limits.low, limits.high], axis=1).tolist(), vel_limits=both(limits.speed),
        acc_limits=both(braking), jerk_limits=both(jerk), normalize_acc_range=False, num_threads=1)  # fmt: skip
    before = {"a": np.zeros(len(limits.low)), "v": None}

    def rule(q, v, q_hat, v_hat):
        # A new episode starts at rest.
        a = before["a"] if before["v"] is not None and np.abs(before["v"] - v).max() < 1e-6 else np.zeros(len(q))
        wanted = 2 * (0.5 * ((q_hat - q) / DT + v_hat) - v) / DT - a
        allowed = np.array(ranges.calculate_valid_acceleration_range(q, v, a)[0])
        after = np.clip(wanted, allowed[:, 0], allowed[:, 1])
        before["a"], before["v"] = after, v + DT * (a + after) / 2
        return before["v"]

    return rule


def by_cbfpy(limits: Limits):
    """cbfpy: a barrier of relative degree 2 on positions and one of degree 1 on velocities, the acceleration as its control with its
    limits. The gains are braking over speed: then the positions' barrier never asks for more than the braking."""
    os.environ.setdefault("JAX_ENABLE_X64", "1")
    import jax.numpy as jnp
    from cbfpy import CBF, CBFConfig

    n = len(limits.low)
    gain = np.tile(limits.braking / limits.speed, 2)

    class Joints(CBFConfig):
        def __init__(self):
            super().__init__(n=2 * n, m=n, u_min=-limits.acceleration, u_max=limits.acceleration, relax_qp=False, solver_tol=1e-10)

        def f(self, z):
            return jnp.concatenate([z[n:], jnp.zeros(n)])

        def g(self, z):
            return jnp.concatenate([jnp.zeros((n, n)), jnp.eye(n)])

        def h_2(self, z):
            return jnp.concatenate([limits.high - z[:n], z[:n] - limits.low])

        def h_1(self, z):
            return jnp.concatenate([limits.speed - z[n:], z[n:] + limits.speed])

        def alpha(self, h):
            # First the barriers of velocity, then those of position; in a period a velocity may come up to its limit.
            return jnp.concatenate([h[: 2 * n] / DT, gain * h[2 * n :]])

        def alpha_2(self, h_2):
            return gain * h_2

    barrier = CBF.from_config(Joints())

    def rule(q, v, q_hat, v_hat):
        wanted = ((posture_target(q, q_hat, v_hat) - q) / DT - v) / DT
        return v + DT * np.asarray(barrier.safety_filter(np.concatenate([q, v]), wanted))

    rule((limits.low + limits.high) / 2, np.zeros(n), (limits.low + limits.high) / 2, np.zeros(n))
    return rule


class Remote:
    """A rule in another Python. `elapsed` is what its last answer took there [ns]."""

    def __init__(self, python: str, robot: str, name: str):
        self.process = subprocess.Popen([python, __file__, robot, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.elapsed = 0

    def __call__(self, *state):
        pickle.dump(state, self.process.stdin)
        self.process.stdin.flush()
        answer, self.elapsed = pickle.load(self.process.stdout)
        if answer is None:
            raise RuntimeError("no answer")
        return answer


def plant(robot: str) -> mujoco.MjModel:
    """MuJoCo at 1 kHz, Euler, without joint stops, contacts or clamps on motor forces."""
    model = mujoco.MjModel.from_xml_string(re.sub(r' (lower|upper)="[^"]*"', "", text(robot)))
    model.opt.timestep = DT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return model


def rules(robot: str, solver: str = "quadprog") -> dict:
    """How each rule is made, by name."""
    limits = arm(robot)[1]
    made = {
        "NEARL, certified braking": lambda: ours(robot, limits),
        "NEARL, stored brake": lambda: ours(robot, limits, "stored"),
        "pink, braking bound": lambda: by_pink(arm(robot)[0], limits, limits.acceleration, solver),
        "pink, braking bound, slow": lambda: by_pink(arm(robot)[0], limits, limits.braking, solver),
        "mink": lambda: by_mink(robot, limits, solver),
        "tsid": lambda: by_tsid(arm(robot)[0], limits),
        "placo": lambda: by_placo(robot, limits) if OTHER_PYTHON is None else Remote(OTHER_PYTHON, robot, "placo"),
        "klimits": lambda: by_klimits(limits, 100 * limits.acceleration),
        "cbfpy": lambda: by_cbfpy(limits),
        "ros2_control, saturation": lambda: by_saturation_limiter(limits),
        "ros2_control, range": lambda: by_range_limiter(limits),
    }
    return made


def make(robot: str, name: str):
    """The rule of that name, without what its package prints while it is made."""
    with redirect_stdout(io.StringIO()):
        return rules(robot)[name]()


def serve(robot: str, name: str) -> None:
    """Answer on standard output what comes on standard input: the other end of `Remote`."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    os.environ.pop("PLACO_PYTHON", None)
    rule = rules(robot)[name]()
    while True:
        try:
            state = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        begin = time.perf_counter_ns()
        try:
            answer = rule(*state)
        except Exception:  # whatever a package raises when it has no answer
            answer = None
        pickle.dump((answer, time.perf_counter_ns() - begin), out)
        out.flush()


if __name__ == "__main__":
    OTHER_PYTHON = None
    serve(sys.argv[1], sys.argv[2])
