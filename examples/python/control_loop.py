"""A robot's control loop: a snapshot file in, torques out. For more than some hundred hertz use the Rust program of the same name."""

import numpy as np

import nearl

controller = nearl.Controller.load("examples/snapshots/panda-reach.safetensors")
q, v = np.array([0, 0, 0, -1.5, 0, 1.5, 0.0]), np.zeros(7)  # [rad], [rad/s]
goal = [0.4, 0.0, 0.5]  # [m]
for tick in range(500):
    hand = [0.1, 0.0, 0.0]  # what this policy observes behind q, v and the goal: the hand's way to the goal [m]
    action, ledger = controller.update(q, v, np.concatenate([q, v, goal, hand]))  # action [N m]: this arm's motors have no gear
    if tick % 100 == 0:
        print(f"tick {tick}: {ledger.status}, torque of joint 2 {action[1]:.2f} N m, its angle {q[1]:.3f} rad")
    q, v = controller.target[:7], controller.target[7:]  # a driver would measure here; this robot reaches every target
