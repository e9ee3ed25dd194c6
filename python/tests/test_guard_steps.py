"""Guarded actions on arms that nobody has seen, pushed onto their limits: every limit holds in the simulator at any number of physics steps."""

import re
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from unknown_arms import ACCELERATION, SPEED, arm, attack, pushed, task, with_drives, with_weak_motors, within_ranges

import nearl


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


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4, 5])
def test_targets_are_kept_within_the_range_of_their_drives(tmp_path: Path, seed: int, integrator: str, recwarn: pytest.WarningsRecorder) -> None:
    """A target that is cut at the `ctrlrange` of its drive brakes the joint harder than its limit: most robot files end it where the joint ends."""
    rng = np.random.default_rng(seed)
    text, ranges = arm(rng, 0.005, integrator)
    text, command = with_drives(text, ranges, rng, [30.0, 80.0], 3.0)
    text = within_ranges(text, ranges)
    (tmp_path / "arm.xml").write_text(text)
    task(tmp_path, len(ranges), 0.005, 0.005, command=command)
    attack(tmp_path, text, 1, rng, far=3.0, ends="target")
    assert not any("cut at its range" in str(warning.message) for warning in recwarn)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("dt", [0.005, 0.01])
@pytest.mark.parametrize("seed", [1, 3, 4, 6, 8])
def test_drives_held_on_their_targets_stay_within_their_limits(tmp_path: Path, seed: int, dt: float, integrator: str) -> None:
    """`implicitfast` takes the damping of the drives implicitly."""
    rng = np.random.default_rng(seed)
    steps = int(rng.choice([2, 5, 10]))
    text, ranges = arm(rng, dt / steps, integrator)
    text, command = with_drives(text, ranges, rng, [10.0, 30.0, 80.0])
    (tmp_path / "arm.xml").write_text(text)
    task(tmp_path, len(ranges), dt, dt / steps, command=command)
    attack(tmp_path, text, steps, rng, far=3.0)


@pytest.mark.parametrize("dt", [0.005, 0.01])
@pytest.mark.parametrize("jerk", [100.0, 1000.0])
@pytest.mark.parametrize("seed", [1, 2, 3, 5, 7])
def test_hard_jerk_is_kept_over_several_steps(tmp_path: Path, seed: int, jerk: float, dt: float) -> None:
    """A joint was not slowed down for where the steps led it: it touched its stop, and left its jerk and its acceleration."""
    rng = np.random.default_rng(seed)
    steps = int(rng.choice([2, 5, 10]))
    text, ranges = arm(rng, dt / steps, "Euler")
    (tmp_path / "arm.xml").write_text(text)
    task(tmp_path, len(ranges), dt, dt / steps, jerk=jerk)
    attack(tmp_path, text, steps, rng, near=0.02, jerk=jerk)


@pytest.mark.parametrize(
    ("dt", "integrator", "seed"), [(0.005, "Euler", 57), (0.005, "Euler", 59), (0.005, "implicitfast", 15), (0.01, "Euler", 57), (0.01, "implicitfast", 15)]
)
def test_targets_over_several_steps_are_kept_within_the_range_of_their_drives(tmp_path: Path, dt: float, integrator: str, seed: int) -> None:
    """The force at the start of a period was reckoned with for a constant acceleration: targets were cut, and 10 rad/s² left."""
    rng = np.random.default_rng(seed)
    steps = int(rng.choice([2, 5, 10]))
    text, ranges = arm(rng, dt / steps, integrator)
    text, command = with_drives(text, ranges, rng, [30.0, 80.0])
    text = within_ranges(text, ranges)
    (tmp_path / "arm.xml").write_text(text)
    task(tmp_path, len(ranges), dt, dt / steps, command=command)
    attack(tmp_path, text, steps, rng, far=3.0, near=0.05)


@pytest.mark.parametrize(("dt", "share", "seed"), [(0.005, 1.05, 20), (0.005, 2.0, 22), (0.01, 1.05, 12), (0.01, 1.05, 20)])
def test_drives_whose_force_swings_within_a_period_can_brake(tmp_path: Path, dt: float, share: float, seed: int) -> None:
    """A drive whose joint comes near its target within a period gives more of its force at the start and at the end than on average: nothing was left to
    brake with, and 10 rad/s² were left by up to 100."""
    rng = np.random.default_rng(seed)
    steps = int(rng.choice([2, 5, 10]))
    text, ranges = arm(rng, dt / steps, "Euler")
    text, command = with_drives(text, ranges, rng, [30.0, 80.0])
    text = with_weak_motors(text, ranges, share)
    (tmp_path / "arm.xml").write_text(text)
    task(tmp_path, len(ranges), dt, dt / steps, command=command)
    attack(tmp_path, text, steps, rng, far=3.0, near=0.05)


