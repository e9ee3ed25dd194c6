"""Prior knowledge that is wrong: an arm that carries a load of which its projector was not told. What is promised, what comes, what helps."""

import numpy as np

import nearl

DT, TICKS = 1e-3, 4000  # [s], control periods
empty = nearl.Model.from_urdf("examples/robots/panda/panda.urdf")


def outside(believed: nearl.Model, true: nearl.Model, margin: float) -> tuple[int, int, float]:
    """Ticks whose target, and whose reached state, is faster than a joint may be, and by how much at most [rad/s].

    Args:
        believed: What the projector and the inverse dynamics know of the arm.
        true: The arm.
        margin: Speed kept below each limit [rad/s].
    """
    limits = [nearl.PositionLimit(believed), nearl.VelocityLimit(believed, margin=margin), nearl.AccelerationLimit(believed, 15.0)]
    projector = nearl.Projector(believed, limits, dt=DT)
    q, v, targets, reached, worst = np.array([0, 0, 0, -1.5, 0, 1.5, 0.0]), np.zeros(7), 0, 0, 0.0
    for tick in range(TICKS):
        wish = 5.0 * np.sin(2.4 * np.arange(1, 8) * (tick // 250))  # careless on purpose [rad/s]
        target = projector.project(q, v, q_proposal=q + DT * wish, v_proposal=wish)
        torque = believed.rnea(q, v, target.acceleration)  # what the believed arm would need [N m]
        v = v + DT * true.aba(q, v, torque)  # what the true one makes of it
        q = true.integrate(q, DT * v)
        excess = [float((np.abs(speed) - true.velocity_limit).max()) for speed in (target.v, v)]
        targets, reached, worst = targets + (excess[0] > 1e-9), reached + (excess[1] > 1e-9), max(worst, excess[1])
    return targets, reached, worst


for mass in (0.1, 0.5):  # [kg]
    loaded = empty.with_payload("panda_hand", mass)
    for knows, believed, margin in (("told", loaded, 0.0), ("not told", empty, 0.0), ("not told, margin 0.05 rad/s", empty, 0.05)):
        targets, reached, worst = outside(believed, loaded, margin)
        print(f"{mass} kg, {knows}: of {TICKS} ticks {targets} targets and {reached} reached states too fast, by {max(worst, 0.0):.3f} rad/s at most")
