"""Gymnasium's own HalfCheetah as the robot of a loop, and what its episodes earn under a snapshot.

    python examples/python/gymnasium_plant.py policy.safetensors 0 1 2      # an episode for each seed of its start

The loop runs on threads of this process; in another terminal it would be `nearl run policy.safetensors --plant cheetah`. Without a snapshot
an untrained policy plays.
"""

import os
import sys
import tempfile

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
    robot = nearl.Plant(name, JOINTS, OBSERVATION, dt=0.05, nu=6, watchdog=5.0, lockstep=True)
    with robot as plant, nearl.Loop(snapshot, name, patience=30.0, ramp=0.0) as loop:
        for episode, seed in enumerate(seeds):
            obs, over, total, begins = env.reset(seed=seed)[0], False, 0.0, True
            while not over:
                patience = 30.0 if plant.attached else 0.2  # a loop that comes later waits for the next state
                turn, action = plant.exchange(data.qpos, data.qvel, obs, patience, episode=episode, begins=begins)
                if turn == "brake" and not plant.attached and loop.running:
                    continue  # it is not there yet
                if turn != "act":
                    raise RuntimeError(f"the loop said '{turn}' in the middle of episode {episode}")
                obs, reward, terminated, truncated, _ = env.step(np.clip(action, low, high).astype(np.float32))
                total, begins, over = total + float(reward), False, terminated or truncated
            returns.append(total)
    return returns


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        snapshot, seeds = (sys.argv[1], sys.argv[2:]) if len(sys.argv) > 1 else (f"{folder}/untrained.safetensors", ["0"])
        if len(sys.argv) == 1:
            nearl.PID2("HalfCheetah-v5", "ppo").save(snapshot)
        for seed, value in zip(seeds, play(snapshot, [int(seed) for seed in seeds], f"cheetah{os.getpid()}")):
            print(f"seed {seed}: return {value:.4f}")
