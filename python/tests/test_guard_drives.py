"""Drives behind a guard: what holds their forces, and what is told of those that it does not hold."""

import re
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from unknown_arms import task

import nearl

DRIVEN = """<mujoco><compiler angle="radian"/><option timestep="0.002" {option}/><worldbody>
<body><joint name="a" axis="0 1 0" range="-6 6" damping="0.2"/><geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="1"/>
<body pos="0.3 0 0"><joint name="b" axis="0 1 0" range="-6 6" damping="0.2"/><geom type="capsule" size="0.03" fromto="0 0 0 0.2 0 0" mass="0.5"/>
</body></body></worldbody><actuator>{actuators}</actuator>{more}</mujoco>"""
SERVOS = "".join(f'<position name="{j}" joint="{j}" kp="40" kv="2" forcerange="-8 8" ctrlrange="-20 20" group="1"/>' for j in "ab")


def drives(folder: Path, constraints: str, idm: str, option: str = "", more: str = "") -> Path:
    (folder / "arm.xml").write_text(DRIVEN.format(option=option, actuators=SERVOS, more=more))
    file = folder / "arm.toml"
    file.write_text(f"""name = "arm"
[model]
mjcf = "arm.xml"
[time]
dt = 0.002
sim_dt = 0.002
[command]
interface = "pd"
stiffness = 40.0
damping = 2.0
[state]
controllable = ["a", "b"]
[reward]
still = "1.0"
[idm]
kind = "{idm}"
[constraints]
{constraints}
""")
    return file


