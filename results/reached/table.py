"""reached.csv and trained.csv as tables: shares of ticks that end outside, and of those that no sampled action avoids."""

import csv
import pathlib

HERE = pathlib.Path(__file__).parent


def share(row: dict, n: str, of: str) -> str:
    return f"{100 * int(row[n]) / max(int(row[of]), 1):.2f} %"


for name, first in (("reached", "policy"), ("trained", "trained")):
    titles = [first, "task", "guard", "outside", "unavoidable by 400 samples", "from inside: outside", "unavoidable", "return", "steps/s"]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for row in csv.DictReader((HERE / f"{name}.csv").open()):
        cells = [row[first], row["task"], row["guard"].replace(";", ","), share(row, "outside", "ticks"), share(row, "unavoidable", "ticks")]
        cells += [share(row, f"{what}_from_inside", "began_inside") for what in ("outside", "unavoidable")]
        lines.append(f"| {' | '.join(cells)} | {row['mean_return']} | {row['steps_per_second']} |")
    (HERE / ("table.md" if name == "reached" else "trained.md")).write_text("\n".join(lines) + "\n")