@pytest.mark.parametrize("friction", [0.0, 1.0])
@pytest.mark.parametrize("seed", [1, 3, 6])
def test_strong_dampers_of_drives_are_taken_implicitly(tmp_path: Path, seed: int, friction: float) -> None:
    """Drives that damp ten times as much as it takes to creep, one step a period, with forces that come to their ends: there MuJoCo's step is another."""
    rng = np.random.default_rng(seed)
    text, ranges = arm(rng, 0.005, "implicitfast")
    text, command = with_drives(text, ranges, rng, [30.0, 80.0], 10.0)
    text = text.replace('forcerange="-300 300"', 'forcerange="-60 60"').replace("<joint ", f'<joint frictionloss="{friction}" ')
    (tmp_path / "arm.xml").write_text(text)
    task(tmp_path, len(ranges), 0.005, 0.005, command=command)
    attack(tmp_path, text, 1, rng, far=3.0)


HAND = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="j0" axis="0 1 0" range="-1 1"/><geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="2" contype="0" conaffinity="0"/>
<body pos="0.3 0 0"><joint name="j1" axis="1 1 0" range="-1 1" armature="0.05"/><inertial pos="0.1 0 0" mass="1" diaginertia=".01 .01 .01"/>
<body pos="0.2 0 0"><joint name="f0" type="slide" axis="0 1 0" range="-0.1 0.1"/><inertial pos="0 0 0" mass="0.02" diaginertia="1e-5 1e-5 1e-5"/></body>
<body pos="0.2 0 0"><joint name="f1" type="slide" axis="0 -1 0" range="-0.1 0.1"/><inertial pos="0 0 0" mass="0.02" diaginertia="1e-5 1e-5 1e-5"/></body>
</body></body></worldbody><tendon><fixed name="split"><joint joint="{across}" coef="0.5"/><joint joint="f1" coef="0.5"/></fixed></tendon>
<equality><joint joint1="f0" joint2="f1"/></equality><actuator>
<position name="j0" joint="j0" kp="4500" kv="450" ctrlrange="-1 1" forcerange="-87 87"/>
<position name="j1" joint="j1" kp="2000" kv="200" ctrlrange="-1 1" forcerange="-30 30"/>
<general tendon="split" gainprm="1" biastype="affine" biasprm="0 -100 -10" ctrlrange="-1 1" forcerange="-100 100"/></actuator></mujoco>"""
OF_HAND = 'interface = "pd"\nstiffness = { j0 = 4500, j1 = 2000 }\ndamping = { j0 = 450, j1 = 200 }'


def test_a_hand_that_a_tendon_closes_is_no_matter_of_the_arm_s_drives(tmp_path: Path) -> None:
    """The gains are those of a Panda and its hand. What the tendon damps is implicit too, and moves the fingers alone."""
    (tmp_path / "arm.xml").write_text(HAND.format(across="f0"))
    envs = nearl.make_vec(task(tmp_path, 2, 0.002, 0.002, command=OF_HAND), 1, constraints="task", actions="guarded")
    fastest = 0.0
    for tick, obs, accelerations, _ in pushed(envs, 0.002, 0, 2000):
        assert accelerations.max() <= ACCELERATION * 1.01, f"tick {tick}: {accelerations}"
        assert np.abs(obs[0, :2]).max() <= 1.0
        fastest = max(fastest, np.abs(obs[0, 2:]).max())
    assert 1.0 < fastest <= SPEED + 1e-3
    (tmp_path / "arm.xml").write_text(HAND.format(across="j1"))
    with pytest.raises(ValueError, match="dampers of tendons or actuators that act on more than a joint; take these out"):
        nearl.make_vec(tmp_path / "arm.toml", 1, constraints="task", actions="guarded")


@pytest.mark.parametrize("seed", [0, 1])
def test_a_force_at_its_end_throws_no_joint(tmp_path: Path, seed: int) -> None:
    """At the end of a forcerange MuJoCo's step is no longer implicit in the drive's damping: with fingers that the guard does not know, whose weight brings
    forces there, the arm had left 10 rad/s² by 31 and 36."""
    (tmp_path / "arm.xml").write_text(HAND.format(across="f0").replace('forcerange="-87 87"', 'forcerange="-15 15"'))
    file = task(tmp_path, 2, 0.002, 0.002, margin=0.003, command=OF_HAND)
    file.write_text(file.read_text() + 'braking = "stored"\n')
    envs = nearl.make_vec(file, 1, constraints="task", actions="guarded")
    most = 0.0
    for tick, obs, accelerations, info in pushed(envs, 0.002, seed, 3000):
        assert accelerations.max() <= ACCELERATION + 1.0, f"tick {tick}: {accelerations}"
        assert np.abs(obs[0, 2:]).max() <= SPEED + 0.005, f"tick {tick}: {obs}"
        most = max(most, abs(4500 * (info["executed"][0][0] - obs[0, 0])))
    assert most > 15.0, "no force came to its end"


@pytest.mark.parametrize(("dt", "timestep", "seed"), [(0.002, 0.002, 0), (0.002, 0.002, 1), (0.005, 0.005, 0), (0.006, 0.002, 0)])
def test_fingers_that_are_left_alone_take_no_arm_off_its_limits(
    tmp_path: Path, recwarn: pytest.WarningsRecorder, dt: float, timestep: float, seed: int
) -> None:
    """An equation and a tendon hold them. Without a stored brake and reckoned with as loose, a Panda's own hand had thrown its arm off 10 rad/s² by 90."""
    (tmp_path / "arm.xml").write_text(HAND.format(across="f0").replace('forcerange="-87 87"', 'forcerange="-40 40"').replace('"0.002"', f'"{timestep}"'))
    envs = nearl.make_vec(task(tmp_path, 2, dt, timestep, margin=0.003, command=OF_HAND), 1, constraints="task", actions="guarded")
    told = "\n".join(str(warning.message) for warning in recwarn)
    assert "a brake is stored as if 'f0', 'f1', which are not controllable, did not move" in told, told
    assert "with joints that nothing drives" not in told, told
    held_back = 0
    for tick, obs, accelerations, _ in pushed(envs, dt, seed, 2000):
        assert accelerations.max() <= ACCELERATION + 0.15, f"tick {tick}: {accelerations}"
        assert np.abs(obs[0, 2:]).max() <= SPEED + 1e-3 and np.abs(obs[0, :2]).max() <= 1.0, f"tick {tick}: {obs}"
        held_back += int(accelerations.max() > 0.9 * ACCELERATION)
    assert held_back > 50


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_brake_is_seen_to_cut_a_target_between_the_ticks_looked_at(tmp_path: Path, seed: int) -> None:
    """A target rises towards the end of its range for a few ticks of a brake while the force stays the same: hidden below the force, it was cut, and the arm
    left 10 rad/s² by 37."""
    text = re.sub(r'<body pos="0.2 0 0">.*?</body>\n', "", HAND.format(across="f0"))
    text = re.sub(r"<tendon>.*</equality>", "", text, flags=re.DOTALL).replace('forcerange="-87 87"', 'forcerange="-15 15"')
    (tmp_path / "arm.xml").write_text(re.sub(r"<general[^>]*/>", "", text).replace('"0.002"', '"0.005"'))
    envs = nearl.make_vec(task(tmp_path, 2, 0.005, 0.005, margin=0.003, command=OF_HAND), 1, constraints="task", actions="guarded")
    highest = 0.0
    for tick, _, accelerations, info in pushed(envs, 0.005, seed, 2000):
        assert accelerations.max() <= ACCELERATION + 1e-8, f"tick {tick}: {accelerations}"
        highest = max(highest, np.abs(info["executed"][0]).max())
    assert 0.99 < highest <= 1.0, highest


