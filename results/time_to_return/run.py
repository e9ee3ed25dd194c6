"""Seconds until a return: NEARL, JAX on EnvPool and Stable-Baselines3's PPO with the same settings, and its SAC with its own.

    cargo build --release --locked -p nearl-trainer --bin nearl
    .peers/bin/python results/time_to_return/run.py > results/time_to_return/table.md      # peers of results/throughput/peers/requirements.txt

Returns are those of training, exploration on: the mean of the last hundred episodes, which every system reports at each of its batches. Runs are processes
of their own, systems by turns: one after another on the whole machine, or with `--one-core` each on a core of its own. A run ends when it has the highest
return of its task, or at `--limit` seconds. What `other` programs did meanwhile (cores, those of the run) stands in each line: above 0.3 a run does not count.
The table is of all lines of `runs.jsonl`; remove the file to start again, or give `--lines`. New lines have their
`--limit`. Rates that fall over other `--steps` than ten million go into STEPS/runs.jsonl. `--systems ppo,pid2-ib` needs no peers.
"""

import argparse
import csv
import json
import math
import os
import queue
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import tomllib

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
GOALS = {"HalfCheetah-v5": [5000, 8000], "Ant-v5": [3000, 5000], "Walker2d-v5": [3500], "Hopper-v5": [2500]}
STEPS = 10_000_000
SYSTEMS = ["ppo", "pid2-ib", "jax", "sb3-ppo", "sb3-sac"]


def busy(core: int | None) -> float:
    """Processor seconds of a core, or of the whole machine, that were not idle."""
    line = Path("/proc/stat").read_text().split("\n")[0 if core is None else core + 1]
    user, nice, system, _, _, irq, soft, steal = map(int, line.split()[1:9])
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
    if system == "jax":
        script = ROOT / "results" / "throughput" / "peers" / "jax_envpool_ppo.py"
        words = ["--env", task, "--seed", seed, "--n-envs", 64, "--batch", s["batch"], "--minibatch", s["minibatch"], "--nets", json.dumps(s["nets"])]
        words += ["--lr", s["lr"], "--log-std", s["log_std"], "--gae-lambda", s["gae_lambda"], "--target-kl", s["target_kl"], "--tell", steps]
        return [a.python, script, *words]
    return [a.python, HERE / "peer.py", system, task, "--seed", str(seed), "--steps", str(steps), "--settings", json.dumps(s)]


def run(system: str, task: str, seed: int, s: dict, a: argparse.Namespace, core: int | None) -> dict:
    """Seconds and steps to each return of the task, none where it was not reached; on one core, or on the whole machine."""
    goals, reached = GOALS[task], {}
    with tempfile.TemporaryDirectory() as folder:
        words = [str(w) for w in command(system, task, seed, a.steps, s, a, Path(folder) / "run")]
        words = words if core is None else ["taskset", "-c", str(core), *words]
        start, before = time.monotonic(), busy(core)
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
    cores = os.cpu_count() if core is None else 1
    return {"task": task, "system": system, "seed": seed, "cores": cores, "other": round((busy(core) - before - own) / wall, 2)} | found


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--nearl", type=Path, default=ROOT / "target" / "release" / "nearl")
    p.add_argument("--python", default=sys.executable, help="interpreter with the peers")
    p.add_argument("--systems", default=",".join(SYSTEMS))
    p.add_argument("--tasks", default=",".join(GOALS))
    p.add_argument("--seeds", type=int, default=5)
    p.add_argument("--steps", type=int, default=STEPS, help="steps over which rates fall to zero")
    p.add_argument("--lines", type=Path, help="file the runs are appended to; the table shows all of them")
    p.add_argument("--limit", type=float, default=1800.0, help="seconds after which a run is given up")
    p.add_argument("--first-seed", type=int, default=0)
    p.add_argument("--one-core", action="store_true", help="each run on a core of its own, as many side by side as there are cores")
    a = p.parse_args()
    a.lines = a.lines or (HERE if a.steps == STEPS else HERE / str(a.steps)) / "runs.jsonl"
    a.lines.parent.mkdir(parents=True, exist_ok=True)
    said = {task: settings(a.nearl, task) for task in a.tasks.split(",")}
    seeds = range(a.first_seed, a.first_seed + a.seeds)
    todo = [(system, task, seed) for task in said for seed in seeds for system in a.systems.split(",")]
    cores: queue.Queue = queue.Queue()
    for core in range(os.cpu_count()) if a.one_core else [None]:
        cores.put(core)

    def one(system: str, task: str, seed: int) -> None:
        core = cores.get()
        try:
            line = run(system, task, seed, said[task], a, core)
        finally:
            cores.put(core)
        with open(a.lines, "a") as log:
            log.write(json.dumps(line | {"limit": a.limit}) + "\n")

    with ThreadPoolExecutor(cores.qsize()) as pool:
        for done in [pool.submit(one, *what) for what in todo]:
            done.result()
    table(a.lines)


def table(file: Path) -> None:
    """Median over the seeds that nobody disturbed; a seed that never came there counts as infinitely late."""
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    if len({line["cores"] for line in lines}) > 1:
        sys.exit(f"{file} has runs on one core and on several, which do not compare; remove the file and start again")
    writer = csv.writer(sys.stdout, delimiter="|", lineterminator="|\n")
    writer.writerows([["", " task ", " return ", " system ", " seconds ", " million steps ", " seeds there ", " left out as disturbed "], ["", *["---"] * 7]])
    found, disturbed = defaultdict(list), defaultdict(int)
    for line in lines:
        for goal in GOALS[line["task"]]:
            key = line["task"], goal, line["system"]
            if line["other"] > 0.3:
                disturbed[key] += 1
            else:
                found[key].append(line[f"to_{goal}"])
    for key, runs in sorted(found.items(), key=lambda kv: (list(GOALS).index(kv[0][0]), kv[0][1])):
        there = [r for r in runs if r]
        seconds, steps = (statistics.median([r[k] if r else math.inf for r in runs]) for k in (0, 1))
        found_it = [f"{seconds:.0f}", f"{steps / 1e6:.2f}"] if math.isfinite(seconds) else ["not reached", ""]
        words = [*key, *found_it, f"{len(there)} of {len(runs)}", disturbed[key]]
        writer.writerow(["", *(f" {w} " for w in words)])


if __name__ == "__main__":
    main()
