"""The live view: what it says about a tick, what it hears of a running loop and of a training, and what a browser shows."""

import contextlib
import io
import re
import shutil
import socket
import subprocess
import sys
import uuid
from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import ROOT

import nearl
from nearl import _core, view
from nearl.view.panel import BARS
from nearl.view.server import serve
from nearl.view.show import PROPOSAL, ROBOT, TARGET, source_of
from nearl.view.sources import labels

SNAPSHOT = ROOT / "examples" / "snapshots" / "panda-reach.safetensors"
LIT = (255, 176, 0)
NEARL = ROOT / "target" / "release" / "nearl"
LEDGER = {"status": "solved", "rung": "active set", "active": 1, "iterations": 3, "moved": 0.5, "slack": 0.0, "residual": 1e-12, "duration_ns": 4200}


def arm(n_rows: int = 2) -> view.Robot:
    rows = ["elbow", "wrist", *(f"wall {i}" for i in range(n_rows))]
    limits = {
        "lower_position": np.array([-1.0, 0.0]), "upper_position": np.array([1.0, np.inf]), "velocity": np.array([2.0, np.inf]),
        "acceleration": np.array([10.0, np.inf]), "effort": np.array([5.0, np.inf]),
    }  # fmt: skip
    return view.Robot(_core.Env("Panda-reach"), rows[:2], rows, limits)


def picture(**given) -> view.Picture:
    q, v = np.array([0.5, 1.0]), np.array([-1.0, 0.0])
    quiet = view.Picture("active", "none", 8, 3, 1, 50, q, v, (q, v), (q, v + [0.005, 0.0]), 0.001, [], LEDGER, 7, 0, 70, 0, np.array([2e-4, 4e-4]), 0)
    quiet = replace(quiet, force=np.array([-2.0, 1.0]))
    return replace(quiet, **given)


def cells(words: str, name: str) -> list[str]:
    """The cells after the first of the line of ``name``."""
    return re.search(rf'<tr><td title="{name}">{name}</td>(.*?)</tr>', words)[1].split("</td>")[:-1]


def test_a_bar_stands_where_the_joint_is_within_its_limits() -> None:
    words = view.Panel(arm()).html(picture(), {})
    position, speed, acceleration, force = cells(words, "elbow")
    assert "left:75.0%" in position and "0.50" in position, "0.5 from -1 to 1"
    assert "left:25.0%" in speed and "-1.00" in speed, "-1 of 2"
    assert "left:75.0%" in acceleration and "</div>5.0" in acceleration, "0.005 in a millisecond, of 10"
    assert "left:30.0%" in force and "</div>-2.0" in force, "-2 of 5"
    assert all('class="bar' not in cell for cell in cells(words, "wrist")), "no limit, no bar"
    assert "bar lit" not in words and "ACTIVE" in words and "70 by proposals, 0 by targets" in words


@pytest.mark.parametrize("kind, place", [("position", 0), ("viability", 0), ("velocity", 1), ("velocity_profile", 1), ("acceleration", 2), ("jerk", 2)])
def test_the_bar_of_an_active_row_is_lit_with_its_multiplier(kind: str, place: int) -> None:
    words = view.Panel(arm()).html(picture(held=[view.Held(0, "elbow", kind, "upper", 1.25, 4)]), {})
    lit = ["bar lit" in cell for cell in cells(words, "elbow")]
    assert lit == [i == place for i in range(4)] and "↑1.2" in cells(words, "elbow")[place]


@pytest.mark.parametrize("kind", ["torque", "torque_rate", "torque_speed"])
def test_a_row_of_a_motor_lights_the_bar_of_its_force(kind: str) -> None:
    robot = arm(0)
    robot.rows = labels([*robot.joints, *robot.joints], [None, None, kind, kind])
    words = view.Panel(robot).html(picture(held=[view.Held(3, robot.rows[3], kind, "lower", 0.5, 1)]), {})
    assert ["bar lit" in cell for cell in cells(words, "elbow")] == [False] * 4
    assert "↓0.5" in cells(words, "wrist")[3], "it has no limit, hence no bar"
    words = view.Panel(robot).html(picture(held=[view.Held(2, robot.rows[2], kind, "lower", 0.5, 1)]), {})
    assert ["bar lit" in cell for cell in cells(words, "elbow")] == [False, False, False, True]


