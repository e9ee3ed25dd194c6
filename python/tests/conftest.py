"""Robots of the tests: the bundled Panda, and two that are written here so that no file or mesh is needed."""

from pathlib import Path

import numpy as np
import pytest

import nearl

ROOT = Path(__file__).resolve().parents[2]
ROBOTS = ROOT / "examples" / "robots"
LOCOMOTION = ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5"]

LINK = """<link name="{name}"><inertial><origin xyz="{x} 0 0"/><mass value="{mass}"/>
<inertia ixx="{small}" iyy="{large}" izz="{large}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{x} {y} 0"/>
<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" velocity="{speed}" effort="{effort}"/><dynamics damping="{damping}"/></joint>"""


def link(name: str, length: float, mass: float) -> str:
    return LINK.format(name=name, x=length / 2, mass=mass, small=1e-3, large=mass * length**2 / 12)


def planar_urdf() -> str:
    """Three links in a vertical plane."""
    parts = ['<robot name="planar"><link name="base"/>']
    for i, effort in enumerate((35.0, 13.0, 2.6)):
        parent = "base" if i == 0 else f"link{i - 1}"
        joint = {"x": 0.4 if i else 0, "y": 0, "axis": "0 1 0", "low": -2.0, "high": 1.8, "speed": 3.0 + i}
        parts.append(JOINT.format(name=f"joint{i}", parent=parent, child=f"link{i}", effort=effort, damping=0.3 * i, **joint))
        parts.append(link(f"link{i}", 0.4, 3.0 - i))
    return "\n".join([*parts, "</robot>"])


def legs_urdf() -> str:
    """Four legs of three joints each on a base that is bolted down."""
    parts = ['<robot name="legs"><link name="base"/>']
    for leg, (x, y) in enumerate([(0.3, 0.2), (0.3, -0.2), (-0.3, 0.2), (-0.3, -0.2)]):
        parent = "base"
        for part, axis, effort in (("hip", "1 0 0", 6.0), ("thigh", "0 1 0", 6.0), ("calf", "0 1 0", 1.5)):
            name = f"{part}{leg}"
            place = {"x": x, "y": y} if part == "hip" else {"x": 0.22, "y": 0}
            joint = {"axis": axis, "low": -1.2, "high": 1.5, "speed": 6.0, "effort": effort, "damping": 0.1}
            parts.append(JOINT.format(name=name, parent=parent, child=f"l_{name}", **place, **joint))
            parts.append(link(f"l_{name}", 0.22, 1.1))
            parent = f"l_{name}"
    return "\n".join([*parts, "</robot>"])


def robot(name: str) -> nearl.Model:
    if name == "panda":
        return nearl.Model.from_urdf(ROBOTS / "panda" / "panda.urdf")
    return nearl.Model.from_urdf_text({"planar": planar_urdf, "legs": legs_urdf}[name]())


@pytest.fixture(params=["panda", "planar", "legs"])
def model(request: pytest.FixtureRequest) -> nearl.Model:
    return robot(request.param)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)
