"""Limits by name: what a class hands on is what a task file would say, and what is wrong is refused where it is written."""

import numpy as np
import pytest
from conftest import ROBOTS

import nearl


@pytest.fixture(scope="module")
def panda() -> nearl.Model:
    return nearl.Model.from_urdf(ROBOTS / "panda" / "panda.urdf")


def test_every_class_is_public_and_a_limit() -> None:
    from nearl import limits

    assert len(limits.__all__) >= 14
    for name in limits.__all__:
        kind = getattr(nearl, name)
        assert issubclass(kind, nearl.Limit) and kind.__doc__ and name in nearl.__all__, name


def test_a_kind_by_its_name_is_its_class(panda) -> None:
    for limit, kind, settings in [
        (nearl.VelocityLimit(panda, scale=0.5), "velocity", {"scale": 0.5}),
        (nearl.JerkLimit(panda, {"panda_joint1": 9.0}, hard=True), "jerk", {"limit": {"panda_joint1": 9.0}, "hard": True}),
        (nearl.LockedJoints(panda, ["panda_joint2"]), "locked", {"joints": ["panda_joint2"]}),
        (nearl.RowLimit(panda, "r", {"q.panda_joint1": 2.0}, equals=0.5), "rows", {"name": "r", "terms": {"q.panda_joint1": 2.0}, "equals": 0.5}),
    ]:
        named = nearl.Limit(panda, kind, settings)
        assert (repr(named), named.name) == (repr(limit), limit.name)


def test_what_an_argument_leaves_out_is_filled_in(panda) -> None:
    box = repr(nearl.FrameLimit(panda, "panda_hand", 2.0, lower=np.array([0.0, -1.0, 0.1])))
    assert "\"lower\": [0.0, -1.0, 0.1], \"upper\": [inf, inf, inf]" in box and "half_space" not in box
    plane = repr(nearl.FrameLimit(panda, "panda_hand", 2.0, normal=(0, 0, -1)))
    assert "\"normal\": [0.0, 0.0, -1.0], \"through\": [0.0, 0.0, 0.0]" in plane and "box" not in plane and "inside" not in plane
    curve = {"limit": 1.0, "offset": 0.1, "squared": 2.0, "lower": -1.0, "upper": 1.0}
    profile = repr(nearl.VelocityProfileLimit(panda, {"panda_joint1": curve, "panda_joint2": curve}, margin=0.25))
    assert profile.count('"margin": 0.25') == 2 and profile.count('"squared": 2.0') == 2
    soft = repr(nearl.TorqueLimit(panda, soft=(2.0, 3.0)))
    assert '"linear": 2.0, "quadratic": 3.0' in soft and "scale=1.0" in soft
    shapes = [{"frame": "panda_hand", "shape": {"sphere": {"radius": 0.1}}}, {"name": "floor", "shape": "half_space"}]
    shapes.append({"name": "post", "shape": {"sphere": {"radius": 0.2}}, "position": [1, 0, 0]})
    bodies = repr(nearl.CollisionLimit(panda, shapes, 2.0, ignore=[("panda_hand", "floor")], rows=3))
    assert '"radius": 0.1' in bodies and '"half_space"' in bodies and '["panda_hand", "floor"]' in bodies and "rows=3" in bodies


def test_limits_are_written_as_python_has_them(panda) -> None:
    """What is written is read back: names, numbers, lists and tables of Python, with what was left out."""
    fields = lambda **given: given  # noqa: E731
    for limit, kind, given in (
        (nearl.AccelerationLimit(panda, 10.0), "AccelerationLimit", {"limit": 10.0}),
        (nearl.AccelerationLimit(panda, {"panda_joint1": 3.0}, braking=2), "AccelerationLimit", {"limit": {"panda_joint1": 3.0}, "braking": 2.0}),
        (nearl.VelocityLimit(panda, limit=np.full(7, 0.5)), "VelocityLimit", {"limit": [0.5] * 7}),
        (nearl.JerkLimit(panda, 9.0, hard=True), "JerkLimit", {"limit": 9.0, "hard": True}),
        (nearl.RowLimit(panda, "r", {"q.panda_joint1": 2.0}, equals=0.5), "RowLimit", {"name": "r", "terms": {"q.panda_joint1": 2.0}, "equals": 0.5}),
    ):
        written = eval(repr(limit), {kind: fields, "inf": np.inf})
        assert written | given == written, repr(limit)
    assert repr(nearl.VelocityLimit(panda)) in repr(nearl.Projector(panda, [nearl.VelocityLimit(panda)], dt=0.01))


def test_complex_numbers_are_refused_everywhere(panda) -> None:
    """NumPy would drop the imaginary part, with a warning that names nothing."""
    for wrong in (np.complex128(1 + 1j), np.full(7, 1 + 1j), [np.complex64(1j)] * 7, {"panda_joint1": np.complex128(1j)}):
        with pytest.raises(TypeError, match="expected a number for all joints.*; got complex numbers, as 'limit'"):
            nearl.VelocityLimit(panda, limit=wrong)
    projector, q = nearl.Projector(panda, [nearl.VelocityLimit(panda)], dt=0.01), np.array([0.0, 0, 0, -1.5, 0, 1.5, 0])
    for k, name in enumerate(("q", "v", "q_proposal", "v_proposal")):
        state = [q, 0 * q, q, 0 * q]
        state[k] = state[k] + 0j
        with pytest.raises(ValueError, match=f"{name} holds complex numbers, and a robot has none; give real ones, e.g. {name}.real"):
            projector.project(*state)
    with pytest.raises(ValueError, match="actions holds complex numbers"):
        vec = nearl.make_vec("HalfCheetah-v5", 2)
        vec.reset(seed=0)
        vec.step(np.zeros((2, 6), complex))
    with pytest.raises(ValueError, match="observation holds complex numbers"):
        nearl.PID2("HalfCheetah-v5").predict(np.zeros(17, complex))


