"""Limits that move: hand arithmetic, and a payload against MuJoCo."""

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
