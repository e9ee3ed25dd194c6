"""SAC of Stable-Baselines3, with its own settings, behind the same limits on actions: rows of `sac.csv`.

    .peers/bin/python results/action_constraints/sac.py [--sets HC+O,HC+rate] [--seed 0] [--steps 200000]

Limits are kept by `actions="limited"` of the environment, in training and after it. Ten episodes without noise are held against the formula here, with the
velocities of the simulator. A row that is there already for set, seed and steps is written anew.
"""

import argparse
import csv
import runpy
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from stable_baselines3 import SAC

import nearl

ROOT = Path(__file__).parents[2]
CSV = Path(__file__).with_name("sac.csv")
excess = runpy.run_path(str(Path(__file__).with_name("table.py")))["excess"]
# task and limit of each
SETS = {name: (task, limit) for name, task, limit in map(str.split, Path(__file__).with_name("sets.txt").read_text().splitlines())}


def environment(name: str, folder: Path) -> nearl.ProjectedEnv:
    task, limits = SETS[name]
    file = folder / f"{task}.toml"
    file.write_text((ROOT / "examples" / "tasks" / f"{task}.toml").read_text() + f"\n[constraints.action]\n{limits}\n")
    return nearl.ProjectedEnv(file, "task", "limited")


def episode(model: SAC, env: nearl.ProjectedEnv, name: str, seed: int) -> tuple[float, np.ndarray]:
    """Return of an episode without noise, and how far each of its steps is outside the set."""
    obs, _ = env.reset(seed=seed)
    total, ended, actions, velocities = 0.0, False, [], []
    while not ended:
        velocities.append(env.native.qvel[0, -env.action_space.shape[0] :])
        obs, reward, terminated, truncated, info = env.step(model.predict(obs, deterministic=True)[0])
        actions.append(info["executed"])
        total, ended = total + reward, terminated or truncated
    return total, excess(name, np.array(actions), np.array(velocities))


def run(name: str, seed: int, steps: int) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        env = environment(name, Path(folder))
        model = SAC("MlpPolicy", env, seed=seed, device="cpu")
        began = time.perf_counter()
        model.learn(steps)
        seconds = time.perf_counter() - began
        done = [episode(model, env, name, seed + 1000 + k) for k in range(10)]
    over = np.concatenate([o for _, o in done])
    row = {"set": name, "task": SETS[name][0], "seed": seed, "trained_steps": steps, "seconds": f"{seconds:.0f}"}
    row |= {"without_noise": f"{np.mean([r for r, _ in done]):.5g}", "steps": len(over), "largest_excess": f"{over.max():.3g}"}
    return row | {"steps_beyond_1e-9": int((over > 1e-9).sum()), "steps_on_the_limit": int((over > -1e-6).sum())}


def keep(row: dict) -> None:
    key = lambda r: (r["set"], int(r["seed"]), int(r["trained_steps"]))  # noqa: E731
    rows = []
    if CSV.exists():
        with open(CSV, newline="") as f:
            rows = [r for r in csv.DictReader(f) if key(r) != key(row)]
    with open(CSV, "w", newline="") as f:
        writer = csv.DictWriter(f, list(row), lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted([*rows, row], key=key))


if __name__ == "__main__":
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--sets", default=",".join(SETS))
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--steps", type=int, default=200_000)
    a = p.parse_args()
    torch.set_num_threads(1)
    for chosen in a.sets.split(","):
        found = run(chosen, a.seed, a.steps)
        print(found, flush=True)
        keep(found)
