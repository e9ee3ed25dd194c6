"""What runs keep of their clip: `table.md`, and `video.webp` of the first beside it.

    MUJOCO_GL=egl .venv/bin/python results/motion/table.py CLIP FOLDER RUN [RUN ...]

CLIP is the demonstrations that `clip.py` wrote, RUN a run folder. The episode is one without noise from the first frame; it is held against the clip frame
by frame, for as long as it lasts. The forces are the simulator's own, in the last physics step of each period; what is beyond a limit is counted here, from
the recorded states and the numbers of the robot file.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import imageio.v3 as imageio
import numpy as np

from nearl import _core

NEARL = os.environ.get("NEARL", Path(__file__).parents[2] / "target" / "release" / "nearl")
BASE = 7  # entries of the base in qpos
DT = 0.02  # s


def sent_the_clip(task: Path, wanted: np.ndarray) -> np.ndarray:
    """Configurations (steps + 1 x nq) of a robot whose drives are sent the clip's own positions, until it falls."""
    env = _core.Env(str(task))
    env.reset(0)
    joints = [BASE + env.joint_names[1:].index(name) for name in env.actuator_names]
    reached = [env.qpos.copy()]
    for row in wanted[1:]:
        _, _, _, terminated, _ = env.step(row[joints])
        reached.append(env.qpos.copy())
        if terminated:
            break
    return np.array(reached)


def told(*words: object) -> object:
    run = subprocess.run([NEARL, *map(str, words), "--json"], check=True, capture_output=True, text=True)
    return json.loads(run.stdout.strip().splitlines()[-1]) if words[0] == "demos" else json.loads(run.stdout)


def limits(robot: Path, names: list[str]) -> np.ndarray:
    """Lowest and highest position and largest speed of each joint by name (3 x joints), as the robot file has them."""
    found = {joint.get("name"): joint.find("limit") for joint in ElementTree.parse(robot).iter("joint")}
    return np.array([[float(found[name].attrib[key]) for name in names] for key in ("lower", "upper", "velocity")])


def measured(run: Path, wanted: np.ndarray, place: Path) -> tuple[dict[str, str], Path]:
    """Every number of a run by name, and the recorded episode."""
    file = place / f"{run.name}.npz"
    told("demos", "record", run, "--out", file, "--episodes", 1)
    with np.load(file) as data:
        reached, speed, n = data["qpos"], data["qvel"], int(data["lengths"][0])
    task = run / "task.toml"
    names = list(_core.Env(str(task)).joint_names[1:])
    lower, upper, fastest = limits(task.parent / "g1.urdf", names)
    joints, speeds = reached[1 : n + 1, BASE:], np.abs(speed[1 : n + 1, BASE - 1 :])
    error = np.abs(joints - wanted[1 : n + 1, BASE:])
    beyond = np.maximum(np.maximum(lower - joints, joints - upper), 0.0)
    still = np.abs(wanted[:1, BASE:] - wanted[1 : n + 1, BASE:])
    base = np.linalg.norm(reached[1 : n + 1, :3] - wanted[1 : n + 1, :3], axis=1)
    evaluated = told("eval", run, "--episodes", 1)[0]
    effort = next(note["largest"] for note in evaluated["told"] if note["name"] == "metrics/effort")
    whole = len(wanted) - 1
    steps = (run / "metrics.csv").read_text().splitlines()[-1].split(",")[0]
    return {
        "steps": f"{int(steps):,}",
        "share of the clip survived": f"{n / whole:.2f}",
        "survived [s]": f"{n * DT:.2f}",
        "mean error of a joint [rad]": f"{error.mean():.3f}",
        "the same of a robot that stays in the first frame": f"{still.mean():.3f}",
        "largest error of a joint [rad]": f"{error.max():.3f}",
        "mean distance of the base [m]": f"{base.mean():.3f}",
        "largest force of a motor, share of its effort": f"{effort:.3f}",
        "periods with a joint beyond its range": f"{int((beyond > 0).any(1).sum())} of {n}",
        "furthest beyond its range [rad]": f"{beyond.max():.3f}",
        "the joint that was": names[int(beyond.max(0).argmax())],
        "periods with a joint beyond its speed": f"{int((speeds > fastest).any(1).sum())} of {n}",
    }, file


def film(episode: Path, task: Path, out: Path, place: Path) -> None:
    path = place / "film.mp4"
    subprocess.run([sys.executable, "-m", "nearl.video", episode, path, "--task", task, "--size", "240", "240"], check=True)
    imageio.imwrite(out, list(imageio.imiter(path))[::2], duration=80, loop=0, quality=40)


def main(clip: Path, folder: Path, *runs: Path) -> None:
    with np.load(clip) as data:
        wanted = data["qpos"]
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        columns, episodes = zip(*(measured(run, wanted, place) for run in runs), strict=True)
        film(episodes[0], runs[0] / "task.toml", folder / "video.webp", place)
    followed = sent_the_clip(runs[0] / "task.toml", wanted)
    m = len(followed) - 1
    sent = {name: "" for name in columns[0]} | {
        "share of the clip survived": f"{m / (len(wanted) - 1):.2f}",
        "survived [s]": f"{m * DT:.2f}",
        "mean error of a joint [rad]": f"{np.abs(followed[1:, BASE:] - wanted[1 : m + 1, BASE:]).mean():.3f}",
    }
    heads = [f"seed {run.name.rsplit('_', 1)[1]}" for run in runs]
    table = [["", *heads, "drives that are sent the clip's positions"], ["---"] * (len(runs) + 2)]
    table += [[row, *(column[row] for column in columns), sent[row]] for row in columns[0]]
    (folder / "table.md").write_text("".join(f"| {' | '.join(cells)} |\n" for cells in table))


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    main(*(Path(word) for word in sys.argv[1:]))
