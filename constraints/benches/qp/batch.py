"""A batch of Panda projections with torque rows beside batched solvers, on two threads.

batch.py ours COUNT PROBLEMS.npz   in the environment of the package: times project_batch and writes the problems;
batch.py peers PROBLEMS.npz        in the environment of the other solvers: times each on the problems as matrices.

Ours is timed from states and proposals (limits, dynamics, rows, solve and judge), the others from the matrices that follow.
"""

import os
import sys
import time

import numpy as np

THREADS = 2


def report(name, count, run):
    wall, cpu = time.perf_counter(), time.process_time()
    result = run()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"| {name} | {count} | {1e6 * wall / count:.1f} | {1e6 * cpu / count:.1f} |", flush=True)
    return result


def ours(count, path):
    import nearl

    model = nearl.Model.from_urdf("examples/robots/panda/panda.urdf")
    limits = [
        nearl.PositionLimit(model),
        nearl.VelocityLimit(model, scale=0.6),
        nearl.AccelerationLimit(model, 20.0),
        nearl.TorqueLimit(model, scale=0.6),
    ]
    projector = nearl.Projector(model, limits, dt=1e-3)
    rng = np.random.default_rng(0)
    low, high = model.lower_position_limit, model.upper_position_limit
    q = low + (high - low) * rng.uniform(0.2, 0.8, (count, model.nv))
    v = rng.uniform(-0.3, 0.3, (count, model.nv))
    y = rng.uniform(-0.03, 0.03, (count, model.nv))
    batch = (q, v, q + 1e-3 * (v + y), v + y)
    projector.project_batch(*(x[:1000] for x in batch), threads=THREADS)
    targets = report("**ours**, whole ticks", count, lambda: projector.project_batch(*batch, threads=THREADS))
    statuses, counts = np.unique(targets.status, return_counts=True)
    print("statuses:", dict(zip(statuses.tolist(), counts.tolist(), strict=True)))
    solved = [i for i in range(count) if targets.status[i] in ("unchanged", "clamped", "solved")][:20_000]
    problems = [projector.problem(*(x[i] for x in batch)) for i in solved]
    H, c, G, h = (np.stack([p[k] for p in problems]) for k in range(4))
    np.savez(path, H=H, c=c, G=G, h=h, y=targets.v[solved] - v[solved])


def proxsuite(H, c, G, h):
    from proxsuite import proxqp

    count, n, m = len(c), c.shape[1], h.shape[1]

    def solve():
        batch = proxqp.dense.BatchQP(count)
        for k in range(count):
            qp = batch.init_qp_in_place(n, 0, m)
            qp.settings.eps_abs, qp.settings.max_iter = 1e-8, 500
            qp.init(H[k], c[k], None, None, G[k], np.full(m, -1e20), h[k])
        proxqp.dense.solve_in_parallel(batch, THREADS)
        return np.stack([batch.get(k).results.x for k in range(count)])

    return solve


def qpth(H, c, G, h):
    import torch
    from qpth.qp import QPFunction

    torch.set_num_threads(THREADS)
    H, c, G, h = (torch.from_numpy(x) for x in (H, c, G, h))
    none = torch.empty(0, dtype=torch.float64)

    def solve():
        step = 1000
        with torch.no_grad():
            parts = [
                QPFunction(verbose=-1)(*(x[k : k + step] for x in (H, c, G, h)), none, none)
                for k in range(0, len(c), step)
            ]
        return torch.cat(parts).numpy()

    return solve


def cvxpylayers(H, c, G, h):
    import cvxpy as cp
    import torch
    from cvxpylayers.torch import CvxpyLayer

    torch.set_num_threads(THREADS)
    n, m = c.shape[1], h.shape[1]
    y, c_, G_, h_ = cp.Variable(n), cp.Parameter(n), cp.Parameter((m, n)), cp.Parameter(m)
    weight = np.sqrt(np.diag(H[0]))  # the same for all
    cost = 0.5 * cp.sum_squares(cp.multiply(weight, y)) + c_ @ y
    layer = CvxpyLayer(cp.Problem(cp.Minimize(cost), [G_ @ y <= h_]), parameters=[c_, G_, h_], variables=[y])
    parameters = [torch.from_numpy(x) for x in (c, G, h)]

    def solve():
        with torch.no_grad():
            return layer(*parameters)[0].numpy()

    return solve


def peers(path):
    data = np.load(path)
    for name, make, count in [
        ("proxsuite, parallel batch", proxsuite, 20_000),
        ("qpth, batches of 1000", qpth, 20_000),
        ("cvxpylayers", cvxpylayers, 2_000),
    ]:
        count = min(count, len(data["c"]))
        arrays = [np.ascontiguousarray(data[k][:count]) for k in "HcGh"]
        try:
            make(*(x[:20] for x in arrays))()  # everything loaded and warm
            answers = report(name, count, make(*arrays))
            print(f"largest distance to ours: {np.abs(answers - data['y'][:count]).max():.1e} rad/s")
        except Exception as error:  # noqa: BLE001 - whatever a peer raises, the others still run
            print(f"| {name} | failed: {error!r}")


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", str(THREADS))
    print("| | projections | wall [us each] | CPU [us each] |\n|---|---|---|---|")
    if sys.argv[1] == "ours":
        ours(int(sys.argv[2]), sys.argv[3])
    else:
        peers(sys.argv[2])
