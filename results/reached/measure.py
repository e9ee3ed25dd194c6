"""Reached states outside the limits, without and with the simulator's guard, beside the share that no sampled action avoids.

    python results/reached/measure.py TASK SNAPSHOT TICKS [MARGIN] >> results/reached/reached.csv

With MARGIN [rad] the guard keeps that distance from the joints' stops, and what is counted are still the limits of the task file, and the joints' ranges where
it has none. Three lines: no guard, the guard, and where that finds no action inside in some ticks the guard that leaves the policy's action there.

The policy runs without noise in Gymnasium's own environment; limits are those of the task file.
"""

import pathlib
import sys
import time
import tomllib

import gymnasium
import numpy as np

import nearl

TASKS = pathlib.Path(__file__).parents[2] / "examples/tasks"
SAMPLES = 400


def limits(task: str, margin: float | None) -> dict:
    """Position margin and velocity limits of the task file, as `nearl.Guard` takes them."""
    given = tomllib.loads((TASKS / f"{task}.toml").read_text())["constraints"]
    found = {name: given[name] for name in ("position", "velocity") if name in given}
    return found if margin is None else {"position": {}, **found}


def ends_outside(guard: nearl.Guard, action: np.ndarray) -> bool:
    return guard._search.excess(guard._foresee(np.asarray(action, float)).tolist()) > 0.0


def avoidable(guard: nearl.Guard, action: np.ndarray, rng: np.random.Generator) -> bool:
    """Whether one of the sampled actions (near the chosen one, anywhere, at the corners) ends inside."""
    for k in range(SAMPLES):
        draw = rng.uniform(-1.0, 1.0, len(action))
        sample = (np.clip(action + draw**3, -1, 1), draw, np.clip(action + 0.3 * rng.normal(size=len(action)), -1, 1), np.sign(draw))[k % 4]
        if not ends_outside(guard, sample):
            return True
    return False


def measure(task: str, snapshot: str, ticks: int, word: str, margin: float | None = None) -> tuple[str, int]:
    """One line of the table, whole episodes of at least ``ticks`` control ticks, and in how many of them it ended outside."""
    controller = nearl.Controller.load(snapshot)
    env = gymnasium.make(task.replace("-velocity", "-v5"))
    counted, rng = limits(task, margin), np.random.default_rng(0)
    guard, unavoidable = nearl.Guard(env, counted), "kept" if "kept" in word else "least"
    keeping = nearl.Guard(env, counted if margin is None else {**counted, "position": {"margin": margin}}, unavoidable=unavoidable)
    count, returns, spent, n = np.zeros((2, 3), int), [], 0.0, 0
    while n < ticks:
        obs, over, total = env.reset(seed=100 + len(returns))[0], False, 0.0
        controller.reset()
        while not over:
            began = not guard.outside
            start = time.perf_counter()
            action = np.clip(np.asarray(controller.act(obs), np.float32), -1, 1)
            if word != "none":
                action, _ = keeping.safe(action)
            spent += time.perf_counter() - start
            out = ends_outside(guard, action)
            lost = out and not avoidable(guard, action, rng)
            start = time.perf_counter()
            obs, reward, terminated, truncated, _ = env.step(action)
            spent += time.perf_counter() - start
            count += np.outer([1, began], [1, out, lost])
            total, over, n = total + float(reward), terminated or truncated, n + 1
        returns.append(total)
    (all_ticks, out, lost), (began, out_inside, lost_inside) = count
    line = [task, word, all_ticks, out, lost, began, out_inside, lost_inside, f"{np.mean(returns):.1f}", len(returns), f"{n / spent:.0f}"]
    return ",".join(map(str, line)), int(out)


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5):
        sys.exit(__doc__)
    for guarded in ("none", "simulator", "simulator, policy kept where nothing is inside"):
        line, out = measure(sys.argv[1], sys.argv[2], int(sys.argv[3]), guarded.replace(",", ";"), *map(float, sys.argv[4:5]))
        print(line, flush=True)
        if guarded == "simulator" and not out:
            break
