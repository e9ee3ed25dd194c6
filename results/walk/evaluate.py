"""A hundred episodes of 20 s of each snapshot, under pushes of several strengths and on bumps of several heights.

    .venv/bin/python results/walk/evaluate.py FOLDER SNAPSHOT...

Writes `evaluation.csv` and `episodes.csv` into FOLDER, which is there already, and prints a table.
"""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

NEARL = os.environ.get("NEARL", str(Path(__file__).parents[2] / "target/release/nearl"))
EPISODES, STEPS = 100, 1000
PUSHES = {"none": "0", "up to 0.5 m/s": "0.5 * uniform", "up to 1 m/s": "1.0 * uniform"}
FLAT = "flat"
# height of the bumps and pushes on them
GROUNDS = [(FLAT, "none"), (FLAT, "up to 0.5 m/s"), (FLAT, "up to 1 m/s"), ("0.04", "up to 0.5 m/s"), ("0.08", "up to 0.5 m/s"), ("0.12", "up to 0.5 m/s")]
TORQUE, TORQUE_RATE = 80.0, 6000.0  # of the robot file [N m] and the task [N m/s]
COLUMNS = {
    "falls": "episodes with a fall",
    "speed_error": "speed error, m/s",
    "worst_speed_error": "in the worst episode",
    "turn_error": "turn error, rad/s",
    "worst_turn_error": "in the worst episode",
    "torque_broken": "torque beyond 80, N m",
    "rate_broken": "torque rate beyond 6000, N m/s",
}


def evaluate(snapshot: str, bumps: str, pushes: str) -> tuple[dict, list[dict]]:
    command = [NEARL, "eval", snapshot, "--episodes", str(EPISODES), "--seed", "7", "--json", "--set", f'pushes.base="{pushes}"']
    if bumps != FLAT:
        command += ["--set", f"scene.floor={{ friction = 0.8, bumps = {bumps} }}"]
    e = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)[0]
    told = {t["name"].removeprefix("metrics/"): t for t in e["told"]}
    beyond = [told[name]["largest"] - limit for name, limit in (("torque", TORQUE), ("torque_rate", TORQUE_RATE))]
    row = {
        "falls": sum(length < STEPS for length in e["lengths"]),
        "speed_error": f"{told['speed_error']['mean']:.4f}",
        "worst_speed_error": f"{told['speed_error']['largest']:.4f}",
        "turn_error": f"{told['turn_error']['mean']:.4f}",
        "worst_turn_error": f"{told['turn_error']['largest']:.4f}",
        "torque_broken": f"{beyond[0] if beyond[0] > 1e-9 * TORQUE else 0:.3g}",
        "rate_broken": f"{beyond[1] if beyond[1] > 1e-9 * TORQUE_RATE else 0:.3g}",
    }
    return row, [{"episode": i, "return": f"{r:.3f}", "policy_steps": n} for i, (r, n) in enumerate(zip(e["returns"], e["lengths"], strict=True))]


def main(folder: Path, snapshots: list[str]) -> None:
    for path, there in [(folder, folder.is_dir()), *((s, Path(s).exists()) for s in snapshots)]:
        if not there:
            sys.exit(f"evaluate.py: '{path}' does not exist; a hundred episodes of each snapshot take minutes, so nothing was begun")
    rows, episodes = [], []
    for snapshot in snapshots:
        for bumps, pushes in GROUNDS:
            head = {"snapshot": Path(snapshot).name, "bumps": bumps, "pushes": pushes}
            row, each = evaluate(snapshot, bumps, PUSHES[pushes])
            rows.append(head | row)
            episodes += [head | episode for episode in each]
    for name, lines in (("evaluation.csv", rows), ("episodes.csv", episodes)):
        with open(folder / name, "w", newline="") as f:
            writer = csv.DictWriter(f, list(lines[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(lines)
    heads = ["snapshot", "bumps, m", "pushes an axis", *COLUMNS.values()]
    print(f"| {' | '.join(heads)} |\n" + "|---" * len(heads) + "|")
    for row in rows:
        print(f"| {' | '.join(str(v) for v in row.values())} |")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), sys.argv[2:])