def test_arguments_of_a_projector_are_named(panda) -> None:
    limit = nearl.VelocityLimit(panda)
    for limits in (limit, "velocity", None):
        with pytest.raises(TypeError, match=f"limits is of {type(limits).__name__}; give a list of limits"):
            nearl.Projector(panda, limits, dt=0.01)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="dt is of str; give a number"):
        nearl.Projector(panda, [limit], dt="1")  # type: ignore[arg-type]
    for wrong, error, words in [
        ({"sub_steps": -1}, ValueError, "sub_steps is -1; give a whole number from 0 to 4294967295"),
        ({"sub_steps": 2**70}, ValueError, "sub_steps is 1180591620717411303424; give a whole number"),
        ({"sub_steps": 1.5}, TypeError, "sub_steps is of float; give a whole number"),
        ({"controllable": "panda_joint1"}, TypeError, 'controllable is of str; give a list of the names of joints, e.g. controllable=."elbow".'),
    ]:
        with pytest.raises(error, match=words):
            nearl.Projector(panda, [limit], dt=0.01, **wrong)
    with pytest.raises(ValueError, match="sub_steps is -1"):
        panda.motors(np.zeros(7), np.zeros(7), np.zeros(7), 0.01, -1)
    projector, q = nearl.Projector(panda, [limit], dt=0.01), np.array([0.0, 0, 0, -1.5, 0, 1.5, 0])
    with pytest.raises(ValueError, match="previous is no pair; give the acceleration and the motor force of the tick before"):
        projector.project(q, 0 * q, q, 0 * q, previous=q)  # type: ignore[arg-type]
    for threads in (0, -1):
        with pytest.raises(ValueError, match=f"threads is {threads}; give a whole number from 1"):
            projector.project_batch(q[None], 0 * q[None], q[None], 0 * q[None], threads=threads)
    assert projector.project_batch(q[None], 0 * q[None], q[None], 0 * q[None], threads=np.int64(2)).q.shape == (1, 7)
    with pytest.raises(ValueError, match="v holds masked numbers.*fill them, e.g. v.filled"):
        projector.project(q, np.ma.array(0 * q, mask=[0, 0, 1, 0, 0, 0, 0]), q, 0 * q)
    assert projector.project(np.ma.array(q), 0 * q, q, 0 * q).status == "unchanged", "nothing is masked"
    with pytest.raises(ValueError, match="velocity limit is inf, but must be finite and above 0 rad/s or m/s"):
        nearl.Projector(panda, [nearl.VelocityLimit(panda, np.inf)], dt=0.01)


def test_what_is_wrong_is_refused_by_name(panda) -> None:
    for build, error, words in [
        (lambda: nearl.Limit(panda, "velocty", {}), ValueError, "no limit of kind 'velocty'; choose one of position, velocity"),
        (lambda: nearl.Limit(panda, "energy", {"limt": 2.0}), TypeError, "EnergyLimit takes no 'limt'; it takes limit, margin, soft"),
        (lambda: nearl.Limit(panda, "energy", {}), TypeError, "EnergyLimit needs 'limit'"),
        (lambda: nearl.FrameLimit(panda, "panda_hand", 2.0, through=[0, 0, 1]), ValueError, "through needs normal"),
        (lambda: nearl.FrameLimit(panda, "panda_hand", 2.0), ValueError, "FrameLimit states no place .* give normal and through .* or lower and upper"),
        (lambda: nearl.FrameLimit(panda, 3, 2.0, normal=[0, 0, 1]), TypeError, "expected a text; got int 3, as 'frame'"),
        (lambda: nearl.EnergyLimit(panda, float("nan")), ValueError, "energy limit is NaN"),
        (lambda: nearl.CollisionLimit(panda, [{"shape": "cone"}], 2.0), ValueError, "limit 'collision': .*cone"),
        (lambda: nearl.VelocityProfileLimit(panda, "fr4"), ValueError, "limit 'velocity_profile': .*\"fr3\""),
    ]:
        with pytest.raises(error, match=f"(?s){words}"):
            build()


def test_joints_that_a_limit_leaves_out_are_told(panda) -> None:
    with pytest.warns(UserWarning, match="acceleration limit does not name 'panda_joint2'.*'panda_joint7'"):
        nearl.Projector(panda, [nearl.VelocityLimit(panda), nearl.AccelerationLimit(panda, {"panda_joint1": 10.0})], dt=0.01)
    inertial = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/>'
    two = nearl.Model.from_mjcf_text(
        f'<mujoco><worldbody><body><joint name="a" range="-1 1" limited="true"/>{inertial}<body><joint name="b" axis="0 1 0"/>{inertial}</body>'
        "</body></worldbody></mujoco>"
    )
    acceleration = nearl.AccelerationLimit(two, 10.0)
    with pytest.warns(UserWarning, match="position limit does not hold for 'b'"):
        nearl.Projector(two, [nearl.PositionLimit(two), acceleration], dt=0.01)
    with pytest.warns(UserWarning, match="velocity limit does not name 'b', for which the robot file gives none either"):
        nearl.Projector(two, [nearl.VelocityLimit(two, {"a": 1.0}), acceleration], dt=0.01)