def test_forces_of_motors_are_gear_times_action_or_those_of_drives(rng: np.random.Generator) -> None:
    """Gears and gains as the robot's and the task's file say them."""
    cheetah = _core.Env("HalfCheetah-v5")
    before = cheetah.qpos.copy()
    action = rng.uniform(-2, 2, 6)
    force = cheetah.motor_forces(rng.uniform(-0.1, 0.1, 9), np.zeros(9), action)
    np.testing.assert_allclose(force, [0, 0, 0, *(np.array([120, 90, 60, 120, 60, 30]) * np.clip(action, -1, 1))])
    assert (cheetah.qpos == before).all(), "beside the environment"
    panda, torque = _core.Env("Panda-reach"), rng.uniform(-30, 30, 7)
    effort = nearl.Model.from_urdf(ROOT / "examples/robots/panda/panda.urdf").effort_limit
    np.testing.assert_allclose(panda.motor_forces(np.zeros(7), np.zeros(7), torque), np.clip(torque, -effort, effort))
    anymal = _core.Env(str(ROOT / "examples/tasks/anymal-walk.toml"))
    q, v, wanted = np.zeros(19), rng.uniform(-0.5, 0.5, 18), rng.uniform(-0.3, 0.3, 12)
    q[2], q[6], q[7:] = 1.0, 1.0, rng.uniform(-0.3, 0.3, 12)
    of = np.array([anymal.joint_names.index(name) + 5 for name in anymal.actuator_names])  # degree of freedom of each drive
    np.testing.assert_allclose(anymal.motor_forces(q, v, wanted)[of], 80.0 * (wanted - q[of + 1]) - 2.0 * v[of], atol=1e-9)


def test_every_kind_of_a_single_joint_has_a_bar() -> None:
    """The projector's own rows of the Panda: what it names by a joint's number lights one of that joint's bars."""
    model = nearl.Model.from_urdf(ROOT / "examples/robots/panda/panda.urdf")
    limits = [nearl.PositionLimit(model, 0.01), nearl.VelocityLimit(model, scale=0.9), nearl.AccelerationLimit(model, 10.0)]
    projector, rng, seen = nearl.Projector(model, limits, dt=0.001), np.random.default_rng(0), set()
    low, high = model.lower_position_limit, model.upper_position_limit
    for _ in range(300):
        q, v = rng.uniform(low, high), rng.uniform(-2, 2, 7) * rng.integers(0, 2)
        target = projector.project(q, v, q, v + rng.uniform(-4, 4, 7))
        seen |= {row["kind"] for row in target.active if row["row"] < 7}
    assert {"position", "velocity", "acceleration", "viability"} <= seen <= BARS.keys(), seen


def test_rows_over_several_joints_have_a_line_each_and_the_active_ones_come_first() -> None:
    held = [view.Held(31, "wall 29", "user", "lower", 0.5, 2), view.Held(5, "wall 3", "user", "upper", 2.0, 2)]
    words = view.Panel(arm(40)).html(picture(held=held), {})
    assert "bar lit" in cells(words, "wall 29")[0] and "width:25%" in cells(words, "wall 29")[0], "a quarter of the largest"
    assert "width:100%" in cells(words, "wall 3")[0] and "↑ <b>2</b>" in cells(words, "wall 3")[1]
    assert "and 24 rows more, 0 of them active" in words


def test_latency_stands_against_the_deadline() -> None:
    panel = view.Panel(arm())
    quiet, late = panel.html(picture(), {}), panel.html(picture(latency=np.array([2e-4, 1.5e-3]), overruns=1), {})
    assert "largest 400 µs, deadline 1,000 µs" in quiet and "the loop itself took longer: 0" in quiet and quiet.count("<rect") == 1
    assert late.count("<rect") == 2 and late.count('fill="#b91c1c"') == 1, "the late one alone is red"
    assert "the loop itself took longer: 1" in late
    assert "deadline" not in view.Panel(arm()).html(picture(latency=None, overruns=None), {}), "a training keeps no real time"


