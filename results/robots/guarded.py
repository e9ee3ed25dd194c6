"""Sends the robots of a folder, those of which every joint has a motor, commands at random from one end of their ranges to the other behind `guard = true`,
in MuJoCo, and measures what they do: writes guarded/runs.jsonl and guarded/table.md beside this script.

    .venv/bin/python results/robots/guarded.py FOLDER      # mjcf.sh does it with the packages
"""

import contextlib
import json
import pathlib
import sys
import tempfile
import warnings
from collections.abc import Iterator

import mujoco
import numpy as np

import nearl

HERE = pathlib.Path(__file__).parent / "guarded"
SPEED, ACCELERATION, TICKS = 2.0, 10.0, 500
# What counts as left: rad or m, per s, per s².
TOLERANCE = {"position": 1e-9, "velocity": 1e-8, "acceleration": 1e-6}


def motors(robot: mujoco.MjModel) -> list[tuple[int, int]] | None:
    """Actuator and joint, one of each; none of a robot that is not driven in full, or by more than forces and position drives."""
    pairs = [(k, int(robot.actuator_trnid[k, 0])) for k in range(robot.nu) if robot.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_JOINT]
    plain = all(robot.joint(j).name and robot.jnt_type[j] >= int(mujoco.mjtJoint.mjJNT_SLIDE) for _, j in pairs)  # or a hinge
    whole = len({j for _, j in pairs}) == len(pairs) == robot.nv == robot.nu and robot.neq == robot.ntendon == 0
    forces = all(robot.actuator_biastype[k] == 0 for k, _ in pairs)
    drives = all(robot.actuator_biasprm[k, 1] < 0 for k, _ in pairs)
    return pairs if plain and whole and pairs and not robot.actuator_dyntype.any() and (forces or drives) else None


def task(file: pathlib.Path, robot: mujoco.MjModel, pairs: list[tuple[int, int]], steps: int) -> str:
    joints, step = [robot.joint(j).name for _, j in pairs], robot.opt.timestep
    command = 'interface = "effort"'
    if robot.actuator_biasprm[pairs[0][0], 1] < 0:
        gains = [{robot.joint(j).name: -robot.actuator_biasprm[k, n] * robot.actuator_gear[k, 0] ** 2 for k, j in pairs} for n in (1, 2)]
        table = ["{ " + ", ".join(f"{json.dumps(name)} = {value}" for name, value in gain.items()) + " }" for gain in gains]
        command = f'interface = "pd"\nstiffness = {table[0]}\ndamping = {table[1]}'
    ranged = [(robot.joint(j).name, *robot.jnt_range[j]) for _, j in pairs if robot.jnt_limited[j]]
    start = ", ".join(f"{json.dumps(name)} = {(low + high) / 2}" for name, low, high in ranged)
    return f"""name = "robot"
[model]
mjcf = {json.dumps(str(file))}
[time]
dt = {step * steps}
sim_dt = {step}
max_episode_steps = 1000000
[command]
{command}
[state]
controllable = {json.dumps(joints)}
observation = {json.dumps([f"{letter}.{joint}" for letter in "qv" for joint in joints])}
[reset]
q = {{ {start} }}
[reward]
none = "0.0"
[idm]
kind = "pinocchio"
[constraints]
{"position = {}" if ranged else ""}
velocity = {{ limit = {SPEED} }}
acceleration = {{ limit = {ACCELERATION} }}
torque = {{ scale = 1.0 }}
"""


