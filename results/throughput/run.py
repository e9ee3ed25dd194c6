"""Training throughput of `nearl` beside its own physics and two peers: alternating runs, one JSON line each, then the table.

    cargo build --release -p nearl-trainer --bin nearl --example physics_speed
    .peers/bin/python results/throughput/run.py > results/throughput/table.md

Every run is a process of its own; its peak memory and processor time come from the system. `other` in a line is how many
cores the rest of the machine used meanwhile: above 0.3 the run does not count. Needs Python 3.11 alone; the peers need
peers/requirements.txt in this interpreter (or the one that `--python` names).
"""
import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
TASKS = ["HalfCheetah-v5", "Ant-v5", "Walker2d-v5", "Hopper-v5"]
# minibatch: (batch, environments of ours, of JAX on EnvPool, of Stable-Baselines3), each its own best
SETTINGS = {64: (2048, 16, 64, 8), 2048: (16384, 64, 64, 8)}
SECONDS = 6.0
SYSTEMS = ["ppo", "pid2-ib", "physics", "jax-envpool", "sb3"]


def command(system, task, minibatch, a):
    batch, ours, jax, sb3 = SETTINGS[minibatch]
    if system == "physics":
        return [f"{a.target}/examples/physics_speed", str(a.seconds / 4), task]
    if system in ("ppo", "pid2-ib"):
        settings = [f"train.ppo.batch_size={minibatch}", f"train.n_envs={ours}", f"train.n_steps={batch // ours}", "train.nets.idm=[32,32]"]
        return [f"{a.target}/nearl", "bench", "train", task, "--algo", system, "--seconds", str(a.seconds), "--repeat", "1",
                "--physics-seconds", "0", "--json", *(w for s in settings for w in ("--set", s))]
    script, n_envs = {"jax-envpool": ("jax_envpool_ppo.py", jax), "sb3": ("sb3_ppo.py", sb3)}[system]
    return [a.python, str(HERE / "peers" / script), "--env", task, "--seconds", str(a.seconds), "--n-envs", str(n_envs),
            "--batch", str(batch), "--minibatch", str(minibatch)]


def busy():
    """Processor seconds of the whole machine that were not idle."""
    user, nice, system, _, _, irq, soft, steal = map(int, Path("/proc/stat").read_text().split("\n")[0].split()[1:9])
    return (user + nice + system + irq + soft + steal) / os.sysconf("SC_CLK_TCK")


def run(system, task, minibatch, a):
    words = command(system, task, minibatch, a)
    start, before = time.monotonic(), busy()
    child = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    out = child.stdout.read()
    _, status, used = os.wait4(child.pid, 0)
    wall, cpu = time.monotonic() - start, used.ru_utime + used.ru_stime
    if status != 0:
        sys.exit(f"'{' '.join(words)}' failed with status {status}; its message is above")
    if system == "physics":
        rate = float(re.search(rf"{task}.* (\d+)\s*$", out, re.M).group(1))
    else:
        rate = json.loads(out.strip().splitlines()[-1])["steps_per_s"]
    return {"task": task, "minibatch": minibatch, "system": system, "steps_per_s": round(rate), "peak_mb": round(used.ru_maxrss / 1024),
            "cores": round(cpu / wall, 2), "other": round((busy() - before - cpu) / wall, 2), "seconds": round(wall, 1)}


def table(lines, loaded):
    """Median of each cell; runs disturbed by other programs are left out unless `loaded`."""
    kept = [r for r in lines if loaded or r["other"] <= 0.3]
    print(f"{len(lines)} runs, {len(lines) - len(kept)} of them disturbed and left out; median of the rest.\n")
    names = {"ppo": "NEARL `ppo`", "pid2-ib": "NEARL `pid2-ib`, constraints on", "physics": "our physics alone",
             "jax-envpool": "JAX on EnvPool", "sb3": "Stable-Baselines3"}
    for minibatch, (batch, *_) in SETTINGS.items():
        print(f"### Batch {batch}, minibatch {minibatch}\n")
        print("| task | system | steps/s | runs | NEARL `ppo` is | of the physics | peak memory, MB |\n|---|---|---|---|---|---|---|")
        for task in TASKS:
            mine = {s: [r for r in kept if (r["task"], r["minibatch"], r["system"]) == (task, minibatch, s)] for s in SYSTEMS}
            rate = {s: statistics.median(r["steps_per_s"] for r in rs) for s, rs in mine.items() if rs}
            for s, value in rate.items():
                share = f"{100 * value / rate['physics']:.0f} %" if "physics" in rate else ""
                ratio = f"{rate['ppo'] / value:.2f} x" if "ppo" in rate else ""
                spread = " ".join(f"{r['steps_per_s'] / 1000:.1f}" for r in mine[s])
                peak = statistics.median(r["peak_mb"] for r in mine[s])
                print(f"| {task} | {names[s]} | {value / 1000:.1f} k | {spread} | {ratio} | {share} | {peak:.0f} |")
        print()


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--tasks", default=",".join(TASKS))
    p.add_argument("--settings", default="64,2048", help="minibatches")
    p.add_argument("--systems", default=",".join(SYSTEMS))
    p.add_argument("--repeats", type=int, default=3)
    p.add_argument("--seconds", type=float, default=SECONDS, help="of each training, after its first iteration")
    p.add_argument("--python", default=sys.executable, help="interpreter of the peers' environment")
    p.add_argument("--target", default="target/release", help="folder of the built programs")
    p.add_argument("--lines", type=Path, help="file the runs are appended to, all in the table: runs.jsonl here, or in a folder of other seconds than 6")
    p.add_argument("--loaded", action="store_true", help="count runs beside other programs too")
    a = p.parse_args()
    a.lines = a.lines or (HERE if a.seconds == SECONDS else HERE / f"{a.seconds:g}") / "runs.jsonl"
    a.lines.parent.mkdir(parents=True, exist_ok=True)
    for _ in range(a.repeats):
        for task in a.tasks.split(","):
            for minibatch in map(int, a.settings.split(",")):
                for system in a.systems.split(","):
                    line = run(system, task, minibatch, a)
                    print(json.dumps(line), file=sys.stderr)
                    with open(a.lines, "a") as f:
                        print(json.dumps(line), file=f)
    lines = [json.loads(line) for line in a.lines.read_text().splitlines()]
    table(lines, a.loaded)


if __name__ == "__main__":
    main()
