"""Pinocchio through our model against MuJoCo's own Python package, on all five robots."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from conftest import ROBOTS

import nearl

GYMNASIUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
FILES = {
    "HalfCheetah-v5": GYMNASIUM / "half_cheetah.xml",
    "Hopper-v5": GYMNASIUM / "hopper.xml",
    "Walker2d-v5": GYMNASIUM / "walker2d_v5.xml",
    "Ant-v5": GYMNASIUM / "ant.xml",
    "Panda-reach": ROBOTS / "panda" / "panda.urdf",
}


@pytest.fixture(params=FILES)
def pair(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[nearl.Model, mujoco.MjModel]:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the working directory
    path = FILES[request.param]
    ours = nearl.Model.from_urdf(path) if path.suffix == ".urdf" else nearl.Model.from_mjcf(path)
    theirs = mujoco.MjModel.from_xml_path(str(path))
    off = mujoco.mjtDisableBit
    theirs.opt.disableflags |= off.mjDSBL_CONTACT | off.mjDSBL_LIMIT
    return ours, theirs


def states(theirs: mujoco.MjModel, rng: np.random.Generator, n: int = 50):
    data = mujoco.MjData(theirs)
    for _ in range(n):
        data.qpos[:] = theirs.qpos0
        mujoco.mj_integratePos(theirs, data.qpos, rng.uniform(-1, 1, theirs.nv), 1.0)
        data.qvel[:] = rng.normal(size=theirs.nv)
        mujoco.mj_forward(theirs, data)
        yield data


def close(ours: np.ndarray, theirs: np.ndarray, tolerance: float) -> None:
    assert np.abs(ours - theirs).max() <= tolerance * max(1e-3, np.abs(theirs).max())


def test_sizes_mass_and_motors(pair) -> None:
    ours, theirs = pair
    assert (ours.nq, ours.nv) == (theirs.nq, theirs.nv)
    assert ours.total_mass == pytest.approx(theirs.body_subtreemass[0], rel=1e-13)
    assert ours.joint_names == [theirs.joint(i).name for i in range(theirs.njnt)]
    for i in range(theirs.nu):
        dof = theirs.jnt_dofadr[theirs.actuator_trnid[i, 0]]
        assert ours.effort_limit[dof] == pytest.approx(theirs.actuator_gear[i, 0] * theirs.actuator_ctrlrange[i, 1])


def test_mass_matrix(pair, rng) -> None:
    ours, theirs = pair
    for data in states(theirs, rng):
        full = np.zeros((theirs.nv, theirs.nv))
        mujoco.mj_fullM(theirs, data, full)
        q = ours.q_from_mujoco(data.qpos)
        mass = ours.mass_matrix(q)
        # v_pinocchio = V v_mujoco and the kinetic energy is one: M_mujoco = V' M V.
        change = np.stack([ours.v_from_mujoco(q, column) for column in np.eye(theirs.nv)], axis=1)
        assert np.array_equal(mass, mass.T)
        close(change.T @ mass @ change, full, 1e-12)


def test_non_linear_effects(pair, rng) -> None:
    ours, theirs = pair
    for data in states(theirs, rng):
        q = ours.q_from_mujoco(data.qpos)
        v = ours.v_from_mujoco(q, data.qvel)
        # MuJoCo's bias is the force at MuJoCo's zero acceleration.
        bias = ours.rnea(q, v, ours.a_from_mujoco(q, v, np.zeros(theirs.nv)))
        close(ours.tau_to_mujoco(q, bias), data.qfrc_bias, 1e-11)
        assert np.abs(ours.nle(q, v) - ours.rnea(q, v, np.zeros(ours.nv))).max() < 1e-9
        close(ours.tau_to_mujoco(q, ours.passive(q, v)), data.qfrc_passive, 1e-12)


def inverses(ours, theirs, rng):
    """MuJoCo's inverse dynamics at random states and accelerations, with what they are in Pinocchio's convention."""
    for data in states(theirs, rng):
        data.qacc[:] = 10 * rng.normal(size=theirs.nv)
        qacc = data.qacc.copy()
        mujoco.mj_inverse(theirs, data)
        q = ours.q_from_mujoco(data.qpos)
        v = ours.v_from_mujoco(q, data.qvel)
        yield data, q, v, ours.a_from_mujoco(q, v, qacc)


def test_inverse_dynamics(pair, rng) -> None:
    ours, theirs = pair
    for data, q, v, a in inverses(ours, theirs, rng):
        tau = ours.rnea(q, v, a) - ours.passive(q, v)
        close(ours.tau_to_mujoco(q, tau), data.qfrc_inverse, 1e-10)
        close(ours.aba(q, v, ours.rnea(q, v, a)), a, 1e-8)


def test_motors_reckon_with_euler_s_implicit_damping(pair, rng) -> None:
    """MuJoCo's own inverse of its discrete step."""
    ours, theirs = pair
    if theirs.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        pytest.skip("another integrator")
    flags = theirs.opt.enableflags
    theirs.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_INVDISCRETE
    for data, q, v, a in inverses(ours, theirs, rng):
        tau = ours.motors(q, v, a, theirs.opt.timestep)
        close(ours.tau_to_mujoco(q, tau), data.qfrc_inverse, 1e-10)
    theirs.opt.enableflags = flags