@pytest.mark.parametrize(("mass", "says"), [(0.02, "a brake is stored as if 'f0', 'f1'"), (2.0, "no brake is stored because 'f0', 'f1' are not controllable")])
def test_a_brake_is_stored_where_what_is_left_alone_is_light(tmp_path: Path, recwarn: pytest.WarningsRecorder, mass: float, says: str) -> None:
    (tmp_path / "arm.xml").write_text(HAND.format(across="f0").replace('mass="0.02"', f'mass="{mass}"'))
    nearl.make_vec(task(tmp_path, 2, 0.002, 0.002, command=OF_HAND), 1, constraints="task", actions="guarded")
    assert any(says in str(warning.message) for warning in recwarn), [str(warning.message) for warning in recwarn]


@pytest.mark.parametrize("seed", [2, 6, 7, 8, 12, 17])
def test_arms_stay_within_their_limits_over_long_periods(tmp_path: Path, seed: int) -> None:
    """A held force does not brake evenly over 20 ms: joints had come up to 1.1 mrad too far, touched their stops and left 10 rad/s² by 17."""
    rng = np.random.default_rng(seed)
    steps = int(rng.choice([2, 5, 10]))
    text, ranges = arm(rng, 0.02 / steps, "Euler")
    (tmp_path / "arm.xml").write_text(text)
    task(tmp_path, len(ranges), 0.02, 0.02 / steps)
    attack(tmp_path, text, steps, rng)


