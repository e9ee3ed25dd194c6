"""Rollouts of one policy on a Ray cluster: an actor a core, each with its own environments, whose starts differ by seed.

    pip install ray        # not a dependency of nearl
    python examples/ray_rollouts.py examples/snapshots/panda-reach.safetensors --workers 2 --episodes 8 --out runs/rollouts.npz

Every limit of the snapshot holds in every worker. The same seeds give the same bits, whoever runs them. Every machine of the cluster needs
the package and sees the snapshot.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

Episode = dict[str, Any]


class Worker:
    """Plays episodes: observations (steps x n_obs), actions (steps x n_act), rewards (steps)."""

    def __init__(self, snapshot: str):
        import nearl
        from nearl import _core

        self.env, self.controller = _core.Env.of_snapshot(snapshot), nearl.Controller.load(snapshot)

    def play(self, seed: int) -> Episode:
        """One episode from the start that ``seed`` draws."""
        obs, over, broken = self.env.reset(seed), False, 0
        self.controller.reset()
        rows: dict[str, list] = {"observations": [], "actions": [], "rewards": []}
        while not over and len(rows["rewards"]) < self.env.max_episode_steps:
            action, ledger = self.controller.update(*self.env.state(), obs)
            broken += sum(ledger.target_violations.values())
            rows["observations"].append(obs)
            rows["actions"].append(action)
            obs, reward, _, over, _ = self.env.step(action)
            rows["rewards"].append(reward)
        return {"seed": seed, "target_violations": broken, **{name: np.array(values) for name, values in rows.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("snapshot", type=lambda text: str(Path(text).resolve()))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--out", required=True, help="an .npz file of all episodes, in the order of their seeds")
    given = parser.parse_args()
    try:
        import ray
        from ray.util import ActorPool
    except ImportError:
        raise SystemExit("ray_rollouts.py needs Ray: pip install ray") from None

    ray.init()
    remote = ray.remote(num_cpus=1)(Worker)
    pool = ActorPool([remote.remote(given.snapshot) for _ in range(given.workers)])
    episodes = list(pool.map(lambda worker, seed: worker.play.remote(seed), range(given.episodes)))
    lengths = [len(e["rewards"]) for e in episodes]
    Path(given.out).parent.mkdir(parents=True, exist_ok=True)
    columns = {name: np.concatenate([e[name] for e in episodes]) for name in ("observations", "actions", "rewards")}
    np.savez(given.out, lengths=lengths, **columns)
    broken = sum(e["target_violations"] for e in episodes)
    print(f"{given.episodes} episodes, {sum(lengths)} control periods, mean return {columns['rewards'].sum() / len(episodes):.2f}, {broken} targets outside")


if __name__ == "__main__":
    main()
