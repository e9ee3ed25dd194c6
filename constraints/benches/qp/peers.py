"""Thread CPU time of the Python packages of other solvers on the problems of gen.py: peers.py OUT FILE.bin..."""

import sys
import time
import warnings
from pathlib import Path

import clarabel
import daqp
import numpy as np
import osqp
import piqp
import proxsuite
import quadprog
import scipy.sparse as sp

warnings.filterwarnings("ignore")


def load(path):
    raw = Path(path).read_bytes()
    n, count = np.frombuffer(raw[:16], np.uint64).astype(int)
    sizes = np.cumsum([n, n, n, n * n, n, n])
    for record in np.frombuffer(raw[16:], np.float64).reshape(count, -1):
        goal, low, high, rows, row_low, row_high, x = (part.copy() for part in np.split(record, sizes))
        yield goal, low, high, rows.reshape(n, n), row_low, row_high, x


class Quadprog:
    name = "quadprog (Python)"

    def __init__(self, n):
        self.eye = np.eye(n)

    def solve(self, goal, low, high, rows, row_low, row_high):
        gradients = np.vstack([self.eye, -self.eye, rows, -rows]).T
        try:
            answer = quadprog.solve_qp(self.eye, goal, gradients, np.concatenate([low, -high, row_low, -row_high]), 0)
        except ValueError:
            return None, 0
        return answer[0], answer[3][0]


class Daqp:
    name = "DAQP (Python, fresh)"

    def __init__(self, n):
        self.eye, self.sense = np.eye(n), np.zeros(2 * n, dtype=np.intc)

    def solve(self, goal, low, high, rows, row_low, row_high):
        high, low = np.concatenate([high, row_high]), np.concatenate([low, row_low])
        x, _, flag, info = daqp.solve(self.eye, -goal, rows, high, low, self.sense, primal_tol=1e-9)
        return (x if flag > 0 else None), info["iterations"]


class Piqp:
    name = "PIQP (Python, updated)"

    def __init__(self, n):
        self.eye, self.solver = np.eye(n), None

    def solve(self, goal, low, high, rows, row_low, row_high):
        if self.solver is None:
            self.solver = piqp.DenseSolver()
            self.solver.settings.eps_abs, self.solver.settings.eps_rel = 1e-9, 1e-10
            self.solver.setup(self.eye, -goal, None, None, rows, row_low, row_high, low, high)
        else:
            self.solver.update(c=-goal, G=rows, h_l=row_low, h_u=row_high, x_l=low, x_u=high)
        status = self.solver.solve()
        return (self.solver.result.x.copy() if "SOLVED" in str(status) else None), self.solver.result.info.iter


class Proxqp:
    name = "ProxQP (Python, cold)"

    def __init__(self, n):
        self.n, self.eye = n, np.eye(n)

    def solve(self, goal, low, high, rows, row_low, row_high):
        qp = proxsuite.proxqp.dense.QP(self.n, 0, self.n, True)
        qp.settings.eps_abs, qp.settings.eps_rel, qp.settings.max_iter = 1e-8, 0, 500
        qp.init(self.eye, -goal, None, None, rows, row_low, row_high, low, high)
        qp.solve()
        solved = qp.results.info.status == proxsuite.proxqp.PROXQP_SOLVED
        return (qp.results.x if solved else None), qp.results.info.iter


class Clarabel:
    name = "Clarabel (Python, fresh)"

    def __init__(self, n):
        self.n, self.eye = n, np.eye(n)
        self.settings = clarabel.DefaultSettings()
        self.settings.verbose = False

    def solve(self, goal, low, high, rows, row_low, row_high):
        matrix = sp.csc_matrix(np.vstack([self.eye, -self.eye, rows, -rows]))
        bounds, cones = np.concatenate([high, -low, row_high, -row_low]), [clarabel.NonnegativeConeT(4 * self.n)]
        answer = clarabel.DefaultSolver(sp.csc_matrix(self.eye), -goal, matrix, bounds, cones, self.settings).solve()
        return np.array(answer.x), answer.iterations


class Osqp:
    name = "OSQP (Python, warm)"

    def __init__(self, n):
        self.eye, self.solver = sp.eye(n, format="csc"), None

    def solve(self, goal, low, high, rows, row_low, row_high):
        low, high = np.concatenate([low, row_low]), np.concatenate([high, row_high])
        matrix = sp.csc_matrix(np.vstack([np.eye(len(goal)), rows]))
        if self.solver is None:
            self.solver = osqp.OSQP()
            options = {"verbose": False, "eps_abs": 1e-5, "eps_rel": 1e-5, "max_iter": 4000, "polishing": False}
            self.solver.setup(self.eye, -goal, matrix, low, high, **options)
        else:
            self.solver.update(q=-goal, l=low, u=high, Ax=matrix.data)
        answer = self.solver.solve(raise_error=False)
        return (answer.x if answer.info.status_val == 1 else None), answer.info.iter


def measure(peer, problems, path):
    times, furthest, failed, steps = [], 0.0, 0, 0
    for *problem, optimum in problems:
        start = time.thread_time_ns()
        x, count = peer.solve(*problem)
        times.append((time.thread_time_ns() - start) / 1e3)
        steps += count
        failed += x is None
        if x is not None:
            furthest = max(furthest, np.abs(x - optimum).max())
    head = f"# failed {failed} furthest {furthest:e} steps {steps / len(problems)}\n"
    path.write_text(head + "".join(f"{t}\n" for t in times[1:]))


if __name__ == "__main__":
    out, files = Path(sys.argv[1]), sys.argv[2:]
    for file in files:
        problems = list(load(file))
        for peer in (Quadprog, Daqp, Piqp, Proxqp, Clarabel, Osqp):
            measure(peer(len(problems[0][0])), problems, out / f"{Path(file).stem}.{peer.name}.txt")
