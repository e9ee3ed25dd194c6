"""A robot file that names other files, which stand beside it: meshes and included files are found from wherever a program is started."""

from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import mujoco
import numpy as np
import pytest

from nearl import _core, render

# A tetrahedron, one shape the robot has of it and one of its own.
MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
ARM = """<mujoco><worldbody><body name="arm"><joint name="elbow"/>
<geom type="mesh" mesh="shell"/><geom type="sphere" size="0.2" pos="0 0 -0.5"/></body></worldbody></mujoco>"""
ROBOT = """<mujoco model="arm"><compiler meshdir="shapes"/><asset><mesh name="shell" file="shell.obj"/></asset>
<worldbody><light pos="0 0 4"/></worldbody><include file="parts/arm.xml"/>
<actuator><motor name="elbow" joint="elbow" ctrlrange="-1 1"/></actuator></mujoco>"""

URDF = """<robot name="arm"><link name="base"/><link name="arm"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="package://robot/shapes/shell.obj"/></geometry></collision></link>
<joint name="elbow" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""
TASK = """name = "arm"
[model]
mjcf = "arm.xml"
[time]
dt = 0.002
sim_dt = 0.002
policy_every = 1
max_episode_steps = 10
[command]
interface = "effort"
[constraints]
[idm]
kind = "pinocchio"
[reward]
none = "0"
"""


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a robot file of three files; the working directory is another."""
    folder, elsewhere = tmp_path / "robot", tmp_path / "elsewhere"
    for place in (folder / "parts", folder / "shapes", elsewhere):
        place.mkdir(parents=True)
    (folder / "shapes" / "shell.obj").write_text(MESH)
    (folder / "parts" / "arm.xml").write_text(ARM)
    (folder / "arm.xml").write_text(ROBOT)
    monkeypatch.chdir(elsewhere)
    return folder


def env_of(folder: Path | str | None, text: str = ROBOT) -> SimpleNamespace:
    """What the pictures ask of an environment."""
    return SimpleNamespace(task="arm", model_text=text, model_folder=folder, nq=1, nv=1)


def test_files_beside_the_robot_file_are_found_from_anywhere(robot: Path) -> None:
    model, own = render.compiled(mujoco, env_of(str(robot))), mujoco.MjModel.from_xml_path(str(robot / "arm.xml"))
    assert (model.nmesh, model.njnt, model.ngeom) == (1, 1, 2)
    assert np.array_equal(model.mesh_vert, own.mesh_vert) and np.array_equal(model.geom_size, own.geom_size)
    assert not (robot / "nearl-robot.xml").exists()


def test_the_text_is_drawn_and_not_what_the_file_has_become(robot: Path) -> None:
    """A snapshot holds the text that it was trained with."""
    (robot / "arm.xml").write_text("<mujoco/>")
    (robot / "nearl-robot.xml").write_text("<mujoco/>")
    assert render.compiled(mujoco, env_of(str(robot))).nmesh == 1


def test_a_robot_of_several_files_is_drawn(robot: Path) -> None:
    renderer = render.Renderer(env_of(str(robot)), (64, 48))
    picture = renderer.frame([0.0], [0.0])
    renderer.close()
    assert picture.shape == (48, 64, 3) and picture.std() > 5, "not an empty picture"


def test_an_environment_says_where_the_files_of_its_robot_are(robot: Path) -> None:
    """Of its own task file; a bundled robot names none."""
    (robot / "arm.toml").write_text(TASK)
    env = _core.Env(str(robot / "arm.toml"))
    assert Path(str(env.model_folder)) == robot.resolve() and _core.Env("Ant-v5").model_folder is None
    renderer = render.Renderer(env, (64, 48))
    picture = renderer.frame(env.qpos, env.qvel)
    renderer.close()
    assert picture.std() > 5, "not an empty picture"


def test_meshes_that_a_package_of_ros_has_are_found(robot: Path) -> None:
    """In the folder of the robot file, which is called as the package."""
    (robot / "arm.urdf").write_text(URDF)
    (robot / "arm.toml").write_text(TASK.replace('mjcf = "arm.xml"', 'urdf = "arm.urdf"'))
    env = _core.Env(str(robot / "arm.toml"))
    assert f'filename="{robot.resolve()}/shapes/shell.obj"' in env.model_text
    assert render.compiled(mujoco, env).nmesh == 1


@pytest.mark.parametrize("gone", ["shapes/shell.obj", "parts/arm.xml"])
def test_a_file_that_is_missing_is_named_and_no_driver_is_blamed(robot: Path, gone: str) -> None:
    (robot / gone).unlink()
    with pytest.raises(render.VideoError) as refused:
        render.Renderer(env_of(str(robot)), (64, 48))
    words = str(refused.value)
    assert words.startswith(f"MuJoCo cannot read the robot file of 'arm' (Error opening file '{gone}'"), words
    assert words.endswith(f"put that file where the robot file in '{robot}' names it, or correct its name there") and "\n" not in words
    assert "MUJOCO_GL" not in words and "apt install" not in words
    with pytest.raises(render.VideoError, match=r"\(Error opening file '[^']*'.*\); put that file where the robot file names it"):
        render.Renderer(env_of(None), (64, 48))


def test_a_robot_file_that_mujoco_does_not_take_is_no_matter_of_drivers(robot: Path) -> None:
    with pytest.raises(render.VideoError, match=r"cannot read the robot file of 'arm' \(Schema violation: .*'leg'.*\); correct the robot file$"):
        render.Renderer(env_of(str(robot), "<mujoco><leg/></mujoco>"), (64, 48))


def test_the_live_view_finds_them_too(robot: Path) -> None:
    show = pytest.importorskip("nearl.view.show")
    with mock.patch.object(show, "Panel"), mock.patch.object(show, "Figure") as figure:
        show.Page(mock.MagicMock(), SimpleNamespace(robot=SimpleNamespace(env=env_of(str(robot)))))
    assert {call.args[2].nmesh for call in figure.call_args_list} == {1}
