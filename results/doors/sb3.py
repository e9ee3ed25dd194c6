"""Stable-Baselines3 itself: its policies in a loop, and its learners behind the limits.

    python results/doors/sb3.py policies STEPS > results/doors/sb3_policies.md
    python results/doors/sb3.py learner ppo|sac PLACE STEPS SEED     # a line of sb3_learners.csv
    python results/doors/sb3.py table > results/doors/sb3_learners.md

A PLACE is `pendulum`, `cheetah` or `torque` (of the Panda), each also with `-guard`; `arm` (proposed states, projected) or `arm-raw` (accelerations through
inverse dynamics, without limits). `sb3.sh` runs learners and table. Needs `pip install stable-baselines3==2.9.2 "gymnasium[mujoco]==1.4.0"` beside nearl.
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
    "pendulum": ("InvertedPendulum-v5", {"position": {}, "velocity": {"limit": {"slider": 1.0, "hinge": 2.0}}}),
    "cheetah": (TASK, guarded.LIMITS),
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


PANDA = nearl.Model.from_urdf(EXAMPLES.parent / "robots/panda/panda.urdf")
TICKS, FASTEST = 20, 10.0  # of a policy period; the task's limit on accelerations [rad/s²]


class Held(gymnasium.Wrapper):
    """The arm without limits: an action in [-1, 1] holds for a policy period, as torques or as accelerations of up to the task's limit."""

    def __init__(self, accelerations: bool):
        super().__init__(gymnasium.make("nearl/Panda-reach"))
        self.accelerations, self.most = accelerations, self.env.action_space.high
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, self.most.shape, np.float64)

    def reset(self, **arguments):
        self.obs, info = self.env.reset(**arguments)
        return self.obs, info

    def step(self, action):
        total, action = 0.0, np.asarray(action, float)
        for _ in range(TICKS):
            torque = PANDA.rnea(self.obs[:7], self.obs[7:14], FASTEST * action) if self.accelerations else self.most * action
            self.obs, reward, *over, info = self.env.step(np.clip(torque, -self.most, self.most).astype(np.float32))
            total += float(reward)
            if any(over):
                break
        return self.obs, total, *over, info


class CountArm(gymnasium.Wrapper):
    """Policy periods of the arm that end outside the task's positions or speeds; of its control ticks, those whose proposal and whose target broke a limit."""

    def __init__(self, env: gymnasium.Env, projects: bool):
        super().__init__(env)
        self.steps = self.outside = 0
        self.raw = self.targets = 0 if projects else ""
        self.low, self.high = np.array(PANDA.lower_position_limit) + 0.01, np.array(PANDA.upper_position_limit) - 0.01
        self.speed = 0.9 * np.array(PANDA.velocity_limit)

    def step(self, action):
        obs, *rest, info = self.env.step(action)
        q, v = obs[:7], obs[7:14]
        beyond = (q < self.low - 1e-6) | (q > self.high + 1e-6) | (np.abs(v) > self.speed + 1e-6)
        self.steps, self.outside = self.steps + 1, self.outside + bool(beyond.any())
        if self.raw != "":
            self.raw, self.targets = self.raw + int(info["raw_violations"]), self.targets + int(info["target_violations"])
        return obs, *rest, info


ARMS = {
    "arm": ("states, projected", lambda: guarded.make("arm")),
    "arm-raw": ("accelerations", lambda: Held(accelerations=True)),
    "torque": ("torques", lambda: Held(accelerations=False)),
    "torque-guard": (
        "torques, guarded",
        lambda: gymnasium.wrappers.RescaleAction(gymnasium.make("nearl/Panda-reach", constraints="task", actions="guarded"), -1.0, 1.0),
    ),
}


def learner(name: str, place: str, steps: int, seed: int) -> None:
    """A line of sb3_learners.csv: one learner, one place, one seed."""

    def make() -> gymnasium.Env:
        if place in ARMS:
            return CountArm(ARMS[place][1](), projects=place in ("arm", "torque-guard"))
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
    asked, targets = getattr(env, "raw", ""), getattr(env, "targets", "")
    seen = [env.outside, env.steps, asked, probe.outside, probe.steps, f"{before:.1f}", f"{after:.1f}", f"{seconds:.0f}", targets]
    print(name, place, steps, seed, *seen, sep=",", flush=True)


def table() -> None:
    """sb3_learners.csv as a table: shares of all seeds together, returns of their mean, of the worst and of the best."""
    rows = list(csv.DictReader((Path(__file__).parent / "sb3_learners.csv").open()))
    shares = "outside while learning [%] | without noise [%]"
    print(f"| environment | learner | steps | seeds | {shares} | targets outside | return before | after | worst | best | steps/s |")
    print("|---" * 12 + "|")
    places = [*(name + behind for name in LIMITED for behind in ("", "-guard")), *ARMS]
    keys = {(row["learner"], row["place"], row["steps"]) for row in rows}
    for name, place, steps in sorted(keys, key=lambda key: (places.index(key[1]), key[0], int(key[2]))):
        of = [row for row in rows if (row["learner"], row["place"], row["steps"]) == (name, place, steps)]
        bare = place.removesuffix("-guard")
        where = f"Panda-reach, {ARMS[place][0]}" if place in ARMS else LIMITED[bare][0] + (", `nearl.Guard`" if bare != place else "")
        total = {key: sum(float(row[key] or 0) for row in of) for key in of[0] if key not in ("learner", "place")}
        outside = [f"{100 * total[n] / total[k]:.2f}" for n, k in (("outside", "ticks"), ("probe_outside", "probe_ticks"))]
        targets = f"{total['targets']:.0f}" if of[0]["targets"] else "-"
        after = [float(row["after"]) for row in of]
        means = [f"{x:.1f}" for x in (total["before"] / len(of), np.mean(after), min(after), max(after))]
        print(f"| {' | '.join([where, name.upper(), steps, str(len(of)), *outside, targets, *means])} | {total['steps'] / total['seconds']:.0f} |")


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
