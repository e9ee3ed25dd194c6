"""Limits that move: hand arithmetic, and a payload against MuJoCo."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import ROBOTS
from test_dynamics import GYMNASIUM

import nearl

DT, A = 1e-3, 5.0


@pytest.fixture
def panda() -> nearl.Model:
    return nearl.Model.from_urdf(ROBOTS / "panda" / "panda.urdf")


def run(projector: nearl.Projector, q: np.ndarray, v: np.ndarray, wanted: np.ndarray, ticks: int):
    statuses = []
    for _ in range(ticks):
        target = projector.project(q, v, q + DT * wanted, wanted)
        assert (np.abs(target.v - v) <= A * DT + 1e-12).all()
        q, v = target.q, target.v
        statuses.append(target.status)
    return q, v, statuses


def test_a_slower_speed_is_reached_in_the_time_it_takes(panda: nearl.Model) -> None:
    limits = [nearl.PositionLimit(panda), nearl.VelocityLimit(panda, scale=0.5), nearl.AccelerationLimit(panda, A)]
    projector = nearl.Projector(panda, limits, DT)
    top = 0.5 * panda.velocity_limit
    wanted = np.zeros(7)
    wanted[0] = 9.0
    start = np.array([-2.5, 0, 0, -1.5, 0, 1.5, 0])
    q, v, _ = run(projector, start, np.zeros(7), wanted, 300)
    assert v[0] == pytest.approx(top[0])
    projector.move_limits(speed=0.4)
    ticks = int(np.ceil(0.6 * top[0] / (A * DT) - 1e-9))
    q, v, statuses = run(projector, q, v, wanted, ticks)
    assert set(statuses) == {"tightening"} and v[0] == pytest.approx(0.4 * top[0])
    q, v, statuses = run(projector, q, v, wanted, 5)
    assert "tightening" not in statuses and v[0] <= 0.4 * top[0] * (1 + 1e-12)
    held = projector.project(q, v, q + DT * wanted, wanted)
    assert ("panda_joint1", "velocity") in [(row["name"], row["kind"]) for row in held.active]
    batch = projector.project_batch(q[None], v[None], (q + DT * wanted)[None], wanted[None])
    assert batch.v[0, 0] == pytest.approx(0.4 * top[0])
    # In front of where it could stop it brakes, goes no further than v² / 2 A and one period, and comes back where it is led.
    behind, speed = q[0] - 0.01, v[0]
    projector.move_limits(upper={"panda_joint1": behind})
    rest, still, statuses = run(projector, q, v, wanted, 400)
    assert set(statuses) == {"tightening"} and still[0] == 0.0 and 0 < rest[0] - q[0] <= speed**2 / (2 * A) + DT * speed
    back, _, statuses = run(projector, rest, still, -wanted, 400)
    assert statuses[-1] != "tightening" and back[0] < behind
    projector.move_limits()
    _, v, statuses = run(projector, rest, still, wanted, 300)
    assert "tightening" not in statuses and v[0] == pytest.approx(top[0])


def test_what_cannot_be_moved_is_named(panda: nearl.Model) -> None:
    projector = nearl.Projector(panda, [nearl.VelocityLimit(panda, scale=0.5), nearl.AccelerationLimit(panda, A)], DT)
    for words, moved in {
        "velocity 2 rad/s or m/s of joint 'panda_joint2' is beyond the 1.08": {"velocity": {"panda_joint2": 2.0}},
        "speed.* above 0 and at most 1": {"speed": 0.0},
        "no limit frame is called 'hand'": {"frame": {"hand": 0.1}},
        "joint 'elbow', which the model does not have": {"upper": {"elbow": 0.1}},
    }.items():
        with pytest.raises(ValueError, match=words):
            projector.move_limits(**moved)
    of_another_kind: dict[str, dict[str, Any]] = {
        "frame: expected numbers by the name of a limit.*got float 0.1": {"frame": 0.1},
        "velocity: expected a number for all joints.*got str 'fast'": {"velocity": "fast"},
        "upper: expected a number for all joints.*got tuple": {"upper": ("a", "b")},
        "energy: expected a number in J; got str '1'": {"energy": "1"},
        "plane: expected by the name of a limit a normal and a point, as a pair.*got dict": {"plane": {"wall": {"normal": [0, 1, 0]}}},
        "body: expected by the name of an obstacle its position and roll": {"body": {"ball": [0.2, 0.5, 0.2]}},
    }
    for words, moved in of_another_kind.items():
        with pytest.raises(TypeError, match=words):
            projector.move_limits(**moved)
    projector.move_limits(frame=None, plane=None)


def test_a_payload_weighs_what_mujoco_says(rng: np.random.Generator) -> None:
    """A walker that carries a body on its thigh: MuJoCo adds the body, the model its inertia."""
    path = GYMNASIUM / "walker2d_v5.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    com, turn, diagonal = [0.1, -0.05, 0.2], np.array([0.9, 0.1, -0.3, 0.2]), [0.03, 0.02, 0.025]
    turn /= np.linalg.norm(turn)
    held = spec.body("thigh").add_body(name="load", mass=2.5, ipos=com, iquat=turn, inertia=diagonal)
    held.explicitinertial = True
    theirs = spec.compile()
    theirs.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, turn)
    axes = axes.reshape(3, 3)
    full = axes @ np.diag(diagonal) @ axes.T
    bare = nearl.Model.from_mjcf(path)
    ours = bare.with_payload("thigh", 2.5, com, full[np.triu_indices(3)])
    assert ours.total_mass == pytest.approx(bare.total_mass + 2.5)
    data = mujoco.MjData(theirs)
    for _ in range(50):
        data.qpos[:], data.qvel[:] = theirs.qpos0 + rng.uniform(-1, 1, theirs.nq), rng.normal(size=theirs.nv)
        mujoco.mj_forward(theirs, data)
        q = ours.q_from_mujoco(data.qpos)
        v = ours.v_from_mujoco(q, data.qvel)
        bias = ours.tau_to_mujoco(q, ours.rnea(q, v, ours.a_from_mujoco(q, v, np.zeros(theirs.nv))))
        assert np.abs(bias - data.qfrc_bias).max() <= 1e-11 * max(1.0, np.abs(data.qfrc_bias).max())
        without = bare.tau_to_mujoco(q, bare.rnea(q, v, bare.a_from_mujoco(q, v, np.zeros(theirs.nv))))
        assert np.abs(without - data.qfrc_bias).max() > 1.0
    with pytest.raises(ValueError, match="mass 0 kg"):
        bare.with_payload("thigh", 0.0)


SLIDES = """<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.001"/><worldbody>
<body name="b0" pos="-0.11155536171678858 0.03405786301146763 0.019218204917232737">
<joint name="j0" type="slide" axis="-0.2113462689504789 -0.05049309654504098 0.9761061426924866"
 range="-0.023439448663431367 0.019531969114371075" armature="0.929950546576902"/><geom type="sphere" size="0.1" mass="0.46847206417739595"/>
