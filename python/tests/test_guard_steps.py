"""Guarded actions on arms that nobody has seen, pushed onto their limits: every limit holds in the simulator at any number of physics steps."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

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


def task(folder: Path, n: int, dt: float, sim_dt: float) -> Path:
    """A task whose guard knows the arm."""
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
interface = "effort"
[state]
controllable = {joints}
observation = {seen}
[reward]
still = "1.0"
[idm]
kind = "pinocchio"
[constraints]
position = {{}}
velocity = {{ limit = {SPEED} }}
acceleration = {{ limit = {ACCELERATION} }}
torque = {{ scale = 1.0 }}
""")
    return file


@pytest.mark.parametrize("steps", [1, 2, 5])
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("seed", [2, 5, 6, 7])
def test_unknown_arms_stay_within_their_limits(tmp_path: Path, seed: int, integrator: str, steps: int) -> None:
    rng = np.random.default_rng(seed)
    dt = float(rng.choice([0.002, 0.005, 0.01] if steps == 1 else [0.002, 0.005]))
    text, ranges = arm(rng, dt / steps, integrator)
    (tmp_path / "arm.xml").write_text(text)
    n = len(ranges)
    envs = nearl.make_vec(task(tmp_path, n, dt, dt / steps), 1, constraints="task", actions="guarded")
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    obs, _ = envs.reset(seed=0)
    data.qpos[:], data.qvel[:] = obs[0, :n], obs[0, n:]
    push = np.zeros(n)
    touched = 0
    for tick in range(1200):
        if tick % 100 == 0:
            push = 300.0 * rng.choice([-1, 1], n) * (rng.random(n) < 0.8)
        obs, _, _, _, info = envs.step(push[None])
        before = data.qvel.copy()
        data.ctrl[:] = info["executed"][0]
        mujoco.mj_step(model, data, steps)
        assert np.array_equal(obs[0], np.concatenate([data.qpos, data.qvel]))
        assert (data.qpos >= ranges[:, 0]).all() and (data.qpos <= ranges[:, 1]).all(), f"tick {tick}: {data.qpos}"
        assert np.abs(data.qvel).max() <= SPEED * (1 + 1e-9), f"tick {tick}: {data.qvel}"
        accelerations = np.abs(data.qvel - before) / dt
        assert accelerations.max() <= ACCELERATION + 1e-7, f"tick {tick}: {accelerations}"
        touched += int((np.minimum(data.qpos - ranges[:, 0], ranges[:, 1] - data.qpos) < 1e-3).any())
    assert touched > 10, "no joint came to the end of its range"
