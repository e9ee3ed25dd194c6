"""Writes the tables of a run of run.sh between the marks of a Markdown file: table.py FOLDER README.md"""

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

PROBLEMS = {"arm7": "7 dofs", "quad12": "12 dofs", "hum29": "29 dofs"}
FIRST = {
    "nearl": "**ours** (exact stage, warm)",
    "nearl-cold": "ours, from nothing each time",
    "DAQP (C, warm)": "DAQP (C, warm)",
    "DAQP (C, warm, -march=native)": "DAQP (C, warm, -march=native)",
    "clarabel-rust": "Clarabel (Rust, updated: our second stage)",
}
START, END = "<!-- table -->\n", "<!-- end of table -->\n"


def cell(files):
    """Percentiles over problems of the median over rounds; steps, error and failures of the last round."""
    times = np.median([np.loadtxt(f, comments="#") for f in files], axis=0)
    words = files[-1].open().readline().split()
    failed, furthest, steps = int(words[2]), float(words[4]), float(words[6])
    p50, p99 = np.percentile(times, [50, 99])
    fine = lambda x: f"{x:.2f}" if x < 10 else f"{x:.0f}"  # noqa: E731
    return fine(p50), fine(p99), f"{steps:.1f}", f"{furthest:.0e}", str(failed)


def main(folder, readme):
    files = defaultdict(lambda: defaultdict(list))
    for path in sorted(folder.glob("round*/*.txt")):
        problem, _, solver = path.stem.partition(".")
        files[solver][problem].append(path)
    order = [*FIRST, *sorted(set(files) - set(FIRST))]
    lines = []
    for problem, dofs in PROBLEMS.items():
        lines += [f"| {dofs} | p50 [us] | p99 [us] | mean steps | largest error [rad/s] | failed |", "|---|---|---|---|---|---|"]
        lines += [f"| {FIRST.get(solver, solver)} | {' | '.join(cell(files[solver][problem]))} |" for solver in order]
        lines.append("")
    text = readme.read_text()
    head, rest = text.split(START)
    readme.write_text(head + START + "\n" + "\n".join(lines) + "\n" + END + rest.split(END)[1])
    print("\n".join(lines))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
