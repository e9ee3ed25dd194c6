"""A driver in Python in front of a real loop: the limits hold, and a plant alone is told to brake at once."""

import os
import subprocess
import sys
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


def test_the_driver_of_the_page(tmp_path) -> None:
    """``examples/driver.py`` beside a loop; Rust and C have the same in runtime/c/tests."""
    with nearl.Loop(spring(tmp_path), name("page"), patience=20.0, ramp=0.0):
        done = subprocess.run([sys.executable, ROOT / "examples" / "driver.py", name("page"), "500"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    acted, _, farthest, fastest = map(float, done.stdout.split())
    assert acted == 500 and farthest <= 0.4 and fastest <= 0.8
