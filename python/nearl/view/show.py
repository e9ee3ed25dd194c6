"""The page of the live view: a scene with the robot, its proposal and its target, and the panel beside it."""

import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nearl.arguments import task_of
from nearl.render import compiled
from nearl.view.figure import Figure, led
from nearl.view.panel import Panel
from nearl.view.server import serve
from nearl.view.sources import Loop, Picture, Source, ViewError
from nearl.view.training import Training

Floats = NDArray[np.float64]
ROBOT, PROPOSAL, TARGET = (208, 116, 58), (0, 114, 178), (0, 158, 115)
PATIENCE = 5.0  # [s] without a tick until the loop counts as gone
APART = 0.02  # [rad or m] from the robot within which a ghost would only stain it
AHEAD = 0.25  # [s] by which proposal and target are drawn ahead
LEGEND = """<div style="font:12px system-ui,sans-serif;padding:6px 10px"><b style="color:#d0743a">●</b> robot
<b style="color:#0072b2">●</b> what the policy proposes <b style="color:#009e73">●</b> its projection</div>"""


class Page:
    """A scene and a panel in a browser.

    Args:
        server: The viser server.
        source: Where the pictures come from.
    """

    def __init__(self, server: Any, source: Source):
        import mujoco

        self.server, self._source = server, source
        model = compiled(mujoco, source.robot.env)
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        server.scene.add_grid("/floor", width=20.0, height=20.0)
        self._robot = Figure(server, "robot", model, ROBOT, 1.0)
        self._ghosts = [Figure(server, "proposal", model, PROPOSAL, 0.35), Figure(server, "target", model, TARGET, 0.35)]
        server.gui.add_html(LEGEND)
        self._ahead = server.gui.add_slider("drawn ahead [s]", min=0.0, max=1.0, step=0.05, initial_value=AHEAD)
        self._board, self._panel = server.gui.add_html(""), Panel(source.robot)
        self._aimed = False

    def show(self, picture: Picture) -> None:
        """Puts the newest picture on the page."""
        with self.server.atomic():
            self._robot.show(picture.q)
            for figure, state in zip(self._ghosts, (picture.proposal, picture.target)):
                ahead = None if state is None else led(*state, self._ahead.value)
                figure.show(None if ahead is None or np.abs(ahead - picture.q).max() < APART else ahead)
            self._board.content = self._panel.html(picture, self._source.curves())
        if not self._aimed:
            self._aimed, (centre, size) = True, self._robot.room()
            camera = self.server.initial_camera
            camera.look_at, camera.position = tuple(centre), tuple(centre + (0.6 + 1.3 * size) * np.array([0.8, -0.7, 0.35]))


def source_of(name: str, task: str | os.PathLike[str] | None) -> Source:
    """The run folder at ``name`` if there is one, else the loop of that name."""
    if "/" in name and not Path(name).is_dir():
        raise ViewError(f"there is no folder '{name}'; give the run folder of a training (`nearl train --out FOLDER`) or the name of a loop")
    return Training(Path(name)) if Path(name).is_dir() else Loop(name, None if task is None else task_of(task))


def view(name: str, task: str | os.PathLike[str] | None = None, port: int = 8080, seconds: float | None = None, rate: float = 20.0) -> int:
    """Shows a running loop until it ends, or a training in its run folder, for ``seconds`` at most; returns the number of pictures.

    Args:
        name: As in ``nearl run --plant NAME``, or a run folder.
        task: Name of the task or task file, whose robot is drawn; None takes what the loop says.
        port: Of the page, on this machine alone; see docs/SECURITY.md for who can open it.
        seconds: How long; None until the loop is gone.
        rate: Pictures a second.

    Raises:
        ViewError: viser is not installed or of a version that cannot be checked, or the robot is not known.
        VideoError: MuJoCo cannot read the robot file, or a file that it names.
        ConnectionError: there is no loop.
    """
    try:
        import mujoco  # noqa: F401
        import viser  # noqa: F401
    except ImportError as error:
        raise ViewError(f"the live view needs viser: pip install 'nearl[view]' ({error})") from error
    if not 0 <= port <= 65535:
        raise ValueError(f"port {port} is none; give 1 to 65535, or 0 for any that is free")
    source = source_of(name, task)
    server = serve(port, f"NEARL: {source.title}")
    page = Page(server, source)
    print(f"http://localhost:{server.get_port()} (robot orange, its proposal blue, the projected target green)", flush=True)
    shown, end, heard = 0, None if seconds is None else time.monotonic() + seconds, time.monotonic()
    try:
        while end is None or time.monotonic() < end:
            picture = source.next(1.0 / rate)
            if picture is not None:
                page.show(picture)
                shown, heard = shown + 1, time.monotonic()
            elif time.monotonic() > heard + PATIENCE:
                print(f"nearl view: the loop of `{name}` sent nothing for {PATIENCE:g} s; it is gone", file=sys.stderr)
                break
    finally:
        server.stop()
        source.close()
    return shown