@pytest.mark.parametrize("steps", [12, 20, 40])
def test_a_gantry_touches_no_stop_in_the_middle_of_a_period(tmp_path: Path, steps: int) -> None:
    """A joint that turns round within a period ends it before its stop, but had been beyond it in between, and was thrown back."""
    text = """<mujoco><option timestep="0.002"/><worldbody>
    <body pos="0 0 1"><joint name="j0" type="slide" axis="1 0 0" range="-0.5 0.5"/><inertial pos="0 0 0" mass="5" diaginertia=".1 .1 .1"/>
     <body><joint name="j1" type="slide" axis="0 0 1" range="-0.3 0.3"/><inertial pos="0 0 0" mass="2" diaginertia=".01 .01 .01"/>
      <body><joint name="j2" type="hinge" axis="0 1 0" range="-115 115" armature="0.01"/><inertial pos="0 0 -.2" mass="1" diaginertia=".01 .01 .01"/>
       <body pos="0 0 -.4"><joint name="j3" type="hinge" axis="0 1 0" armature="0.005"/><inertial pos="0 0 -.1" mass=".5" diaginertia=".004 .004 .004"/>
       </body></body></body></body></worldbody>
    <actuator><motor joint="j0" ctrlrange="-300 300"/><motor joint="j1" ctrlrange="-300 300"/><motor joint="j2" ctrlrange="-300 300"/>
     <motor joint="j3" ctrlrange="-300 300"/></actuator></mujoco>"""
    (tmp_path / "arm.xml").write_text(text)
    file, most = task(tmp_path, 4, 0.002 * steps, 0.002), np.array([6.0, 6.0, 15.0, 20.0])
    by_joint = ", ".join(f"j{i} = {a}" for i, a in enumerate(most))
    file.write_text(file.read_text().replace(f"acceleration = {{ limit = {ACCELERATION}", f"acceleration = {{ limit = {{ {by_joint} }}"))
    attack(tmp_path, text, steps, np.random.default_rng(0), most)


