"""Return without noise, excess over the set and the time of an update, for each set of actions: `runs.csv` and `table.md`.

    .venv/bin/python results/action_constraints/table.py RUNS FOLDER

RUNS has `<set>/<task>/<algo>_<seed>` and, where times were taken, `<set>/update.json`. Runs that it does not have stay what they are in FOLDER. Runs without a
set are those of results/strong, of a million steps: they stand beside runs of as many steps alone, in the folder of this program. Ten episodes of each run are
recorded (`nearl demos record`), and what was done in them is held against the formula here, from the joint velocities of the simulator: nothing that projects
has a say in it.
"""

import csv
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from nearl.curves import bootstrap_band, interquartile_mean

ROOT = Path(__file__).parents[2]
NEARL = os.environ.get("NEARL", ROOT / "target/release/nearl")
sys.path.insert(0, str(ROOT / "results/strong"))
from table import rank_test  # noqa: E402

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


def free() -> dict[tuple[str, str], list[float]]:
    """Returns without noise of the runs without a set, by task and algorithm."""
    found = defaultdict(list)
    with open(ROOT / "results/strong/runs.csv") as f:
        for row in csv.DictReader(f):
            found[row["task"], row["algo"]].append(float(row["without_noise"]))
    return found


def measure(run: Path) -> dict:
    """A row of the data: ten episodes of this run."""
    name, task, (algo, seed) = run.parents[1].name, run.parent.name, run.name.rsplit("_", 1)
    recorded = episodes(run)
    over = np.concatenate([excess(name, a, w) for a, w, _ in recorded])
    row = {"set": name, "task": task, "algo": algo, "seed": seed, "without_noise": f"{np.mean([r for *_, r in recorded]):.5g}"}
    row |= {"steps": len(over), "largest_excess": f"{over.max():.3g}", "steps_beyond_1e-9": int((over > 1e-9).sum())}
    return row | {"steps_on_the_limit": int((over > -1e-6).sum())}


def centre(values: list[float]) -> str:
    """Interquartile mean with its band."""
    low, high = bootstrap_band(values)
    return f"{interquartile_mean(values):.0f}" + (f" ({low:.0f} to {high:.0f})" if len(values) > 1 else "")


def main(runs: Path, folder: Path) -> None:
    finished = sorted(file.parents[1] for file in runs.glob("*/*/*_*/checkpoints/final.safetensors"))
    if not finished:
        sys.exit(f"no finished run in {runs}")
    folder.mkdir(parents=True, exist_ok=True)
    rows, beside = [measure(run) for run in finished], free() if folder.resolve() == Path(__file__).parent.resolve() else {}
    name = lambda row: tuple(row[k] for k in ("set", "task", "algo", "seed"))  # noqa: E731
    measured = {name(row) for row in rows}
    if (folder / "runs.csv").is_file():
        with open(folder / "runs.csv", newline="") as f:
            rows += [row for row in csv.DictReader(f) if name(row) not in measured]
    rows.sort(key=name)
    with open(folder / "runs.csv", "w", newline="") as f:
        writer = csv.DictWriter(f, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    timed = {f.parent.name: json.loads(f.read_text()) for f in runs.glob("*/update.json")}
    titles = ["set", "algorithm", "seeds", "return", "without the set", "share", "p", "steps beyond", "largest excess", "steps on it"]
    titles += [f"update {p} {how} [us]" for how in ("with the set", "without") for p in ("p50", "p99")] if timed else []
    us = lambda name: [f"{timed[name][p]:.1f}" if name in timed else "" for p in ("p50", "p99")]  # noqa: E731
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for name, task, algo in sorted({(r["set"], r["task"], r["algo"]) for r in rows}):
        mine = [r for r in rows if (r["set"], r["task"], r["algo"]) == (name, task, algo)]
        values, without = [float(r["without_noise"]) for r in mine], beside.get((task, algo), [])
        broken, held, steps = (sum(int(r[k]) for r in mine) for k in ("steps_beyond_1e-9", "steps_on_the_limit", "steps"))
        cells = [name, algo, str(len(values)), centre(values)]
        cells += [centre(without), f"{interquartile_mean(values) / interquartile_mean(without):.2f}"] if without else ["", ""]
        cells += [f"{rank_test(values, without):.2f}" if without and len(values) > 2 else ""]
        cells += [f"{broken} of {steps}", f"{max(float(r['largest_excess']) for r in mine):.1g}", f"{100 * held / steps:.0f} %"]
        cells += us(name) + us(f"free-{task}") if timed else []
        lines.append(f"| {' | '.join(cells)} |")
    (folder / "table.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
