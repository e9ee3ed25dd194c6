"""A limit of your own: two joints of a Panda together may not turn further than 1 rad."""

import numpy as np

import nearl

model = nearl.Model.from_urdf("examples/robots/panda/panda.urdf")
together = nearl.RowLimit(model, "shoulder and elbow", {"q.panda_joint1": 1.0, "q.panda_joint3": 1.0}, upper=1.0, braking=2.0)
limits = [nearl.PositionLimit(model), nearl.VelocityLimit(model), nearl.AccelerationLimit(model, 10.0), together]
projector = nearl.Projector(model, limits, dt=1e-3)

q, v = np.array([0, 0, 0, -1.5, 0, 1.5, 0.0]), np.zeros(7)
away = np.array([1, 0, 1, 0, 0, 0, 0.0])
for _ in range(3000):  # three seconds of a robot that reaches every target
    target = projector.project(q, v, q_proposal=q + away, v_proposal=away)
    q, v = target.q, target.v
print(f"joint 1 + joint 3 = {q[0] + q[2]:.4f} rad, allowed 1")
assert q[0] + q[2] <= 1.0 + 1e-9
