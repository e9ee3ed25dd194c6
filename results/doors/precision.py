"""Whose rounding is it? Outputs of imported policies and of onnxruntime, both against the same graph in double precision.

    python results/doors/precision.py FOLDER > results/doors/precision.md

FOLDER holds .onnx files, as for policies.py. Both compute in single precision and sum in another order; what the order costs is seen against a reference
that does not round. Errors are shares of the largest output that the policy gives on the same observations (a scale, the same for both).
"""

import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from onnx import numpy_helper

import nearl

SCALES = (0.1, 1.0, 3.0)
DRAWS = 300


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1.0 + np.tanh(0.5 * x))


def in_double(path: Path, obs: np.ndarray, output: str) -> np.ndarray:
    """The graph with every constant and every operation in double precision."""
    graph = onnx.load(path).graph
    values = {t.name: numpy_helper.to_array(t).astype(float) if t.data_type == 1 else numpy_helper.to_array(t) for t in graph.initializer}
    values[graph.input[0].name] = obs[None].astype(float)
    for node in graph.node:
        x = [values.get(name) for name in node.input]
        a = {attribute.name: onnx.helper.get_attribute_value(attribute) for attribute in node.attribute}
        if node.op_type == "Constant":
            value = numpy_helper.to_array(a["value"])
            y = value.astype(float) if value.dtype == np.float32 else value
        elif node.op_type == "Gemm":
            left, right = (x[0].T if a.get("transA") else x[0]), (x[1].T if a.get("transB") else x[1])
            y = a.get("alpha", 1.0) * left @ right + (a.get("beta", 1.0) * x[2] if len(x) > 2 else 0.0)
        elif node.op_type == "Split":
            sizes = x[1] if len(x) > 1 else a.get("split", [x[0].shape[-1] // len(node.output)] * len(node.output))
            for name, part in zip(node.output, np.split(x[0], np.cumsum(sizes)[:-1], axis=a.get("axis", 0)), strict=True):
                values[name] = part
            continue
        else:
            y = {
                "Sub": lambda: x[0] - x[1],
                "Div": lambda: x[0] / x[1],
                "Mul": lambda: x[0] * x[1],
                "Add": lambda: x[0] + x[1],
                "Sigmoid": lambda: sigmoid(x[0]),
                "Tanh": lambda: np.tanh(x[0]),
                "Elu": lambda: np.where(x[0] > 0, x[0], a.get("alpha", 1.0) * np.expm1(x[0])),
                "Identity": lambda: x[0],
                "MatMul": lambda: x[0] @ x[1],
                "Clip": lambda: np.clip(x[0], x[1], x[2]),
            }[node.op_type]()
        values[node.output[0]] = y
    return values[output][0]


def row(path: Path, folder: Path) -> str:
    policy, session = nearl.Policy.from_onnx(path), onnxruntime.InferenceSession(path)
    (given,), out, rng = session.get_inputs(), session.get_outputs()[0].name, np.random.default_rng(0)
    errors, size = [], 0.0
    for scale in SCALES:
        for _ in range(DRAWS):
            obs = (scale * rng.normal(size=policy.n_in)).astype(np.float32)
            exact = in_double(path, obs, out)
            theirs = session.run([out], {given.name: obs[None]})[0][0]
            ours = policy(obs)
            size = max(size, float(np.abs(exact).max()))
            errors.append([np.abs(ours - exact).max(), np.abs(theirs - exact).max(), np.abs(ours - theirs).max()])
    worst, median = np.max(errors, axis=0) / size, np.median(errors, axis=0) / size
    name = path.relative_to(folder).as_posix()
    cells = " | ".join(f"{w:.1e} | {m:.1e}" for w, m in zip(worst, median, strict=True))
    return f"| {name} | {size:.3g} | {cells} |"


def main(folder: Path) -> None:
    files = sorted(folder.rglob("*.onnx"))
    if not files:
        sys.exit(f"{Path(__file__).name}: '{folder}' holds no .onnx file")
    print("| policy | largest output | worst error of nearl | median | worst of onnxruntime | median | worst between the two | median |")
    print("|---|---|---|---|---|---|---|---|")
    for path in files:
        print(row(path, folder), flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
