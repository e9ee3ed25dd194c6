"""Stable-Baselines3, printing `{"steps": ..., "return": ...}` on its way: the return is the mean of its last hundred episodes in training.

    .peers/bin/python results/time_to_return/peer.py sb3-ppo Hopper-v5 --steps 1000000 --settings '{"batch": 2048, ...}'
"""

import argparse
import json

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

ENVS = 8


class Teller(BaseCallback):
    def _on_step(self) -> bool:
        if self.n_calls % 256 == 0:
            returns = [e["r"] for e in self.model.ep_info_buffer]
            print(json.dumps({"steps": self.num_timesteps, "return": float(np.mean(returns)) if returns else None}), flush=True)
        return True


def sb3(system: str, task: str, seed: int, steps: int, s: dict) -> None:
    """Its PPO with VecNormalize and our settings, or its SAC with its own."""
    if system == "sb3-sac":
        model = SAC("MlpPolicy", make_vec_env(task, 1, seed=seed), seed=seed, device="cpu")
    else:
        torch.set_num_threads(1)
        nets = {"net_arch": s["nets"], "activation_fn": torch.nn.Tanh, "log_std_init": s["log_std"]}
        fixed = {"n_steps": s["batch"] // ENVS, "batch_size": s["minibatch"], "n_epochs": 10, "gae_lambda": s["gae_lambda"], "policy_kwargs": nets}
        falling = {"learning_rate": lambda left: s["lr"] * left, "target_kl": s["target_kl"] or None}
        model = PPO("MlpPolicy", VecNormalize(make_vec_env(task, ENVS, seed=seed)), seed=seed, device="cpu", **fixed, **falling)
    model.learn(steps, callback=Teller())


if __name__ == "__main__":
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("system", choices=["sb3-ppo", "sb3-sac"])
    p.add_argument("task")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--steps", type=int, default=1_000_000)
    p.add_argument("--settings", type=json.loads, required=True)
    a = p.parse_args()
    sb3(a.system, a.task, a.seed, a.steps, a.settings)
