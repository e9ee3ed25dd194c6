"""Imitate: from recorded positions, without a motor command, to a policy. Somebody balances a pole; PID²-IL learns it from five recordings."""

import sys

import numpy as np

import nearl
from nearl import demos

TASK = "examples/tasks/cart-pole.toml"
folder = sys.argv[1] if len(sys.argv) > 1 else "runs"

# The recording: by hand-made gains here, in place of yours. What is kept is where slider [m] and hinge [rad] were, at 50 Hz.
env, episodes = nearl.Env(TASK), []
for seed in range(5):
    (x, s, c, v, w), _ = env.reset(seed=seed)
    rows = []
    for _ in range(250):
        rows.append([x, np.arctan2(s, c)])
        (x, s, c, v, w), *_ = env.step([np.clip(0.3 * x + 0.5 * v + 5 * rows[-1][1] + w, -1, 1)])
    positions = np.array(rows)  # (250, 2)
    episodes.append({"q.slider": positions[:, 0], "q.hinge": positions[:, 1]})
file = f"{folder}/pole.npz"
demos.from_columns(TASK, episodes, file, dt=0.02, overwrite=True)

agent = nearl.PID2(TASK, "pid2-il", seed=0, demos=file).learn(40_000)
(obs, _), over, periods, state = env.reset(seed=100), False, 0, None
while not over:
    action, state = agent.predict(obs, state)
    obs, _, terminated, truncated, _ = env.step(action)
    over, periods = terminated or truncated or periods == 499, periods + 1
print(f"the pole stood for {periods} periods of 500")
