"""Projection problems of three robots in closed loop at 1 ms with torque rows: arm7.bin, quad12.bin, hum29.bin in the folder given.

Each file: dofs n and count N as uint64; per problem, as float64: proposal, box (lower, upper), rows A (n x n), their bounds
(lower, upper), and the optimum x of min |x - proposal|^2 by quadprog.
"""

import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import quadprog

ROBOTS = Path(sys.prefix) / "lib/python3.11/site-packages/cmeel.prefix/share/example-robot-data/robots"
PERIOD, COUNT = 1e-3, 2000


def velocity_box(q, v, lower, upper, v_max, a_max):
    """Velocities from which braking at a_max stays inside, reached within a_max."""
    step = a_max * PERIOD
    stop = lambda room: np.sqrt(step**2 + 2 * a_max * np.maximum(room, 0)) - step  # noqa: E731
    low = np.maximum.reduce([-v_max, v - step, (lower - q) / PERIOD, -stop(q - lower)])
    high = np.minimum.reduce([v_max, v + step, (upper - q) / PERIOD, stop(upper - q)])
    empty = low > high
    low[empty] = np.minimum(low, v - step)[empty]
    high[empty] = np.maximum(high, low + 1e-6)[empty]
    return low, high


def write(folder, name, urdf, locked, a_max, effort, seed=0):
    model = pin.buildModelFromUrdf(str(ROBOTS / urdf))
    if locked:
        model = pin.buildReducedModel(model, [model.getJointId(j) for j in locked], pin.neutral(model))
    data, n, rng = model.createData(), model.nv, np.random.default_rng(seed)
    lower, upper = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
    v_max, tau = model.upperVelocityLimit.copy(), model.upperEffortLimit * effort
    free = ~np.isfinite(lower) | (lower < -10) | (upper > 10)
    lower[free], upper[free] = -3, 3
    q, v, t, records, tries = (lower + upper) / 2, np.zeros(n), 0.0, [], 0
    phase, rate, size = rng.uniform(0, 6.28, n), rng.uniform(0.5, 4, n), rng.uniform(0.3, 1.6, n) * v_max
    while len(records) < COUNT:
        t += PERIOD
        proposal = size * np.sin(2 * np.pi * rate * t + phase) + rng.normal(size=n) * 0.002 * v_max
        if tries % 400 == 399:
            size, rate = rng.uniform(0.1, 1.6, n) * v_max, rng.uniform(0.5, 6, n)
        tries += 1
        mass = np.triu(pin.crba(model, data, q))
        mass = mass + np.triu(mass, 1).T
        nle = pin.nonLinearEffects(model, data, q, v)
        low, high = velocity_box(q, v, lower, upper, v_max, np.full(n, float(a_max)))
        rows = mass / (PERIOD * tau)[:, None]
        still = rows @ v - nle / tau
        gradients = np.vstack([np.eye(n), -np.eye(n), rows, -rows]).T
        bounds = np.concatenate([low, -high, still - 1, -still - 1])
        try:
            x = quadprog.solve_qp(np.eye(n), proposal, gradients, bounds, 0)[0]
        except ValueError:  # no velocity obeys everything: start elsewhere, at rest
            q, v = lower + (upper - lower) * rng.uniform(0.2, 0.8, n), np.zeros(n)
            continue
        records.append(np.concatenate([proposal, low, high, rows.ravel(), still - 1, still + 1, x]))
        q, v = q + x * PERIOD, x
    head = np.array([n, COUNT], dtype=np.uint64).tobytes()
    (folder / f"{name}.bin").write_bytes(head + np.concatenate(records).tobytes())


if __name__ == "__main__":
    out = Path(sys.argv[1])
    write(out, "arm7", "panda_description/urdf/panda.urdf", ["panda_finger_joint1", "panda_finger_joint2"], 60, 0.5)
    write(out, "quad12", "go2_description/urdf/go2.urdf", [], 400, 0.6)
    write(out, "hum29", "g1_description/urdf/g1_29dof_rev_1_0.urdf", [], 400, 0.5)
