"""What each switch gives: `switches.csv` and `switches.md`.

    .venv/bin/python results/first_figure/switches.py RUNS FOLDER

RUNS has `<switch>/<task>/<algo>_<seed>`. Returns are those of ten episodes without noise; the error of the inverse model is the mean of the last ten rows. The
runs of FOLDER's `runs.csv` stand beside them as what the task files set.
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path

from nearl.report.sweep import read_sweep

sys.path.append(str(Path(__file__).parents[1]))
from curves import LOSS, end, without_noise, write

TASKS = ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5"]


def main(runs: Path, folder: Path) -> None:
    rows = []
    for switch in sorted(path for path in runs.iterdir() if path.is_dir()):
        for run in read_sweep(switch):
            rows.append({"switch": switch.name, "task": run.task, "algo": run.algo, "seed": run.seed})
            rows[-1] |= {"without_noise": f"{without_noise(run):.1f}", "idm_mse": f"{end(run, LOSS):.4g}"}
    write(folder / "switches.csv", rows)
    with open(folder / "runs.csv") as file:
        rows += [row | {"switch": "as the task files set"} for row in csv.DictReader(file) if row["algo"] == "pid2-ib"]
    cells: dict = defaultdict(dict)
    for row in rows:
        cells[row["switch"]].setdefault(row["task"], {})[int(row["seed"])] = float(row["without_noise"])
    lines = [f"| | {' | '.join(task.removesuffix('-v5') for task in TASKS)} |", "|---" * 5 + "|"]
    for switch, tasks in sorted(cells.items()):
        words = [", ".join(f"{x:.0f}" for _, x in sorted(tasks.get(task, {}).items())) for task in TASKS]
        lines.append(f"| {switch} | {' | '.join(words)} |")
    (folder / "switches.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
