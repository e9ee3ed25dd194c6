"""The sweep of `nearl sweep` on a Ray cluster: tasks x algorithms x seeds, one core a run.

    pip install ray        # not a dependency of nearl
    python examples/ray_sweep.py --tasks HalfCheetah-v5,Hopper-v5 --algos ppo,pid2-ib --seeds 0,1,2 --steps 1000000 --out runs/ray
    nearl report runs/ray

Every machine of the cluster needs the package and sees the folder. Finished runs are skipped, broken ones done again.
"""

import argparse
import shutil
from itertools import product
from pathlib import Path
from typing import Any

import tomllib


def train(task: str, algo: str, seed: int, steps: int, out: str, settings: dict[str, Any]) -> tuple[str, float | None]:
    """One run in `<out>/<task>/<algo>_<seed>`: its folder, and the mean return of its last 100 episodes."""
    import nearl

    name = Path(task).stem if task.endswith(".toml") else task
    run = Path(out) / name / f"{algo}_{seed}"
    if (run / "checkpoints" / "final.safetensors").exists():
        rows = (run / "metrics.csv").read_text().splitlines()
        last = dict(zip(rows[0].split(","), rows[-1].split(",")))
        if float(last["time/total_timesteps"]) >= steps:
            return str(run), float(last["rollout/ep_rew_mean"] or "nan")
    shutil.rmtree(run, ignore_errors=True)
    seen: dict[str, float] = {}
    agent = nearl.PID2(task, algo=algo, seed=seed, threads=1, settings=settings, run=run)
    agent.learn(steps, callback=lambda _, metrics: seen.update(metrics))
    return str(run), seen.get("rollout/ep_rew_mean")


def _setting(text: str) -> tuple[str, Any]:
    """`key=value`, the value in TOML or a bare string."""
    key, value = text.split("=", 1)
    try:
        return key, tomllib.loads(f"x = {value}")["x"]
    except tomllib.TOMLDecodeError:
        return key, value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    several = {"type": lambda text: text.split(",")}
    parser.add_argument("--tasks", **several, required=True)
    parser.add_argument("--algos", **several, default=["ppo", "pid2-ib"])
    parser.add_argument("--seeds", **several, default=["0", "1", "2"])
    parser.add_argument("--steps", type=lambda text: int(float(text)), default=1_000_000)
    parser.add_argument("--out", required=True)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    try:
        import ray
    except ImportError:
        raise SystemExit("ray_sweep.py needs Ray: pip install ray") from None

    ray.init()
    settings = dict(_setting(text) for text in given.settings)
    tasks = [str(Path(task).resolve()) if task.endswith(".toml") else task for task in given.tasks]
    remote = ray.remote(num_cpus=1, max_retries=2)(train)
    out = str(Path(given.out).resolve())
    waiting = [remote.remote(t, a, int(s), given.steps, out, settings) for s, t, a in product(given.seeds, tasks, given.algos)]
    while waiting:
        done, waiting = ray.wait(waiting)
        for run, mean in ray.get(done):
            print(f"{run}: return {'-' if mean is None else f'{mean:.1f}'}", flush=True)


if __name__ == "__main__":
    main()
