"""reached.csv as a table: shares of ticks that end outside, and of those that no sampled action avoids."""

import csv
import pathlib

HERE = pathlib.Path(__file__).parent
rows = list(csv.DictReader((HERE / "reached.csv").open()))
lines = [
    "| task | guard | outside | unavoidable by 400 samples | from inside: outside | unavoidable | return | steps/s |",
    "|---|---|---|---|---|---|---|---|",
]
for row in rows:
    share = lambda n, of: f"{100 * int(row[n]) / max(int(row[of]), 1):.2f} %"
    shares = [share("outside", "ticks"), share("unavoidable", "ticks")]
    shares += [share("outside_from_inside", "began_inside"), share("unavoidable_from_inside", "began_inside")]
    lines.append(f"| {row['task']} | {row['guard']} | {' | '.join(shares)} | {row['mean_return']} | {row['steps_per_second']} |")
(HERE / "table.md").write_text("\n".join(lines) + "\n")
print("\n".join(lines))
