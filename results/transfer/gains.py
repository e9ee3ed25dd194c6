"""Trained xArm7 policies on drives whose gains are not the task's: `gains.md`.

    .venv/bin/python results/transfer/gains.py RUNS FOLDER [EPISODES]
"""

import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

NEARL = os.environ.get("NEARL", str(Path(__file__).parents[2] / "target/release/nearl"))
FACTORS = {"damping": [1.2, 1.0, 0.98, 0.96, 0.94, 0.92, 0.9, 0.8], "stiffness": [0.8, 1.02, 1.04, 1.06, 1.08, 1.1, 1.2]}


def evaluate(run: Path, gain: str, factor: float, episodes: int) -> tuple[float, float, float]:
    """Return, share of ticks outside in per cent, and how far a speed came beyond its limit in rad/s."""
    words = ["noise={}", "delay={}", f"random={{ {gain} = {factor} }}"]
    command = [NEARL, "eval", run, "--episodes", str(episodes), "--seed", "7", "--json", *(w for s in words for w in ("--set", s))]
    e = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)[0]
    worst = {w["limit"]: w["by"] for w in e["worst"]}
    return statistics.mean(e["returns"]), 100 * e["reached_violations"] / e["ticks"], worst.get("velocity", 0.0)


def main(runs: Path, folder: Path, episodes: int = 10) -> None:
    found = sorted(p for p in runs.glob("plain/xarm7-transfer/*_*") if list(p.glob("checkpoints/*.safetensors")))
    text = [f"Means and largest of {len(found)} seeds, {episodes} episodes each.", ""]
    text += ["| gain | factor | return | lowest of a seed | outside, % | speed beyond its limit, rad/s |", "|---|---|---|---|---|---|"]
    for gain, factors in FACTORS.items():
        for factor in factors:
            rows = [evaluate(run, gain, factor, episodes) for run in found]
            returns, outside, speed = zip(*rows, strict=True)
            cells = [gain, f"{factor:g}", f"{statistics.mean(returns):.1f}", f"{min(returns):.1f}", f"{statistics.mean(outside):.2f}", f"{max(speed):.3g}"]
            text.append(f"| {' | '.join(cells)} |")
            print(text[-1], flush=True)
    (folder / "gains.md").write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
