"""One training on several workers of Ray Train, each a rank of `nearl.Ranks`: the weights are those of one process.

    pip install 'ray[train]' torch        # no dependencies of nearl
    python examples/ray_train.py HalfCheetah-v5 --workers 2 --steps 1000000 --out runs/ray_train

The first worker writes the run folder, which every machine of the cluster sees. Given a run folder that is there, the training goes on.
"""

import argparse
import os
from pathlib import Path
from typing import Any


def train(given: dict[str, Any]) -> None:
    """What each worker runs; Ray Train has made the process group."""
    import ray.train

    import nearl

    ranks, out = nearl.Ranks(), Path(given["out"])
    if (out / "checkpoints" / "resume.safetensors").is_file():
        agent = nearl.PID2.load(out, threads=1, ranks=ranks)
    else:
        agent = nearl.PID2(given["task"], given["algo"], seed=given["seed"], threads=1, settings=given["settings"], run=out, ranks=ranks)

    def report(agent: nearl.PID2, metrics: dict[str, float]) -> None:
        ray.train.report({"steps": agent.num_timesteps, "return": metrics.get("rollout/ep_rew_mean")})

    rest = given["steps"] - agent.num_timesteps
    if rest > 0:
        agent.learn(rest, callback=report)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("--algo", default="pid2-ib")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--steps", type=lambda text: int(float(text)), default=1_000_000)
    parser.add_argument("--n-envs", type=int, default=64, help="of all workers together")
    parser.add_argument("--n-steps", type=int, default=256)
    parser.add_argument("--batch-size", type=int, default=2048, help="of a minibatch; the workers share those of 512 and more")
    parser.add_argument("--out", required=True, type=lambda text: str(Path(text).resolve()))
    given = parser.parse_args()
    os.environ.setdefault("RAY_TRAIN_WORKER_GROUP_START_TIMEOUT_S", "600")  # [s]; on a busy machine a minute, Ray's own, is short for importing torch
    try:
        import torch  # noqa: F401
        from ray.train import ScalingConfig
        from ray.train.torch import TorchConfig, TorchTrainer
    except ImportError as error:
        raise SystemExit(f"ray_train.py needs Ray Train and torch, but {error}: pip install 'ray[train]' torch") from None

    sizes = {"train.n_envs": given.n_envs, "train.n_steps": given.n_steps, "train.ppo.batch_size": given.batch_size}
    if given.task.endswith(".toml"):
        given.task = str(Path(given.task).resolve())
    told = {**{name: getattr(given, name) for name in ("task", "algo", "seed", "steps", "out")}, "settings": sizes}
    scaling = ScalingConfig(num_workers=given.workers, use_gpu=False)
    result = TorchTrainer(train, train_loop_config=told, torch_config=TorchConfig(backend="gloo"), scaling_config=scaling).fit()
    if result.error is not None:
        raise SystemExit(f"a worker failed: {result.error}")
    print(f"{given.out}: {given.steps} steps by {given.workers} workers")


if __name__ == "__main__":
    main()
