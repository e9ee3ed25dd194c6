"""Writes the robots of this folder that come from the Python package example-robot-data: what a URDF says about joints,
inertias and primitive collision geometry, and nothing else (no meshes, colours, transmissions, simulator blocks, comments).

    pip download --no-deps example-robot-data==6.0.0
    python examples/robots/strip.py example_robot_data-6.0.0-0-py3-none-any.whl
"""
import pathlib
import sys
import xml.etree.ElementTree as ET
import zipfile

ROBOTS = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "solo12": "solo_description/robots/solo12.urdf",
    "anymal": "anymal_c_simple_description/urdf/anymal.urdf",
    "g1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "simple_humanoid": "simple_humanoid_description/urdf/simple_humanoid.urdf",
}
PREFIX = "cmeel.prefix/share/example-robot-data/robots/"
# Joint damping and friction go too: MuJoCo integrates damping implicitly, and without it both engines compute the same.
KEPT = {"link": ("inertial", "collision"), "joint": ("origin", "parent", "child", "axis", "limit", "mimic")}

# Products of inertia that no rigid body has (MuJoCo refuses them): dropped, the moments stay.
IMPOSSIBLE = [f"depth_camera_{side}_camera" for side in ("front", "rear", "left", "right")] + ["hatch"]


def strip(text):
    source = ET.fromstring(text)
    robot = ET.Element("robot", name=source.get("name"))
    for node in source:
        if node.tag not in KEPT:
            continue
        kept = ET.SubElement(robot, node.tag, node.attrib)
        for part in node:
            mesh = part.tag == "collision" and part.find("geometry/mesh") is not None
            if part.tag in KEPT[node.tag] and not mesh:
                kept.append(part)
    for link in robot.iter("link"):
        if link.get("name") in IMPOSSIBLE:
            link.find("inertial/inertia").attrib.update(ixy="0", ixz="0", iyz="0")
    for node in robot.iter():
        node.text = node.tail = None
    ET.indent(robot, " ")
    return ET.tostring(robot, encoding="unicode") + "\n"


wheel = zipfile.ZipFile(sys.argv[1])
for name, path in ROBOTS.items():
    out = pathlib.Path(__file__).parent / name / f"{name}.urdf"
    out.parent.mkdir(exist_ok=True)
    out.write_text(strip(wheel.read(PREFIX + path)))
    print(out, out.stat().st_size)
