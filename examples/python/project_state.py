"""Project one proposed state of a Panda, and say which limits held it back."""

import numpy as np

import nearl

model = nearl.Model.from_urdf("examples/robots/panda/panda.urdf")
limits = [nearl.PositionLimit(model), nearl.VelocityLimit(model), nearl.AccelerationLimit(model, 10.0), nearl.TorqueLimit(model)]
projector = nearl.Projector(model, limits, dt=1e-3)

q, v = np.array([0, 0, 0, -1.5, 0, 1.5, 0]), np.zeros(7)  # [rad], [rad/s]
target = projector.project(q, v, q_proposal=q + 0.1, v_proposal=v)
print(target.status, "moved by", round(target.moved, 3))
for row in target.active:
    print(f"{row['name']}: {row['kind']} ({row['side']}), multiplier {row['multiplier']:.3g}")
