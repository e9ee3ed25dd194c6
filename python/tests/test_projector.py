"""The projector against quadprog on problems put together here, from the formulas and not from our code."""

import warnings

import numpy as np
import pytest
import quadprog
from conftest import robot

import nearl

A_MAX, SCALE = 20.0, 0.9
Array = np.ndarray


def upper_acceleration(d: Array, v: Array, speed: Array, dt: float, n: int) -> Array:
    """Largest acceleration from which braking with A_MAX still ends in front of the limit at distance ``d``.

    Del Prete (RA-L 2018) for n = 0; for n semi-implicit Euler sub-steps of length tau, the set
    (v - A tau / 2)_+^2 <= 2 A d.
    """
    tau, kappa = (0.0, 0.5) if n == 0 else (dt / n, (n + 1) / (2 * n))
    with np.errstate(divide="ignore", invalid="ignore"):
        if n:
            inside = np.min([2 * (d - j * tau * v) / (tau**2 * j * (j + 1)) for j in range(1, n + 1)], axis=0)
        else:
            end = 2 * (d - dt * v) / dt**2
            inside = np.where((v <= 0) | (end > -v / dt), end, np.minimum(-(v**2) / (2 * d), -v / dt))
        w = v - A_MAX * tau / 2
        b, c = 2 * w * dt + 2 * A_MAX * kappa * dt**2, w**2 - 2 * A_MAX * (d - dt * v)
        root = (-b + np.sqrt(b**2 - 4 * dt**2 * c)) / (2 * dt**2)
    braking = np.where(np.isnan(root), -w / dt, np.fmax(root, -w / dt))
    return np.min([np.full_like(v, A_MAX), (speed - v) / dt, inside, braking], axis=0)


class Problem:
    """min 1/2 y'H y + c'y s.t. box and torque rows, for one state and proposal."""

    def __init__(self, model: nearl.Model, q: Array, v: Array, dt: float, n: int):
        self.model, self.q, self.v, self.dt = model, q, v, dt
        self.kappa = 0.5 if n == 0 else (n + 1) / (2 * n)
        speed, low, high = SCALE * model.velocity_limit, model.lower_position_limit, model.upper_position_limit
        self.upper = dt * upper_acceleration(high - q, v, speed, dt, n)
        self.lower = -dt * upper_acceleration(q - low, -v, speed, dt, n)
        damping = model.passive(q, 0 * v) - model.passive(q, 0 * v + 1)  # it meets v + kappa (v' - v) on average
        # gravity and the rest are met at q + h v and v + h (v' - v) / dt
        h = dt / 2 if n == 0 else (dt - dt / n) / 2
        middle, eye = model.integrate(q, h * v), np.eye(len(v))
        slope = np.column_stack([(model.nle(middle, v + e) - model.nle(middle, v - e)) / 2 for e in eye])
        self.rows = (model.mass_matrix(middle) + h * slope) / dt + self.kappa * np.diag(damping)
        offset = model.nle(middle, v) - model.passive(q, v)
        self.row_lower, self.row_upper = -model.effort_limit - offset, model.effort_limit - offset

    def solve(self, q_hat: Array, v_hat: Array) -> Array | None:
        nv = len(self.v)
        y_q, y_v = (q_hat - self.q - self.dt * self.v) / (self.kappa * self.dt), v_hat - self.v
        G = np.vstack([np.eye(nv), -np.eye(nv), self.rows, -self.rows])
        h = np.concatenate([self.upper, -self.lower, self.row_upper, -self.row_lower])
        try:
            return quadprog.solve_qp(2 * np.eye(nv), y_q + y_v, -G.T, -h)[0]
        except ValueError:
            return None  # nothing satisfies all rows

    def violation(self, y: Array) -> float:
        """Largest violation: of the box in rad/s, of a torque row as a share of its limit."""
        torque = np.maximum(self.rows @ y - self.row_upper, self.row_lower - self.rows @ y) / self.model.effort_limit
        return max((y - self.upper).max(), (self.lower - y).max(), torque.max())


def viable_state(model: nearl.Model, rng: np.random.Generator, n: int, dt: float) -> tuple[Array, Array]:
    low, high = model.lower_position_limit, model.upper_position_limit
    q = low + (high - low) * rng.uniform(0.001, 0.999, model.nq)
    tau = dt / n if n else 0.0
    brake = lambda d: np.sqrt(2 * A_MAX * d) + A_MAX * tau / 2  # noqa: E731
    speed = SCALE * model.velocity_limit
    v = rng.uniform(-np.minimum(speed, 0.98 * brake(q - low)), np.minimum(speed, 0.98 * brake(high - q)))
    return q, v


