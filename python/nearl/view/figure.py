"""A robot as meshes of a viser scene."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Figure:
    """A robot as meshes of a scene: its geoms, or capsules between its bodies where the file has none.

    Args:
        server: The viser server.
        name: Of the figure in the scene.
        model: The compiled MuJoCo model.
        colour: Red, green, blue (0 to 255).
        opacity: From 0 to 1.
    """

    def __init__(self, server: Any, name: str, model: Any, colour: tuple[int, int, int], opacity: float):
        import mujoco

        self._mujoco, self._model, self._data = mujoco, model, mujoco.MjData(model)
        look = {"color": colour, "opacity": opacity if opacity < 1.0 else None}
        self._geoms = [g for g in range(model.ngeom) if model.geom_type[g] in _shapes(mujoco)]
        self._bones = [] if self._geoms else list(range(2, model.nbody))
        self._parts = [
            server.scene.add_mesh_simple(f"/{name}/{i}", mesh.vertices, mesh.faces, **look)
            for i, mesh in enumerate([self._geom_mesh(g) for g in self._geoms] + [self._bone_mesh(b) for b in self._bones])
        ]
        self._visible = True

    def show(self, q: Floats | None) -> None:
        """Puts the robot at ``q`` (nq), Pinocchio's convention; None hides it."""
        if self._visible != (q is not None):
            self._visible = q is not None
            for part in self._parts:
                part.visible = self._visible
        if q is None:
            return
        self._data.qpos[:] = qpos_of(self._model, q)
        self._mujoco.mj_kinematics(self._model, self._data)
        quat = np.empty(4)
        for part, (position, rotation) in zip(self._parts, self._places()):
            self._mujoco.mju_mat2Quat(quat, rotation)
            part.position, part.wxyz = position, quat.copy()

    def room(self) -> tuple[Floats, float]:
        """Middle of the box around the centres of its parts where it was shown last (3), and the length of its diagonal [m]."""
        at = np.array([position for position, _ in self._places()] or [np.zeros(3)])
        low, high = at.min(axis=0), at.max(axis=0)
        return (low + high) / 2, float(np.linalg.norm(high - low))

    def _places(self) -> list[tuple[Floats, Floats]]:
        data = self._data
        geoms = [(data.geom_xpos[g], data.geom_xmat[g]) for g in self._geoms]
        return geoms + [(data.xpos[self._model.body_parentid[b]], data.xmat[self._model.body_parentid[b]]) for b in self._bones]

    def _bone_mesh(self, body: int) -> Any:
        import trimesh

        end = self._model.body_pos[body]
        if np.linalg.norm(end) < 1e-6:
            return trimesh.creation.icosphere(radius=0.035, subdivisions=1)
        return trimesh.creation.cylinder(radius=0.03, segment=[np.zeros(3), end], sections=16)

    def _geom_mesh(self, geom: int) -> Any:
        return _shapes(self._mujoco)[self._model.geom_type[geom]](self._model.geom_size[geom])


def _shapes(mujoco: Any) -> dict[int, Any]:
    import trimesh

    create, kind = trimesh.creation, mujoco.mjtGeom
    return {
        int(kind.mjGEOM_SPHERE): lambda size: create.icosphere(radius=size[0], subdivisions=2),
        int(kind.mjGEOM_CAPSULE): lambda size: create.capsule(radius=size[0], height=2 * size[1], count=[12, 12]),
        int(kind.mjGEOM_CYLINDER): lambda size: create.cylinder(radius=size[0], height=2 * size[1], sections=16),
        int(kind.mjGEOM_BOX): lambda size: create.box(extents=2 * size),
    }


def qpos_of(model: Any, q: Floats) -> Floats:
    """MuJoCo's configuration for Pinocchio's: the quaternion of a free joint begins with w there and ends with it here."""
    qpos = np.array(q, float)
    if model.njnt and model.jnt_type[0] == 0:
        qpos[3:7] = qpos[[6, 3, 4, 5]]
    return qpos


def led(q: Floats, v: Floats, seconds: float) -> Floats:
    """Where the joints of ``q`` (nq) are after so long at ``v`` (nv); a free base stays where it is."""
    ahead, base = q.copy(), 0 if len(q) == len(v) else 6
    ahead[len(q) - len(v) + base :] += seconds * v[base:]
    return ahead
