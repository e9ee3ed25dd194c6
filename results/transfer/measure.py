"""Evaluates trained policies on other plants: `python measure.py ROBOT RUN...` prints a row a run and plant, as CSV.

A run's name ends in `plain` or `random` and its seed: `panda_plain_0`.
"""

import csv
import json
import subprocess
import sys
from pathlib import Path

from robots import plants

NEARL = "nearl"
EPISODES = 20


def evaluate(run, sets):
    command = [NEARL, "eval", str(run), "--episodes", str(EPISODES), "--seed", "7", "--json"]
    for one in sets:
        command += ["--set", one]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)[0]


def row(run, plant, found):
    told = {one["name"].removeprefix("metrics/"): one for one in found["told"] if one["name"].startswith("metrics/")}
    worst = {one["limit"]: one["by"] for one in found["worst"]}
    returns = found["returns"]
    cells = {
        "run": run.name,
        "plant": plant,
        "return": sum(returns) / len(returns),
        "lowest_return": min(returns),
        "shortest_episode": min(found["lengths"]),
        "outside_percent": 100 * found["reached_violations"] / found["ticks"],
        "position_excess": worst.get("position", 0.0),
        "velocity_excess": worst.get("velocity", 0.0),
        "target_violations": found["target_violations"],
    }
    for name, one in told.items():
        cells[name] = one["largest" if name in ("torque", "torque_rate") else "mean"]
    return {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in cells.items()}


def main(robot, runs):
    writer = None
    for run in map(Path, runs):
        for plant, sets in plants(robot).items():
            cells = row(run, plant, evaluate(run, sets))
            if writer is None:
                writer = csv.DictWriter(sys.stdout, cells)
                writer.writeheader()
            writer.writerow(cells)
            sys.stdout.flush()


main(sys.argv[1], sys.argv[2:])