def make(model: nearl.Model, dt: float, n: int, **settings) -> nearl.Projector:
    limits = [
        nearl.PositionLimit(model),
        nearl.VelocityLimit(model, scale=SCALE),
        nearl.AccelerationLimit(model, A_MAX),
        nearl.TorqueLimit(model),
    ]
    # certified: what is compared is the nearest state, which a stored brake may hold back
    return nearl.Projector(model, limits, dt=dt, sub_steps=n, **{"braking": "certified", **settings})


def cases(model: nearl.Model, rng: np.random.Generator, count: int, dt: float, n: int):
    for _ in range(count):
        q, v = viable_state(model, rng, n, dt)
        size = 10.0 ** rng.uniform(-2, 2)
        v_hat = v + size * A_MAX * dt * rng.normal(size=model.nv)
        q_hat = q + dt * v + size * A_MAX * dt**2 * rng.normal(size=model.nq)
        yield Problem(model, q, v, dt, n), q_hat, v_hat


@pytest.mark.parametrize("solver, tolerance", [("ladder", 1e-6), ("clarabel", 1e-5)])
@pytest.mark.parametrize("dt, n", [(1e-3, 1), (1e-2, 0), (1e-2, 5)])
def test_targets_are_the_optimum(model, rng, dt, n, solver, tolerance) -> None:
    projector = make(model, dt, n, solver=solver)
    solved = torque_active = 0
    for problem, q_hat, v_hat in cases(model, rng, 300, dt, n):
        target = projector.project(problem.q, problem.v, q_hat, v_hat)
        optimum = problem.solve(q_hat, v_hat)
        y = target.v - problem.v
        if optimum is None:
            assert target.status == "braked" and target.reason == "no answer passed the checker"
            continue
        assert target.is_ok, f"{target.status}: {target.reason}"
        solved += 1
        torque_active += any(row["kind"] == "torque" for row in target.active)
        distance = np.linalg.norm(y - optimum) / max(np.linalg.norm(optimum), A_MAX * dt)
        assert distance <= tolerance, f"{target.status} {target.rung}: {distance}"
        assert problem.violation(y) <= 1e-9
        assert target.target_violations["torque"] == 0 and target.slack <= 1e-9
        np.testing.assert_allclose(target.q, problem.q + dt * problem.v + problem.kappa * dt * y, atol=1e-12)
    assert solved > 250 and torque_active > 20, f"{solved} solved, {torque_active} with torque rows active"


@pytest.mark.parametrize("solver, furthest_size", [("ladder", 8), ("clarabel", 5)])
def test_targets_are_the_optimum_however_far_the_proposal(model, rng, solver, furthest_size) -> None:
    """Goals beyond 100 times the box were brought nearer dof by dof, which pulled another way: answers were up to the whole box off."""
    projector, compared, furthest = make(model, 1e-3, 1, solver=solver), 0, 0.0
    for size in np.repeat(10.0 ** np.arange(2, furthest_size + 1), 60):
        q, v = viable_state(model, rng, 1, 1e-3)
        pull = size * A_MAX * 1e-3 * rng.normal(size=model.nv)
        target = projector.project(q, v, q + 1e-3 * (v + pull), v + pull)
        nearer = pull * min(1.0, 1e6 / size)  # quadprog's answers are rounding beyond it, and do not change any more
        optimum = Problem(model, q, v, 1e-3, 1).solve(q + 1e-3 * (v + nearer), v + nearer)
        if optimum is None:
            continue
        compared += any(row["kind"] == "torque" for row in target.active)
        furthest = max(furthest, np.abs(target.v - v - optimum).max())
    assert furthest < 1e-8 and compared > 50, f"{furthest:.1e} rad/s, {compared} with torque rows active"


@pytest.mark.parametrize("dt, n", [(1e-3, 1), (1e-2, 0)])
def test_feasible_proposals_pass_bit_for_bit(model, rng, dt, n) -> None:
    projector = make(model, dt, n)
    passed = 0
    while passed < 200:
        q, v = viable_state(model, rng, n, dt)
        problem = Problem(model, q, v, dt, n)
        y = problem.lower + (problem.upper - problem.lower) * rng.uniform(0.05, 0.95, model.nv)
        if problem.violation(y) > -1e-6:
            continue
        passed += 1
        q_hat, v_hat = q + dt * v + problem.kappa * dt * y, v + y
        target = projector.project(q, v, q_hat, v_hat)
        assert target.status == "unchanged" and target.moved == 0 and target.active == []
        assert np.array_equal(target.q, q_hat) and np.array_equal(target.v, v_hat)


