"""What the scripts that switch policies of a robot on legs have in common: MuJoCo's state in the words of a plant, and pushes."""

import sys
from pathlib import Path

import mujoco
import numpy as np

import nearl


def in_nearls_words(d: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Configuration and velocity as a plant gives them: quaternion x y z w, the base's velocity in its own axes."""
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, d.qpos[3:7])
    q, v = d.qpos.copy(), d.qvel.copy()
    q[3:7] = np.roll(q[3:7], -1)
    v[:3] = turn.reshape(3, 3).T @ v[:3]
    return q, v


LINKS: dict[str, nearl.Link] = {}


def push(name: str, snapshot: Path) -> None:
    receipt = LINKS.setdefault(name, nearl.Link(name)).push(snapshot)
    if not receipt.accepted:
        print(f"{name}: {receipt.text}", file=sys.stderr)
