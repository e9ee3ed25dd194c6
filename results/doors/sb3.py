"""Stable-Baselines3 itself: its policies in a loop, and its learners behind the limits.

    python results/doors/sb3.py policies STEPS > results/doors/sb3_policies.md
    python results/doors/sb3.py learner ppo|sac PLACE STEPS SEED     # a line of sb3_learners.csv
    python results/doors/sb3.py table > results/doors/sb3_learners.md

A PLACE is `pendulum`, `cheetah`, either with `-guard` behind it, or `arm`. `sb3.sh` runs learners and table. Needs
`pip install stable-baselines3==2.9.2 "gymnasium[mujoco]==1.4.0"` beside nearl.
"""

import csv
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
EPISODES = [100, 101, 102]
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
        act = lambda obs: model.predict(seen(obs), deterministic=True)[0]  # noqa: B023, E731
        controller = nearl.import_sb3(model, env if on_policy else None, task=TASK)
        rng = np.random.default_rng(0)
        worst = max(float(np.abs(act(obs) - controller.act(obs)).max()) for obs in 2 * rng.normal(size=(500, 17)))
        with tempfile.TemporaryDirectory() as folder:
            snapshot = f"{folder}/policy.safetensors"
            controller.save(snapshot)
            here, there = returns(gymnasium.make(TASK), act), plant.play(snapshot, SEEDS, f"sb3{name}")
        log(here, there)
        furthest = max(abs(a - b) for a, b in zip(here, there))
        kind = f"{name}, VecNormalize" if on_policy else name
        print(f"| {kind} | {of} | {worst:.0e} | {np.mean(here):.3f} | {np.mean(there):.3f} | {furthest:.0e} |", flush=True)


# Of the places below: the environment and its limits. Random actions leave the pendulum's in a quarter of the ticks.
LIMITED = {
    "cheetah": (TASK, guarded.LIMITS),
    "pendulum": ("InvertedPendulum-v5", {"position": {}, "velocity": {"limit": {"slider": 1.0, "hinge": 2.0}}}),
}


class Count(gymnasium.Wrapper):
    """Steps, and those after which the simulator's own state is outside the limits, by the robot file's ranges and nobody's words."""

    def __init__(self, env: gymnasium.Env, limits: dict):
        super().__init__(env)
        self.steps = self.outside = 0
        model, speed = env.unwrapped.model, limits["velocity"]["limit"]
        ranged = model.jnt_limited.astype(bool)
        self.q, self.v = model.jnt_qposadr[ranged], model.jnt_dofadr[ranged]
        self.low, self.high = model.jnt_range[ranged].T
        names = [model.joint(i).name for i in np.flatnonzero(ranged)]
        self.speed = np.array([speed[name] if isinstance(speed, dict) else speed for name in names])

    def step(self, action):
        result = self.env.step(action)
        data = self.env.unwrapped.data
        q, v = data.qpos[self.q], data.qvel[self.v]
        beyond = (q < self.low - 1e-9) | (q > self.high + 1e-9) | (np.abs(v) > self.speed + 1e-9)
        self.steps, self.outside = self.steps + 1, self.outside + bool(beyond.any())
        return result


class CountArm(gymnasium.Wrapper):
    """Control ticks of the projected arm whose raw proposal and whose target broke a limit, and states outside, by the URDF's numbers and the task's shares."""

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


def learner(name: str, place: str, steps: int, seed: int) -> None:
    """A line of sb3_learners.csv: one learner, one place, one seed."""

    def make() -> gymnasium.Env:
        if place == "arm":
            return CountArm(guarded.make("arm"))
        task, limits = LIMITED[place.removesuffix("-guard")]
        env = gymnasium.make(task)
        return Count(nearl.Guard(env, limits) if place.endswith("-guard") else env, limits)

    def act(obs):
        return model.predict(obs, deterministic=True)[0]

    env = make()
    settings = {"n_steps": 512} if name == "ppo" else {}
    model = {"ppo": sb3.PPO, "sac": sb3.SAC}[name]("MlpPolicy", env, seed=seed, device="cpu", **settings)
    before, start = np.mean(returns(make(), act, EPISODES)), time.perf_counter()
    model.learn(steps)
    seconds = time.perf_counter() - start
    probe = make()
    after = np.mean(returns(probe, act, EPISODES))
    asked = getattr(env, "raw", "")
    print(f"{name},{place},{steps},{seed},{env.outside},{env.steps},{asked},{probe.outside},{probe.steps},{before:.1f},{after:.1f},{seconds:.0f}", flush=True)


def table() -> None:
    """sb3_learners.csv as a table: each figure of every seed."""
    rows = list(csv.DictReader((Path(__file__).parent / "sb3_learners.csv").open()))
    print("| learner | environment | steps | ticks outside while learning [%] | outside without noise [%] | return before | return after |")
    print("|---|---|---|---|---|---|---|")
    for key in dict.fromkeys((row["learner"], row["place"], row["steps"]) for row in rows):
        of = sorted((row for row in rows if (row["learner"], row["place"], row["steps"]) == key), key=lambda row: int(row["seed"]))
        bare = key[1].removesuffix("-guard")
        where = 'Panda-reach, `constraints="task"`' if bare == "arm" else LIMITED[bare][0] + (", `nearl.Guard`" if bare != key[1] else "")
        shares = [", ".join(f"{100 * int(row[n]) / int(row[k]):.1f}" for row in of) for n, k in (("outside", "ticks"), ("probe_outside", "probe_ticks"))]
        means = [", ".join(row[name] for row in of) for name in ("before", "after")]
        print(f"| {' | '.join([key[0].upper(), where, key[2], *shares, *means])} |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    match sys.argv[1:]:
        case ["policies", steps]:
            policies(int(steps))
        case ["learner", name, place, steps, seed]:
            learner(name, place, int(steps), int(seed))
        case ["table"]:
            table()
        case _:
            sys.exit(__doc__)