def test_the_problem_it_states_is_the_problem_it_solves(model, rng) -> None:
    projector = make(model, 1e-3, 1)
    for problem, q_hat, v_hat in cases(model, rng, 50, 1e-3, 1):
        H, c, G, h, *_ = projector.problem(problem.q, problem.v, q_hat, v_hat)
        optimum = problem.solve(q_hat, v_hat)
        if optimum is None:
            continue
        stated = quadprog.solve_qp(H, -c, -G.T, -h)[0]
        np.testing.assert_allclose(stated, optimum, atol=1e-8 * max(1.0, np.abs(optimum).max()))


@pytest.mark.parametrize("braking", ["certified", "stored"])
def test_a_batch_is_its_rows(model, rng, braking) -> None:
    """A brake stored for the row before was used for the next: rows depended on their order and on the number of threads."""
    projector = make(model, 1e-3, 1, braking=braking)
    rows = [(p.q, p.v, q_hat, v_hat) for p, q_hat, v_hat in cases(model, rng, 101, 1e-3, 1)]
    batch = [np.stack(x) for x in zip(*rows, strict=True)]
    fresh = [make(model, 1e-3, 1, braking=braking).project(*row) for row in rows]
    for threads in (1, 2, 3, None):
        targets = projector.project_batch(*batch, threads=threads)
        assert len(targets) == 101 and targets.q.shape == (101, model.nq)
        for i, one in enumerate(fresh):
            assert np.array_equal(targets.q[i], one.q) and np.array_equal(targets.v[i], one.v)
            assert targets.status[i] == one.status == targets[i].status
            assert targets.moved[i] == one.moved and targets[i].active == one.active
        if braking == "certified":
            assert all(np.array_equal(projector.project(*row).v, v) for row, v in zip(rows, targets.v, strict=True))
    order = rng.permutation(101)
    shuffled = projector.project_batch(*[x[order] for x in batch], threads=2)
    assert np.array_equal(shuffled.q, targets.q[order]) and np.array_equal(shuffled.v, targets.v[order])
    assert [targets.status[i] for i in order] == list(shuffled.status)
    weights = rng.normal(size=(101, model.nv)), rng.normal(size=(101, model.nv))
    pulled = [projector.vjp_batch(*batch, *weights, threads=threads) for threads in (1, 2)]
    pulled.append([x[np.argsort(order)] for x in projector.vjp_batch(*[x[order] for x in (*batch, *weights)], threads=2)])
    assert all(np.array_equal(x, y) for one in pulled[1:] for x, y in zip(pulled[0], one, strict=True))
    for layout in (np.asfortranarray, lambda x: np.repeat(x, 2, axis=1)[:, ::2], lambda x: x[::-1].copy()[::-1]):
        assert np.array_equal(projector.project_batch(*[layout(x) for x in batch]).q, targets.q)
    assert len(projector.project_batch(*[x[:0] for x in batch])) == 0


def test_batches_and_problems_leave_a_stored_brake_alone(model, rng) -> None:
    row, *others = [(p.q, p.v, q_hat, v_hat) for p, q_hat, v_hat in cases(model, rng, 60, 1e-3, 1)]
    batch = [np.stack(x) for x in zip(row, *others, strict=True)]
    alone, busy = (make(model, 1e-3, 1, braking="stored") for _ in range(2))
    stated = make(model, 1e-3, 1, braking="stored").problem(*row)
    for k, other in enumerate(others):
        one, two = alone.project(*other), busy.project(*other)
        assert one.status == two.status and np.array_equal(one.q, two.q) and np.array_equal(one.v, two.v), f"row {k}"
        busy.project_batch(*batch, threads=2)
        assert all(np.array_equal(x, y) for x, y in zip(stated, busy.problem(*row), strict=True)), f"row {k}"