def rubbing_arm(rng: np.random.Generator, timestep: float) -> tuple[str, int]:
    """A chain of 2 to 4 light hinges about any axes, of which half rub and half have dampers."""
    n = int(rng.integers(2, 5))
    bodies, motors, strong = "", "", rng.uniform(40, 150, n)
    for i in range(n):
        x, y, z = rng.normal(size=3)
        inertia = " ".join(map(str, rng.uniform(0.01, 0.012, 3)))
        friction, damping = rng.uniform(0.1, 2) * (rng.random() < 0.5), rng.uniform(0, 5) * (rng.random() < 0.5)
        bodies += (
            f'<body pos="{rng.uniform(-0.1, 0.1)} 0 {rng.uniform(0.1, 0.3)}"><joint name="j{i}" axis="{x} {y} {z}" range="-1 1" damping="{damping}" '
            f'frictionloss="{friction}"/><inertial pos="0 0.05 0.1" mass="{rng.uniform(0.3, 3)}" diaginertia="{inertia}"/>'
        )
        motors += f'<motor name="m{i}" joint="j{i}" ctrlrange="-{strong[i]} {strong[i]}"/>'
    text = (
        f'<mujoco><compiler angle="radian"/><option timestep="{timestep}" gravity="0 0 {-9.81 * (rng.random() < 0.5)}"/>'
        f"<worldbody>{bodies}{'</body>' * n}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    return text, n


@pytest.mark.parametrize("seed", [5, 7, 21, 41, 45, 55])
def test_joints_that_stick_and_slip_within_a_period_are_led_through_its_steps(tmp_path: Path, seed: int) -> None:
    """Dry friction bends how a velocity grows with the force: a search by slopes of a robot without it had ended at the motors' limits, 3900 rad/s² off."""
    rng = np.random.default_rng(seed)
    steps, timestep = int(rng.choice([2, 5])), float(rng.choice([0.001, 0.002, 0.004]))
    text, n = rubbing_arm(rng, timestep)
    (tmp_path / "arm.xml").write_text(text)
    dt = timestep * steps
    envs = nearl.make_vec(task(tmp_path, n, dt, timestep, margin=0.01), 1, constraints="task", actions="guarded")
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    obs, _ = envs.reset(seed=0)
    data.qpos[:], data.qvel[:] = obs[0, :n], obs[0, n:]
    push, pushed = np.zeros(n), 0
    for tick in range(700):
        if rng.random() < 0.05:
            push = rng.choice([-1, 1], n) * 10.0 ** rng.uniform(0, 4)
        *_, info = envs.step(push[None])
        before = data.qvel.copy()
        data.ctrl[:] = info["executed"][0]
        mujoco.mj_step(model, data, steps)
        accelerations = np.abs(data.qvel - before) / dt
        assert np.abs(data.qpos).max() <= 1.0, f"tick {tick}: {data.qpos}"
        assert np.abs(data.qvel).max() <= SPEED + 1e-6, f"tick {tick}: {data.qvel}"
        assert accelerations.max() <= ACCELERATION + 1e-3, f"tick {tick}: {accelerations}"
        pushed += int(accelerations.max() > 0.9 * ACCELERATION)
    assert pushed > 50, "nothing was held back"


JERK = "jerk = { limit = 500.0, hard = true }\n"


@pytest.mark.parametrize(("steps", "more"), [(1, ""), (1, 'braking = "stored"\n'), (4, JERK), (2, 'frame_speed = [{ frame = "b2", limit = 0.5 }]\n')])
@pytest.mark.parametrize("kilograms", [5.0, 20.0])
def test_an_arm_on_a_base_that_floats_moves_within_its_limits(tmp_path: Path, kilograms: float, steps: int, more: str) -> None:
    """The base was thought to be thrown about as by the action that was not taken, so that nothing but to stand still was left to the arm. Over several
    steps a tick that was projected once more for what they reach took the base for thrown about again, and counted targets outside."""
    arm = "".join(
        f'<body name="b{i}" pos="0 0 {0.3 if i == 0 else 0.4}"><joint name="j{i}" axis="{"0 1 0" if i % 2 == 0 else "1 0 0"}" range="-2 2" damping="0.3" '
        f'armature="0.01"/><geom type="capsule" size="0.03" fromto="0 0 0 0.02 0.03 0.4" mass="{mass}" contype="0" conaffinity="0"/>'
        for i, mass in enumerate([2.0, 1.2, 0.7])
    )
    motors = "".join(f'<motor name="m{i}" joint="j{i}" ctrlrange="-30 30"/>' for i in range(3))
    text = (
        f'<mujoco><compiler angle="radian"/><option timestep="{0.004 / steps}" gravity="0 0 0"/><worldbody><body name="base"><freejoint name="root"/>'
        f'<geom type="box" size="0.2 0.2 0.1" mass="{kilograms}" contype="0" conaffinity="0"/>{arm}</body></body></body></body></worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    (tmp_path / "arm.xml").write_text(text)
    file = task(tmp_path, 3, 0.004, 0.004 / steps)
    file.write_text(file.read_text().replace("[constraints]\n", f"[constraints]\nguard = true\n{more}"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        envs = nearl.make_vec(file, 1, constraints="task", actions="guarded")
    model = mujoco.MjModel.from_xml_string(text)
    data, rng, fastest = mujoco.MjData(model), np.random.default_rng(0), 0.0
    obs, _ = envs.reset(seed=0)
    data.qpos[7:], data.qvel[6:] = obs[0, :3], obs[0, 3:]
    for tick in range(600):
        if tick % 10 == 0:
            push = 30.0 * rng.choice([-1, 1], 3)
        *_, info = envs.step(push[None])
        before = data.qvel[6:].copy()
        data.ctrl[:] = info["executed"][0]
        mujoco.mj_step(model, data, steps)
        v, a = data.qvel[6:], (data.qvel[6:] - before) / 0.004
        assert info["target_violations"][0] == 0 and np.abs(data.qpos[7:]).max() <= 2.0, f"tick {tick}: {data.qpos} {info}"
        assert np.abs(v).max() <= SPEED * (1 + 1e-9) and np.abs(a).max() <= ACCELERATION + 1e-7, f"tick {tick}: {v} {a}"
        fastest = max(fastest, np.abs(v).max())
    assert fastest > 0.5 * SPEED, f"no joint came beyond {fastest} rad/s"
