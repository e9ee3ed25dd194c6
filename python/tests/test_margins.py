"""`margin` and `soft` of every limit: what was exceeded, and by how much, from quantities that are computed here."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from conftest import planar_urdf

import nearl

DT, LINK = 1e-3, 0.4
Array = np.ndarray
STRICT, WEAK = (1e4, 1e4), (0.0, 1e-4)


@dataclass
class Tick:
    model: nearl.Model
    q: Array
    v: Array
    q_next: Array
    v_next: Array

    @property
    def q_ahead(self) -> Array:
        """Where the present speed leads: rows and cones are those of this configuration."""
        return self.q + DT * self.v

    @property
    def acceleration(self) -> Array:
        return (self.v_next - self.v) / DT

    @property
    def torque(self) -> Array:
        # With one Euler step the dampers meet the next velocity; there are no springs.
        return self.model.rnea(self.q, self.v, self.acceleration) - self.model.passive(self.q, self.v_next)


def tip(q: Array) -> Array:
    """The end of the third link: joints turn about y, links point along x."""
    angle = np.cumsum(q)
    return LINK * np.array([np.cos(angle).sum(), 0, -np.sin(angle).sum()])


def tip_velocity(q: Array, v: Array) -> Array:
    angle, rate = np.cumsum(q), np.cumsum(v)
    return -LINK * np.array([(np.sin(angle) * rate).sum(), 0, (np.cos(angle) * rate).sum()])


def energy(t: Tick) -> float:
    """At the next speed, with the mass matrix where the present speed leads."""
    return 0.5 * t.v_next @ t.model.mass_matrix(t.q_ahead) @ t.v_next


@dataclass
class Case:
    """A limit, the quantity it bounds, and the bound."""

    make: Callable[..., object]
    measure: Callable[[Tick], float]
    bound: float
    margin: float
    soft: bool = True
    #: How far below its bound a hard limit may stop because it looks ahead.
    ahead: float = 1e-6
    #: Joints stay so slow that the motors, or the point's circle, always leave a way to brake.
    speed: float = 4.0


POINT = [LINK, 0.0, 0.0]
CASES = {
    "position": Case(lambda m, **k: nearl.PositionLimit(m, **k), lambda t: t.q_next[1], 1.8, 0.3, soft=False, ahead=0.02),
    "velocity": Case(lambda m, **k: nearl.VelocityLimit(m, 2.0, **k), lambda t: np.abs(t.v_next).max(), 2.0, 0.5, soft=False),
    "acceleration": Case(
        lambda m, **k: nearl.AccelerationLimit(m, 20.0, 5.0, **k), lambda t: np.abs(t.acceleration).max(), 20.0, 4.0, soft=False
    ),
    "torque": Case(lambda m, **k: nearl.TorqueLimit(m, **k), lambda t: (np.abs(t.torque) - [35.0, 13.0, 2.6]).max(), 0.0, 0.4, speed=1.5),
    "torque_speed": Case(
        lambda m, **k: nearl.TorqueSpeedLimit(m, 30.0, 9.0, **k),
        lambda t: np.abs(t.torque + 30.0 / 9.0 * t.v_next).max(),
        30.0,
        5.0,
        speed=1.5,
    ),
    "frame": Case(
        lambda m, **k: nearl.FrameLimit(m, "link2", 4.0, normal=[0, 0, -1], through=[0, 0, 0.3], point=POINT, **k),
        lambda t: tip(t.q_next)[2] * -1.0,
        -0.3,
        0.1,
        ahead=0.05,
    ),
    "frame_speed": Case(
        lambda m, **k: nearl.FrameSpeedLimit(m, "link2", 1.0, point=POINT, **k),
        lambda t: np.linalg.norm(tip_velocity(t.q_ahead, t.v_next)),
        1.0,
        0.3,
        speed=1.0,
    ),
    "energy": Case(lambda m, **k: nearl.EnergyLimit(m, 2.0, **k), energy, 2.0, 0.8),
    "rows": Case(
        lambda m, **k: nearl.RowLimit(m, "bend", {"v.joint1": 1.0, "v.joint2": 1.0}, upper=1.0, **k),
        lambda t: t.v_next[1] + t.v_next[2],
        1.0,
        0.25,
    ),
}


def drive(case: Case, **keywords) -> tuple[float, float]:
    """The largest measure and the largest slack over runs in which every joint is pushed about."""
    model = nearl.Model.from_urdf_text(planar_urdf())
    limits = [nearl.PositionLimit(model), nearl.VelocityLimit(model, case.speed), nearl.AccelerationLimit(model, 25.0, 5.0)]
    projector = nearl.Projector(model, [*limits, case.make(model, **keywords)], dt=DT, braking="certified")
    rng, worst, slack = np.random.default_rng(3), -np.inf, 0.0
    for _ in range(4):
        q, v = np.array([-1.2, 0.2, 0.1]), np.zeros(3)
        for tick in range(900):
            if tick % 300 == 0:
                push = rng.choice([-1.0, 1.0], 3) * 20.0
                push[1] = abs(push[1]) if tick else push[1]
            v_hat = v + push * DT * rng.uniform(0.5, 1.5)
            target = projector.project(q, v, q + DT * v_hat, v_hat)
            assert target.is_ok, f"{target.status}: {target.reason}"
            worst = max(worst, case.measure(Tick(model, q, v, target.q, target.v)))
            slack = max([slack, *(row["slack"] for row in target.active)])
            q, v = target.q, target.v
    return worst, slack


@pytest.mark.parametrize("kind", CASES)
def test_a_margin_is_kept(kind: str) -> None:
    case = CASES[kind]
    without, _ = drive(case)
    within, slack = drive(case, margin=case.margin)
    assert slack == 0.0
    assert without <= case.bound + 1e-8 and without > case.bound - case.margin, f"{without}: the bound was not reached"
    edge = case.bound - case.margin
    assert edge - case.ahead <= within <= edge + 1e-8, f"{within} instead of {edge}"


@pytest.mark.parametrize("kind", [k for k, c in CASES.items() if c.soft])
def test_a_soft_limit_gives_way_for_its_price_and_says_so(kind: str) -> None:
    case = CASES[kind]
    strict, none = drive(case, soft=STRICT)
    weak, slack = drive(case, soft=WEAK)
    assert strict <= case.bound + 1e-6 and none <= 1e-6, f"{strict} above {case.bound}, slack {none}"
    assert weak > case.bound + 1e-3 and slack > 1e-3, f"{weak}, slack {slack}"


def test_joints_may_have_margins_of_their_own() -> None:
    case = CASES["velocity"]
    model = nearl.Model.from_urdf_text(planar_urdf())
    limit = nearl.VelocityLimit(model, 2.0, margin={"joint2": 1.5})
    projector = nearl.Projector(model, [limit, nearl.AccelerationLimit(model, 1e4)], dt=DT, braking="certified")
    target = projector.project(np.zeros(3), np.zeros(3), np.zeros(3), np.full(3, 50.0))
    np.testing.assert_allclose(target.v, [case.bound, case.bound, 0.5], rtol=1e-12)


@pytest.mark.parametrize("kind", [k for k, c in CASES.items() if not c.soft])
def test_limits_that_braking_counts_on_are_always_hard(kind: str) -> None:
    model = nearl.Model.from_urdf_text(planar_urdf())
    with pytest.raises(TypeError, match="soft"):
        CASES[kind].make(model, soft=WEAK)


def test_margins_that_leave_nothing_are_refused() -> None:
    model = nearl.Model.from_urdf_text(planar_urdf())
    with pytest.raises(ValueError, match="joint0"):
        nearl.Projector(model, [nearl.PositionLimit(model, margin=2.0), nearl.AccelerationLimit(model, 5.0)], dt=DT)
    with pytest.raises(ValueError, match="margin"):
        nearl.EnergyLimit(model, 2.0, margin=3.0)
