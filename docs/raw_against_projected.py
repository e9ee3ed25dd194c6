"""The picture of the README: one joint of the Panda under a careless proposal, raw and projected.

    .venv/bin/python docs/raw_against_projected.py
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import nearl

ROOT = Path(__file__).parent.parent
DT, TICKS, JOINT = 1e-3, 6000, 3
A_MAX = 10.0

model = nearl.Model.from_urdf(str(ROOT / "examples/robots/panda/panda.urdf"))
limits = [
    nearl.PositionLimit(model),
    nearl.VelocityLimit(model),
    nearl.AccelerationLimit(model, A_MAX),
    nearl.TorqueLimit(model),
]
projector = nearl.Projector(model, limits, dt=DT)
lower, upper = np.array(model.lower_position_limit), np.array(model.upper_position_limit)
q = (lower + upper) / 2
v = np.zeros(model.nv)
t = np.arange(TICKS) * DT
raw_q = q[JOINT] + 2.2 * np.sin(2 * np.pi * 0.3 * t) * (1 + 0.02 * np.sin(2 * np.pi * 7 * t))
raw_v = np.gradient(raw_q, DT)
rows = []
for k in range(TICKS):
    q_hat, v_hat = q.copy(), np.zeros(model.nv)
    q_hat[JOINT], v_hat[JOINT] = raw_q[k], raw_v[k]
    target = projector.project(q, v, q_hat, v_hat)
    rows.append((target.q[JOINT], target.v[JOINT], (target.v[JOINT] - v[JOINT]) / DT))
    q, v = np.array(target.q), np.array(target.v)
rows = np.array(rows)

figure, axes = plt.subplots(1, 3, figsize=(11, 2.9), constrained_layout=True)
series = [
    ("position [rad]", raw_q, rows[:, 0], (lower[JOINT], upper[JOINT])),
    ("velocity [rad/s]", raw_v, rows[:, 1], np.array([-1, 1]) * model.velocity_limit[JOINT]),
    ("acceleration [rad/s²]", np.gradient(raw_v, DT), rows[:, 2], (-A_MAX, A_MAX)),
]
for axis, (name, raw, projected, bounds) in zip(axes, series):
    axis.plot(t, raw, color="0.65", label="proposed")
    axis.plot(t, projected, color="#0b6e99", linewidth=1.8, label="projected")
    for b in bounds:
        axis.axhline(b, color="#c0392b", linestyle="--", linewidth=1)
    axis.set_title(name, fontsize=10)
    axis.set_xlabel("time [s]")
    axis.set_ylim(1.6 * min(bounds[0], projected.min()), 1.6 * max(bounds[1], projected.max()))
    axis.spines[["top", "right"]].set_visible(False)
axes[0].set_ylim(lower[JOINT] - 1.2, upper[JOINT] + 1.2)
axes[0].legend(frameon=False, fontsize=9)
figure.savefig(ROOT / "docs/raw_against_projected.png", dpi=130)