<body name="b1" pos="-0.19707441753682478 0.3062739487284471 -0.26770999219816055">
<joint name="j1" type="slide" axis="-0.03673460981902366 -0.9476357597051218 -0.3172334083439837"
 range="-0.06145300993915712 0.02188904554566905"/><geom type="sphere" size="0.1" mass="0.9282335275673759"/>
<body name="b2" pos="-0.18658478997889288 -0.4124679019591756 0.07400699507737991">
<joint name="j2" axis="-0.6804446376061852 0.5761447412467442 0.4528270445619492" range="-0.18170968719437255 0.4001676311425474"
 pos="0.045991054061412996 -0.0017574952189473346 0.0013456517012280416"/><geom type="sphere" size="0.1" mass="0.13599395320729094"/>
<body name="b3" pos="-0.2344787470848233 -0.1529819016499437 0.026338123013537967">
<joint name="j3" type="slide" axis="0.9206395030978117 0.3892000330294481 -0.030761008203418934"
 range="-0.06699093824557259 0.19595098331707544" armature="0.04227032046921974"/><geom type="sphere" size="0.1" mass="1.3079086831199722"/>
</body></body></body></body></worldbody></mujoco>"""


def test_a_frame_keeps_the_box_of_the_build_while_its_limit_is_moved_inside(tmp_path: Path) -> None:
    """By MuJoCo's kinematics; once it came 35 um out, as what was allowed for between two looks at a brake added up from tick to tick."""
    file, speed, acceleration = tmp_path / "slides.xml", 5.546264595288924, 31.424668345001468
    file.write_text(SLIDES)
    plant = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(plant)
    mujoco.mj_forward(plant, data)
    rng = np.random.default_rng(63 + 2 * 10**6)
    rng.choice([0.001, 0.002, 0.005, 0.01, 0.02]), rng.choice([0, 1, 5]), rng.uniform(0.9, 3), rng.random(10)
    off = rng.uniform(0.02, 0.3, 6)
    low, high = data.body("b3").xpos - off[:3], data.body("b3").xpos + off[3:]
    robot = nearl.Model.from_mjcf(file)
    limits = [
        nearl.PositionLimit(robot, margin=0.001),
        nearl.VelocityLimit(robot, limit=speed),
        nearl.AccelerationLimit(robot, acceleration),
        nearl.FrameLimit(robot, "b3", 0.2 * acceleration, lower=list(low), upper=list(high), name="box"),
    ]
    projector = nearl.Projector(robot, limits, dt=0.001, sub_steps=5)
    q, v, nearest = np.zeros(4), np.zeros(4), -1.0
    for tick in range(300):
        if tick == 244:
            projector.move_limits(speed=0.033, frame={"box": 0.0128})
        wanted = 2 * speed * np.sin(0.005 * tick * np.arange(1, 5))
        target = projector.project(q, v, q + 0.001 * wanted, wanted)
        q, v = np.array(target.q), np.array(target.v)
        data.qpos[:] = q
        mujoco.mj_kinematics(plant, data)
        at = data.body("b3").xpos
        nearest = max(nearest, (low - at).max(), (at - high).max())
    assert -0.01 < nearest <= 1e-9, nearest


