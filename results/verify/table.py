"""Flights and what was confirmed of them: table.py --add FOUND.json ROBOT SUB_STEPS DT KIND SEED, then table.py for table.md."""

import json
import sys
from pathlib import Path

HERE = Path(__file__).parent
FLIGHTS = HERE / "flights.jsonl"
COLUMNS = ("ticks", "verified", "optimal", "stoppable", "found")


def add(found: str, robot: str, sub_steps: str, dt: str, kind: str, seed: str) -> None:
    """Appends a flight, unless it is there already."""
    flight = {"robot": robot, "steps": int(sub_steps), "dt": float(dt), "kind": kind, "seed": int(seed)}
    there = FLIGHTS.read_text().splitlines() if FLIGHTS.exists() else []
    if any(flight.items() <= json.loads(line).items() for line in there):
        print(f"flights.jsonl has {robot}, {kind}, {sub_steps} steps, seed {seed}: not added again", file=sys.stderr)
        return
    with FLIGHTS.open("a") as file:
        file.write(json.dumps({**flight, **json.loads(Path(found).read_text())}) + "\n")


def main() -> None:
    """Writes table.md."""
    flights = [json.loads(line) for line in FLIGHTS.read_text().splitlines()]
    of: dict[tuple, list[dict]] = {}
    for flight in flights:
        of.setdefault((flight["robot"], flight["kind"], 1000 * flight["dt"], flight["steps"]), []).append(flight)
    lines = [
        "| robot | kind | period | steps | flights | ticks | limits held | nearest | way to stop | does not hold |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (robot, kind, dt, steps), all_of in sorted(of.items()):
        sums = [sum(flight[column] for flight in all_of) for column in COLUMNS]
        numbers = " | ".join(f"{x:,}" for x in sums)
        lines.append(f"| {robot} | {kind} | {dt:g} ms | {steps} | {len(all_of)} | {numbers} |")
    total = [sum(flight[column] for flight in flights) for column in COLUMNS]
    lines.append(f"| all | | | | {len(flights)} | " + " | ".join(f"{x:,}" for x in total) + " |")
    (HERE / "table.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    add(*sys.argv[2:]) if sys.argv[1:2] == ["--add"] else main()
