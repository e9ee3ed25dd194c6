"""Gymnasium's own HalfCheetah as the robot of a loop: a plant of thirty lines, and what its episodes earned under a snapshot.

    python examples/python/gymnasium_plant.py policy.safetensors 0 1 2

Plays one episode for each seed of the start. The loop is `nearl run` on threads of this process; in another terminal it would be
`nearl run policy.safetensors --plant cheetah`.
"""

import sys

import gymnasium
import numpy as np

import nearl

JOINTS = ["rootx", "rootz", "rooty", "bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]
OBSERVATION = [f"q.{joint}" for joint in JOINTS[1:]] + [f"v.{joint}" for joint in JOINTS]


def play(snapshot: str, seeds: list[int], name: str = "cheetah") -> list[float]:
    """Returns of an episode for each seed, by Gymnasium's rewards."""
    env = gymnasium.make("HalfCheetah-v5")
    data, low, high = env.unwrapped.data, env.action_space.low, env.action_space.high
    returns: list[float] = []
    with nearl.Plant(name, JOINTS, OBSERVATION, dt=0.05, nu=6, watchdog=5.0, lockstep=True) as plant, nearl.Loop(snapshot, name, patience=30.0, ramp=0.0):
        for episode, seed in enumerate(seeds):
            obs, over, total, begins = env.reset(seed=seed)[0], False, 0.0, True
            while not over:
                turn, action = plant.exchange(data.qpos, data.qvel, obs, patience=30.0, episode=episode, begins=begins)
                if turn != "act":
                    if begins:
                        continue  # the loop is not there yet
                    raise RuntimeError(f"the loop said '{turn}' in the middle of episode {episode}")
                obs, reward, terminated, truncated, _ = env.step(np.clip(action, low, high).astype(np.float32))
                total, begins, over = total + float(reward), False, terminated or truncated
            returns.append(total)
    return returns


if __name__ == "__main__":
    for seed, value in zip(sys.argv[2:], play(sys.argv[1], [int(seed) for seed in sys.argv[2:]])):
        print(f"seed {seed}: return {value:.4f}")
