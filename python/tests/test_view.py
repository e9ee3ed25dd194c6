"""The live view: what it says about a tick, and that a browser shows the robot where the loop says it is."""

import shutil
import socket
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nearl import _core, view


def tick(q, v_proposal, v_target) -> SimpleNamespace:
    one = {"q": q, "v": v_target, "proposal_v": v_proposal, "target_v": v_target}
    counts = {"raw_violations": [3, 4], "target_violations": [0, 0], "tick": [7, 8], "version": [1, 1]}
    return SimpleNamespace(mode=["active", "active"], **{k: np.array([x, x]) for k, x in one.items()}, **{k: np.array(x) for k, x in counts.items()})


def test_the_panel_says_what_holds_a_joint_back() -> None:
    words = view.panel(["elbow", "wrist"], np.array([-1.0, 0.0]), np.array([1.0, 2.0]), tick([0.5, 1.0], [2.0, 0.1], [0.5, 0.1]))
    assert "7 by proposals, 0 by targets" in words and "tick 8" in words
    elbow, wrist = words.split("<tr>")[2:4]
    assert "width:75%" in elbow and "+1.5" in elbow and "#0072B2" in elbow
    assert "width:50%" in wrist and "#98a2b3" in wrist


def test_a_free_joint_has_its_w_where_mujoco_wants_it() -> None:
    model = mujoco.MjModel.from_xml_string(_core.Env("Ant-v5").model_text)
    q = np.arange(15.0)
    assert view.qpos_of(model, q).tolist() == [0, 1, 2, 6, 3, 4, 5, *range(7, 15)]


def test_a_browser_shows_the_robot_where_it_is() -> None:
    viser, sync_api = pytest.importorskip("viser"), pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium here")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    model = mujoco.MjModel.from_xml_string(_core.Env("Panda-reach").model_text)
    figure = view.Figure(server, "robot", model, view.ROBOT, 1.0)
    server.initial_camera.position, server.initial_camera.look_at = (2.0, 0.0, 0.8), (0.0, 0.0, 0.5)
    pictures = []
    arguments = ["--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        page = browser.new_page(viewport={"width": 600, "height": 500})
        page.goto(f"http://127.0.0.1:{port}")
        for q in ([0, 0, 0, -1.5, 0, 1.5, 0], [1.2, 0.8, 0, -0.8, 0, 1.5, 0]):
            figure.show(np.array(q, float))
            page.wait_for_timeout(4000)
            pictures.append(page.screenshot())
        browser.close()
    server.stop()
    first, second = (orange(picture) for picture in pictures)
    assert first.sum() > 300 and second.sum() > 300, "the arm is in both pictures"
    assert (first != second).sum() > 300, "and moved"


def orange(png: bytes) -> np.ndarray:
    import io

    from PIL import Image

    r, g, b = np.moveaxis(np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int), 2, 0)
    return (r > g + 30) & (g > b)