def test_multipliers_balance_the_pull_of_the_proposal(model, rng) -> None:
    """Stationarity, with the rows as the ledger lists them: H (y - goal) + mu + G' lambda = 0."""
    dt = 1e-3
    projector = make(model, dt, 1)
    for problem, q_hat, v_hat in cases(model, rng, 100, dt, 1):
        target = projector.project(problem.q, problem.v, q_hat, v_hat)
        if target.status != "solved":
            continue
        y = target.v - problem.v
        pull = (q_hat - problem.q - dt * problem.v) / dt + v_hat - problem.v - 2 * y
        held = np.zeros(model.nv)
        for row in target.active:
            sign = 1.0 if row["side"] == "upper" else -1.0
            assert row["multiplier"] >= 0 and row["slack"] == 0 and row["name"] == projector.row_names[row["row"]]
            dof = model.joint_names.index(row["name"])
            direction = problem.rows[dof] if row["kind"] == "torque" else np.eye(model.nv)[dof]
            held += sign * row["multiplier"] * direction
        np.testing.assert_allclose(held, pull, atol=1e-6 * max(1.0, np.abs(pull).max()))


def test_only_controllable_joints_move(rng) -> None:
    model = robot("legs")
    mine = ["thigh0", "calf2"]
    limits = [nearl.PositionLimit(model), nearl.VelocityLimit(model), nearl.AccelerationLimit(model, A_MAX)]
    for consistency in ("kinematic", "free"):
        projector = nearl.Projector(model, limits, dt=1e-3, controllable=mine, consistency=consistency)
        assert sorted(projector.controllable) == sorted(mine)
        q, v = viable_state(model, rng, 1, 1e-3)
        q_hat, v_hat = q + rng.normal(size=12), v + rng.normal(size=12)
        target = projector.project(q, v, q_hat, v_hat)
        kept = [i for i, name in enumerate(model.joint_names) if name not in mine]
        moved = [i for i in range(12) if i not in kept]
        assert np.array_equal(target.q[kept], q_hat[kept]) and np.array_equal(target.v[kept], v_hat[kept])
        assert np.all(np.abs(target.v[moved] - v[moved]) <= A_MAX * 1e-3 + 1e-12)


def test_nothing_finite_comes_back_as_anything_else(model) -> None:
    projector, zero = make(model, 1e-3, 1), np.zeros(model.nv)
    q = (model.lower_position_limit + model.upper_position_limit) / 2
    bad = projector.project(q, zero, np.full(model.nq, np.nan), zero)
    assert bad.status == "braked" and np.isfinite(bad.q).all() and np.array_equal(bad.v, zero)
    lost = projector.project(np.full(model.nq, np.nan), zero, q, zero)
    assert lost.status == "refused" and np.isfinite(lost.q).all() and not lost.is_ok
    assert projector.project(q, zero, q, zero).status == "unchanged", "nothing of it stays behind"


def test_what_is_outside_is_named_and_what_is_no_configuration_is_refused() -> None:
    panda = nearl.Model.from_urdf("examples/robots/panda/panda.urdf")
    q, zero = np.array([0, 0, 0, -1.5, 0, 1.5, 0]), np.zeros(7)
    row = nearl.RowLimit(panda, "elbow", {"q.panda_joint4": 1.0}, upper=-2.0, braking=2.0)
    limits = [nearl.AccelerationLimit(panda, 10.0), nearl.VelocityLimit(panda, {"panda_joint1": 1.0})]
    target = nearl.Projector(panda, [*limits, row], 1e-3).project(q, zero, q, zero)
    assert (target.status, target.outside) == ("recovering", ["elbow"]) and "outside" in target.reason
    fast = nearl.Projector(panda, limits, 1e-3)
    v = np.zeros(7)
    for _ in range(1000):
        target = fast.project(q, v, q + 1.0, np.full(7, 9.0))
        q, v = target.q, target.v
    assert v[0] == 1.0 and (np.abs(v[1:]) <= panda.velocity_limit[1:]).all(), "joints without a number keep the file's"
    with pytest.raises(ValueError, match="has no braking|no braking"):
        nearl.RowLimit(panda, "elbow", {"q.panda_joint4": 1.0}, upper=-2.0)
    solo = nearl.Model.from_urdf("examples/robots/solo12/solo12.urdf", free_flyer=True)
    projector = nearl.Projector(solo, [nearl.AccelerationLimit(solo, 10.0)], 1e-3, controllable=list(solo.joint_names[1:]))
    good, still = solo.neutral(), np.zeros(solo.nv)
    bad = good.copy()
    bad[3:7] = 0
    assert projector.project(good, still, good, still).is_ok
    with pytest.raises(ValueError, match="q: quaternion of joint 'root_joint' has length 0, not 1"):
        projector.project(bad, still, good, still)
    jerk = nearl.Projector(panda, [limits[0], nearl.JerkLimit(panda, 100.0)], 1e-3)
    rows = q[None], zero[None], q[None], zero[None]
    assert jerk.project(q, zero, q, zero, previous=(zero, zero)).is_ok
    for call, arrays in (("project_batch", rows), ("vjp_batch", (*rows, zero[None], zero[None])), ("problem", (q, zero, q, zero))):
        with pytest.raises(ValueError, match="needs the tick before, which .* does not have; .*build a projector without it"):
            getattr(jerk, call)(*arrays)


