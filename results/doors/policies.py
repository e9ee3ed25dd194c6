"""Policies of other people: what is read of them, and how far the outputs are from onnxruntime's.

    python results/doors/policies.py FOLDER > results/doors/policies.md

FOLDER holds .onnx files, for example checkouts of mujoco_playground, unitree_rl_lab and unitree_rl_mjlab. Needs onnx and onnxruntime.
"""

import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

import nearl


def row(path: Path, folder: Path) -> str:
    graph = onnx.load(path, load_external_data=False).graph
    nodes = " ".join(f"{op} {n}" for op, n in sorted(Counter(node.op_type for node in graph.node).items()))
    name = path.relative_to(folder).as_posix().replace("/exported/policy.onnx", "").replace("/config/policy", "")
    try:
        policy = nearl.Policy.from_onnx(path)
    except ValueError as refusal:
        return f"| {name} | {nodes} | refused: {refusal} | | | |"
    session = onnxruntime.InferenceSession(path)
    (given,), rng, worst = session.get_inputs(), np.random.default_rng(0), 0.0
    for scale in (0.1, 1.0, 3.0):
        for _ in range(300):
            obs = (scale * rng.normal(size=policy.n_in)).astype(np.float32)
            want = session.run(None, {given.name: obs[None]})[0][0]
            worst = max(worst, float(np.max(np.abs(policy(obs) - want) / np.maximum(1.0, np.abs(want)))))
    obs = np.zeros(policy.n_in, np.float32)
    ours, theirs = [], []
    for _ in range(2000):
        begin = time.perf_counter_ns()
        policy(obs)
        middle = time.perf_counter_ns()
        session.run(None, {given.name: obs[None]})
        ours.append(middle - begin)
        theirs.append(time.perf_counter_ns() - middle)
    us = [f"{np.median(t) / 1e3:.1f}" for t in (ours, theirs)]
    functions = " ".join(policy.functions)
    return f"| {name} | {nodes} | {policy.n_in} -> {policy.n_out}: {functions} | {worst:.1e} | {us[0]} | {us[1]} |"


def main(folder: Path) -> None:
    files = sorted(folder.rglob("*.onnx"))
    if not files:
        sys.exit(f"{Path(__file__).name}: '{folder}' holds no .onnx file")
    print("| policy | nodes | read as | largest difference to onnxruntime (relative above 1) | p50 [us] | onnxruntime p50 [us] |")
    print("|---|---|---|---|---|---|")
    for path in files:
        print(row(path, folder))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
