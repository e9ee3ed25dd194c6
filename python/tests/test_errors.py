"""What a user gets wrong is one sentence that names it."""

import subprocess
import sys

import numpy as np
import pytest
from conftest import planar_urdf

import nearl


@pytest.fixture
def planar() -> nearl.Model:
    return nearl.Model.from_urdf_text(planar_urdf())


def projector(model: nearl.Model, **settings) -> nearl.Projector:
    settings = {"dt": 1e-3, **settings}
    return nearl.Projector(model, [nearl.VelocityLimit(model), nearl.AccelerationLimit(model, 9.0)], **settings)


def reset(vec: nearl.VecEnv) -> nearl.VecEnv:
    vec.reset(seed=0)
    return vec


def test_unreadable_files() -> None:
    for load in (nearl.Model.from_urdf, nearl.Model.from_mjcf):
        with pytest.raises(OSError, match="no/such/robot.*check the path"):
            load("no/such/robot.urdf")
    with pytest.raises(OSError, match="cannot read snapshot 'none.safetensors'"):
        nearl.Controller.load("none.safetensors")


def test_files_of_another_kind(tmp_path) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text("<robot name='x'><link name='a'>")
    with pytest.raises(ValueError, match=r"robot\.urdf"):
        nearl.Model.from_urdf(file)
    file.write_text(planar_urdf())
    with pytest.raises(ValueError, match=r"robot\.urdf is not a usable MJCF file.*Model\.from_urdf"):
        nearl.Model.from_mjcf(file)
    with pytest.raises(ValueError, match=r"the text is not a usable MJCF file.*Model\.from_urdf"):
        nearl.Model.from_mjcf_text(planar_urdf())
    file.write_bytes(b"not a snapshot at all")
    with pytest.raises(ValueError, match="not a safetensors file"):
        nearl.Controller.load(file)


def test_wrong_shapes(planar) -> None:
    p, zero = projector(planar), np.zeros(3)
    with pytest.raises(ValueError, match=r"v_proposal has shape \(2,\), expected \(3,\)"):
        p.project(zero, zero, zero, np.zeros(2))
    with pytest.raises(ValueError, match=r"q has shape \(3,\), expected \(n, 3\)"):
        p.project_batch(zero, zero, zero, zero)
    with pytest.raises(ValueError, match=r"v has shape \(3, 3\), expected \(4, 3\)"):
        p.project_batch(np.zeros((4, 3)), np.zeros((3, 3)), np.zeros((4, 3)), np.zeros((4, 3)))
    with pytest.raises(ValueError, match="q is not an array of numbers"):
        planar.mass_matrix("upright")
    env = nearl.Env("HalfCheetah-v5")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action has shape \(5,\), expected \(6,\)"):
        env.step(np.zeros(5))
    with pytest.raises(ValueError, match=r"actions has shape \(2, 6\), expected \(3, 6\)"):
        reset(nearl.make_vec("HalfCheetah-v5", 3)).step(np.zeros((2, 6)))


def test_unknown_names(planar) -> None:
    with pytest.raises(ValueError, match="'joint_1'.*did you mean 'joint1'"):
        nearl.AccelerationLimit(planar, {"joint_1": 3.0})
    with pytest.raises(ValueError, match="no joint 'wheel'"):
        projector(planar, controllable=["wheel"])
    with pytest.raises(ValueError, match='solver is "osqp"; use "ladder" or "clarabel"'):
        projector(planar, solver="osqp")
    with pytest.raises(ValueError, match="HalfCheeta.*did you mean 'HalfCheetah-v5'"):
        nearl.Env("HalfCheeta")


def test_impossible_numbers(planar) -> None:
    with pytest.raises(ValueError, match="acceleration limit is -1"):
        nearl.AccelerationLimit(planar, -1.0)
    with pytest.raises(ValueError, match="dt is 0"):
        projector(planar, dt=0.0)
    with pytest.raises(ValueError, match=r"actions\[1, 2\] \('bfoot'\) is NaN"):
        actions = np.zeros((2, 6))
        actions[1, 2] = np.nan
        reset(nearl.make_vec("HalfCheetah-v5", 2)).step(actions)
    with pytest.raises(ValueError, match=r"qpos\[0\] is inf"):
        nearl.Env("Hopper-v5").set_state([np.inf] * 6, [0.0] * 6)
    with pytest.raises(ValueError, match="num_envs is 0"):
        nearl.make_vec("Hopper-v5", 0)


def test_something_that_is_no_limit(planar) -> None:
    with pytest.raises(TypeError, match=r"limits\[0\] is .*float.*pass objects such as nearl.PositionLimit"):
        nearl.Projector(planar, [3.0], dt=1e-3)


def test_a_fork_loses_the_threads_and_says_so() -> None:
    code = """
import os, numpy as np, nearl
vec = nearl.make_vec("Hopper-v5", 4, threads=2); vec.reset(seed=0)
child = os.fork()
if child == 0:
    try:
        vec.step(np.zeros((4, 3))); os._exit(1)
    except ValueError as error:
        os._exit(0 if "forked" in str(error) else 2)
os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-W", "ignore", "-c", code], timeout=60).returncode == 0


def test_nearl_works_without_gymnasium() -> None:
    code = """
import sys; sys.modules["gymnasium"] = None
import nearl
assert nearl.Projector
try: nearl.make_vec
except ImportError as error: assert "nearl[train]" in str(error)
else: raise SystemExit("no error")
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_arguments_of_another_type_are_told_what_is_expected(planar) -> None:
    joint = planar.joint_names[0]
    for build, words in [
        (lambda: nearl.VelocityLimit(planar, limit=1j), "expected a number for all joints.*; got complex.*'limit'"),
        (lambda: nearl.VelocityLimit(planar, limit=np.bool_(True)), "expected a number for all joints.*; got bool.*'limit'"),
        (lambda: nearl.PositionLimit(planar, margin="wide"), "expected a number for all joints.*; got str.*'margin'"),
        (lambda: nearl.LockedJoints(planar, joint), "expected a list of names.*; got str.*'joints'"),
        (lambda: nearl.TorqueLimit(planar, soft=5.0), r"expected the weights \(linear, quadratic\).*; got float.*'soft'"),
    ]:
        with pytest.raises(TypeError, match=f"(?s){words}"):
            build()
    with pytest.raises(ValueError, match="LockedJoints names nothing; name a joint, or leave the limit out"):
        nearl.LockedJoints(planar, [])
    assert nearl.VelocityLimit(planar, limit={joint: 1}).name == "velocity"
    assert nearl.VelocityLimit(planar, limit=np.ones(3)).name == "velocity"
    assert nearl.LockedJoints(planar, [joint]).name == "locked"
