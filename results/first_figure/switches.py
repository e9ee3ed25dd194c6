"""What each switch gives: `switches.csv` and `switches.md`.

    .venv/bin/python results/first_figure/switches.py RUNS FOLDER

RUNS has `<switch>/<task>/<algo>_<seed>`. Returns are those of ten episodes without noise; the error of the inverse model is the mean of the last ten rows. The
runs of FOLDER's `runs.csv` stand beside them as what the task files set.
"""

import csv
import json
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

NEARL = os.environ.get("NEARL", Path(__file__).parents[2] / "target" / "release" / "nearl")
TASKS = ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5"]


def measured(run: Path) -> tuple[float, float]:
    """Mean return without noise, and the error of the inverse model at the end."""
    told = subprocess.run([NEARL, "eval", run, "--json"], check=True, capture_output=True, text=True)
    with open(run / "metrics.csv") as file:
        errors = [float(row["idm/mse_after"]) for row in list(csv.DictReader(file))[-10:]]
    return float(np.mean(json.loads(told.stdout)[0]["returns"])), float(np.mean(errors))


def main(runs: Path, folder: Path) -> None:
    rows = []
    for path in sorted(runs.glob("*/*/*_*")):
        algo, seed = path.name.rsplit("_", 1)
        value, error = measured(path)
        rows.append({"switch": path.parents[1].name, "task": path.parent.name, "algo": algo, "seed": int(seed)})
        rows[-1] |= {"without_noise": f"{value:.1f}", "idm_mse": f"{error:.4g}"}
    with open(folder / "switches.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    with open(folder / "runs.csv") as file:
        rows += [row | {"switch": "as the task files set"} for row in csv.DictReader(file) if row["algo"] == "pid2-ib"]
    cells: dict = defaultdict(dict)
    for row in rows:
        cells[row["switch"]].setdefault(row["task"], {})[int(row["seed"])] = float(row["without_noise"])
    lines = [f"| | {' | '.join(task.removesuffix('-v5') for task in TASKS)} |", "|---" * 5 + "|"]
    for switch, tasks in sorted(cells.items()):
        words = [", ".join(f"{x:.0f}" for _, x in sorted(tasks.get(task, {}).items())) for task in TASKS]
        lines.append(f"| {switch} | {' | '.join(words)} |")
    (folder / "switches.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
