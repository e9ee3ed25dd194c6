"""The problems of the comparison, from the formulas and the Python package of Pinocchio, and their exact answers by quadprog.

A problem is the projection of one proposal on a Panda. With `T` the period, `sigma = A T` the largest change of velocity in it and
`y = sigma z` the change sought:

    min 1/2 |z - goal|^2   s.t.   lower <= z <= upper   and, with torque rows,   row_lower <= G z <= row_upper

`goal = (y_q + y_v) / (2 sigma)` with `y_q = (q_hat - q - T v) / T` and `y_v = v_hat - v`. Torque rows are shares of the effort limits. Nothing of NEARL
is imported.
"""

import sys
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pinocchio as pin
import quadprog

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bounds import upper_acceleration  # noqa: E402

URDF = Path(__file__).resolve().parents[2] / "examples/robots/panda/panda.urdf"
PERIOD = 1e-3  # [s], one semi-implicit Euler step
ACCELERATION = 20.0  # and braking [rad/s^2]
VELOCITY, EFFORT = 0.9, 0.7  # shares of the limits in the robot file
SIGMA = ACCELERATION * PERIOD  # [rad/s]
STRICT = 1e-6  # multipliers and distances to bounds below this make a problem degenerate, in units of sigma and of the effort limits

Array = np.ndarray


@dataclass
class Problems:
    """n problems; states and proposals (n, 7) beside the numbers of the problem (n, 7) and G (n, 7, 7)."""

    q: Array
    v: Array
    q_hat: Array
    v_hat: Array
    goal: Array
    lower: Array
    upper: Array
    rows: Array
    row_lower: Array
    row_upper: Array

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, which: slice | Array) -> "Problems":
        return Problems(*(getattr(self, f.name)[which] for f in fields(self)))

    def inequalities(self, torque: bool) -> tuple[Array, Array]:
        """`G z <= h`, one-sided: (n, m, 7) or (m, 7) where all problems share it, and (n, m)."""
        eye = np.eye(7)
        if not torque:
            return np.vstack([eye, -eye]), np.hstack([self.upper, -self.lower])
        box = np.broadcast_to(np.vstack([eye, -eye]), (len(self), 14, 7))
        return np.concatenate([box, self.rows, -self.rows], axis=1), np.hstack(
            [self.upper, -self.lower, self.row_upper, -self.row_lower]
        )


def draw(n: int, rng: np.random.Generator, size: tuple[float, float]) -> Problems:
    """States inside the limits with room to brake, and proposals `10^size` times `sigma` away; size is drawn uniformly."""
    model = pin.buildModelFromUrdf(str(URDF))
    data = model.createData()
    low, high, speed = model.lowerPositionLimit, model.upperPositionLimit, VELOCITY * model.upperVelocityLimit
    q = low + (high - low) * rng.uniform(0.001, 0.999, (n, 7))
    brake = lambda d: 0.98 * np.sqrt(2 * ACCELERATION * d)  # noqa: E731
    v = rng.uniform(-np.minimum(speed, brake(q - low)), np.minimum(speed, brake(high - q)))
    far = SIGMA * 10.0 ** rng.uniform(*size, (n, 1))
    v_hat = v + far * rng.normal(size=(n, 7))
    q_hat = q + PERIOD * v + PERIOD * far * rng.normal(size=(n, 7))
    mass, nle = np.empty((n, 7, 7)), np.empty((n, 7))
    for i in range(n):
        nle[i] = pin.nonLinearEffects(model, data, q[i], v[i])
        mass[i] = pin.crba(model, data, q[i])
    mass = np.triu(mass) + np.swapaxes(np.triu(mass, 1), 1, 2)
    effort = EFFORT * model.upperEffortLimit
    return Problems(
        q, v, q_hat, v_hat,
        goal=((q_hat - q) / PERIOD - v + v_hat - v) / (2 * SIGMA),
        lower=-upper_acceleration(q - low, -v, speed, ACCELERATION, ACCELERATION, PERIOD) / ACCELERATION,
        upper=upper_acceleration(high - q, v, speed, ACCELERATION, ACCELERATION, PERIOD) / ACCELERATION,
        rows=mass * ACCELERATION / effort[:, None],
        row_lower=-1 - nle / effort,
        row_upper=1 - nle / effort,
    )  # fmt: skip


def make(n: int, seed: int, size: tuple[float, float] = (-1.0, 3.0)) -> tuple[Problems, float]:
    """n problems that have an answer with 0.1 % of the effort to spare, and the share of draws that were left out because they have none."""
    rng, found, drawn = np.random.default_rng(seed), [], 0
    while sum(map(len, found)) < n:
        batch = draw(max(n // 4, 100), rng, size)
        g, h = batch.inequalities(True)
        h[:, 14:] -= 1e-3
        found.append(batch[np.array([solve(x, g, h) is not None for x, g, h in zip(batch.goal, g, h, strict=True)])])
        drawn += len(batch)
    kept = sum(map(len, found))
    return Problems(*(np.concatenate([getattr(b, f.name) for b in found])[:n] for f in fields(Problems))), 1 - kept / drawn


def solve(goal: Array, g: Array, h: Array) -> tuple[Array, Array] | None:
    """Answer and multipliers by quadprog; None where nothing satisfies all rows."""
    try:
        answer = quadprog.solve_qp(np.eye(len(goal)), goal, -g.T, -h)
    except ValueError:
        return None
    return answer[0], answer[4]


@dataclass
class Exact:
    """Answers z (n, 7), cotangents of the goal for those of z (n, 7), and where the derivative exists (n)."""

    z: Array
    pulled: Array
    smooth: Array
    torque_active: float


def exact(problems: Problems, torque: bool, cotangent: Array) -> Exact:
    """By quadprog; the product with the Jacobian is the projection of the cotangent onto the null space of the active rows.

    It exists where every active row pulls and every other one is away, both by more than STRICT, and the active rows are independent.
    """
    g_all, h_all = problems.inequalities(torque)
    z, pulled, smooth, rows_active = np.empty_like(cotangent), np.empty_like(cotangent), [], 0
    for i in range(len(problems)):
        g, h = (g_all[i] if torque else g_all), h_all[i]
        z[i], multipliers = solve(problems.goal[i], g, h)
        active, slack = multipliers > STRICT, h - g @ z[i]
        a = g[active]
        clear = np.all(slack[~active] > STRICT) and (not len(a) or np.linalg.cond(a) < 1e6)
        smooth.append(bool(clear))
        pulled[i] = cotangent[i] - (np.linalg.pinv(a) @ (a @ cotangent[i]) if len(a) else 0.0)
        rows_active += bool(active[14:].any())
    return Exact(z, pulled, np.array(smooth), rows_active / len(problems))
