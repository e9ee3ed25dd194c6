"""What runs of the presets `strong` and `long` are worth without noise: `runs.csv`, `table.md` and `figure.png`.

    .venv/bin/python results/strong/table.py FOLDER [RUNS]

RUNS has `<task>/<algo>_<seed>`; each is evaluated over ten episodes without noise and written to `FOLDER/runs.csv`. Without RUNS table and figure are made
of the `runs.csv` that is there.
"""

import csv
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt

from nearl.curves import bootstrap_band, interquartile_mean

NEARL = Path(__file__).parents[2] / "target" / "release" / "nearl"
# the highest of the public tables of PPO after a million steps, and after ten million
WANTED = {"HalfCheetah-v5": (5800, 9300), "Hopper-v5": (2600, 3300), "Walker2d-v5": (4000, 6400), "Ant-v5": (3300, 6000)}
ALGOS = ["ppo", "pid2-ib"]


def evaluate(runs: Path) -> list[dict]:
    """A row for each run."""
    rows = []
    for run in sorted(p.parent for p in runs.glob("*/*_*/metrics.csv")):
        algo, seed = run.name.rsplit("_", 1)
        told = subprocess.run([NEARL, "eval", run, "--json"], check=True, capture_output=True, text=True)
        with open(run / "metrics.csv") as text:
            last = list(csv.DictReader(text))[-1]
        row = {"task": run.parent.name, "algo": algo, "seed": int(seed), "steps": last["time/total_timesteps"]}
        row |= {"training": last["rollout/ep_rew_mean"], "without_noise": f"{np.mean(json.loads(told.stdout)[0]['returns']):.0f}"}
        rows.append(row)
    return rows


def rank_test(a: list[float], b: list[float]) -> float:
    """Two-sided p of Mann and Whitney, exact: the share of all ways to divide the values whose sum of ranks is as far from even as this one."""
    values = sorted([*a, *b])
    doubled = {v: values.index(v) + len(values) - values[::-1].index(v) + 1 for v in values}  # twice the middle rank of equal values
    ways = [Counter() for _ in range(len(a) + 1)]  # by how many of the values were taken, and the sum of their ranks
    ways[0][0] = 1
    for v in values:
        for k in range(len(a), 0, -1):
            for total, n in ways[k - 1].items():
                ways[k][total + doubled[v]] += n
    even = len(a) * (len(values) + 1)
    seen = abs(sum(doubled[v] for v in a) - even)
    return sum(n for total, n in ways[-1].items() if abs(total - even) >= seen) / ways[-1].total()


def main(folder: Path, runs: Path | None) -> None:
    if runs:
        rows = evaluate(runs)
        with open(folder / "runs.csv", "w", newline="") as f:
            writer = csv.DictWriter(f, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    with open(folder / "runs.csv") as f:
        rows = list(csv.DictReader(f))
    wanted = {task: of[max(int(r["steps"]) for r in rows) > 5_000_000] for task, of in WANTED.items()}
    lines = ["| task | PPO | PID²-IB | wanted of PPO | pairs in which PID²-IB is ahead | p of the rank test |", "|---|---|---|---|---|---|"]
    figure, axis = plt.subplots(figsize=(8.5, 4))
    for at, task in enumerate(wanted):
        found = {}
        for algo in ALGOS:
            mine = sorted((r for r in rows if (r["task"], r["algo"]) == (task, algo)), key=lambda r: int(r["seed"]))
            if mine:
                found[algo] = [float(r["without_noise"]) for r in mine]
        words = []
        for k, (algo, values) in enumerate(found.items()):
            centre, (low, high) = float(interquartile_mean(values)), bootstrap_band(values)
            runs = ", ".join(f"{v:.0f}" for v in values) if len(values) <= 5 else f"{len(values)} runs"
            words.append(f"**{centre:.0f}** ({low:.0f} to {high:.0f}): {runs}")
            x = at + 0.24 * (k - 0.5)
            axis.plot([x] * len(values), values, "o", color=f"C{k}", alpha=0.5, ms=5)
            axis.errorbar(x + 0.07, centre, [[centre - low], [high - centre]], fmt="s", color=f"C{k}", capsize=3, label=algo if at == 0 else None)
        axis.plot([at - 0.3, at + 0.3], [wanted[task]] * 2, "k--", lw=1, label="public tables of PPO" if at == 0 else None)
        if len(found) == 2:
            a, b = found["ppo"], found["pid2-ib"]
            ahead = sum(q > p for p in a for q in b)
            lines.append(f"| {task} | {' | '.join(words)} | {wanted[task]} | {ahead} of {len(a) * len(b)} | {rank_test(a, b):.2f} |")
    (folder / "table.md").write_text("\n".join(lines) + "\n")
    axis.set_xticks(range(len(wanted)), list(wanted))
    axis.set_ylabel("return without noise")
    axis.grid(axis="y", alpha=0.3)
    axis.legend()
    figure.tight_layout()
    figure.savefig(folder / "figure.png", dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
