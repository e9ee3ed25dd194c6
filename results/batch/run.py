"""Batches of projections and of their vector-Jacobian products, ours beside other people's: writes runs.jsonl, sizes.jsonl and table.md.

python results/batch/run.py [--problems 100000] [--qpth 100000] [--rounds 3]
"""

import argparse
import gc
import json
import os
import time
import warnings
from pathlib import Path

import numpy as np
import problems
from diffcp import SolverError
from problems import SIGMA, Array, Exact
from sides import Cvxpylayers, Ours, OursTorch, Proxsuite, Qpth, Side
from table import table

HERE = Path(__file__).resolve().parent
USUAL = (100_000, 3)  # problems, rounds
SAMPLE = 2_000
SIZES = (0, 1, 2, 3, 4)  # powers of ten of sigma
warnings.filterwarnings("ignore")  # "Solved/Inaccurate" of SCS


def sides(count: int, qpth: int) -> list[tuple[Side, int]]:
    """Each side and how many problems a round gives it: the slow ones a part."""
    return [
        (Ours(), count),
        (OursTorch(), count),
        (Qpth(), min(count, qpth)),
        (Proxsuite(exact=True), count),
        (Proxsuite(exact=False), min(count, 20_000)),
        (Cvxpylayers("SCS"), min(count, 1_000)),
        (Cvxpylayers("Clarabel"), min(count, 2_000)),
    ]


def measure(side: Side, p: problems.Problems, torque: bool, cotangent: Array) -> tuple[float, float, Array, Array]:
    """Seconds of all forward and of all backward calls, and the answers."""
    side.ready(p[:10], torque)
    side.forward(), side.backward(cotangent[:10])  # what is made once is not timed
    seconds, answers, pulled = np.zeros(2), [], []
    for i in range(0, len(p), side.most):
        part = slice(i, i + side.most)
        side.ready(p[part], torque)
        gc.collect()
        start = time.perf_counter()
        answers.append(side.forward())
        between = time.perf_counter()
        pulled.append(side.backward(cotangent[part]))
        seconds += between - start, time.perf_counter() - between
    return *seconds, np.concatenate(answers), np.concatenate(pulled)


def distances(z: Array, pulled: Array, exact: Exact) -> dict[str, float]:
    """Of the answers [rad/s] and of the products (cotangents are standard normal) from the exact ones, where there is an answer."""
    n = min(len(z), len(exact.z))
    given = ~np.isnan(z[:n]).any(axis=1)
    smooth = given & exact.smooth[:n]
    y = SIGMA * np.abs(z[:n] - exact.z[:n]).max(axis=1)[given]
    g = np.abs(pulled[:n] - exact.pulled[:n]).max(axis=1)[smooth]
    return {
        "compared": n, "none": int(n - given.sum()), "furthest": y.max(), "median": np.median(y), "above_1e-6": float(np.mean(y > 1e-6)),
        "vjp_compared": int(smooth.sum()), "vjp_furthest": g.max(), "vjp_median": np.median(g), "vjp_above_1e-3": float(np.mean(g > 1e-3)),
    }  # fmt: skip


def rounds(count: int, qpth: int, repeats: int, log: Path) -> None:
    p, left_out = problems.make(count, seed=0)
    cotangent = np.random.default_rng(1).normal(size=(count, 7))
    everyone = sides(count, qpth)
    for torque in (False, True):
        exact = problems.exact(p[:SAMPLE], torque, cotangent[:SAMPLE])
        limits = "box and torque rows" if torque else "box"
        print(f"{limits}: {left_out:.2%} left out, {exact.smooth.mean():.2%} smooth, torque active in {exact.torque_active:.0%}", flush=True)
        for k in range(repeats):
            for side, n in everyone[k % len(everyone) :] + everyone[: k % len(everyone)]:
                forward, backward, z, pulled = measure(side, p[:n], torque, cotangent[:n])
                line = {"limits": limits, "round": k, "side": side.name, "problems": n, "forward_s": forward, "backward_s": backward}
                line |= {"load": os.getloadavg()[0], "torque_active": exact.torque_active, **distances(z, pulled, exact)}
                with log.open("a") as file:
                    file.write(json.dumps(line) + "\n")
                print(f"  {k} {side.name:22s} {n / forward:9.0f} {n / (forward + backward):9.0f} per second", flush=True)


def by_size(path: Path) -> None:
    """How far answers are from the optimum with proposals of one size, box and torque rows."""
    lines = []
    for size in SIZES:
        p, _ = problems.make(300, seed=2, size=(size, size))
        cotangent = np.random.default_rng(3).normal(size=(len(p), 7))
        exact = problems.exact(p, True, cotangent)
        for side, _ in sides(len(p), len(p)):
            try:
                _, _, z, pulled = measure(side, p, True, cotangent)
                far = distances(z, pulled, exact)
            except SolverError as error:  # one problem without an answer, and the batch has none
                far = {"raised": str(error)}
            lines.append({"size": size, "side": side.name, **far})
    path.write_text("".join(json.dumps(x) + "\n" for x in lines))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--problems", type=int, default=USUAL[0], help="other problems or rounds go into a folder of their own, 1000-3 for 1000")
    parser.add_argument("--qpth", type=int, default=100_000, help="at most so many for qpth")
    parser.add_argument("--rounds", type=int, default=USUAL[1])
    options = parser.parse_args()
    folder = HERE if (options.problems, options.rounds) == USUAL else HERE / f"{options.problems}-{options.rounds}"
    folder.mkdir(exist_ok=True)
    runs, sizes, part = folder / "runs.jsonl", folder / "sizes.jsonl", folder / "runs.part.jsonl"
    part.unlink(missing_ok=True)
    rounds(options.problems, options.qpth, options.rounds, part)
    part.replace(runs)
    by_size(sizes)
    (folder / "table.md").write_text(table(runs, sizes))


if __name__ == "__main__":
    main()
