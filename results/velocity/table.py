"""Ends of the runs of `run.sh` as `runs.csv`, and `table.md`: interquartile mean (lowest .. highest) over seeds.

    .venv/bin/python results/velocity/table.py RUNS FOLDER
"""

import csv
import sys
from pathlib import Path

import numpy as np

from nearl.curves import interquartile_mean
from nearl.report.sweep import read_sweep

WAYS = {
    "ppo": "PPO",
    "free": "PID²-IB, unconstrained",
    "prior": "PID²-IB, velocity prior",
    "tight": "PID²-IB, velocity prior, inverse model to 0.02",
}
COLUMNS = {
    "return": "rollout/ep_rew_mean",
    "cost": "rollout/ep_cost_mean",
    "residual": "idm/residual",
    "idm_mse": "idm/mse_after",
}


def main(runs: Path, folder: Path) -> None:
    rows = []
    for way in WAYS:
        for run in read_sweep(runs / way):
            row = {"way": way, "task": run.task, "algo": run.algo, "seed": run.seed}
            for name, metric in COLUMNS.items():
                found = run.column(metric)
                row[name] = "" if found is None else f"{np.mean(found[1][-10:]):.5g}"
            row["steps"] = int(run.column("time/total_timesteps")[1][-1])
            rows.append(row)
    with open(folder / "runs.csv", "w", newline="") as f:
        writer = csv.DictWriter(f, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)

    def cell(way: str, task: str, name: str) -> str:
        values = [float(r[name]) for r in rows if (r["way"], r["task"]) == (way, task) and r[name]]
        return f"{interquartile_mean(values):.4g} ({min(values):.3g} .. {max(values):.3g})" if values else "–"

    lines = ["| task | | " + " | ".join(COLUMNS) + " |", "|---|---|" + "---|" * len(COLUMNS)]
    for task in sorted({r["task"] for r in rows}):
        for way, name in WAYS.items():
            lines.append(f"| {task} | {name} | " + " | ".join(cell(way, task, c) for c in COLUMNS) + " |")
    (folder / "table.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