def test_hard_jerk_holds_with_position_velocity_and_acceleration():
    """The robot is where the target says; each proposal asks for thrice the largest speed, to and fro."""
    panda = nearl.Model.from_urdf("examples/robots/panda/panda.urdf")
    limits = [nearl.PositionLimit(panda), nearl.VelocityLimit(panda), nearl.AccelerationLimit(panda, 10.0), nearl.JerkLimit(panda, 300.0, hard=True)]
    projector, dt, random = nearl.Projector(panda, limits, 1e-3), 1e-3, np.random.default_rng(1)
    q, v, a = 0.5 * (panda.lower_position_limit + panda.upper_position_limit), np.zeros(7), np.zeros(7)
    side, most = np.ones(7), np.zeros(4)
    for tick in range(3000):
        side = np.where(random.random(7) < 0.004, -side, side)
        wish = 3 * side * panda.velocity_limit
        target = projector.project(q, v, q + dt * wish, wish, previous=(a, np.zeros(7)))
        assert sum(target.ledger.target_violations.values()) == 0, tick
        beyond = np.maximum(target.q - panda.upper_position_limit, panda.lower_position_limit - target.q)
        jerk = np.abs(target.acceleration - a) / dt / 300 - 1
        seen = [beyond, np.abs(target.v) / panda.velocity_limit - 1, np.abs(target.acceleration) / 10 - 1, jerk]
        most = np.maximum(most, [x.max() for x in seen])
        q, v, a = target.q, target.v, target.acceleration
    assert (most < 1e-9).all() and np.abs(v).max() > 0.5, most
    with pytest.raises(ValueError, match="hard and has weights of a soft one; drop hard or soft"):
        nearl.JerkLimit(panda, 300.0, (1.0, 100.0), hard=True)
    with pytest.raises(ValueError, match="hard jerk of .*'panda_joint1'.* has no acceleration limit to brake with"):
        nearl.Projector(panda, [limits[-1]], 1e-3)


@pytest.mark.parametrize("kind", ["frame_speed", "energy"])
def test_a_speed_of_several_joints_that_no_period_takes_off_is_named(kind: str) -> None:
    """The tick was braked, named nothing, and counted as one that began within its limits."""
    panda = robot("panda")
    q, v = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.7]), np.array([1.0, 0, 0, 0, 0, 0, 0])
    most = {"frame_speed": 0.4, "energy": 0.3}[kind]
    limit = nearl.FrameSpeedLimit(panda, "panda_hand", most) if kind == "frame_speed" else nearl.EnergyLimit(panda, most)
    joints = [nearl.PositionLimit(panda), nearl.VelocityLimit(panda), nearl.AccelerationLimit(panda, 10.0)]
    p = nearl.Projector(panda, [*joints, limit], dt=0.004)
    slow, fast = p.project(q, 0.2 * v, q, 0.2 * v), p.project(q, v, q, v)
    assert slow.outside == [] and slow.is_ok
    assert fast.status == "braked" and len(fast.outside) == 1 and not fast.target_breaks, (fast.status, fast.outside)
    assert sum(fast.target_violations.values()) > 0
    assert (np.abs(fast.v) < np.abs(v) + 1e-12).all()


BALL = """<mujoco><worldbody><body><joint name="hinge" range="-1 1" limited="true"/><geom size=".1"/>
<body pos="0 0 1"><joint name="ball" type="ball"/><geom size=".1"/></body></body></worldbody></mujoco>"""


def test_a_ball_joint_that_nothing_holds_is_told() -> None:
    model = nearl.Model.from_mjcf_text(BALL)
    limits = [nearl.VelocityLimit(model, limit=2.0), nearl.AccelerationLimit(model, 10.0)]
    with pytest.warns(UserWarning, match="joint 'ball' moves in three directions at once.*no limit of joints holds it"):
        assert nearl.Projector(model, limits, 0.01).controllable == ["hinge"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        nearl.Projector(model, limits, 0.01, controllable=["hinge"])
    with pytest.raises(ValueError, match="in Python an AccelerationLimit"):
        nearl.Projector(model, [nearl.PositionLimit(model)], 0.01)
