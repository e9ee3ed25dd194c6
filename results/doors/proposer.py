"""A process that proposes, beside a loop at 1 kHz: how old its answers are, what is lost, and what the limits say.

    python results/doors/proposer.py > results/doors/proposer.md

`nearl plant Panda-reach` waits for each action (a busy machine would be late otherwise) and for nothing else, so that the ticks of 1 ms pass as fast as the
machine computes them. Ages of proposals are of real time. The loop runs on threads of this process, and the proposer is a process of its own that answers
each state it reads with a wild one (up to three radians away), after the time that a model would take.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import nearl

SECONDS = 20.0
MODES = ("active", "degraded", "hold", "braking")
BROKEN = ("ticks whose proposal breaks a limit", "ticks whose target does", "limits broken on the plant")
MODEL = """
import sys, time
import numpy as np
import nearl
random, think = np.random.default_rng(0), float(sys.argv[2])
with nearl.Proposer(sys.argv[1], patience=60.0) as proposer:
    for state in proposer.states(patience=3.0):
        time.sleep(think)
        here = np.concatenate([state.q, state.v])
        proposer.propose(here + random.uniform(-3.0, 3.0, len(here)))
"""


def row(snapshot: Path, think: float) -> str:
    name = f"door-{round(1e3 * think)}"
    plant = subprocess.Popen([sys.executable, "-m", "nearl", "plant", "Panda-reach", "--name", name, "--endless", "--lockstep"], stdout=subprocess.DEVNULL)
    model = subprocess.Popen([sys.executable, "-c", MODEL, name, str(think)])
    try:
        with nearl.Loop(snapshot, name, seconds=SECONDS, patience=30.0, proposal_age=0.1, proposal_hold=0.1) as loop:
            report = loop.wait()
    finally:
        model.kill(), plant.terminate()
        model.wait(), plant.wait()
    c, p = report["counters"], report["proposer"]
    times = [f"{p[key][share] / 1e6:.2f}" for key in ("answer", "link") for share in ("p50", "p99")]
    modes = [report["modes"][mode] for mode in MODES]
    outside = sum(report["plant"]["violations"].values())
    counts = [c["raw_violations"], c["target_violations"], outside]
    cells = [f"{1e3 * think:.0f}", c["proposals"], c["overtaken_proposals"], *times, *modes, *counts]
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    with tempfile.TemporaryDirectory() as scratch:
        snapshot = Path(scratch) / "arm.safetensors"
        nearl.blank("Panda-reach", snapshot)
        times = [f"{what} {share} [ms]" for what in ("state to answer", "sent to answer") for share in ("p50", "p99")]
        columns = ["model takes [ms]", "taken", "overtaken", *times, *(f"ticks {mode}" for mode in MODES), *BROKEN]
        print(f"| {' | '.join(columns)} |")
        print(f"|{'---|' * len(columns)}")
        for think in (0.0, 0.005, 0.02, 0.05, 0.15):
            print(row(snapshot, think), flush=True)


if __name__ == "__main__":
    main()
