"""reached.csv and trained.csv as tables: shares of ticks that end outside, and of those that no sampled action avoids.

    python results/reached/table.py [FOLDER]

FOLDER has one of the files or both; it is results/reached unless given.
"""

import csv
import pathlib
import sys

HERE = pathlib.Path(__file__).parent


def share(row: dict, n: str, of: str) -> str:
    return f"{100 * int(row[n]) / max(int(row[of]), 1):.2f} %"


folder = pathlib.Path(sys.argv[1]) if len(sys.argv) > 1 else HERE
for name, first in (("reached", "policy"), ("trained", "trained")):
    if not (folder / f"{name}.csv").is_file():
        continue
    titles = [first, "task", "guard", "outside", "unavoidable by 400 samples", "from inside: outside", "unavoidable", "return", "steps/s"]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for row in csv.DictReader((folder / f"{name}.csv").open()):
        cells = [row[first], row["task"], row["guard"].replace(";", ","), share(row, "outside", "ticks"), share(row, "unavoidable", "ticks")]
        cells += [share(row, f"{what}_from_inside", "began_inside") for what in ("outside", "unavoidable")]
        lines.append(f"| {' | '.join(cells)} | {row['mean_return']} | {row['steps_per_second']} |")
    (folder / ("table.md" if name == "reached" else "trained.md")).write_text("\n".join(lines) + "\n")
