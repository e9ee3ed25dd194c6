"""Training speed behind each set beside that without it, side by side in one run: the two alternate, and what stands is the median ratio.

    .venv/bin/python results/action_constraints/speed.py          # six sets, both algorithms; four minutes of a quiet machine
"""

import csv
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
NEARL = os.environ.get("NEARL", "target/release/nearl")
SECONDS, TURNS = "2", 5


def speed(task: str, algo: str, *sets: str) -> float:
    command = [NEARL, "bench", "train", task, "--algo", algo, "--preset", "strong", "--seconds", SECONDS, "--repeat", "1"]
    done = subprocess.run([*command, "--physics-seconds", "0", "--json", *sets], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)["steps_per_s"]


def main() -> None:
    rows = []
    for line in (FOLDER / "sets.txt").read_text().splitlines():
        name, task, limit = line.split()
        for algo in ("ppo", "pid2-ib"):
            pairs = [(speed(task, algo, "--set", f"constraints.action.{limit}"), speed(task, algo)) for _ in range(TURNS)]
            behind, free = (statistics.median(side) for side in zip(*pairs, strict=True))
            ratio = statistics.median(a / b for a, b in pairs)
            rows.append([name, algo, round(behind), round(free), f"{ratio:.2f}"])
            print(*rows[-1], file=sys.stderr)
    with (FOLDER / "speed.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["set", "algo", "steps_per_s", "steps_per_s_without", "ratio"], *rows])


main()