def test_a_free_joint_has_its_w_where_mujoco_wants_it_and_stays_where_it_is_ahead_in_time() -> None:
    model = mujoco.MjModel.from_xml_string(_core.Env("Ant-v5").model_text)
    q = np.arange(15.0)
    assert view.qpos_of(model, q).tolist() == [0, 1, 2, 6, 3, 4, 5, *range(7, 15)]
    assert view.led(q, np.ones(14), 0.5).tolist() == [*range(7), *(x + 0.5 for x in range(7, 15))]
    assert view.led(np.zeros(2), np.array([1.0, -2.0]), 0.25).tolist() == [0.25, -0.5]


@contextlib.contextmanager
def loop(*options: str) -> Iterator[str]:
    """A Panda in MuJoCo and the loop that runs it, in processes of their own."""
    if not NEARL.exists():
        pytest.fail(f"{NEARL} was not built: run 'make build'")
    name = f"view-{uuid.uuid4().hex[:12]}"
    plant = subprocess.Popen([NEARL, "plant", "Panda-reach", "--name", name, *options], stdout=subprocess.DEVNULL)
    run = subprocess.Popen([NEARL, "run", SNAPSHOT, "--plant", name], stdout=subprocess.DEVNULL)
    try:
        yield name
    finally:
        for process in (run, plant):
            process.terminate()
        for process in (run, plant):
            process.wait(timeout=30)


def test_a_running_loop_says_its_task_limits_rows_and_what_holds_it() -> None:
    controller = nearl.Controller.load(SNAPSHOT)
    with loop() as name:
        source = view.Loop(name, None)
        pictures = [p for p in (source.next(0.1) for _ in range(30)) if p is not None]
        source.close()
    assert source.robot.env.task == "Panda-reach" and source.robot.rows == [f"panda_joint{i}{kind}" for kind in ("", " torque") for i in range(1, 8)]
    for what, values in controller.limits.items():
        np.testing.assert_array_equal(source.robot.limits[what], values)
    ticks = [p.tick for p in pictures]
    assert len(pictures) > 20 and ticks == sorted(ticks) and sum(p.ticks for p in pictures) + pictures[-1].lost >= ticks[-1] - ticks[0]
    acting = [p for p in pictures if p.proposal is not None]
    held = [h for p in acting for h in p.held]
    assert acting and held and all(h.multiplier > 0 and h.name == source.robot.rows[h.row] and h.kind in {*BARS, "torque"} for h in held)
    assert all(len(p.latency) == p.ticks and (p.latency > 0).all() and p.period == 0.001 for p in acting)
    assert all((np.abs(p.force) <= controller.limits["effort"] + 1e-9).all() and p.force.any() for p in acting)
    assert all(p.broken == 0 for p in acting) and max(p.raw_total for p in acting) > 0


def test_a_plant_in_lockstep_has_no_deadline() -> None:
    with loop("--lockstep") as name:
        source = view.Loop(name, "Panda-reach")
        shown = next(p for p in (source.next(0.1) for _ in range(50)) if p is not None)
        source.close()
    assert shown.latency is None and shown.overruns is None and "deadline" not in view.Panel(source.robot).html(shown, {})


def test_a_loop_that_is_not_there_is_named() -> None:
    with pytest.raises(ConnectionError, match="nobody-here"):
        view.Loop("nobody-here", None, patience=0.2)
    with pytest.raises(view.ViewError, match="no folder 'runs/nothing'"):
        source_of("runs/nothing", None)


def test_a_training_is_shown_with_its_newest_policy_and_its_curves(tmp_path) -> None:
    out = tmp_path / "run"
    with pytest.raises(view.ViewError, match="not a run folder"):
        view.Training(tmp_path)
    train = [NEARL, "train", "HalfCheetah-v5", "--algo", "pid2-ib", "--out", out, "--steps", "12000", "--set", "train.n_steps=256"]
    subprocess.run([*train, "--set", "train.n_envs=8"], check=True, capture_output=True)
    source = view.Training(out)
    first = source.next(0.1)
    assert first.mode == "training" and first.latency is None and first.ticks == round(0.1 / source.robot.env.dt)
    assert first.proposal is not None and first.q.shape == (9,) and set(source.curves()) >= {"proposals outside", "reached outside"}
    low, high, velocity = (source.robot.limits[k] for k in ("lower_position", "upper_position", "velocity"))
    for _ in range(20):
        p = source.next(0.02)
        q, v = p.target
        assert (q >= low - 1e-9).all() and (q <= high + 1e-9).all() and (np.abs(v) <= velocity + 1e-9).all()
    assert source.next(0.02).raw_total >= p.raw_total and p.broken_total == 0
    before = source.next(0.02).version
    subprocess.run([NEARL, "train", "HalfCheetah-v5", "--resume", out, "--steps", "20000"], check=True, capture_output=True)
    source._looked = 0.0
    assert source.next(0.02).version > before, "the newer policy took over"


