"""The sides of the comparison: each takes problems, gives answers z and, for a cotangent of z, that of the goal.

Peers get their matrices ready made: `ready` puts them into the form that the package wants and is not timed. Ours gets states and proposals; its time
includes Pinocchio, the viability box, the assembly, the checker and the ledger.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import cvxpy
import nearl
import nearl.torch
import numpy as np
import problems
import proxsuite
import torch
from cvxpylayers.torch import CvxpyLayer
from problems import PERIOD, SIGMA, Array, Problems
from qpth.qp import QPFunction

THREADS = 2
torch.set_num_threads(THREADS)
torch.set_default_dtype(torch.float64)
WORKERS = ThreadPoolExecutor(THREADS)
dense = proxsuite.proxqp.dense
SOLVED = proxsuite.proxqp.QPSolverOutput.PROXQP_SOLVED


class Side(Protocol):
    """`forward` then `backward`, timed apart, on what `ready` gave; `most` problems at once. Problems it gives up are NaN."""

    name: str
    most: int

    def ready(self, p: Problems, torque: bool) -> None: ...
    def forward(self) -> Array: ...
    def backward(self, cotangent: Array) -> Array: ...


def projector(torque: bool) -> nearl.Projector:
    model = nearl.Model.from_urdf(problems.URDF)
    limits = [
        nearl.PositionLimit(model),
        nearl.VelocityLimit(model, scale=problems.VELOCITY),
        nearl.AccelerationLimit(model, problems.ACCELERATION),
    ]
    if torque:
        limits.append(nearl.TorqueLimit(model, scale=problems.EFFORT))
    return nearl.Projector(model, limits, dt=PERIOD, sub_steps=1)


class Ours:
    """`project_batch`, then `vjp_batch`, which projects again: for a training step call the second alone."""

    name, most = "NEARL, arrays", 100_000

    def ready(self, p: Problems, torque: bool) -> None:
        self.projector, self.p = projector(torque), p
        self.batch = p.q, p.v, p.q_hat, p.v_hat
        self.projector.project_batch(*(x[:10] for x in self.batch), threads=THREADS)

    def forward(self) -> Array:
        return (self.projector.project_batch(*self.batch, threads=THREADS).v - self.p.v) / SIGMA

    def backward(self, cotangent: Array) -> Array:
        dq, dv = self.projector.vjp_batch(*self.batch, np.zeros_like(cotangent), cotangent, threads=THREADS)
        return dv + PERIOD * dq


class OursTorch(Ours):
    """`nearl.torch.project` and `backward()`."""

    name = "NEARL, torch"

    def ready(self, p: Problems, torque: bool) -> None:
        super().ready(p, torque)
        state = [torch.from_numpy(x) for x in (p.q, p.v)]
        self.tensors = [*state, *(torch.from_numpy(x).requires_grad_() for x in (p.q_hat, p.v_hat))]

    def forward(self) -> Array:
        _, self.answer = nearl.torch.project(self.projector, *self.tensors)
        return (self.answer.detach().numpy() - self.p.v) / SIGMA

    def backward(self, cotangent: Array) -> Array:
        dq, dv = torch.autograd.grad(self.answer, self.tensors[2:], torch.from_numpy(cotangent))
        return (dv + PERIOD * dq).numpy()


class Qpth:
    """`QPFunction` with its own settings (an interior point, 20 iterations for all of a batch together).

    Two threads with one of torch's each, half a thousand to a thousand problems at a time, was its fastest way to use two cores.
    """

    name, most, portion = "qpth", 20_000, 1_000

    def ready(self, p: Problems, torque: bool) -> None:
        self.eye, self.none, self.parts = torch.eye(7), torch.empty(0), []
        for i in range(0, len(p), self.portion):
            part = p[i : i + self.portion]
            g, h = part.inequalities(torque)
            pull = torch.from_numpy(-part.goal).requires_grad_()
            self.parts.append((pull, torch.from_numpy(np.ascontiguousarray(g)), torch.from_numpy(h)))

    def forward(self) -> Array:
        torch.set_num_threads(1)
        self.answers = list(WORKERS.map(self.solve, self.parts))
        torch.set_num_threads(THREADS)
        return np.concatenate([x.detach().numpy() for x in self.answers])

    def solve(self, part: tuple[torch.Tensor, ...]) -> torch.Tensor:
        return QPFunction(verbose=-1)(self.eye, *part, self.none, self.none)

    def backward(self, cotangent: Array) -> Array:
        torch.set_num_threads(1)
        pieces = [cotangent[i : i + self.portion] for i in range(0, len(cotangent), self.portion)]
        pulled = list(WORKERS.map(self.pull, self.answers, self.parts, pieces))
        torch.set_num_threads(THREADS)
        return -np.concatenate(pulled)

    @staticmethod
    def pull(answer: torch.Tensor, part: tuple[torch.Tensor, ...], cotangent: Array) -> Array:
        return torch.autograd.grad(answer, part[0], torch.from_numpy(cotangent))[0].numpy()


class Cvxpylayers:
    """`CvxpyLayer` over diffcp, with SCS (its default) or Clarabel.

    diffcp turns `sum_squares` into a second-order cone, so the goal stands in the linear term: within the squares it costs up to four digits.
    """

    most = 1_000

    def __init__(self, method: str):
        self.name = f"cvxpylayers, {method}"
        self.settings = {"solve_method": method, "n_jobs_forward": THREADS, "n_jobs_backward": THREADS}
        self.layers = {torque: self.layer(torque) for torque in (False, True)}

    @staticmethod
    def layer(torque: bool) -> CvxpyLayer:
        z, goal, lower, upper = cvxpy.Variable(7), *(cvxpy.Parameter(7) for _ in range(3))
        parameters, limits = [goal, lower, upper], [z >= lower, z <= upper]
        if torque:
            rows, row_lower, row_upper = cvxpy.Parameter((7, 7)), cvxpy.Parameter(7), cvxpy.Parameter(7)
            parameters += [rows, row_lower, row_upper]
            limits += [rows @ z >= row_lower, rows @ z <= row_upper]
        objective = cvxpy.Minimize(0.5 * cvxpy.sum_squares(z) - goal @ z)
        return CvxpyLayer(cvxpy.Problem(objective, limits), parameters=parameters, variables=[z])

    def ready(self, p: Problems, torque: bool) -> None:
        names = ["goal", "lower", "upper", *(["rows", "row_lower", "row_upper"] if torque else [])]
        self.numbers = [torch.from_numpy(np.ascontiguousarray(getattr(p, name))) for name in names]
        self.numbers[0].requires_grad_()
        self.solve = self.layers[torque]

    def forward(self) -> Array:
        (self.answer,) = self.solve(*self.numbers, solver_args=self.settings)
        return self.answer.detach().numpy()

    def backward(self, cotangent: Array) -> Array:
        (pulled,) = torch.autograd.grad(self.answer, self.numbers[0], torch.from_numpy(cotangent))
        return pulled.numpy()


class Proxsuite:
    """`solve_in_parallel` and `solve_backward_in_parallel`; making and initialising each QP is not timed.

    With its default settings, or with those its exact answers need: without a check of the duality gap it takes points that are feasible and
    stationary with multipliers of rows that are far away, and at its default of 1e-4 it calls some of these problems infeasible.
    """

    most = 10_000

    def __init__(self, exact: bool):
        self.exact, self.name = exact, f"proxsuite, {'exact' if exact else 'default'} settings"

    def ready(self, p: Problems, torque: bool) -> None:
        count, eye = 14 if torque else 7, np.eye(7)
        self.batch = dense.BatchQP()
        for i in range(len(p)):
            qp = self.batch.init_qp_in_place(7, 0, count)
            if self.exact:
                qp.settings.eps_abs, qp.settings.eps_rel, qp.settings.eps_primal_inf = 1e-9, 0.0, 1e-12
                qp.settings.check_duality_gap = True
                qp.settings.eps_duality_gap_abs, qp.settings.eps_duality_gap_rel = 1e-9, 0.0
            if torque:
                c = np.vstack([eye, p.rows[i]])
                l, u = np.concatenate([p.lower[i], p.row_lower[i]]), np.concatenate([p.upper[i], p.row_upper[i]])
            else:
                c, l, u = eye, p.lower[i], p.upper[i]
            qp.init(H=eye, g=-p.goal[i], C=c, l=l, u=u)
        self.count = count

    def forward(self) -> Array:
        dense.solve_in_parallel(self.batch, THREADS)
        results = [self.batch.get(i).results for i in range(self.batch.size())]
        return np.array([r.x if r.info.status == SOLVED else np.full(7, np.nan) for r in results])

    def backward(self, cotangent: Array) -> Array:
        losses = dense.VectorLossDerivatives()
        for w in np.hstack([cotangent, np.zeros((len(cotangent), self.count))]):
            losses.append(w)
        dense.solve_backward_in_parallel(THREADS, self.batch, losses)
        return -np.array([self.batch.get(i).model.backward_data.dL_dg for i in range(self.batch.size())])
