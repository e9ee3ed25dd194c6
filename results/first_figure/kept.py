"""Ends of the runs of `kept.sh`: `kept.csv`.

    .venv/bin/python results/first_figure/kept.py RUNS FOLDER

RUNS has `<task>/<algo>_<seed>`. `return`, `idm_mse` and `residual` are means of the last ten rows, `without_noise` is the return of ten episodes without noise,
and `learned_by_itself` counts the updates in which the inverse model learned by itself, the first one included.
"""

import sys
from pathlib import Path

from nearl.report.sweep import read_sweep

sys.path.append(str(Path(__file__).parents[1]))
from curves import COLUMNS, end, without_noise, write

TASKS = ["Walker2d-v5", "Hopper-v5", "HalfCheetah-v5", "Ant-v5"]


def main(runs: Path, folder: Path) -> None:
    rows = []
    for run in sorted(read_sweep(runs), key=lambda run: (TASKS.index(run.task), run.seed)):
        last = {name: end(run, COLUMNS[name]) for name in ("return", "idm_mse", "residual")}
        told = {name: "" if value is None else f"{value:.1f}" if name == "return" else f"{value:.4g}" for name, value in last.items()}
        learned = int((run.column("idm/updated")[1] == 1).sum())
        rows.append({"task": run.task, "algo": run.algo, "seed": run.seed, "steps": int(run.column("time/total_timesteps")[1][-1])})
        rows[-1] |= {**told, "without_noise": f"{without_noise(run):.1f}", "learned_by_itself": learned}
    write(folder / "kept.csv", rows)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
