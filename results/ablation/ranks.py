"""Each variant beside the right inverse model: interquartile means with their bands, and a rank test over seeds, from `curves.csv` to `ranks.md`.

    .venv/bin/python results/ablation/ranks.py [FOLDER]

Variants with the threshold 0.05 stand beside `right_0.05`, that and all others beside `right_0.5`. Two numbers of each run are compared: its mean over all
evaluations, which is how fast it learned, and the mean of its last three.
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from nearl.curves import bootstrap_band, interquartile_mean

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent / "strong"))
from table import rank_test  # noqa: E402


def words(mine: np.ndarray, right: np.ndarray, itself: bool) -> list[str]:
    """Centre and band of `mine`, pairs in which it is below `right`, and p of the rank test."""
    low, high = bootstrap_band(mine)
    centre = f"{interquartile_mean(mine):.0f} ({low:.0f} to {high:.0f})"
    if itself:
        return [centre, "", ""]
    below = int(sum(a < b for a in mine for b in right))
    return [centre, f"{below} of {len(mine) * len(right)}", f"{rank_test(list(mine), list(right)):.3f}"]


def main(folder: Path) -> None:
    runs: dict = defaultdict(lambda: defaultdict(list))
    with open(folder / "curves.csv") as text:
        for row in csv.DictReader(text):
            runs[row["task"], row["name"]][int(row["seed"])].append(float(row["return"]))
    titles = ["task", "", "seeds", "mean over the run", "below the right one", "p", "mean of the last three", "below the right one", "p"]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for (task, name), seeds in sorted(runs.items()):
        right = runs[task, "right_0.05" if name in ("full_0.05", "missing_0.05") else "right_0.5"]
        cells = [task, name, str(len(seeds))]
        for number in (np.mean, lambda returns: np.mean(returns[-3:])):
            mine, theirs = (np.array([number(returns) for _, returns in sorted(of.items())]) for of in (seeds, right))
            cells += words(mine, theirs, name == "right_0.5")
        lines.append(f"| {' | '.join(cells)} |")
    (folder / "ranks.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