@contextlib.contextmanager
def browser_at(port: int, size: tuple[int, int]) -> Iterator:
    sync_api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    arguments = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(f"http://127.0.0.1:{port}")
        yield page
        browser.close()


@contextlib.contextmanager
def page_of(source: view.Loop) -> Iterator[view.Page]:
    pytest.importorskip("viser")
    server = serve(0, "test")
    yield view.Page(server, source)
    server.stop()


def answer(port: int, head: bytes) -> bytes:
    """What the view sends back at first; nothing where it hangs up."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        connection.sendall(head)
        with contextlib.suppress(ConnectionError):
            return connection.recv(65536)
    return b""


WEBSOCKET = (
    "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    "Sec-WebSocket-Protocol: viser-v1\r\n"
)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    pytest.importorskip("viser")
    server = serve(0, "test")
    yield server.get_port()
    server.stop()


@pytest.mark.parametrize("upgrade, good", [("", b"200 OK"), (WEBSOCKET, b"101 Switching Protocols")], ids=["page", "websocket"])
def test_the_view_answers_what_was_asked_of_its_own_names_alone(port: int, upgrade: str, good: bytes) -> None:
    def asked(*lines: str) -> bytes:
        return answer(port, ("GET / HTTP/1.1\r\n" + "".join(f"{line}\r\n" for line in lines) + upgrade + "\r\n").encode())

    own = [f"{name}:{at}" for name in ("localhost", "LOCALHOST", "127.0.0.1", "[::1]") for at in (port, 9000)] + ["localhost"]
    for host in own:
        assert good in asked(f"Host: {host}") and good in asked(f"Host: {host}", f"Origin: http://{host}"), host
    foreign = ("evil.example", f"evil.example:{port}", "localhost.evil.example", f"localhost:{port}.evil.example", "127.0.0.1.evil.example", "")
    refused = [(f"Host: {host}",) for host in foreign]
    refused += [(f"Host: {own[0]}", f"Origin: {origin}") for origin in ("http://evil.example", "null", f"http://localhost:{port + 1}", f"https://{own[0]}")]
    for lines in [*refused, (), (f"Host: {own[0]}", "Host: evil.example"), (f"Host: {own[0]}", f"Origin: http://{own[0]}", "Origin: http://evil.example")]:
        given = asked(*lines)
        assert b" 403 " in given and good not in given, lines
        name, body = ("Origin" if "Origin" in "".join(lines) else "Host"), given.split(b"\r\n\r\n")[1].decode()
        assert body.startswith(f"nearl view: {name} of this request is ") and body.endswith(f"; open http://localhost:{port}\n"), body


def test_a_viser_that_cannot_be_checked_is_not_shown(monkeypatch) -> None:
    viser = pytest.importorskip("viser")
    stopped = []

    class Other:
        def __init__(self, **_) -> None:
            pass

        def stop(self) -> None:
            stopped.append(True)

    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(view.ViewError, match="cannot check who asks viser"):
        serve(0, "test")
    assert stopped


def test_what_is_no_request_leaves_no_traceback_and_an_error_of_ours_does() -> None:
    pytest.importorskip("viser")
    program = """if True:
        import socket, sys, time
        from nearl.view import server
        own = server.serve(0, "test")
        for head in (b"\\x16\\x03\\x01\\x02\\r\\n\\r\\n", b"POST / HTTP/1.1\\r\\n\\r\\n", b"GET /", b""):
            with socket.create_connection(("127.0.0.1", own.get_port()), 30) as connection:
                connection.sendall(head)
                connection.shutdown(socket.SHUT_WR)
                while connection.recv(4096):
                    pass
        print("quiet", file=sys.stderr, flush=True)
        server._refusal = lambda *_: 1 / 0
        with socket.create_connection(("127.0.0.1", own.get_port()), 30) as connection:
            connection.sendall(b"GET / HTTP/1.1\\r\\nHost: localhost\\r\\n\\r\\n")
            while connection.recv(4096):
                pass
        own.stop()
    """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    before, _, after = done.stderr.partition("quiet\n")
    assert done.returncode == 0 and before == "" and "ZeroDivisionError" in after, done.stderr


class Still:
    """A source of pictures that are made by hand."""

    def __init__(self) -> None:
        env = _core.Env("Panda-reach")
        controller = nearl.Controller.load(SNAPSHOT)
        self.robot, self.title = view.Robot(env, env.joint_names, labels(controller.row_names, controller.row_kinds), controller.limits), "still"

    def curves(self) -> dict:
        return {}

    def picture(self, q: list[float], held: list[view.Held], ahead: float) -> view.Picture:
        at, still = np.array(q), np.zeros(7)
        led = (at + ahead, still)
        return view.Picture("active", None, 1, 1, 0, 50, at, still, led, (at - ahead, still), 0.001, held, LEDGER, 0, 0, 0, 0, np.array([1e-4]), 0)


def pixels(png: bytes) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def shot_with(tab, holds, what: str) -> np.ndarray:
    """The first screenshot in which ``holds``; a renderer in software draws when it comes to it."""
    for _ in range(20):
        shot = pixels(tab.screenshot(timeout=180_000))
        if holds(shot):
            return shot
        tab.wait_for_timeout(1000)
    pytest.fail(f"no screenshot shows {what}")


def near(image: np.ndarray, colour: tuple[int, int, int], by: int = 12) -> int:
    """Pixels of that colour."""
    return int((np.abs(image - colour) <= by).all(axis=2).sum())


def tinted(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Where the picture has the hue of ``colour``, whatever the light."""
    import colorsys

    wanted = colorsys.rgb_to_hsv(*(c / 255 for c in colour))[0]
    high, low = image.max(axis=2), image.min(axis=2)
    spread = np.maximum(high - low, 1)
    r, g, b = np.moveaxis(image, 2, 0)
    hue = np.where(high == r, ((g - b) / spread) % 6, np.where(high == g, (b - r) / spread + 2, (r - g) / spread + 4)) / 6
    apart = np.abs((hue - wanted + 0.5) % 1 - 0.5)
    return (apart < 0.035) & (spread > 40)