@pytest.mark.parametrize("idm", ["learned", "pinocchio"])
@pytest.mark.parametrize("rate", ["limit = 100.0", "limit = [100.0, 100.0]", "limit = 5000.0, margin = 4900.0", "limit = { a = 100.0, b = 100.0 }"])
def test_the_guard_of_drives_holds_their_forces_and_rates(tmp_path: Path, idm: str, rate: str) -> None:
    """By MuJoCo's own actuator forces, of targets that jump from end to end."""
    text = f'guard = "drive"\ntorque = {{ scale = 0.5 }}\ntorque_rate = {{ {rate} }}\nacceleration = {{ limit = 20.0 }}'
    file = drives(tmp_path, text, idm)
    envs = nearl.make_vec(file, 1, constraints="task", actions="guarded")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    data = mujoco.MjData(model)
    envs.reset(seed=0)
    before = None
    for tick in range(300):
        data.qpos[:], data.qvel[:] = envs.native.qpos[0], envs.native.qvel[0]
        *_, info = envs.step(np.array([[2.0, -2.0]]) * (1 if tick // 7 % 2 else -1))
        data.ctrl[:] = info["executed"][0]
        mujoco.mj_forward(model, data)
        force = data.actuator_force.copy()
        assert np.abs(force).max() <= 0.5 * 8.0 + 1e-9, force
        if before is not None:
            assert np.abs(force - before).max() <= 100.0 * 0.002 + 1e-9, (tick, force, before)
        before = force


@pytest.mark.parametrize(("guard", "keeps"), [("true", True), ('"simulator"', False)])
def test_guarded_actions_are_guarded_as_the_task_says(tmp_path: Path, guard: str, keeps: bool) -> None:
    """The simulator's guard keeps positions and velocities alone."""
    text = f"guard = {guard}\nposition = {{}}\nvelocity = {{ limit = 2.0 }}\nacceleration = {{ limit = 5.0 }}\ntorque = {{ scale = 1.0 }}"
    envs = nearl.make_vec(drives(tmp_path, text, "pinocchio"), 1, constraints="task", actions="guarded")
    envs.reset(seed=0)
    rng, most = np.random.default_rng(0), 0.0
    for tick in range(300):
        before = envs.native.qvel[0].copy()
        if tick % 20 == 0:
            push = rng.uniform(-3, 3, 2)
        envs.step(push[None])
        most = max(most, np.abs(envs.native.qvel[0] - before).max() / 0.002)
    assert (most <= 5.0 + 1e-6) == keeps, most


@pytest.mark.parametrize(("ends", "told"), [("-1 1", True), ("-20 20", False)])
def test_targets_that_end_before_the_guard_of_drives_can_hold_a_force_are_told(
    tmp_path: Path, recwarn: pytest.WarningsRecorder, ends: str, told: bool
) -> None:
    file = drives(tmp_path, 'guard = "drive"\ntorque = { scale = 0.5 }', "learned")
    arm = tmp_path / "arm.xml"
    arm.write_text(arm.read_text().replace('ctrlrange="-20 20"', f'ctrlrange="{ends}"'))
    nearl.make_vec(file, 1, constraints="task", actions="guarded")
    assert any("limits on torque are not promised where they are: 'a'" in str(warning.message) for warning in recwarn) == told


def test_drives_whose_damping_shakes_a_joint_apart_within_a_period_are_told(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    """25 N·m·s/rad on some 0.03 kg m², in steps of 5 ms."""
    for integrator, told in (("Euler", True), ("implicitfast", False)):
        text = DRIVEN.format(option=f'integrator="{integrator}"', actuators=SERVOS.replace('kv="2"', 'kv="25"'), more="")
        (tmp_path / "arm.xml").write_text(text.replace('timestep="0.002"', 'timestep="0.005"'))
        file = task(tmp_path, 2, 0.01, 0.005, command='interface = "pd"\nstiffness = 40.0\ndamping = 25.0')
        file.write_text(file.read_text().replace("j0", "a").replace("j1", "b"))
        recwarn.clear()
        nearl.make_vec(file, 1, constraints="task", actions="guarded")
        assert any("which shakes them apart" in str(warning.message) for warning in recwarn) == told, integrator


def test_what_the_limits_do_not_reckon_with_is_told_where_an_environment_is_made(tmp_path: Path) -> None:
    text = "velocity = { limit = 100.0 }\nacceleration = { limit = 20.0 }\ntorque = { scale = 1.0 }"
    tendon = '<tendon><fixed name="t" stiffness="5"><joint joint="a" coef="1"/></fixed></tendon>'
    with pytest.warns(UserWarning) as told:
        nearl.make_vec(drives(tmp_path, text, "pinocchio", more=tendon), 1, constraints="task", actions="guarded")
    said = " ".join(str(warning.message) for warning in told)
    assert "tendons are not modelled" in said and "'a' is 100 rad/s" in said


@pytest.mark.parametrize(
    ("drive", "words"),
    [
        ('position kp="40" kv="2" gear="2"', r"\(actuator 'a' has gear 2; with gear 1 its gains are 2² times as much"),
        ('position kp="40" kv="2" timeconst="0.1"', r"\(actuator 'a' has dynamics of its own\)"),
        ('general biastype="affine" gainprm="40" biasprm="0 -30 -2"', r"\(actuator 'a' pushes with 40 times what it is sent and -30 times the position"),
    ],
)
def test_drives_that_are_no_plain_ones_are_refused_by_what_they_are(tmp_path: Path, drive: str, words: str) -> None:
    text = "velocity = { limit = 2.0 }\nacceleration = { limit = 20.0 }\ntorque = { scale = 1.0 }"
    file = drives(tmp_path, text, "pinocchio")
    arm = tmp_path / "arm.xml"
    arm.write_text(re.sub(r'<position name="a"[^>]*/>', f'<{drive} name="a" joint="a" ctrlrange="-9 9" forcerange="-8 8"/>', arm.read_text()))
    with pytest.raises(ValueError, match=words):
        nearl.make_vec(file, 1, constraints="task", actions="guarded")


def test_actuators_that_are_switched_off_are_refused_by_name(tmp_path: Path) -> None:
    text = "velocity = { limit = 2.0 }\nacceleration = { limit = 20.0 }\ntorque = { scale = 1.0 }"
    file = drives(tmp_path, text, "pinocchio", option='actuatorgroupdisable="1"')
    with pytest.raises(ValueError, match="'a' is switched off with its group 1"):
        nearl.make_vec(file, 1, constraints="task", actions="guarded")


def test_an_inertia_that_is_negative_about_some_axis_is_refused() -> None:
    text = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/>
        <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="1" ixz="0" iyz="0"/></inertial></link>
        <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="1 -1 0"/>
        <limit lower="-1" upper="1" effort="5" velocity="2"/></joint></robot>"""
    with pytest.raises(ValueError, match="inertia of body 'arm' is negative about some axis"):
        nearl.Model.from_urdf_text(text)


def test_targets_that_no_torque_limit_holds_to_the_motors_are_told(tmp_path: Path) -> None:
    """Of two weak motors: the target keeps 50 rad/s², and the arm does not."""
    text = "velocity = { limit = 2.0 }\nacceleration = { limit = 50.0 }"
    file = drives(tmp_path, text, "pinocchio")
    arm = (tmp_path / "arm.xml").read_text()
    motors = "".join(f'<motor name="{j}" joint="{j}" ctrlrange="-1 1"/>' for j in "ab")
    (tmp_path / "arm.xml").write_text(arm.replace(SERVOS, motors))
    file.write_text(file.read_text().replace('interface = "pd"\nstiffness = 40.0\ndamping = 2.0', 'interface = "effort"'))
    with pytest.warns(UserWarning, match="without a torque limit a target may ask for more than the motors of 'a', 'b' give"):
        nearl.make_vec(file, 1, constraints="task")


@pytest.mark.parametrize(("force", "told"), [(8.0, False), (0.2, True)])
def test_drives_whose_force_swings_within_a_period_are_told(tmp_path: Path, force: float, told: bool) -> None:
    """40 N m/rad at 2 rad/s make 0.16 N m less at the end of two steps of 2 ms than at their start."""
    file = drives(tmp_path, "guard = true\nposition = {}\nvelocity = { limit = 2.0 }\nacceleration = { limit = 5.0 }\ntorque = {}", "pinocchio")
    file.write_text(file.read_text().replace("dt = 0.002\nsim_dt", "dt = 0.004\nsim_dt"))
    (tmp_path / "arm.xml").write_text((tmp_path / "arm.xml").read_text().replace("-8 8", f"-{force} {force}"))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        nearl.make_vec(file, 1, constraints="task", actions="guarded")
    said = "\n".join(str(warning.message) for warning in found)
    assert ("at their speed limits the drives of 'a' (0.160 of its 0.200 N m or N), 'b'" in said) == told, said


def test_what_may_touch_and_an_episode_that_begins_outside_are_told(tmp_path: Path) -> None:
    """A table in reach threw an arm to 310 rad/s² where 10 were allowed, and no word was said."""

    def told(text: str, reset: str = "") -> str:
        file = drives(tmp_path, "guard = true\nposition = {}\nvelocity = { limit = 2.0 }\nacceleration = { limit = 5.0 }\ntorque = {}", "pinocchio")
        (tmp_path / "arm.xml").write_text(text)
        file.write_text(file.read_text() + reset)
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            nearl.make_vec(file, 1, constraints="task", actions="guarded")
        return "\n".join(str(warning.message) for warning in found)

    joined = DRIVEN.format(option="", actuators=SERVOS, more="")
    alone = joined.replace("<geom ", '<geom contype="0" conaffinity="0" ')
    floor = '<worldbody><geom name="floor" type="plane" size="9 9 1" pos="0 0 -9"/>'
    assert "3 geoms may touch something, and limits on the motion know of no contact" in told(joined.replace("<worldbody>", floor))
    # Bodies that a joint connects, and a floor beside geoms that touch nothing.
    assert "touch" not in told(joined) + told(alone) + told(alone.replace("<worldbody>", floor))
    table = '<worldbody><geom name="t" size="1" pos="9 0 0" contype="0" conaffinity="0"/>'
    pair = alone.replace("<geom contype", '<geom name="l" contype', 1).replace("<worldbody>", table)
    assert "2 geoms may touch" in told(pair.replace("</mujoco>", '<contact><pair geom1="t" geom2="l"/></contact></mujoco>'))
    said = told(alone, "[reset]\nq = { a = 6.5 }\nv = { b = 3.0 }\n")
    assert "64 of 64 episodes begin with joint 'a' outside its limits, furthest at 6.5000 rad or m where -5.999999 to 5.999999" in said, said
    assert "64 of 64 episodes begin with joint 'b' outside its limits, furthest at 3.0000 rad/s or m/s" in said, said
    # From 1.9 rad/s by 5 rad/s² it takes 0.361 rad more to stand.
    said = told(alone, "[reset]\nq = { a = 5.9 }\nv = { a = 1.9 }\n")
    assert "joint 'a' too fast to stop before the end of its range, furthest on to 6.2610 rad or m where -5.999999 to 5.999999" in said, said
    assert "outside its limits" not in said and "too fast" not in told(alone, "[reset]\nq = { a = 5.5 }\nv = { a = 1.9 }\n"), said


def test_periods_that_begin_outside_are_counted(tmp_path: Path) -> None:
    file = drives(tmp_path, "guard = true\nposition = {}\nvelocity = { limit = 2.0 }\nacceleration = { limit = 5.0 }\ntorque = {}", "pinocchio")
    env = nearl.ProjectedEnv(file, actions="guarded")
    for q, v, there in (5.5, 1.0, False), (5.9, 1.9, True), (6.1, 0.0, True):
        env.reset(seed=0)
        env.unwrapped._native.set_state(0, [q, 0.0], [v, 0.0])
        info = env.step(np.zeros(env.action_space.shape))[4]
        assert (info["recovering"] > 0) == there and info["target_violations"] == 0, (q, v, info)
