"""Return and cost of the runs of `limited.sh` as `limited.csv`, and `limited.md`: interquartile mean (lowest .. highest) over seeds.

    .venv/bin/python results/velocity/limited.py RUNS FOLDER

RUNS has `<steps>/<task>-<way>-<seed>`. Return and cost are of the last hundred episodes of training, exploration on, and of twenty without noise.
A finished run whose line is in `limited.csv` is not evaluated again.
"""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from nearl.curves import interquartile_mean

NEARL = os.environ.get("NEARL", "target/release/nearl")
WAYS = {"free": "PPO", "limited": "PPO, limit", "prior": "PID²-IB, prior", "both": "PID²-IB, prior and limit"}
# Safety-Gymnasium's tasks in OmniSafe's benchmark, 1e7 steps: return and cost of PPO-Lagrangian
PUBLISHED = {"HalfCheetah": ("2946", "3.4"), "Hopper": ("962", "14.0"), "Walker2d": ("2982", "13.5"), "Ant": ("3262", "–")}
NUMBERS = ["training_return", "training_cost", "return", "cost", "multiplier"]


def measure(run: Path) -> dict:
    task, way, seed = run.name.rsplit("-", 2)
    with open(run / "metrics.csv") as text:
        last = list(csv.DictReader(text))[-1]
    told = subprocess.run([NEARL, "eval", run, "--episodes", "20", "--json"], check=True, capture_output=True, text=True)
    found = json.loads(told.stdout)[0]
    row = {"steps": run.parent.name, "task": task, "way": way, "seed": seed}
    row |= {"training_return": last["rollout/ep_rew_mean"], "training_cost": last["rollout/ep_cost_mean"]}
    row |= {"return": np.mean(found["returns"]), "cost": np.mean(found["costs"]), "multiplier": last["cost/multiplier"]}
    return row | {n: f"{float(row[n]):.5g}" if row[n] != "" else "" for n in NUMBERS}


def main(runs: Path, folder: Path) -> None:
    file, key = folder / "limited.csv", lambda r: (r["steps"], r["task"], r["way"], r["seed"])
    rows = {key(r): r for r in csv.DictReader(file.open())} if file.exists() else {}
    for run in sorted(p.parents[1] for p in runs.glob("*/*-*-*/checkpoints/final.safetensors")):
        if (run.parent.name, *run.name.rsplit("-", 2)) not in rows:
            row = measure(run)
            if row["training_return"] == "":
                print(f"{run}: no episode came to its end in training, so that there is no return: left out", file=sys.stderr)
                continue
            rows[key(row)] = row
    if not rows:
        sys.exit(f"no finished run with a return in {runs}")
    ordered = sorted(rows.values(), key=lambda r: (list(PUBLISHED).index(r["task"]), r["steps"], list(WAYS).index(r["way"]), int(r["seed"])))
    with file.open("w", newline="") as text:
        writer = csv.DictWriter(text, list(ordered[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(ordered)

    lines = [
        "| task | steps | | seeds | return in training | cost in training | return without noise | cost without noise | published return | published cost |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for task, steps, way in dict.fromkeys((r["task"], r["steps"], r["way"]) for r in ordered):
        those = [r for r in ordered if (r["task"], r["steps"], r["way"]) == (task, steps, way)]

        def cell(name: str, those: list[dict] = those) -> str:
            values = [float(r[name]) for r in those]
            band = f" ({min(values):.4g} .. {max(values):.4g})" if len(values) > 1 else ""
            return f"{interquartile_mean(values):.4g}{band}"

        cells = [task, steps, WAYS[way], str(len(those)), *(cell(n) for n in NUMBERS[:4]), *PUBLISHED[task]]
        lines.append(f"| {' | '.join(cells)} |")
    (folder / "limited.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
