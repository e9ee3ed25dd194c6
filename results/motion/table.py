"""What a run keeps of its clip: `table.md`, and `video.webp` beside it.

    MUJOCO_GL=egl .venv/bin/python results/motion/table.py RUN CLIP FOLDER

RUN is the run folder, CLIP the demonstrations that `clip.py` wrote. The episode is one without noise from the first frame; it is held against the clip frame
by frame, for as long as it lasts. The forces are the simulator's own, in the last physics step of each period.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

from nearl import _core

NEARL = Path(__file__).parents[2] / "target" / "release" / "nearl"
BASE = 7  # entries of the base in qpos


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


def main(run: Path, clip: Path, folder: Path) -> None:
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "episode.npz"
        told("demos", "record", run, "--out", file, "--episodes", 1)
        with np.load(file) as data:
            reached, n = data["qpos"], int(data["lengths"][0])
        film = Path(place) / "film.mp4"
        task = run / "task.toml"
        subprocess.run([sys.executable, "-m", "nearl.video", file, film, "--task", task, "--size", "240", "240"], check=True)
        frames = list(imageio.imiter(film))[::2]
        imageio.imwrite(folder / "video.webp", frames, duration=80, loop=0, quality=40)
    with np.load(clip) as data:
        wanted = data["qpos"]
    whole, dt = len(wanted) - 1, 0.02
    followed = sent_the_clip(task, wanted)
    m = len(followed) - 1
    distance = np.abs(followed[1:, BASE:] - wanted[1 : m + 1, BASE:])
    error = np.abs(reached[1 : n + 1, BASE:] - wanted[1 : n + 1, BASE:])
    still = np.abs(wanted[:1, BASE:] - wanted[1 : n + 1, BASE:])
    base = np.linalg.norm(reached[1 : n + 1, :3] - wanted[1 : n + 1, :3], axis=1)
    evaluated = told("eval", run, "--episodes", 1)[0]
    effort = next(note["largest"] for note in evaluated["told"] if note["name"] == "metrics/effort")
    rows = [
        ("share of the clip survived", f"{n / whole:.2f} ({n * dt:.2f} s of {whole * dt:.2f} s)"),
        ("mean error of a joint [rad]", f"{error.mean():.3f}"),
        ("the same of a robot that stays in the first frame", f"{still.mean():.3f}"),
        ("largest error of a joint [rad]", f"{error.max():.3f}"),
        ("drives that are sent the clip's positions: share survived", f"{m / whole:.2f} ({m * dt:.2f} s)"),
        ("drives that are sent the clip's positions: mean error of a joint [rad]", f"{distance.mean():.3f}"),
        ("mean distance of the base [m]", f"{base.mean():.3f}"),
        ("largest force of a motor, share of its effort", f"{effort:.3f}"),
    ]
    (folder / "table.md").write_text("| | |\n|---|---|\n" + "".join(f"| {name} | {value} |\n" for name, value in rows))


if __name__ == "__main__":
    main(*(Path(word) for word in sys.argv[1:]))
