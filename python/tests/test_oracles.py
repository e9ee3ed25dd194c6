"""Soft, equal and hard rows of the user's own beside torque limits, in closed loop, against quadprog on problems put together here."""

import numpy as np
import pytest
import quadprog
from conftest import ROBOTS
from test_projector import upper_acceleration

import nearl

DT, SCALE, A_MAX = 1e-3, 0.6, 20.0
SOFT = (0.3, 20.0)
Array = np.ndarray


class Oracle:
    """The rows of a robot's first six joints: v0 - v1/2 softly within 0.1, v2 = v3/2, v4 + v5 <= 0.25 [rad/s]; torques at `share`."""

    def __init__(self, model: nearl.Model, share: float):
        self.model, self.share, n = model, share, model.nv
        e = np.eye(n)
        self.soft, self.equal, self.hard = e[0] - e[1] / 2, e[2] - e[3] / 2, e[4] + e[5]
        name = model.joint_names
        limits = [
            nearl.PositionLimit(model),
            nearl.VelocityLimit(model, scale=SCALE),
            nearl.AccelerationLimit(model, A_MAX),
            nearl.TorqueLimit(model, scale=share),
            nearl.RowLimit(model, "soft", {f"v.{name[0]}": 1.0, f"v.{name[1]}": -0.5}, lower=-0.1, upper=0.1, soft=SOFT),
            nearl.RowLimit(model, "equal", {f"v.{name[2]}": 1.0, f"v.{name[3]}": -0.5}, equals=0.0),
            nearl.RowLimit(model, "hard", {f"v.{name[4]}": 1.0, f"v.{name[5]}": 1.0}, upper=0.25),
        ]
        self.projector = nearl.Projector(model, limits, dt=DT, sub_steps=1, braking="certified")

    def solve(self, q: Array, v: Array, q_hat: Array, v_hat: Array) -> Array | None:
        """The optimum by quadprog, over y and the slack s of the soft row as a share of its bound."""
        m, n = self.model, self.model.nv
        speed, effort = SCALE * m.velocity_limit, self.share * m.effort_limit
        upper = DT * upper_acceleration(m.upper_position_limit - q, v, speed, DT, 1)
        lower = -DT * upper_acceleration(q - m.lower_position_limit, -v, speed, DT, 1)
        lower = np.minimum(lower, upper)  # they cross by rounding where only full braking is left
        torque, still = m.mass_matrix(q) / DT / effort[:, None], (m.nle(q, v) - m.passive(q, v)) / effort
        worth = 2 * (A_MAX * DT) ** 2
        unit = A_MAX * DT
        goal = ((q_hat - q - DT * v) / DT + v_hat - v) / 2
        pad = lambda g, s=0.0: np.hstack([np.reshape(g, (-1, n)) * unit, np.full((np.size(g) // n, 1), s)])  # noqa: E731
        G = np.vstack([
            pad(np.eye(n)), pad(-np.eye(n)), pad(torque), pad(-torque), pad(self.hard / 0.25),
            pad(self.soft / 0.1, -1.0), pad(-self.soft / 0.1, -1.0), pad(np.zeros(n), -1.0)])  # fmt: skip
        h = np.concatenate([
            upper, -lower, 1 - still, 1 + still, [1 - self.hard @ v / 0.25],
            [1 - self.soft @ v / 0.1, 1 + self.soft @ v / 0.1, 0.0]])  # fmt: skip
        hessian = np.diag(np.append(np.full(n, 2 * unit**2), worth * SOFT[1])) / worth
        pull = np.append(2 * unit * goal, -worth * SOFT[0]) / worth
        A, b, off = pad(self.equal), [-(self.equal @ v)], self.equal @ v
        if abs(off) > 1e-8:  # a brake left the row: it comes back where the proposal leads it, and goes no further
            side = pad(np.sign(off) * self.equal)
            G, h, A, b = np.vstack([G, side, -side]), np.append(h, [0.0, abs(off)]), np.zeros((0, n + 1)), []
        try:
            x = quadprog.solve_qp(hessian, pull, np.vstack([A, -G]).T, np.concatenate([b, -h]), len(b))[0]
        except ValueError:
            return None  # nothing satisfies all rows
        return unit * x[:n]


@pytest.mark.parametrize("robot, share", [("panda", 0.7), ("ur5", 0.5), ("xarm7", 0.9), ("anymal", 0.15), ("g1", 0.8)])
def test_rows_of_all_kinds_give_the_optimum_in_closed_loop(robot: str, share: float, rng: np.random.Generator) -> None:
    model = nearl.Model.from_urdf(ROBOTS / robot / f"{robot}.urdf")
    oracle = Oracle(model, share)
    low, high, n = model.lower_position_limit, model.upper_position_limit, model.nv
    q, v, furthest, solved, seen = low + (high - low) * 0.45, np.zeros(n), 0.0, 0, set()
    for tick in range(1000):
        if tick % 50 == 0:
            wish = SCALE * model.velocity_limit * rng.uniform(-1.5, 1.5, n)
        v_hat = v + np.clip(wish - v, -3 * A_MAX * DT, 3 * A_MAX * DT) + A_MAX * DT * rng.uniform(-1, 1, n)
        q_hat = q + DT * (v_hat + A_MAX * DT * rng.uniform(-1, 1, n))
        target = oracle.projector.project(q, v, q_hat, v_hat)
        optimum = oracle.solve(q, v, q_hat, v_hat)
        if optimum is not None and target.status != "braked":
            solved += 1
            seen |= {row["name"] if row["kind"] == "user" else row["kind"] for row in target.active}
            furthest = max(furthest, np.linalg.norm(target.v - v - optimum))
        assert (optimum is None) == (target.status == "braked"), f"tick {tick}: {target.status}, {target.reason}"
        q, v = target.q, target.v
    assert furthest <= 1e-8, f"{robot}: {furthest:.1e} rad/s from the optimum"
    assert solved > 800 and {"soft", "equal", "hard", "torque"} <= seen, f"{robot}: {solved} solved, {seen} active"