def test_one_of_two_planes_of_a_name_cannot_be_meant(panda: nearl.Model) -> None:
    """Both were put where one was meant to be, and the other was gone."""
    limits = [nearl.PositionLimit(panda), nearl.VelocityLimit(panda), nearl.AccelerationLimit(panda, A)]
    wall, floor = ([1, 0, 0], [0.8, 0, 0]), ([0, 0, -1], [0, 0, 0.2])
    elsewhere = ([1, 0, 0], [0.7, 0, 0])

    def planes(*names: str | None) -> nearl.Projector:
        both = [
            nearl.FrameLimit(panda, "panda_hand", 5.0, normal=normal, through=through, **({} if name is None else {"name": name}))
            for name, (normal, through) in zip(names, [wall, floor], strict=True)
        ]
        return nearl.Projector(panda, limits + both, DT)

    with pytest.raises(ValueError, match="several planes are called 'panda_hand' and lie apart.*a name of its own"):
        planes(None, None).move_limits(plane={"panda_hand": elsewhere})
    planes("wall", "floor").move_limits(plane={"wall": elsewhere})

    def collisions(*names: str) -> nearl.CollisionLimit:
        ball = {"sphere": {"radius": 0.1}}
        shapes = [{"frame": "panda_hand", "shape": ball}]
        shapes += [{"name": name, "shape": ball, "position": [3.0, float(k), 0.0]} for k, name in enumerate(names)]
        return nearl.CollisionLimit(panda, shapes, 2.0, influence=2.0)

    elsewhere = ([2, 2, 2], [0, 0, 0])
    with pytest.raises(ValueError, match="two obstacles of collision are named 'person'; give each a name of its own"):
        nearl.Projector(panda, [*limits, collisions("person", "person")], DT)
    with pytest.raises(ValueError, match="several obstacles are called 'person' and lie apart"):
        nearl.Projector(panda, [*limits, collisions("person"), collisions("other", "person")], DT).move_limits(body={"person": elsewhere})
    nearl.Projector(panda, [*limits, collisions("a", "b")], DT).move_limits(body={"b": elsewhere})
