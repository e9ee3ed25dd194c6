"""What trained policies are worth on plants that differ from their robot file, and how far these leave the limits: `runs.csv` and `table.md`.

    .venv/bin/python results/transfer/table.py RUNS FOLDER [EPISODES]

Runs that RUNS does not have stay what they are in FOLDER. Everything is measured in MuJoCo's own state, without noise and delay.
`excess` columns are 0 where no control period left the limit.
"""

import csv
import json
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path

NEARL = os.environ.get("NEARL", str(Path(__file__).parents[2] / "target/release/nearl"))
ALL = ["random={ mass = 1.2, strength = { all = 0.8 } }", "noise={ q = '0.005 * normal', v = '0.05 * normal' }", "delay={ action = 2 }"]
PLANTS = {
    "the file's": [],
    "masses x 1.2": ["random={ mass = 1.2 }"],
    "masses x 0.8": ["random={ mass = 0.8 }"],
    "motors x 0.8": ["random={ strength = { all = 0.8 } }"],
    "noise": [ALL[1]],
    "actions 2 ticks late": [ALL[2]],
    "masses x 1.2, motors x 0.8": ALL[:1],
    "the same, actions 2 ticks late": [ALL[0], ALL[2]],
    "the same, noise": ALL[:2],
    "all at once": ALL,
}
# Limits of the task files: torque of each joint [N m], acceleration [rad/s²]
TORQUE = {"panda-transfer": [0.8 * t for t in (87, 87, 87, 87, 12, 12, 12)], "xarm7-transfer": [0.9 * t for t in (50, 50, 30, 30, 30, 20, 20)]}
ACCELERATION = {"panda-transfer": 10.0, "xarm7-transfer": 15.0}
JOINT = {"panda-transfer": "panda_joint{}", "xarm7-transfer": "joint{}"}


def largest(words: list[str]) -> str:
    """An expression for the largest of some."""
    return words[0] if len(words) == 1 else f"max({words[0]}, {largest(words[1:])})"


def evaluate(run: Path, plant: list[str], episodes: int) -> dict:
    task = run.parent.name
    share = largest([f"abs(torque.{JOINT[task].format(i + 1)}) / {limit:g}" for i, limit in enumerate(TORQUE[task])])
    told = [f'metrics.torque_share={{ max = "{share}" }}', 'metrics.acceleration={ max = "dv.max" }']
    words = [w for s in ["random={}", "noise={}", "delay={}", *plant, *told] for w in ("--set", s)]
    out = subprocess.run([NEARL, "eval", run, "--episodes", str(episodes), "--seed", "7", "--json", *words], check=True, capture_output=True, text=True)
    e = json.loads(out.stdout)[0]
    told = {t["name"].removeprefix("metrics/"): t for t in e["told"]}
    worst = {w["limit"]: w["by"] for w in e["worst"]}
    return {
        "return": statistics.mean(e["returns"]),
        "late_distance": told["late_distance"]["mean"],
        "outside": 100 * e["reached_violations"] / e["ticks"],
        "position_excess": worst.get("position", 0.0),
        "velocity_excess": worst.get("velocity", 0.0),
        "acceleration_excess": over(told["acceleration"]["largest"] - ACCELERATION[task]),
        "torque_excess": 100 * over(told["torque_share"]["largest"] - 1),
    }


def steps(run: Path) -> int:
    """Policy steps of its last row."""
    return int(float((run / "metrics.csv").read_text().splitlines()[-1].split(",")[0]))


def over(x: float) -> float:
    """What is more than rounding."""
    return x if x > 1e-6 else 0.0


COLUMNS = {
    "return": "return",
    "late_distance": "away, m",
    "outside": "outside, %",
    "position_excess": "position, rad",
    "velocity_excess": "speed, rad/s",
    "acceleration_excess": "acceleration, rad/s²",
    "torque_excess": "torque, %",
}


def main(runs: Path, folder: Path, episodes: int = 20) -> None:
    found = sorted(p for p in runs.glob("*/*-transfer/*_*") if list(p.glob("checkpoints/*.safetensors")))
    if not found:
        sys.exit(f"no run in {runs} has a snapshot")
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for run in found:
        seed = int(re.search(r"_(\d+)$", run.name).group(1))
        for plant, changes in PLANTS.items():
            head = {"robot": run.parent.name.removesuffix("-transfer"), "trained": run.parents[1].name, "seed": seed, "steps": steps(run), "plant": plant}
            rows.append(head | {k: f"{v:.4g}" for k, v in evaluate(run, changes, episodes).items()})
            print(*rows[-1].values(), sep=", ", flush=True)
    name = lambda row: (row["trained"], row["robot"], int(row["seed"]))  # noqa: E731
    measured = {name(row) for row in rows}
    if (folder / "runs.csv").is_file():
        with open(folder / "runs.csv", newline="") as f:
            rows += [row for row in csv.DictReader(f) if name(row) not in measured]
    rows.sort(key=name)
    with open(folder / "runs.csv", "w", newline="") as f:
        writer = csv.DictWriter(f, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    (folder / "table.md").write_text(table(rows))


def table(rows: list[dict]) -> str:
    """Least steps of the seeds, return as mean and band of the seeds, the distance's mean, the share's mean, and of each excess the largest of all seeds."""
    text = []
    for robot in dict.fromkeys(r["robot"] for r in rows):
        heads = ["plant", "trained", "seeds", "least steps", "return", "lowest", "highest", *list(COLUMNS.values())[1:]]
        text += [f"### {robot}\n", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
        for plant in PLANTS:
            for trained in ("plain", "random", "history"):
                mine = [r for r in rows if (r["robot"], r["plant"], r["trained"]) == (robot, plant, trained)]
                if not mine:
                    continue
                of = {k: [float(r[k]) for r in mine] for k in COLUMNS}
                least = min(int(r["steps"]) for r in mine) // 1000
                cells = [plant, trained, len(mine), f"{least}k", f"{statistics.mean(of['return']):.1f}"]
                cells += [f"{min(of['return']):.1f}", f"{max(of['return']):.1f}"]
                cells += [f"{statistics.mean(of['late_distance']):.3f}", f"{statistics.mean(of['outside']):.2f}"]
                cells += [f"{max(of[k]):.3g}" for k in list(COLUMNS)[3:]]
                text.append("| " + " | ".join(map(str, cells)) + " |")
        text.append("")
    return "\n".join(text)


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