@contextlib.contextmanager
def without_contacts(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """The robot of a file in a file beside it, in which nothing touches: what touches a robot may stop it harder than any limit."""
    file = path.with_name(f"without_contacts_{path.name}")
    file.write_text(f'<mujoco><include file="{path.name}"/><option><flag contact="disable"/></option></mujoco>')
    try:
        yield file
    finally:
        file.unlink()


def attack(folder: pathlib.Path, root: pathlib.Path, path: pathlib.Path, steps: int) -> dict | None:
    with without_contacts(path) as file, warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            robot = mujoco.MjModel.from_xml_path(str(file))
        except ValueError:
            return None
        pairs = motors(robot)
        if not pairs:
            return None
        row = {"file": str(path.relative_to(root)), "joints": len(pairs), "steps": steps}
        (folder / "task.toml").write_text(task(file, robot, pairs, steps))
        try:
            envs = nearl.make_vec(folder / "task.toml", 1, constraints="task", actions="guarded")
        except (ValueError, OSError) as error:
            return {**row, "refused": str(error).replace(str(folder), "").replace(str(root), "")}
    row["weak"] = any("cannot hold" in str(warning.message) for warning in told)
    n, rng = len(pairs), np.random.default_rng(0)
    ends = np.array([robot.jnt_range[j] if robot.jnt_limited[j] else [-np.inf, np.inf] for _, j in pairs])
    low, high = np.clip(np.array([robot.actuator_ctrlrange[k] if robot.actuator_ctrllimited[k] else [-50.0, 50.0] for k, _ in pairs]), -50.0, 50.0).T
    obs, _ = envs.reset(seed=0)
    furthest, beyond = dict.fromkeys(TOLERANCE, 0.0), dict.fromkeys(TOLERANCE, 0)
    for tick in range(TICKS):
        if tick % 25 == 0:
            push = np.where(rng.random(n) < 0.3, np.where(rng.random(n) < 0.5, low, high), rng.uniform(low, high))
        v = obs[0, n:].copy()
        obs, *_ = envs.step(push[None])
        excess = {
            "position": np.maximum(ends[:, 0] - obs[0, :n], obs[0, :n] - ends[:, 1]).max(),
            "velocity": np.abs(obs[0, n:]).max() - SPEED,
            "acceleration": np.abs(obs[0, n:] - v).max() / (robot.opt.timestep * steps) - ACCELERATION,
        }
        for kind, by in excess.items():
            furthest[kind] = max(furthest[kind], float(by))
            beyond[kind] += int(by > TOLERANCE[kind])
    return row | {"furthest": furthest, "beyond": beyond}


def table(rows: list[dict]) -> str:
    def whole(row: dict) -> bool:
        return "furthest" in row and not any(row["beyond"].values())

    able = [row for row in rows if "furthest" in row and not row["weak"]]
    lines = [
        f"{len({row['file'] for row in rows})} robots of which every joint has a motor, {TICKS} ticks with commands at random, each in one and in three",
        f"physics steps a tick. Of {len(able)} runs of robots whose motors can hold them {sum(map(whole, able))} kept all limits:",
        f"{SPEED} rad/s, {ACCELERATION} rad/s² and the ranges of the file.",
        "",
        "| file | joints | physics steps | beyond position [rad or m] | beyond velocity [rad/s] | beyond acceleration [rad/s²] | ticks beyond it | motors |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        begin = f"| {row['file']} | {row['joints']} | {row['steps']} |"
        if "refused" in row:
            lines.append(f"{begin} refused: {row['refused']} | | | | |")
            continue
        numbers = " | ".join(f"{by:.0e}" if by > 0.0 else "0" for by in row["furthest"].values())
        lines.append(f"{begin} {numbers} | {row['beyond']['acceleration']} | {'cannot hold it' if row['weak'] else ''} |")
    return "\n".join(lines) + "\n"


if len(sys.argv) != 2:
    sys.exit(__doc__)
root = pathlib.Path(sys.argv[1]).resolve()
with tempfile.TemporaryDirectory() as folder:
    found = (attack(pathlib.Path(folder), root, path, steps) for path in sorted(root.rglob("*.xml")) for steps in (1, 3))
    rows = [row for row in found if row]
HERE.mkdir(exist_ok=True)
(HERE / "runs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
(HERE / "table.md").write_text(table(rows))
print("\n".join(table(rows).splitlines()[:3]))
