"""A motion clip as demonstrations of the G1, and the task whose episodes begin in its first frame.

    .venv/bin/python results/motion/clip.py CLIP.npz FOLDER [FIRST [LAST]]

CLIP is a file of holosoma's (`pip download --no-deps holosoma==0.0.3`, Apache-2.0): 29 joints and the base, 50 frames a second. Nothing of it is kept here.
The frames FIRST to LAST are taken, turned so that the first of them looks along x; an episode begins upright, so it should be a frame that nearly is.
"""

import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nearl import demos

HERE = Path(__file__).parent
ROBOT = HERE.parents[1] / "examples" / "robots" / "g1" / "g1.urdf"
BASE = "root_joint"


def turned(q: np.ndarray) -> np.ndarray:
    """The same motion from the origin, the first frame looking along x: q (frames x (7 + joints)), rotations w first."""
    w, x, y, z = q[0, 3:7]
    half = -0.5 * np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    c, s = np.cos(half), np.sin(half)
    result = q.copy()
    east, north = (q[:, k] - q[0, k] for k in (0, 1))
    cos, sin = np.cos(2 * half), np.sin(2 * half)
    result[:, 0], result[:, 1] = cos * east - sin * north, sin * east + cos * north
    w, x, y, z = q[:, 3:7].T
    result[:, 3:7] = np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], 1)
    return result


def share_of_effort(robot: Path) -> str:
    """The largest force of a motor as a share of what the robot file lets it give, as an expression of a task file."""
    found = {joint.get("name"): joint.find("limit") for joint in ElementTree.parse(robot).iter("joint")}
    expression = "0"
    for name, limit in found.items():
        if limit is not None and "effort" in limit.attrib:
            expression = f"max(abs(torque.{name}) / {float(limit.attrib['effort'])}, {expression})"
    return expression


def main(clip: Path, folder: Path, first: int = 0, last: int | None = None) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(ROBOT, folder / "g1.urdf")
    with np.load(clip) as data:
        q, joints, fps = turned(data["joint_pos"][first:last]), [str(name) for name in data["joint_names"]], data["fps"]
    cut, task, out = folder / "cut.npz", folder / "g1.toml", folder / "clip.npz"
    np.savez(cut, fps=fps, joint_pos=q, joint_names=np.array(joints))
    text = (HERE / "g1.toml").read_text().replace("max_episode_steps = 1", f"max_episode_steps = {len(q) - 1}")
    text += f'\n[metrics]\neffort = {{ max = "{share_of_effort(ROBOT)}" }}\n'
    task.write_text(text)
    demos.from_motion(task, cut, out, base=BASE, overwrite=True)
    with np.load(out) as data:
        q, v = data["qpos"][0], data["qvel"][0]
    table = lambda names, values: ", ".join(f'"{name}" = {x:.6f}' for name, x in zip(names, values, strict=True))  # noqa: E731
    start = table([f"{BASE}.z", *joints], [q[2], *q[7:]])
    speed = table([f"{BASE}.{e}" for e in ("x", "y", "z", "wx", "wy", "wz")] + joints, v)
    task.write_text(f"{text}\n[reset]\nq = {{ {start} }}\nv = {{ {speed} }}\n")
    tilt = np.degrees(np.arccos(1 - 2 * (q[4] ** 2 + q[5] ** 2)))
    print(f"{out}: the first frame leans by {tilt:.1f} degrees")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4, 5):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *(int(word) for word in sys.argv[3:]))
