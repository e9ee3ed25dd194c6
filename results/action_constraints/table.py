"""Return without noise, excess over the set and the time of an update, for each set of actions: `runs.csv` and `table.md`.

    .venv/bin/python results/action_constraints/table.py RUNS FOLDER

RUNS has `<set>/<task>/<algo>_<seed>` and `<set>/update.json`. Ten episodes of each run are recorded (`nearl demos record`), and what was done in them is
held against the formula here, from the joint velocities of the simulator: nothing that projects has a say in it.
"""

import csv
import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from nearl.curves import bootstrap_band, interquartile_mean

NEARL = Path(__file__).parents[2] / "target" / "release" / "nearl"
RATES = {"HC+rate": [0.2, 0.2, 0.2, 0.5, 0.5, 0.5], "H+rate": [0.2, 0.5, 0.5]}
BOUNDS = {"HC+O": 20.0, "H+M": 10.0, "W+M": 10.0, "Ant+S": 2.0}


def excess(name: str, action: np.ndarray, w: np.ndarray) -> np.ndarray:
    """How far each step of an episode is outside the set: `action` (steps x n_act), `w` the velocities of its joints [rad/s]."""
    if name in RATES:
        return (np.abs(np.diff(action, axis=0)) - RATES[name]).max(axis=1)
    value = {"HC+O": lambda: np.abs(w * action), "Ant+S": lambda: action**2}.get(name, lambda: np.maximum(w * action, 0.0))()
    return value.sum(axis=1) - BOUNDS[name]


def episodes(run: Path) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Actions, velocities of the driven joints and return of ten episodes without noise."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "episodes.npz"
        told = subprocess.run([NEARL, "demos", "record", run, "--out", file, "--json"], check=True, capture_output=True, text=True)
        found = dict(np.load(file))
    returns = json.loads(told.stdout.strip().splitlines()[-1])["returns"]
    n_act, at, result = found["actions"].shape[1], 0, []
    for k, n in enumerate(found["lengths"].astype(int)):
        # planar robots: the driven joints are the last of qvel, in the order of the actions; Ant's set has no velocities
        result.append((found["actions"][at : at + n], found["qvel"][at + k : at + k + n, -n_act:], returns[k]))
        at += n
    return result


def main(runs: Path, folder: Path) -> None:
    rows, returns = [], defaultdict(dict)
    for run in sorted(p.parent for p in runs.glob("*/*/*_*/checkpoints")):
        name, task, (algo, seed) = run.parents[1].name, run.parent.name, run.name.rsplit("_", 1)
        recorded = episodes(run)
        over = None if name.startswith("free") else np.concatenate([excess(name, a, w) for a, w, _ in recorded])
        value = float(np.mean([r for *_, r in recorded]))
        returns[name, task, algo][int(seed)] = value
        rows.append(
            {"set": name, "task": task, "algo": algo, "seed": seed, "without_noise": f"{value:.5g}", "steps": sum(len(a) for a, *_ in recorded)}
            | {"largest_excess": "" if over is None else f"{over.max():.3g}", "steps_beyond_1e-9": 0 if over is None else int((over > 1e-9).sum())}
            | {"steps_on_the_limit": 0 if over is None else int((over > -1e-6).sum())}
        )
    with open(folder / "runs.csv", "w", newline="") as f:
        writer = csv.DictWriter(f, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    titles = ["set", "algorithm", "seeds", "return without noise", "without the set", "steps beyond by more than 1e-9", "steps on it"]
    titles += ["update p50, p99 [us]", "without the set"]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    timed = {f.parent.name: json.loads(f.read_text()) for f in runs.glob("*/update.json")}
    us = lambda name: f"{timed[name]['p50']:.1f}, {timed[name]['p99']:.1f}" if name in timed else ""  # noqa: E731
    for (name, task, algo), found in sorted(returns.items()):
        if name.startswith("free"):
            continue
        values, free = np.array(list(found.values())), list(returns.get((f"free-{task}", task, algo), {}).values())
        low, high = bootstrap_band(values)
        mine = [r for r in rows if (r["set"], r["task"], r["algo"]) == (name, task, algo)]
        broken, held, steps = (sum(int(r[k]) for r in mine) for k in ("steps_beyond_1e-9", "steps_on_the_limit", "steps"))
        beside = f"{interquartile_mean(free):.0f}" if free else ""
        centre = f"{interquartile_mean(values):.0f}" + (f" ({low:.0f} to {high:.0f})" if len(values) > 1 else "")
        lines.append(f"| {name} | {algo} | {len(values)} | {centre} | {beside} | {broken} of {steps} | {held} | {us(name)} | {us(f'free-{task}')} |")
    (folder / "table.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
