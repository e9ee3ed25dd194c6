"""Arms that are drawn at random, their tasks, and what attacks them."""

import re
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

import nearl

SPEED, ACCELERATION = 2.0, 10.0


def arm(rng: np.random.Generator, timestep: float, integrator: str) -> tuple[str, np.ndarray]:
    """A chain of 2 to 6 hinges with stops of any stiffness, and their ranges."""
    n = int(rng.integers(2, 7))
    ranges = np.stack([-rng.uniform(0.3, 1.5, n), rng.uniform(0.3, 1.5, n)], axis=1).round(3)
    bodies, motors = "", ""
    for i, (low, high) in enumerate(ranges):
        axis = ["1 0 0", "0 1 0", "0 0 1"][rng.integers(3)]
        stop = ["", 'solreflimit="0.005 1"', 'solreflimit="-10000 -100"'][rng.integers(3)]
        at, length = 0.0 if i == 0 else rng.uniform(0.1, 0.3), rng.uniform(0.1, 0.3)
        bodies += (
            f'<body name="b{i}" pos="{at} 0 0"><joint name="j{i}" axis="{axis}" range="{low} {high}" armature="{rng.choice([0, 0.01])}" '
            f'damping="{rng.choice([0, 0.5])}" {stop}/>'
            f'<geom type="capsule" size="0.03" fromto="0 0 0 {length} 0 0.02" contype="0" conaffinity="0"/>'
        )
        motors += f'<motor name="m{i}" joint="j{i}" ctrlrange="{-300 - 100 * (i % 2)} 300"/>'
    text = (
        f'<mujoco><compiler angle="radian"/><option timestep="{timestep}" integrator="{integrator}"/>'
        f"<worldbody>{bodies}{'</body>' * n}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    return text, ranges


def with_drives(text: str, ranges: np.ndarray, rng: np.random.Generator, speeds: list[float], more: float = 1.0) -> tuple[str, str]:
    """The arm with drives of targets in place of its motors, whose joints would swing at one of these `speeds` [rad/s] alone, and `[command]`. They damp
    `more` than a tenth to all of what it takes to creep."""
    model = mujoco.MjModel.from_xml_string(text)
    data, n = mujoco.MjData(model), len(ranges)
    w, share = rng.choice(speeds, n), more * rng.choice([0.1, 0.5, 1.0], n)
    inertia = np.full(n, np.inf)
    for _ in range(20):
        data.qpos[:] = rng.uniform(ranges[:, 0], ranges[:, 1])
        mujoco.mj_forward(model, data)
        mass = np.zeros((n, n))
        mujoco.mj_fullM(model, data, mass)
        inertia = np.minimum(inertia, 1.0 / np.diag(np.linalg.inv(mass)))
    stiffness, damping = (w * w * inertia).round(4), (2.0 * share * w * inertia).round(5)
    for i in range(n):
        drive = f'<position name="m{i}" joint="j{i}" kp="{stiffness[i]}" kv="{damping[i]}" ctrlrange="-1e5 1e5" forcerange="-300 300"/>'
        text = re.sub(rf'<motor name="m{i}"[^>]*/>', drive, text)
    gains = [", ".join(f"j{i} = {gain}" for i, gain in enumerate(gains)) for gains in (stiffness, damping)]
    return text, f'interface = "pd"\nstiffness = {{ {gains[0]} }}\ndamping = {{ {gains[1]} }}'


def with_weak_motors(text: str, ranges: np.ndarray, share: float) -> str:
    """The arm with drives whose largest force is this share of what it takes to accelerate all joints at their limits in the worst of some hundred places."""
    model = mujoco.MjModel.from_xml_string(text)
    data, n, rng = mujoco.MjData(model), len(ranges), np.random.default_rng(1)
    most, mass = np.zeros(n), np.zeros((n, n))
    for _ in range(300):
        data.qpos[:], data.qvel[:] = rng.uniform(ranges[:, 0], ranges[:, 1]), rng.uniform(-SPEED, SPEED, n)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        most = np.maximum(most, np.abs(data.qfrc_bias - data.qfrc_passive) + ACCELERATION * np.abs(mass).sum(axis=1))
    for i, force in enumerate(share * most):
        text = re.sub(rf'(name="m{i}"[^>]*forcerange=)"[^"]*"', rf'\1"{-force:.4f} {force:.4f}"', text)
    return text


def within_ranges(text: str, ranges: np.ndarray) -> str:
    """The arm whose targets end where its joints do."""
    for i, (low, high) in enumerate(ranges):
        text = re.sub(rf'(<position name="m{i}"[^>]*)ctrlrange="[^"]*"', rf'\1ctrlrange="{low} {high}"', text)
    return text


def task(folder: Path, n: int, dt: float, sim_dt: float, margin: float = 0.0, command: str = 'interface = "effort"', jerk: float = np.inf) -> Path:
    """A task whose guard knows the arm; a `jerk` [rad/s³] that is not infinite is hard."""
    joints = [f"j{i}" for i in range(n)]
    seen = [f"{letter}.{joint}" for letter in "qv" for joint in joints]
    file = folder / "arm.toml"
    file.write_text(f"""name = "arm"
[model]
mjcf = "arm.xml"
[time]
dt = {dt}
sim_dt = {sim_dt}
max_episode_steps = 100000
[command]
{command}
[state]
controllable = {joints}
observation = {seen}
[reward]
still = "1.0"
[idm]
kind = "pinocchio"
[constraints]
position = {{ margin = {margin} }}
velocity = {{ limit = {SPEED} }}
acceleration = {{ limit = {ACCELERATION} }}
torque = {{ scale = 1.0 }}
{f"jerk = {{ limit = {jerk}, hard = true }}" if np.isfinite(jerk) else ""}
""")
    return file


def attack(
    folder: Path,
    text: str,
    steps: int,
    rng: np.random.Generator,
    accelerations: float | np.ndarray = ACCELERATION,
    far: float = 300.0,
    ends: str = "position",
    near: float = 1e-3,
    jerk: float = np.inf,
) -> None:
    """Pushes onto the limits of the task in `folder`, and steps the simulator beside it, whose joints keep to their ranges, speeds, accelerations and `jerk`.
    Some joint must come `near` the end of its range of positions [rad], or some drive to that of its targets where `ends` says so."""
    envs = nearl.make_vec(folder / "arm.toml", 1, constraints="task", actions="guarded")
    model = mujoco.MjModel.from_xml_string(text)
    data, dt, n = mujoco.MjData(model), model.opt.timestep * steps, model.nv
    obs, _ = envs.reset(seed=0)
    data.qpos[:], data.qvel[:] = obs[0, :n], obs[0, n:]
    low, high = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.inf, np.inf]).T
    # what a joint keeps of its range for a brake that leads further
    push, touched, near = np.zeros(n), 0, near + accelerations * dt * dt / 4
    last = np.zeros(n)
    for tick in range(800):
        if tick % 25 == 0:
            push = rng.uniform(-far, far, n)
        _, _, _, _, info = envs.step(push[None])
        before = data.qvel.copy()
        data.ctrl[:] = info["executed"][0]
        for _ in range(steps):
            mujoco.mj_step(model, data)
            assert (data.qpos >= low).all() and (data.qpos <= high).all(), f"tick {tick}, within it: {data.qpos}"
        assert np.abs(data.qvel).max() <= SPEED * (1 + 1e-9), f"tick {tick}: {data.qvel}"
        assert (np.abs(data.qvel - before) / dt <= accelerations + 1e-7).all(), f"tick {tick}: {data.qvel - before}"
        acceleration = (data.qvel - before) / dt
        assert np.abs(acceleration - last).max() <= jerk * dt + 1e-7, f"tick {tick}: {acceleration} after {last}"
        last = acceleration
        room = np.minimum(data.qpos - low, high - data.qpos) - near
        if ends == "target":
            room = np.minimum(data.ctrl - model.actuator_ctrlrange[:, 0], model.actuator_ctrlrange[:, 1] - data.ctrl) - 1e-6
        touched += int((room < 0).any())
    assert touched > 10, f"nothing came to the end of its range of {ends}s"


def pushed(envs: nearl.VecEnv, dt: float, seed: int, ticks: int) -> Iterator[tuple[int, np.ndarray, np.ndarray, dict]]:
    """Pushes two joints onto their limits, another way every hundred ticks: tick, observation, mean accelerations and info of each."""
    obs, _ = envs.reset(seed=0)
    rng, before = np.random.default_rng(seed), obs[0, 2:].copy()
    for tick in range(ticks):
        if tick % 100 == 0:
            push = rng.uniform(-2, 2, 2)
        obs, *_, info = envs.step(push[None])
        yield tick, obs, np.abs(obs[0, 2:] - before) / dt, info
        before = obs[0, 2:].copy()