def test_a_browser_shows_robot_ghosts_and_lit_bars() -> None:
    """One page: a quiet arm, the same with a row active, with proposal and target elsewhere, and moved."""
    still, rest = Still(), [0, 0, 0, -1.5, 0, 1.5, 0]
    row = view.Held(3, "panda_joint4", "velocity", "upper", 1.5, 9)
    scene = np.s_[:, :500]  # left of the panel
    with page_of(still) as page:
        page.show(still.picture(rest, [], 0.0))
        with browser_at(page.server.get_port(), (900, 640)) as tab:
            tab.wait_for_selector(".nearl", timeout=120_000)
            quiet = shot_with(tab, lambda shot: tinted(shot[scene], ROBOT).sum() > 1000, "the robot")
            assert near(quiet, LIT) == 0
            page.show(still.picture(rest, [row], 0.0))
            shot_with(tab, lambda shot: near(shot, LIT) > 200, "the lit bar of the active row")
            page.show(still.picture(rest, [], 0.6))
            ghosts = [tinted(quiet[scene], colour).sum() for colour in (PROPOSAL, TARGET)]
            shot_with(
                tab,
                lambda shot: near(shot, LIT) == 0 and all(tinted(shot[scene], c).sum() > n + 500 for c, n in zip((PROPOSAL, TARGET), ghosts)),
                "no lit bar, and the ghosts where proposal and target are",
            )
            page.show(still.picture([1.2, 0.8, 0, -0.8, 0, 1.5, 0], [], 0.0))
            shot_with(tab, lambda shot: (tinted(quiet[scene], ROBOT) != tinted(shot[scene], ROBOT)).sum() > 1000, "the robot elsewhere")
            wide = tab.evaluate("(() => { const e = document.querySelector('.nearl'); return e.scrollWidth - e.clientWidth })()")
    assert wide <= 0, "nothing runs over the edge of the panel"
