"""A training whose metrics go to Weights & Biases as they come; offline here, so no account is needed (pip install wandb)."""

import sys
from pathlib import Path

import nearl

try:
    import wandb
except ImportError as error:
    raise SystemExit(f"wandb_callback.py needs Weights & Biases, but {error}: pip install wandb") from None

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/wandb")
folder.mkdir(parents=True, exist_ok=True)
run = wandb.init(project="nearl", mode="offline", dir=folder, config={"task": "Hopper-v5", "algo": "pid2-ib", "seed": 0})


def log(agent: nearl.PID2, metrics: dict[str, float]) -> None:
    """SB3's tags, over environment steps."""
    run.log(metrics, step=int(metrics["time/total_timesteps"]))


agent = nearl.PID2("Hopper-v5", algo="pid2-ib", seed=0, settings={"train.n_envs": 4, "train.n_steps": 512})
agent.learn(6_000, callback=log)
print("return in the summary:", run.summary.get("rollout/ep_rew_mean"))
run.finish()
