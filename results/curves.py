"""The data and the figure of a sweep, to be committed: `figure.png`, `curves.csv` (every hundredth row), `runs.csv` and `table.md`.

    .venv/bin/python results/curves.py RUNS FOLDER
"""

import csv
import sys
from pathlib import Path

import numpy as np

from nearl.report.read import Run
from nearl.report.sweep import HEAD, figure, read_sweep, table

RETURN, COST, LOSS = "rollout/ep_rew_mean", "rollout/ep_cost_mean", "idm/mse_after"
COLUMNS = {"return": RETURN, "cost": COST, "idm_mse": LOSS, "residual": "idm/residual"}
LAST, THIN = 10, 100


def end(run: Run, metric: str) -> float | None:
    """The mean over the last ten rows."""
    found = run.column(metric)
    return None if found is None else float(np.mean(found[1][-LAST:]))


def write(path: Path, rows: list[dict]) -> None:
    with open(path, "w", newline="") as f:
        writer = csv.DictWriter(f, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main(runs: Path, folder: Path) -> None:
    found = read_sweep(runs)
    drawn = figure(found)
    drawn.savefig(folder / "figure.png", dpi=110)
    curves, ends = [], []
    for run in found:
        head = {"task": run.task, "algo": run.algo, "seed": run.seed}
        steps = run.column("time/total_timesteps")[1]
        values = {k: dict(zip(*c)) if (c := run.column(m)) is not None else {} for k, m in COLUMNS.items() if k != "residual"}
        at = lambda k, s: f"{values[k][s]:.5g}" if s in values[k] else ""  # noqa: E731
        curves += [head | {"steps": int(s)} | {k: at(k, s) for k in values} for s in steps[::THIN]]
        last = {k: "" if (v := end(run, m)) is None else f"{v:.5g}" for k, m in COLUMNS.items()}
        ends.append(head | {"steps": int(steps[-1]), **last, "seconds": round(run.column("time/seconds")[1][-1])})
    write(folder / "curves.csv", curves)
    write(folder / "runs.csv", ends)
    lines = [HEAD, ["---"] * len(HEAD), *table(found)]
    (folder / "table.md").write_text("".join(f"| {' | '.join(line)} |\n" for line in lines))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
