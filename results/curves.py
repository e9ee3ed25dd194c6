"""The data and the figure of a sweep, to be committed: `figure.png`, `curves.csv` (every hundredth row), `runs.csv` and `table.md`. The
returns in training are with exploration; `runs.csv` and `table.md` have beside them those of ten episodes without noise (`nearl eval`).

    .venv/bin/python results/curves.py RUNS FOLDER
"""

import csv
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np

from nearl import curves as seeds
from nearl.report.read import Run
from nearl.report.sweep import HEAD, figure, read_sweep, table

RETURN, COST, LOSS = "rollout/ep_rew_mean", "rollout/ep_cost_mean", "idm/mse_after"
COLUMNS = {"return": RETURN, "cost": COST, "idm_mse": LOSS, "residual": "idm/residual"}
LAST, THIN = 10, 100
NEARL = Path(__file__).parents[1] / "target" / "release" / "nearl"


def end(run: Run, metric: str) -> float | None:
    """The mean over the last ten rows."""
    found = run.column(metric)
    return None if found is None else float(np.mean(found[1][-LAST:]))


def without_noise(run: Run) -> float:
    """Mean return of ten episodes of the mean action, as the run was trained: projected, or its proposals as they are."""
    trained = tomllib.loads((run.path / "task.toml").read_text()).get("train", {})
    mode = "projected" if trained.get("project_in_training", True) else "raw"
    told = subprocess.run([NEARL, "eval", run.path, "--compare", mode, "--json"], check=True, capture_output=True, text=True)
    return float(np.mean(json.loads(told.stdout)[0]["returns"]))


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
        ends.append(head | {"steps": int(steps[-1]), **last, "without_noise": f"{without_noise(run):.5g}", "seconds": round(run.column("time/seconds")[1][-1])})
    write(folder / "curves.csv", curves)
    write(folder / "runs.csv", ends)
    titles = [*HEAD, "return without noise"]
    lines = [titles, ["---"] * len(titles)]
    for line in table(found):
        returns = [float(end["without_noise"]) for end in ends if f"{end['task']}, {end['algo']}" == line[0]]
        lines.append([*line, f"{seeds.interquartile_mean(returns):.1f} ({min(returns):.0f} .. {max(returns):.0f})"])
    (folder / "table.md").write_text("".join(f"| {' | '.join(line)} |\n" for line in lines))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
