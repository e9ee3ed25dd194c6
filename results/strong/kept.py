"""Updates in which an inverse model learned by itself, and what became of the return: a line of CSV for each.

    .venv/bin/python results/strong/kept.py RUN...

Of a run's `metrics.csv`: the squared error of the inverse model before and after the update, the mean return of the last hundred episodes before it, the lowest
of that within the sixty batches that follow, and that after them.
"""

import csv
import sys
from pathlib import Path

BATCHES = 60


def updates(run: Path) -> list[list[str]]:
    """A row for each such update of a run."""
    with open(run / "metrics.csv") as text:
        rows = list(csv.DictReader(text))
    found = []
    for i, row in enumerate(rows):
        # Before the first episodes have ended there is no return.
        if i == 0 or float(row["idm/updated"] or 0) != 1 or not rows[i - 1]["rollout/ep_rew_mean"]:
            continue
        returns = [float(later["rollout/ep_rew_mean"]) for later in rows[i : i + BATCHES]]
        errors = [f"{float(row[key]):.2f}" for key in ("idm/mse_before", "idm/mse_after")]
        before = float(rows[i - 1]["rollout/ep_rew_mean"])
        found.append([row["time/total_timesteps"], *errors, *(f"{x:.0f}" for x in (before, min(returns), returns[-1]))])
    return found


if __name__ == "__main__":
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(["run", "steps", "error_before", "error_after", "return_before", "lowest", f"after_{BATCHES}"])
    for run in map(Path, sys.argv[1:]):
        table.writerows([run.name, *update] for update in updates(run))
