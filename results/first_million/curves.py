"""Learning curves of results/first_million: reads the runs, writes curves.csv, summary.csv and curves.png beside this file.

    .venv/bin/python results/first_million/curves.py
"""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from nearl.curves import bootstrap_band, interquartile_mean

HERE = Path(__file__).parent
RUNS = HERE.parent.parent / "runs/first_million"
TASKS, ALGORITHMS, SEEDS = ("HalfCheetah-v5", "Hopper-v5"), ("ppo", "pid2-ib"), (0, 1, 2)
COLOURS = {"ppo": "0.45", "pid2-ib": "#0b6e99"}


def read(task, algo, seed):
    with open(RUNS / task / f"{algo}_{seed}" / "metrics.csv") as f:
        rows = list(csv.DictReader(f))
    column = lambda k: np.array([float(r[k]) if r[k] else np.nan for r in rows])
    return column("time/total_timesteps"), column("rollout/ep_rew_mean"), column("idm/mse_after"), column("time/fps")


figure, axes = plt.subplots(2, len(TASKS), figsize=(10, 5.6), sharex=True, constrained_layout=True)
curves, summary = [], []
for column, task in enumerate(TASKS):
    for algo in ALGORITHMS:
        data = [read(task, algo, s) for s in SEEDS]
        steps = data[0][0]
        for row, k in ((0, 1), (1, 2)):
            lines = np.array([d[k] for d in data])
            axis = axes[row, column]
            for line in lines:
                axis.plot(steps / 1e6, line, color=COLOURS[algo], linewidth=0.6, alpha=0.5)
            good = np.isfinite(lines).all(axis=0)
            mean, (low, high) = interquartile_mean(lines[:, good]), bootstrap_band(lines[:, good])
            axis.plot(steps[good] / 1e6, mean, color=COLOURS[algo], linewidth=1.8, label=algo)
            axis.fill_between(steps[good] / 1e6, low, high, color=COLOURS[algo], alpha=0.15, linewidth=0)
        for seed, d in zip(SEEDS, data):
            curves += [(task, algo, seed, int(s), r, m) for s, r, m in list(zip(*d[:3]))[::8]]
            summary.append((task, algo, seed, int(d[0][-1]), round(d[1][-1], 1), round(d[2][-1], 4), round(d[3][-1])))
    axes[0, column].set_title(task)
    axes[0, column].legend(frameon=False)
    axes[1, column].axhline(0.5, color="#c0392b", linestyle="--", linewidth=1)
    axes[1, column].set_xlabel("million steps")
axes[0, 0].set_ylabel("return, last 100 episodes")
axes[1, 0].set_ylabel("inverse-dynamics error")
figure.savefig(HERE / "curves.png", dpi=120)
for name, header, rows in (
    ("curves.csv", ("task", "algo", "seed", "steps", "return", "idm_mse"), curves),
    ("summary.csv", ("task", "algo", "seed", "steps", "return", "idm_mse", "steps_per_s"), summary),
):
    with open(HERE / name, "w", newline="") as f:
        writer = csv.writer(f, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
for task in TASKS:
    for algo in ALGORITHMS:
        returns = [r[4] for r in summary if r[:2] == (task, algo)]
        print(f"{task:15} {algo:8} {np.mean(returns):7.0f}  {returns}")
