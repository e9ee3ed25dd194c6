"""A driver in Python in front of a real loop: the limits hold, and a plant alone is told to brake at once."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from conftest import ROOT

import nearl

CARRIAGE = """<robot name="carriage"><link name="rail"/><link name="carriage"><inertial><mass value="2"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="carriage"/><axis xyz="1 0 0"/>
<limit lower="-0.3" upper="0.4" velocity="0.8" effort="40"/></joint></robot>"""
RECIPE = """
[time]
dt = 0.001
[policy]
joints = ["slide"]
action = { scale = 20.0 }
observation = [{ term = "joint_pos" }, { term = "joint_vel" }]
"""


def name(what: str) -> str:
    return f"py{os.getpid()}-{what}"


def spring(tmp_path):
    """A policy that is a spring and a damper: force = -20 (2 q + 0.5 v)."""
    (tmp_path / "carriage.urdf").write_text(CARRIAGE)
    (tmp_path / "recipe.toml").write_text(RECIPE)
    policy = nearl.Policy.from_layers([([[-2.0, -0.5]], [0.0], "identity")], [0, 0], [1, 1], (-np.inf, np.inf), (-np.inf, np.inf))
    snapshot = tmp_path / "spring.safetensors"
    policy.controller(tmp_path / "carriage.urdf", tmp_path / "recipe.toml", "spring").save(snapshot)
    return snapshot


def open_plant(what: str, lockstep: bool) -> nearl.Plant:
    return nearl.Plant(name(what), ["slide"], ["q.slide", "v.slide"], 0.001, 1, lockstep=lockstep)


def test_a_loop_in_the_same_process_acts_on_every_state(tmp_path) -> None:
    q, v, dt = 0.2, 0.0, 0.001
    with open_plant("loop", lockstep=True) as plant, nearl.Loop(spring(tmp_path), name("loop"), ramp=0.0) as loop:
        acted = 0
        for tick in range(1500):
            turn, action = plant.exchange([q], [v], [q, v], patience=5.0, time=tick * dt)
            if turn == "act":
                acted += 1
                np.testing.assert_allclose(action, -20 * (2 * q + 0.5 * v), atol=1e-5)
            force = action[0] if action is not None else 0.0
            v += dt * force / 2.0
            q += dt * v
        assert acted > 1400 and plant.attached and loop.running
        assert abs(q) < 0.1
    assert loop.report["ticks"] > 1400


def test_a_plant_alone_is_told_to_brake_at_once() -> None:
    with open_plant("alone", lockstep=False) as plant:
        begin = time.monotonic()
        turns = {plant.exchange([0.0], [0.0], [0.0, 0.0], patience=0.5)[0] for _ in range(20)}
        assert turns == {"brake"} and not plant.attached
        assert time.monotonic() - begin < 5.0, "without a loop there is no waiting"
    with pytest.raises(RuntimeError, match="the plant is closed"):
        plant.exchange([0.0], [0.0], [0.0, 0.0], patience=0.0)


def test_mistakes_are_named(tmp_path) -> None:
    with open_plant("mine", lockstep=False) as plant:
        with pytest.raises(ConnectionError):
            open_plant("mine", lockstep=False)
        with pytest.raises(ValueError, match=r"obs has shape \(1,\), expected \(2,\)"):
            plant.exchange([0.0], [0.0], [0.0], patience=0.0)
    with pytest.raises(ValueError, match="dt is 0 s"):
        nearl.Plant(name("slow"), ["slide"], ["q.slide"], 0.0, 1)
    loop = nearl.Loop(spring(tmp_path), name("nobody"), patience=0.3)
    with pytest.raises(RuntimeError, match="nobody"):
        loop.stop()


def test_names_and_numbers_of_a_plant_are_named() -> None:
    right = {"joints": ["slide"], "observation": ["q.slide", "v.slide"], "dt": 0.01, "nu": 1}
    for wrong, error, said in (
        ({"joints": "slide"}, ValueError, r"joints is 'slide', a single name; give a list of names, e.g. \['slide'\]"),
        ({"observation": "q.slide"}, ValueError, "observation is 'q.slide', a single name"),
        ({"joints": [1]}, ValueError, r"joints\[0\] is 1; give names"),
        ({"dt": "0.01"}, TypeError, "dt is of str; give a number"),
        ({"joints": ["slide", "slide"], "nv": 2}, ValueError, "names joint `slide` twice: give each joint once"),
        ({"joints": ["slide", "turn"], "nv": 1}, ValueError, "names 2 joints, and has 1 velocity entries"),
        ({"watchdog": None}, TypeError, "watchdog is of NoneType; give a number"),
        ({"joints": []}, ValueError, "a robot of 0 joints and 1 entries of an action cannot be moved"),
        ({"joints": [""]}, ValueError, "names joint 0 ``, which is empty, longer than 255 bytes or no plain text"),
        ({"observation": ["q.slide", "v\n"]}, ValueError, r"names entry of its observation 1 `v\\n`, which is empty"),
        ({"nq": 0}, ValueError, "nq is 0; give the number of entries of a configuration"),
        ({"nu": -1}, ValueError, "nu is -1; give the number of entries of an action"),
        ({"nu": 10**30}, ValueError, f"nu is {10**30}; give the number of entries of an action"),
        ({"nq": 10**30}, ValueError, f"nq is {10**30}; give the number of entries of a configuration"),
        ({"nv": 10**30}, ValueError, f"nv is {10**30}; give the number of entries of a velocity"),
        ({"nu": 0}, ValueError, "a robot of 1 joints and 0 entries of an action cannot be moved"),
    ):
        with pytest.raises(error, match=said):
            nearl.Plant(name("named"), **{**right, **wrong})
    with open_plant("named", lockstep=False) as plant:
        for episode in (-3, 2**64):
            with pytest.raises(ValueError, match=rf"episode is {episode}; give its number, counted from 0 to 2\*\*64 - 1"):
                plant.exchange([0.1], [0.0], [0.1, 0.0], patience=0.0, episode=episode)
        for state, said in (
            ((["a"], [0.0], [0.1, 0.0]), r"q\[0\] is 'a'; give a number"),
            (([0.1], [None], [0.1, 0.0]), r"v\[0\] is None; give a number"),
            (([0.1], [0.0], [0.1, "b"]), r"obs\[1\] is 'b'; give a number"),
        ):
            with pytest.raises(ValueError, match=said):
                plant.exchange(*state, patience=0.0)
        assert plant.exchange([0.1], (0.0,), np.zeros(2), patience=0.0)[0] == "brake"
    for key, value in (("priority", 10**30), ("rollback_window", 10**30)):
        with pytest.raises(ValueError, match=f"{key} is {value}; give"):
            nearl.Loop("none.safetensors", name("named"), **{key: value})


def test_a_plant_whose_time_stands_still_does_not_spin() -> None:
    with open_plant("idle", lockstep=True) as plant:
        begun, busy = time.monotonic(), time.thread_time()
        assert plant.exchange([0.1], [0.0], [0.1, 0.0], patience=1.0)[0] == "brake"
        assert time.monotonic() - begun >= 1.0 and time.thread_time() - busy < 0.1, "a look every 30 us took more"


def test_an_exception_of_the_body_is_what_comes_out(tmp_path) -> None:
    with pytest.raises(ZeroDivisionError, match="mine") as own, nearl.Loop(spring(tmp_path), name("mine"), patience=0.2):
        raise ZeroDivisionError("mine")
    if sys.version_info >= (3, 11):
        assert "no plant named" in own.value.__notes__[0]
    with pytest.raises(RuntimeError, match="no plant named"), nearl.Loop(spring(tmp_path), name("mine"), patience=0.2):
        pass


def test_a_refusal_that_the_body_hears_is_not_lost(tmp_path) -> None:
    """Said again whenever the report is asked for, and not a second time at the end of a body that has dealt with it."""
    what = name("refused")
    plant, refused = nearl.Plant(what, ["other"], ["q.slide", "v.slide"], 0.001, 1), pytest.raises(RuntimeError, match="joint 0 is `slide`")
    with plant, refused, nearl.Loop(spring(tmp_path), what) as loop:
        while loop.running:
            plant.exchange([0.0], [0.0], [0.0, 0.0], patience=0.001)
        loop.stop()
    with pytest.raises(RuntimeError, match="joint 0 is `slide`"):
        loop.stop()
    with nearl.Loop(spring(tmp_path), name("nobody"), patience=0.2) as loop, pytest.raises(RuntimeError, match="nobody"):
        loop.stop()


def test_snapshots_and_limits_of_a_loop_are_looked_at_before_it_is_asked(tmp_path) -> None:
    spring(tmp_path)
    link = nearl.Link(name("nobody"), patience=0.05)
    with pytest.raises(FileNotFoundError, match="cannot read snapshot 'nope': it does not exist; give a snapshot file or a run folder"):
        link.push("nope")
    with pytest.raises(FileNotFoundError, match="the folder has no checkpoints/final.safetensors"):
        link.push(tmp_path)
    for moved, said in (({"speed": np.nan}, "speed is nan"), ({"velocity": {"slide": np.float32(np.inf)}}, "velocity of 'slide' is inf")):
        with pytest.raises(ValueError, match=f"{said}; give a finite number"):
            link.move_limits(**moved)


def test_a_run_folder_is_pushed_and_a_refused_file_is_named(tmp_path) -> None:
    snapshot, what = spring(tmp_path), name("push")
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "latest.safetensors").write_bytes(snapshot.read_bytes())
    (tmp_path / "junk.safetensors").write_bytes(b"not a snapshot at all")
    receipts: list = []

    def push() -> None:
        with nearl.Link(what) as link:
            receipts.extend(link.push(path) for path in (tmp_path / "junk.safetensors", tmp_path / "run"))

    with open_plant("push", lockstep=True) as plant, nearl.Loop(snapshot, what, ramp=0.0):
        plant.exchange([0.0], [0.0], [0.0, 0.0], patience=5.0)
        thread = threading.Thread(target=push)
        thread.start()
        while thread.is_alive():
            plant.exchange([0.0], [0.0], [0.0, 0.0], patience=5.0)
    assert not receipts[0].accepted and "junk.safetensors'" in receipts[0].text, receipts
    assert receipts[1].accepted, receipts


def test_a_loop_that_comes_while_time_stands_still_is_told_of_the_plant(tmp_path) -> None:
    """The driver waits for an action in lockstep before there is a loop, and says meanwhile what it is and where it is."""
    snapshot, turns = spring(tmp_path), []
    with open_plant("late", lockstep=True) as plant:
        thread = threading.Thread(target=lambda: turns.append(plant.exchange([0.0], [0.0], [0.0, 0.0], patience=10.0)))
        thread.start()
        time.sleep(0.5)
        with nearl.Loop(snapshot, name("late"), ramp=0.0, patience=3.0):
            thread.join()
    assert turns[0][1] is not None, turns


def test_times_that_are_none_are_refused(tmp_path) -> None:
    """A ramp that is no number had let the first motion in at once, and so had infinity."""
    snapshot = spring(tmp_path)
    for key, values in {"ramp": (np.nan, np.inf, -1.0), "patience": (np.nan, -1.0), "seconds": (np.nan, -1.0, 0.0), "rollback_window": (-1,)}.items():
        for value in values:
            with pytest.raises(ValueError, match=f"{key} is .*; give"):
                nearl.Loop(snapshot, name("none"), **{key: value})


def test_ctrl_c_brakes_and_ends_the_loop_that_is_waited_for(tmp_path) -> None:
    over = threading.Event()

    def drive(plant: nearl.Plant) -> None:
        tick = 0
        while not over.is_set():
            plant.exchange([0.1], [0.0], [0.1, 0.0], patience=0.2, time=tick * 0.001)
            tick += 1

    with open_plant("interrupt", lockstep=True) as plant:
        driver = threading.Thread(target=drive, args=(plant,))
        driver.start()
        loop = nearl.Loop(spring(tmp_path), name("interrupt"), ramp=0.0, seconds=60.0)
        timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        begin = time.monotonic()
        try:
            with pytest.raises(KeyboardInterrupt):
                loop.wait()
        finally:
            over.set()
            timer.cancel()
            driver.join()
        assert time.monotonic() - begin < 30.0 and not loop.running
        assert loop.report is not None and loop.report["reason"] == "stop", loop.report


def nearl_command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "nearl", *map(str, arguments)]


def test_an_imported_policy_without_a_reward_is_its_own_plant(tmp_path) -> None:
    """``nearl plant SNAPSHOT`` simulates the robot that travels in the snapshot, from the start that its recipe says."""
    (tmp_path / "carriage.urdf").write_text(CARRIAGE)
    (tmp_path / "recipe.toml").write_text(RECIPE.replace("dt = 0.001", "dt = 0.002") + "[reset]\nq = { slide = 0.2 }\n")
    policy = nearl.Policy.from_layers([([[-2.0, -0.5]], [0.0], "identity")], [0, 0], [1, 1], (-np.inf, np.inf), (-np.inf, np.inf))
    snapshot = tmp_path / "spring.safetensors"
    policy.controller(tmp_path / "carriage.urdf", tmp_path / "recipe.toml", "spring").save(snapshot)
    plant = subprocess.Popen(nearl_command("plant", snapshot, "--name", name("own"), "--lockstep"), stdout=subprocess.DEVNULL)
    q: list[float] = []
    try:
        with nearl.Loop(snapshot, name("own"), patience=30.0, ramp=0.0), nearl.Link(name("own")) as link:
            while len(q) < 3000:
                states = link.states()
                q += list(states.q[:, 0])
                assert states.lost == 0 or len(q) > 100
    finally:
        plant.terminate()
        assert plant.wait(20) == 0
    assert max(q) <= 0.2 + 1e-9 and min(q) > -0.2
    starts = [k for k in range(1, len(q)) if q[k] == 0.2]  # an episode has 1000 control periods
    assert starts and all(abs(q[k - 1]) < 0.02 for k in starts)


def test_a_guard_that_only_a_simulator_has_is_said(tmp_path) -> None:
    (tmp_path / "recipe.toml").write_text(RECIPE + '[constraints]\nguard = "simulator"\n')
    (tmp_path / "carriage.urdf").write_text(CARRIAGE)
    policy = nearl.Policy.from_layers([([[-2.0, -0.5]], [0.0], "identity")], [0, 0], [1, 1], (-np.inf, np.inf), (-np.inf, np.inf))
    snapshot = tmp_path / "spring.safetensors"
    policy.controller(tmp_path / "carriage.urdf", tmp_path / "recipe.toml", "spring").save(snapshot)
    said = subprocess.run(nearl_command("doctor", snapshot), capture_output=True, text=True, check=False).stdout
    assert "a robot's driver has not" in said, said
    with open_plant("unguarded", lockstep=True) as plant, nearl.Loop(snapshot, name("unguarded"), ramp=0.0) as loop:
        for _ in range(20):
            plant.exchange([0.1], [0.0], [0.1, 0.0], patience=1.0)
    assert loop.report is not None and any("a robot's driver has not" in warning for warning in loop.report["warnings"])


def test_the_driver_of_the_page(tmp_path) -> None:
    """``examples/driver.py`` beside a loop; Rust and C have the same in runtime/c/tests."""
    with nearl.Loop(spring(tmp_path), name("page"), patience=20.0, ramp=0.0):
        done = subprocess.run([sys.executable, ROOT / "examples" / "driver.py", name("page"), "500"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    acted, _, farthest, fastest = map(float, done.stdout.split())
    assert acted == 500 and farthest <= 0.4 and fastest <= 0.8


@pytest.mark.parametrize(("window", "rolled_back"), [(None, 1), (0, 0)])
def test_a_policy_that_the_robot_does_not_follow_is_taken_back_unless_it_is_meant_to_stay(tmp_path, window, rolled_back) -> None:
    """The carriage trembles by 0.2 m/s as soon as the second policy, a push of 1 N, is in use: its states are far from any target."""
    first = spring(tmp_path)
    push = nearl.Policy.from_layers([([[0.0, 0.0]], [0.05], "identity")], [0, 0], [1, 1], (-np.inf, np.inf), (-np.inf, np.inf))
    second = tmp_path / "push.safetensors"
    push.controller(tmp_path / "carriage.urdf", tmp_path / "recipe.toml", "push").save(second)
    what = f"keep{window}"
    with open_plant(what, lockstep=True) as plant, nearl.Loop(first, name(what), ramp=0.0, priority=0, rollback_window=window) as loop:
        sent, tremble, tick, in_use, end = False, 0.0, 0, 0, time.monotonic() + 60.0
        while in_use < 1500 and time.monotonic() < end:
            _, action = plant.exchange([0.0], [tremble], [0.0, tremble], patience=5.0, time=tick * 0.001)
            is_pushed = action is not None and abs(action[0] - 1.0) < 1e-6
            # Counted from the tick the second policy is in use: how long a push takes is the machine's affair.
            in_use += is_pushed or in_use > 0
            tremble = 0.2 * (-1) ** tick if is_pushed else 0.0
            tick += 1
            if tick >= 500 and not sent:
                sent = True
                threading.Thread(target=lambda: nearl.Link(name(what)).push(second)).start()
    assert in_use == 1500, f"the second policy was in use for {in_use} of {tick} ticks"
    assert loop.report["rolled_back"] == rolled_back and not any("priority" in warning for warning in loop.report["warnings"]), loop.report
    with pytest.raises(ValueError, match="priority is 100; give 1 to 99, or 0 for the normal scheduler"):
        nearl.Loop(first, name(what), priority=100)
    with pytest.raises(ValueError, match="rollback_window is 2000000 ticks; give 0 to 1000000"):
        nearl.Loop(first, name(what), rollback_window=2_000_000)
