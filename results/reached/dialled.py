"""The share asked for by `constraints.reached` and the one that came, in training and after it.

    python results/reached/dialled.py NEARL RUNS FOLDER SEED...

RUNS has the run folders of `dialled.sh`. FOLDER/dialled.csv is written; the lines of other seeds than these stay what they are in it. Each policy is evaluated
for 40 episodes of 1000 ticks, of which the second half counts, as margins that begin at 0 need some thousand ticks: with what it was trained for, and the one
that was trained without under each share. The floor is what the best of 400 sampled actions leaves outside, in every fortieth tick of 10,000 of the policy
without margins (`dial.py`).
"""

import csv
import json
import pathlib
import subprocess
import sys

import numpy as np
from dial import Snapshot, fly

EPISODES = 40
SHARES = ("0.1", "0.05", "0.01")


def evaluate(nearl: str, run: pathlib.Path, asked: str) -> dict:
    """Shares and returns of the second half of the episodes; all of them where there are no margins, velocities counted too."""
    command = [nearl, "eval", str(run), "--episodes", str(EPISODES), "--json", *(() if asked == "none" else ("--reached", asked))]
    (found,) = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    half, reached = EPISODES // 2, found["reached"]
    if reached is None:
        share = f"{found['reached_violations'] / found['ticks']:.4f}"
        return {"outside": share, "outside of all": share, "return": f"{np.mean(found['returns']):.1f}", "worst rows": "", "unattainable": ""}
    rows = sorted(reached["rows"], key=lambda row: -row["outside"])
    return {
        "outside": f"{np.mean(reached['by_episode'][half:]):.4f}",
        "outside of all": f"{reached['share']:.4f}",
        "return": f"{np.mean(found['returns'][half:]):.1f}",
        "worst rows": "; ".join(f"{r['joint']} {r['side']} {r['outside'] / found['ticks']:.4f} margin {r['margin']:.2f}" for r in rows[:3]),
        "unattainable": "; ".join(f"{r['joint']} {r['side']}" for r in rows if r["unattainable"]),
    }


def in_training(run: pathlib.Path) -> str:
    """Share of the ticks outside a position or a velocity limit in the second half of the training, exploration included."""
    with (run / "metrics.csv").open() as file:
        shares = [float(row["constraints/reached_violations"]) for row in csv.DictReader(file)]
    return f"{np.mean(shares[len(shares) // 2 :]):.4f}"


def kept(file: pathlib.Path, seeds: list[str]) -> list[dict]:
    """Lines of other seeds that are there already."""
    if not file.is_file():
        return []
    with file.open(newline="") as text:
        return [row for row in csv.DictReader(text) if row["seed"] not in seeds]


if __name__ == "__main__":
    if len(sys.argv) < 5:
        sys.exit(__doc__)
    nearl, runs, folder, seeds = sys.argv[1], pathlib.Path(sys.argv[2]), pathlib.Path(sys.argv[3]), sys.argv[4:]
    columns = ["seed", "trained for", "in training", "asked", "outside", "outside of all", "return", "floor", "worst rows", "unattainable"]
    folder.mkdir(parents=True, exist_ok=True)
    rows = kept(folder / "dialled.csv", seeds)
    for seed in seeds:
        for trained in ("none", *SHARES):
            run = runs / f"{trained}_{seed}"
            floor = fly(Snapshot(str(run / "checkpoints/final.safetensors")), None, 10000, "motor")["floor"]
            for asked in ("none", *SHARES) if trained == "none" else (trained,):
                row = {"seed": seed, "trained for": trained, "in training": in_training(run), "asked": asked}
                rows.append({**row, **evaluate(nearl, run, asked), "floor": floor})
                print(",".join(str(rows[-1][column]) for column in columns), flush=True)
    with (folder / "dialled.csv").open("w", newline="") as text:
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda row: int(row["seed"])))
