"""What becomes of an action through a regression of actions on what noise reached.

    .venv/bin/python results/strong/slopes.py

16384 steps of Gymnasium's tasks with actions of a spread of e^-0.5, all columns in their standard deviations; of NumPy alone, nothing here is the trainer's.
"""

import gymnasium
import numpy as np

STEPS, SPREAD = 16384, np.exp(-0.5)
ENTRIES = {"HalfCheetah-v5": 17, "Hopper-v5": 11, "Walker2d-v5": 17, "Ant-v5": 27}


def noise(task: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observations, actions and changes of state."""
    env, rng, rows = gymnasium.make(task), np.random.default_rng(0), ([], [], [])
    obs, _ = env.reset(seed=0)
    for _ in range(STEPS):
        action = SPREAD * rng.standard_normal(env.action_space.shape[0])
        reached, _, terminated, truncated, _ = env.step(np.clip(action, env.action_space.low, env.action_space.high))
        n = ENTRIES[task]
        for column, value in zip(rows, (obs[:n], action, reached[:n] - obs[:n]), strict=True):
            column.append(value)
        obs = env.reset()[0] if terminated or truncated else reached
    x, a, change = (np.array(column) for column in rows)
    return (x - x.mean(0)) / x.std(0), a, change / change.std(0)


def regression(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Slopes of `y` by `x`, as outputs x inputs."""
    x, y = x - x.mean(0), y - y.mean(0)
    return np.linalg.solve(x.T @ x / len(x) + 1e-4 * np.eye(x.shape[1]), x.T @ y / len(x)).T


def main() -> None:
    """The table."""
    print("| task | singular values of G | own slope of an action | least slope of any mixture of actions |")
    print("|---|---|---|---|")
    for task, n in ENTRIES.items():
        x, a, change = noise(task)
        g = regression(np.c_[x, a], change)[:, n:]
        s = np.linalg.svd(g)[1]
        slopes = regression(np.c_[x, change], a)[:, n:] @ g
        own, least = np.diag(slopes), np.linalg.svd(slopes)[1].min()
        values = f"{s[-1]:.2f} to {s[0]:.2f}"
        print(f"| {task} | {values} | {own.min():.2f} to {own.max():.2f} | {least:.2f} |")


if __name__ == "__main__":
    main()
