"""What the drives of a walking ANYmal were asked for, from a flight log and the drives' own formula: largest torque, largest change, tracking.

    .venv/bin/python results/walk/forces.py LOG

`K (u - q) - D v` of every tick with an action, `u` the target sent. A change counts between two ticks in a row of one episode.
"""

import json
import sys

import numpy as np
from mcap.reader import make_reader

STIFFNESS, DAMPING, DT = 80.0, 2.0, 0.005
TORQUE, RATE = 80.0, 6000.0
LEGS = ("LF", "LH", "RF", "RH")  # the order of the motors, as `nearl robot` prints them


def main(file: str) -> None:
    with open(file, "rb") as stream:
        joints = next(r.metadata["joints"] for r in make_reader(stream).iter_metadata() if "joints" in r.metadata).split(",")[1:]
    with open(file, "rb") as stream:
        ticks = [json.loads(message.data) for _, _, message in make_reader(stream).iter_messages(topics=["tick"])]
    order = [joints.index(f"{leg}_{joint}") for leg in LEGS for joint in ("HAA", "HFE", "KFE")]
    acted = [t for t in ticks if t.get("mode") == "active" and t.get("action")]
    q, v = (np.array([t["state"][key] for t in acted])[:, skip:][:, order] for key, skip in (("q", 7), ("v", 6)))
    target = np.array([t["action"] for t in acted])
    number, episode = (np.array(x) for x in ([t["tick"] for t in acted], [t["state"]["episode"] for t in acted]))
    force = STIFFNESS * (target - q) - DAMPING * v
    follows = (np.diff(number) == 1) & (np.diff(episode) == 0)
    rate = np.abs(np.diff(force, axis=0))[follows] / DT
    print(f"{len(ticks)} ticks, {len(acted)} active, {int(follows.sum())} in a row, {len(set(episode.tolist()))} episodes")
    for name, values, limit, unit in (("torque", np.abs(force), TORQUE, "N m"), ("torque rate", rate, RATE, "N m/s")):
        beyond = (values > limit * (1 + 1e-9)).any(axis=1).sum()
        print(f"{name}: at most {values.max():.6g} {unit}, beyond {limit:g} in {beyond} ticks")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
