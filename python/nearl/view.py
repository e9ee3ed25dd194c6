"""A running loop in a browser: the robot, its proposals as a ghost, and what holds each joint back.

    nearl run examples/snapshots/panda-reach.safetensors --plant arm
    python -m nearl.view arm --task Panda-reach          # then open http://localhost:8080

What is drawn is what the loop sends: state, proposal, target, mode, violations. Which limit holds a joint stands in the flight log.
"""

import argparse
import html
import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nearl import _core
from nearl.link import Link
from nearl.states import States

Floats = NDArray[np.float64]
ROBOT, GHOST = (208, 116, 58), (0, 114, 178)
PULL_OF_NOTE = 1e-6  # [rad/s]


class ViewError(RuntimeError):
    """Nothing can be shown; the message says what is missing."""


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
        look = {"color": colour, "opacity": opacity}
        self._geoms = [g for g in range(model.ngeom) if model.geom_type[g] in _shapes(mujoco)]
        self._bones = [] if self._geoms else list(range(2, model.nbody))
        self._parts = [
            server.scene.add_mesh_simple(f"/{name}/{i}", mesh.vertices, mesh.faces, **look)
            for i, mesh in enumerate([self._geom_mesh(g) for g in self._geoms] + [self._bone_mesh(b) for b in self._bones])
        ]

    def show(self, q: Floats) -> None:
        """Puts the robot at ``q`` (nq), Pinocchio's convention."""
        self._data.qpos[:] = qpos_of(self._model, q)
        self._mujoco.mj_kinematics(self._model, self._data)
        quat = np.empty(4)
        for part, (position, rotation) in zip(self._parts, self._places()):
            self._mujoco.mju_mat2Quat(quat, rotation)
            part.position, part.wxyz = position, quat.copy()

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


def panel(names: list[str], low: Floats, high: Floats, states: States) -> str:
    """The newest tick as HTML: mode, counts, and a bar for each joint, blue where the projection holds it back."""
    q, v = states.q[-1], states.v[-1]
    pull = states.proposal_v[-1] - states.target_v[-1]
    shift = len(q) - len(v)
    rows = []
    for i, name in enumerate(names):
        share = np.nan if not low[i] < high[i] else float(np.clip((q[i + shift] - low[i]) / (high[i] - low[i]), 0, 1))
        held = abs(pull[i]) > PULL_OF_NOTE
        bar = "" if np.isnan(share) else f'<div style="width:{100 * share:.0f}%;height:8px;background:{"#0072B2" if held else "#98a2b3"}"></div>'
        rows.append(
            f'<tr><td>{html.escape(name)}</td><td style="width:90px;border:1px solid #d0d5dd">{bar}</td>'
            f"<td>{q[i + shift]:.2f}</td><td>{v[i]:.2f}</td><td>{f'{pull[i]:+.2g}' if held else ''}</td></tr>"
        )
    raw, target = int(states.raw_violations.sum()), int(states.target_violations.sum())
    head = "<tr><th>joint</th><th>in its range</th><th>q</th><th>v</th><th>held back by [rad/s]</th></tr>"
    now = f"<b>{html.escape(str(states.mode[-1]))}</b>, tick {int(states.tick[-1]):,}, policy {int(states.version[-1])}"
    return (
        f'<div style="font:12px sans-serif;padding:8px">{now}<br>'
        f"limits broken since the last picture: {raw} by proposals, {target} by targets<table>{head}{''.join(rows)}</table></div>"
    )


def view(name: str, task: str, port: int = 8080, seconds: float | None = None, rate: float = 20.0) -> int:
    """Shows the loop of ``name`` until it ends, or for ``seconds``; returns the number of pictures.

    Args:
        name: As in ``nearl run --plant NAME``.
        task: Name of the task or task file, whose robot is drawn.
        port: Of the page, on this machine alone.
        seconds: How long; None until the loop is gone.
        rate: Pictures a second.

    Raises:
        ViewError: viser is not installed.
        ConnectionError: there is no loop.
    """
    try:
        import mujoco
        import viser
    except ImportError as error:
        raise ViewError(f"the live view needs viser: pip install 'nearl[view]' ({error})") from error
    env = _core.Env(task)
    model = mujoco.MjModel.from_xml_string(env.model_text)
    names = list(env.joint_names)
    low, high = (model.jnt_range[-len(names) :, side] if len(names) <= model.njnt else np.zeros(len(names)) for side in (0, 1))
    with Link(name) as link:
        states = link.states()
        server = viser.ViserServer(host="127.0.0.1", port=port, label=f"NEARL: {name}", verbose=False)
        server.scene.add_grid("/floor", width=4.0, height=4.0)
        robot, ghost = Figure(server, "robot", model, ROBOT, 1.0), Figure(server, "proposal", model, GHOST, 0.3)
        board = server.gui.add_html("")
        print(f"http://localhost:{port} (robot orange, its proposal blue)", flush=True)
        shown, end = 0, None if seconds is None else time.monotonic() + seconds
        try:
            while end is None or time.monotonic() < end:
                robot.show(states.q[-1])
                ghost.show(states.proposal_q[-1])
                board.content = panel(names, low, high, states)
                shown += 1
                time.sleep(1.0 / rate)
                states = link.states()
        except (TimeoutError, ConnectionError) as gone:
            print(f"nearl.view: {gone}", file=sys.stderr)
        finally:
            server.stop()
    return shown


def main(arguments: list[str] | None = None) -> int:
    """0 on success, 1 with one sentence on standard error otherwise."""
    parser = argparse.ArgumentParser(prog="nearl view", description="A running loop in a browser.")
    parser.add_argument("name", metavar="NAME", help="as in `nearl run --plant NAME`")
    parser.add_argument("--task", required=True, help="task name or file, whose robot is drawn")
    parser.add_argument("--port", type=int, default=8080)
    parser.add_argument("--seconds", type=float)
    given = parser.parse_args(arguments)
    try:
        view(given.name, given.task, given.port, given.seconds)
    except (ViewError, OSError, RuntimeError, ValueError) as error:
        print(f"nearl view: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
