"""Stable-Baselines3 itself: its policies in a loop, and its learners behind the limits.

    python results/doors/sb3.py policies STEPS > results/doors/sb3_policies.md
    python results/doors/sb3.py learners PPO_STEPS SAC_STEPS > results/doors/sb3_learners.md

Needs `pip install stable-baselines3==2.9.2 "gymnasium[mujoco]==1.4.0"` beside nearl.
One seed and few steps: what is measured is whether policies come over whole and whether
limits hold, not how well SB3 learns.
"""

import importlib.util
import sys
import tempfile
import time
from pathlib import Path

import gymnasium
import numpy as np
import stable_baselines3 as sb3
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import nearl

TASK = "HalfCheetah-v5"
SEEDS = [0]
EXAMPLES = Path(__file__).parents[2] / "examples/python"


def load(name: str):
    """A module of the examples."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


guarded, plant = load("sb3_guarded"), load("gymnasium_plant")


def log(*words: object) -> None:
    print(time.strftime("%H:%M:%S"), *words, file=sys.stderr, flush=True)


def returns(env: gymnasium.Env, act, seeds=SEEDS) -> list[float]:
    """Of an episode for each seed."""
    found = []
    for seed in seeds:
        obs, over, total = env.reset(seed=seed)[0], False, 0.0
        while not over:
            obs, reward, terminated, truncated, _ = env.step(act(obs))
            total, over = total + float(reward), terminated or truncated
        found.append(total)
    return found


def policies(steps: int) -> None:
    """Every kind of policy that import_sb3 reads: the numbers of SB3 beside those of a loop on the same environment of Gymnasium's."""
    print("| model | steps | largest difference of an action, 500 observations | return in SB3 | in the loop | largest difference of an episode's return |")
    print("|---|---|---|---|---|---|")
    off = {"learning_starts": 500, "buffer_size": 20_000}
    kinds = {"PPO": {"n_steps": 512}, "A2C": {}, "SAC": off, "TD3": off, "DDPG": off}
    for name, arguments in kinds.items():
        on_policy = name in ("PPO", "A2C")
        env = VecNormalize(make_vec_env(f"nearl:nearl/{TASK}", n_envs=4, seed=0)) if on_policy else make_vec_env(f"nearl:nearl/{TASK}", n_envs=4, seed=0)
        of = steps if on_policy else steps // 20
        log(name, of)
        model = getattr(sb3, name)("MlpPolicy", env, seed=0, device="cpu", **arguments).learn(of)
        seen = env.normalize_obs if on_policy else lambda obs: obs
        act = lambda obs: model.predict(seen(obs), deterministic=True)[0]  # noqa: B023
        controller = nearl.import_sb3(model, env if on_policy else None, task=TASK)
        rng = np.random.default_rng(0)
        worst = max(float(np.abs(act(obs) - controller.act(obs)).max()) for obs in 2 * rng.normal(size=(500, 17)))
        with tempfile.TemporaryDirectory() as folder:
            snapshot = f"{folder}/policy.safetensors"
            controller.save(snapshot)
            here, there = returns(gymnasium.make(TASK), act), plant.play(snapshot, SEEDS, f"sb3{name}")
        log(here, there)
        furthest = max(abs(a - b) for a, b in zip(here, there))
        row = f"{name}{', VecNormalize' if on_policy else ''}"
        print(f"| {row} | {of} | {worst:.0e} | {np.mean(here):.3f} | {np.mean(there):.3f} | {furthest:.0e} |", flush=True)


class Count(gymnasium.Wrapper):
    """Steps, and those after which the simulator's own state is outside the limits, by the robot file's ranges and nobody's words."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.steps = self.outside = 0
        model = env.unwrapped.model
        ranged = model.jnt_limited.astype(bool)
        self.q, self.v = model.jnt_qposadr[ranged], model.jnt_dofadr[ranged]
        self.low, self.high = model.jnt_range[ranged].T

    def step(self, action):
        result = self.env.step(action)
        data = self.env.unwrapped.data
        q, v = data.qpos[self.q], data.qvel[self.v]
        beyond = (q < self.low - 1e-9) | (q > self.high + 1e-9) | (np.abs(v) > guarded.LIMITS["velocity"]["limit"] + 1e-9)
        self.steps, self.outside = self.steps + 1, self.outside + bool(beyond.any())
        return result


class CountArm(gymnasium.Wrapper):
    """Control ticks of the projected arm whose raw proposal and whose target broke a limit, and states
    outside: by the URDF's numbers and the task's shares of them."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.steps = self.raw = self.outside = 0
        model = nearl.Model.from_urdf(EXAMPLES.parent / "robots/panda/panda.urdf")
        self.low, self.high = np.array(model.lower_position_limit) + 0.01, np.array(model.upper_position_limit) - 0.01
        self.speed = 0.9 * np.array(model.velocity_limit)

    def step(self, action):
        obs, *rest, info = self.env.step(action)
        q, v = obs[:7], obs[7:14]
        beyond = (q < self.low - 1e-6) | (q > self.high + 1e-6) | (np.abs(v) > self.speed + 1e-6)
        self.steps, self.raw = self.steps + 1, self.raw + int(info["raw_violations"])
        self.outside += int(info["target_violations"]) + bool(beyond.any())
        return obs, *rest, info


def learners(ppo_steps: int, sac_steps: int) -> None:
    """PPO and SAC on the cheetah without and behind nearl.Guard, and on the arm behind the projection."""
    print("| learner | environment | steps | seconds | ticks outside while learning | outside in an episode without noise | return before | after |")
    print("|---|---|---|---|---|---|---|---|")
    cheetah = lambda: gymnasium.make(TASK)  # noqa: E731
    environments = {
        f"{TASK}": lambda: Count(cheetah()),
        f"{TASK}, `nearl.Guard`": lambda: Count(nearl.Guard(cheetah(), guarded.LIMITS)),
        "Panda-reach, `constraints=\"task\"`": lambda: CountArm(guarded.make("arm")),
    }
    for name, steps in (("PPO", ppo_steps), ("SAC", sac_steps)):
        for where, make in environments.items():
            env, of = make(), steps // 4 if "arm" in where or "Panda" in where else steps
            log(name, where, of)
            model = getattr(sb3, name)("MlpPolicy", env, seed=0, device="cpu")
            act = lambda obs: model.predict(obs, deterministic=True)[0]  # noqa: B023
            before, start = np.mean(returns(make(), act)), time.perf_counter()
            model.learn(of)
            seconds = time.perf_counter() - start
            probe = make()
            after = np.mean(returns(probe, act))
            share = lambda c: f"{c.outside} of {c.steps}"  # noqa: E731
            asked = f" ({env.raw} ticks asked for)" if hasattr(env, "raw") else ""
            print(f"| {name} | {where} | {of} | {seconds:.0f} | {share(env)}{asked} | {share(probe)} | {before:.1f} | {after:.1f} |", flush=True)
            log(before, after)


if __name__ == "__main__":
    torch.set_num_threads(1)
    if sys.argv[1] == "policies":
        policies(int(sys.argv[2]))
    else:
        learners(int(sys.argv[2]), int(sys.argv[3]))
