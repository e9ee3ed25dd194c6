"""Seconds until a return: NEARL, Stable-Baselines3's PPO with the same settings, and its SAC with its own.

    cargo build --release --locked -p nearl-trainer --bin nearl
    .peers/bin/python results/time_to_return/run.py > results/time_to_return/table.md      # peers of results/throughput/peers/requirements.txt

Returns are those of training, exploration on: the mean of the last hundred episodes, which every system reports at each of its batches. Runs are processes
of their own, one after another, systems by turns; a run ends when it has the highest return of its task, or at `--limit` seconds. What `other` cores of the
machine did meanwhile stands in each line: above 0.3 a run does not count. `--systems ppo,pid2-ib` needs no peers.
"""

import argparse
import csv
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import tomllib

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
GOALS = {"HalfCheetah-v5": [5000, 8000], "Ant-v5": [3000, 5000], "Walker2d-v5": [3500], "Hopper-v5": [2500]}
SYSTEMS = ["ppo", "pid2-ib", "sb3-ppo", "sb3-sac"]


def busy() -> float:
    """Processor seconds of the whole machine that were not idle."""
    user, nice, system, _, _, irq, soft, steal = map(int, Path("/proc/stat").read_text().split("\n")[0].split()[1:9])
    return (user + nice + system + irq + soft + steal) / os.sysconf("SC_CLK_TCK")


def settings(nearl: Path, task: str) -> dict:
    """What the preset sets for the task: the peers take it from the run folder that it writes, so that nothing is said twice."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = [nearl, "train", task, "--algo", "ppo", "--preset", "strong", "--steps", "1", "--out", out, "--json"]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        train = tomllib.loads((out / "task.toml").read_text())["train"]
    ppo = train["ppo"]
    return {"batch": train["n_envs"] * train["n_steps"], "minibatch": ppo["batch_size"], "lr": ppo.get("lr", 3e-4), "log_std": ppo["log_std"]} | {
        "gae_lambda": train.get("gae_lambda", 0.95),
        "target_kl": ppo.get("target_kl", 0.0),
        "nets": train["nets"]["policy"],
    }


def command(system: str, task: str, seed: int, steps: int, s: dict, a: argparse.Namespace, out: Path) -> list:
    """The words of a run that prints `{steps, return}` a line."""
    if system in ("ppo", "pid2-ib"):
        return [a.nearl, "train", task, "--algo", system, "--preset", "strong", "--steps", str(steps), "--seed", str(seed), "--out", out, "--json"]
    return [a.python, HERE / "peer.py", system, task, "--seed", str(seed), "--steps", str(steps), "--settings", json.dumps(s)]


def run(system: str, task: str, seed: int, s: dict, a: argparse.Namespace) -> dict:
    """Seconds and steps to each return of the task, none where it was not reached."""
    goals, reached = GOALS[task], {}
    with tempfile.TemporaryDirectory() as folder:
        words = [str(w) for w in command(system, task, seed, a.steps, s, a, Path(folder) / "run")]
        start, before = time.monotonic(), busy()
        child = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        ended = False
        for line in child.stdout:
            seconds, row = time.monotonic() - start, json.loads(line)
            for goal in goals:
                if (row["return"] or -math.inf) >= goal and goal not in reached:
                    reached[goal] = (seconds, row["steps"])
            if len(reached) == len(goals) or seconds > a.limit:
                ended = True
                child.terminate()
                break
        _, status, used = os.wait4(child.pid, 0)
        if status != 0 and not ended:
            sys.exit(f"'{' '.join(words)}' failed with status {status}; its message is above")
        wall, own = time.monotonic() - start, used.ru_utime + used.ru_stime
    found = {f"to_{goal}": reached.get(goal) for goal in goals}
    return {"task": task, "system": system, "seed": seed, "other": round((busy() - before - own) / wall, 2)} | found


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--nearl", type=Path, default=ROOT / "target" / "release" / "nearl")
    p.add_argument("--python", default=sys.executable, help="interpreter with the peers")
    p.add_argument("--systems", default=",".join(SYSTEMS))
    p.add_argument("--tasks", default=",".join(GOALS))
    p.add_argument("--seeds", type=int, default=5)
    p.add_argument("--steps", type=int, default=10_000_000, help="steps over which rates fall to zero")
    p.add_argument("--limit", type=float, default=1800.0, help="seconds after which a run is given up")
    a = p.parse_args()
    lines = []
    with open(HERE / "runs.jsonl", "a") as log:
        for task in a.tasks.split(","):
            s = settings(a.nearl, task)
            for seed in range(a.seeds):
                for system in a.systems.split(","):
                    lines.append(run(system, task, seed, s, a))
                    log.write(json.dumps(lines[-1]) + "\n")
                    log.flush()
    table(lines)


def table(lines: list[dict]) -> None:
    """Median over the seeds; a seed that never came there counts as infinitely late."""
    writer = csv.writer(sys.stdout, delimiter="|", lineterminator="|\n")
    writer.writerows([["", " task ", " return ", " system ", " seconds ", " million steps ", " seeds there ", " disturbed "], ["", *["---"] * 7]])
    found = defaultdict(list)
    for line in lines:
        for goal in GOALS[line["task"]]:
            found[line["task"], goal, line["system"]].append((line[f"to_{goal}"], line["other"] > 0.3))
    for (task, goal, system), runs in found.items():
        there = [r for r, _ in runs if r]
        seconds, steps = (statistics.median([r[k] if r else math.inf for r, _ in runs]) for k in (0, 1))
        words = [task, goal, system, f"{seconds:.0f}", f"{steps / 1e6:.2f}", f"{len(there)} of {len(runs)}", sum(d for _, d in runs)]
        writer.writerow(["", *(f" {w} " for w in words)])


if __name__ == "__main__":
    main()
