"""Stable-Baselines3's own PPO with VecNormalize on one task: the networks, batch, minibatch and epochs of the figure. Prints the mean return
of the last 100 training episodes, as JSON. Same interpreter as the throughput comparison (`results/throughput/README.md`).

    .peers/bin/python results/first_figure/sb3.py Walker2d-v5 --seed 0
"""

import argparse
import json

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

BATCH, ENVS = 2048, 8

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("task")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--steps", type=int, default=1_000_000)
asked = parser.parse_args()
torch.set_num_threads(1)
env = VecNormalize(make_vec_env(asked.task, ENVS, seed=asked.seed))
nets = {"net_arch": [32, 32], "activation_fn": torch.nn.Tanh}
model = PPO("MlpPolicy", env, n_steps=BATCH // ENVS, batch_size=64, n_epochs=10, seed=asked.seed, device="cpu", policy_kwargs=nets)
model.learn(asked.steps)
last = [episode["r"] for episode in model.ep_info_buffer]
print(json.dumps({"task": asked.task, "seed": asked.seed, "steps": model.num_timesteps, "return": round(float(np.mean(last)), 1), "episodes": len(last)}))