@pytest.mark.parametrize("share", [0.4, 1.0])
def test_a_weight_that_is_held_is_no_weight(tmp_path: Path, rng, share: float) -> None:
    """`gravcomp` of all that moves; a pedestal that does not move has none."""
    bodies = "".join(
        f'<body pos="0.1 0 {k}" gravcomp="{share}"><joint name="j{k}" axis="{axis}" damping="0.3"/><geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0.1"/>'
        for k, axis in enumerate(["0 1 0", "1 0 0", "0 1 1"])
    )
    text = f'<mujoco><worldbody><body name="pedestal"><geom size="0.1"/>{bodies}{"</body>" * 4}</worldbody></mujoco>'
    (tmp_path / "held.xml").write_text(text)
    ours, theirs = nearl.Model.from_mjcf(tmp_path / "held.xml"), mujoco.MjModel.from_xml_string(text)
    for data in states(theirs, rng, 20):
        q, v = data.qpos.copy(), data.qvel.copy()
        close(ours.nle(q, v) - ours.passive(q, v), data.qfrc_bias - data.qfrc_passive, 1e-11)
        assert np.abs(data.qfrc_gravcomp).max() > 0.1


SERVOS = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>
<body><joint name="a" axis="0 1 0" damping="0.4" armature="0.01"/><geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="1"/>
<body pos="0.3 0 0"><joint name="b" axis="1 1 0" damping="0.1"/><geom type="capsule" size="0.03" fromto="0 0 0 0.2 0 0" mass="0.5"/></body></body></worldbody>
<actuator><position joint="a" kp="90" kv="30" forcerange="-40 40"/><position joint="b" kp="20" kv="2" forcerange="-8 8"/></actuator></mujoco>"""


def test_motors_reckon_with_drives_whose_damping_a_step_takes_implicitly(tmp_path: Path, rng) -> None:
    """What MuJoCo's drives give at the start of a step of `implicitfast` is what its change of velocity asks for."""
    (tmp_path / "servos.xml").write_text(SERVOS)
    ours, theirs = nearl.Model.from_mjcf(tmp_path / "servos.xml"), mujoco.MjModel.from_xml_string(SERVOS)
    dt, tried = theirs.opt.timestep, 0
    for data in states(theirs, rng):
        data.ctrl[:] = data.qpos + rng.uniform(-0.3, 0.3, 2)
        q, v = data.qpos.copy(), data.qvel.copy()
        mujoco.mj_step(theirs, data)
        force, a = data.actuator_force, (data.qvel - v) / dt
        if (np.abs(force) < [40, 8]).all():
            close(ours.motors(q, v, a, dt), force, 1e-10)
            tried += 1
        explicit = ours.rnea(q, v, a) - ours.passive(q, v)
        assert np.abs(explicit - force).max() > 0.01, "what is implicit does not show"
    assert tried > 20


def test_integrate_and_difference_invert_each_other(pair, rng) -> None:
    ours, theirs = pair
    for data in states(theirs, rng, 10):
        q, dq = ours.q_from_mujoco(data.qpos), rng.uniform(-0.5, 0.5, ours.nv)
        np.testing.assert_allclose(ours.difference(q, ours.integrate(q, dq)), dq, atol=1e-12)


@pytest.mark.parametrize("refsafe", ["enable", "disable"])
@pytest.mark.parametrize(
    ("impedance", "reference"),
    [
        ("0.9 0.95 0.001 0.5 2", "0.02 1"),
        ("0.8 0.8 0.001 0.5 2", "0.02 1"),
        ("0.1 0.1 0.1 0.5 1", "0.02 1"),
        ("0.5 0.9 0 0.5 2", "0.02 1"),
        ("0.5 0.8 0.01 0.5 2", "0.004 1"),
        ("0.9 0.95 0.001 0.5 2", "0.001 1"),
        ("0.9 0.95 0.001 0.5 2", "-100 -1000"),
        ("0.9 0.95 0.001 0.5 2", "-100 0"),
        ("0.9 0.95 0.001 0.5 2", "0 1"),
    ],
)
def test_motors_make_up_for_friction_however_the_file_has_it_set_in(impedance: str, reference: str, refsafe: str) -> None:
    """An onset shorter than 0.95 of a step was taken for that: at 10 ms a limit of 9 rad/s² was left by 7."""
    joints = "".join(
        f'<body pos="0 0 {0.4 * (i > 0)}"><joint name="j{i}" axis="{axis}" damping="0.3" frictionloss="{2.0 - i}" solimpfriction="{impedance}" '
        f'solreffriction="{reference}"/><geom type="capsule" size="0.03" fromto="0 0 0 0.02 0.03 0.4" mass="{2 - i}" contype="0" conaffinity="0"/>'
        for i, axis in enumerate(["0 1 0", "1 0 0"])
    )
    motors = "".join(f'<motor joint="j{i}" ctrlrange="-100 100"/>' for i in range(2))
    text = (
        f'<mujoco><option timestep="0.01" tolerance="0" iterations="200"><flag refsafe="{refsafe}"/></option><worldbody>{joints}</body></body></worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    model, theirs, rng = nearl.Model.from_mjcf_text(text), mujoco.MjModel.from_xml_string(text), np.random.default_rng(0)
    data, held = mujoco.MjData(theirs), 0
    for _ in range(200):
        q, v, a = rng.uniform(-1, 1, 2), rng.normal(size=2) * rng.choice([1e-3, 0.1, 1.0]), rng.normal(size=2) * rng.choice([0.1, 10.0])
        mujoco.mj_resetData(theirs, data)
        data.qpos[:], data.qvel[:] = q, v
        data.qfrc_applied[:] = model.motors(q, v, a, dt=0.01)
        mujoco.mj_step(theirs, data)
        off = np.abs((data.qvel - v) / 0.01 - a).max()
        assert off < 1e-6, f"{q} {v} {a}: {off} rad/s²"
        held += int((np.abs(data.qfrc_constraint) < [1.9, 0.9]).any())
    assert held > 20, "friction was never less than all of it"
