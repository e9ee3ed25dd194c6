"""Pictures of a robot through MuJoCo's own renderer, on a machine without a screen."""

import os
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.arguments import whole

Frame = NDArray[np.uint8]
MOST_PIXELS = 8192


class VideoError(RuntimeError):
    """No picture can be made here; the message says what is missing."""


class Renderer:
    """Draws a task's robot.

    Args:
        env: The native environment, whose robot is drawn.
        size: Width and height [pixel].
        camera: A camera of the robot file; by default its ``track``, else one that follows the robot.

    Raises:
        VideoError: no renderer here, no such camera, or a file that the robot file names and that cannot be read.
    """

    def __init__(self, env: _core.Env, size: tuple[int, int], camera: str | None = None):
        give = f"give pixels, from 1 to {MOST_PIXELS}"
        size = whole("width", size[0], 1, give, MOST_PIXELS), whole("height", size[1], 1, give, MOST_PIXELS)
        os.environ.setdefault("MUJOCO_GL", "egl")
        backend = os.environ["MUJOCO_GL"]
        try:
            import mujoco

            if backend == "egl":
                # Whoever imported mujoco before the variable was set has chosen another context, or none.
                from mujoco.egl import GLContext
                from mujoco.rendering.classic import gl_context

                gl_context.GLContext = GLContext
            self._mujoco = mujoco
            self._model = compiled(mujoco, env)
            self._model.vis.global_.offwidth, self._model.vis.global_.offheight = size
            self._data = mujoco.MjData(self._model)
            self._renderer = mujoco.Renderer(self._model, size[1], size[0])
        except VideoError:
            raise
        except Exception as error:  # each missing library fails in its own way, from AttributeError to EGLError
            words = str(error).strip().splitlines() or [type(error).__name__]
            advice = "on Debian: apt install libegl1 libegl-mesa0 libgl1-mesa-dri" if backend == "egl" else "try MUJOCO_GL=egl"
            raise VideoError(f"MuJoCo cannot render with MUJOCO_GL={backend} ({words[0]}); {advice}") from error
        self._view = self._camera(camera)

    def frame(self, qpos: ArrayLike, qvel: ArrayLike) -> Frame:
        """The robot at ``qpos`` (nq) and ``qvel`` (nv), MuJoCo's convention, as a picture (height x width x 3)."""
        self._data.qpos[:], self._data.qvel[:] = qpos, qvel
        self._mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._view)
        if self._model.ngeom < self._model.nbody // 2:
            self._skeleton(self._renderer.scene)
        return self._renderer.render().copy()

    def close(self) -> None:
        """Frees the renderer."""
        self._renderer.close()

    def _camera(self, name: str | None) -> Any:
        names = [self._model.camera(i).name for i in range(self._model.ncam)]
        if name is not None and name not in names:
            raise VideoError(f"the robot has no camera '{name}'; it has {', '.join(names) or 'none'}")
        if name is not None or "track" in names:
            return name or "track"
        view = self._mujoco.MjvCamera()
        view.type, view.trackbodyid = self._mujoco.mjtCamera.mjCAMERA_TRACKING, min(1, self._model.nbody - 1)
        view.distance, view.azimuth, view.elevation = 2.0 * self._model.stat.extent, 120.0, -15.0
        return view

    def _skeleton(self, scene: Any) -> None:
        """A robot file with hardly a shape (a URDF stripped of its meshes) is drawn as capsules between its bodies."""
        capsule = self._mujoco.mjtGeom.mjGEOM_CAPSULE
        for body in range(2, self._model.nbody):
            ends = self._data.xpos[self._model.body_parentid[body]], self._data.xpos[body]
            if scene.ngeom < scene.maxgeom and np.linalg.norm(ends[1] - ends[0]) > 1e-6:
                geom = scene.geoms[scene.ngeom]
                colour = np.array([0.85, 0.45, 0.2, 1.0], np.float32)
                self._mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.zeros(9), colour)
                self._mujoco.mjv_connector(geom, capsule, 0.03, *ends)
                scene.ngeom += 1


def compiled(mujoco: Any, env: _core.Env) -> Any:
    """MuJoCo's model of the robot file; where the task lets a URDF's base float, with that joint and a floor.

    Raises:
        VideoError: MuJoCo cannot read it, or a file that it names.
    """
    folder = None if env.model_folder is None else os.fspath(env.model_folder)
    try:
        return _compiled_in(mujoco, env, folder)
    except ValueError as error:  # how MuJoCo refuses a file
        words = " ".join(str(error).removeprefix("XML ").removeprefix("Error: ").split())
        where = "" if folder is None else f" in '{folder}'"
        is_missing = "opening file" in words
        advice = f"put that file where the robot file{where} names it, or correct its name there" if is_missing else "correct the robot file"
        raise VideoError(f"MuJoCo cannot read the robot file of '{env.task}' ({words}); {advice}") from error


def _compiled_in(mujoco: Any, env: _core.Env, folder: str | None) -> Any:
    model = _spec(mujoco, env.model_text, folder).compile()
    if (model.nq, model.nv) == (env.nq, env.nv):
        return model
    robot = ElementTree.fromstring(env.model_text)
    children = {child.get("link") for child in robot.iter("child")}
    root = next(link.get("name") for link in robot.iter("link") if link.get("name") not in children)
    ElementTree.SubElement(robot, "link", name="world")
    joint = ElementTree.SubElement(robot, "joint", name="root_joint", type="floating")
    ElementTree.SubElement(joint, "parent", link="world")
    ElementTree.SubElement(joint, "child", link=str(root))
    spec = _spec(mujoco, ElementTree.tostring(robot, encoding="unicode"), folder)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], rgba=[0.6, 0.65, 0.7, 1.0])
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.7] * 3
    return spec.compile()


def _spec(mujoco: Any, text: str, folder: str | None) -> Any:
    """MuJoCo's reading of a text as if it stood in a file of ``folder``, from where it finds what the text includes, and meshes."""
    if folder is None:
        return mujoco.MjSpec.from_string(text)
    file = os.path.join(folder, "nearl-robot.xml")  # of no disk; a text that is given goes before the file of its name
    return mujoco.MjSpec.from_file(file, include={file: text.encode()})
