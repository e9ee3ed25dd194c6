"""A task as a Gymnasium environment, and one whose action is a proposed state that is projected inside."""

import gymnasium
import numpy as np

import nearl

env = gymnasium.make("nearl/HalfCheetah-v5")
obs, _ = env.reset(seed=0)
env.action_space.seed(0)
total = 0.0
for _ in range(100):
    obs, reward, terminated, truncated, _ = env.step(env.action_space.sample())
    total += float(reward)
print(f"HalfCheetah, random torques: return of 100 steps {total:.1f}")

arms = nearl.make_vec("Panda-reach", 4, constraints="task")
arms.reset(seed=0)
rng, raw = np.random.default_rng(0), 0
for _ in range(50):
    proposals = rng.normal(0.0, 2.0, arms.action_space.shape)  # careless on purpose
    *_, info = arms.step(proposals)
    raw += int(info["raw_violations"].sum())
    assert not info["target_violations"].any()
print(f"Panda: {raw} proposals outside the limits, 0 targets")
