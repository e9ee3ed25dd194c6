"""What random robots, noise, delay and a history cost in steps per second, and how far training is from its physics alone: `cost.md`.

    .venv/bin/python results/transfer/cost.py [SECONDS [REPEATS]]      8 and 3 unless given; 4 2, say, goes into results/transfer/4-2

Each repetition trains every variant for SECONDS in a process of its own, one after the other, so that a slow minute of the machine meets all of them.
Needs Python 3.11. The machine must be idle: `other` is how many cores something else used meanwhile, and a run with more than 0.3 is left out.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import tomllib

ROOT = Path(__file__).parents[2]
NEARL = os.environ.get("NEARL", str(ROOT / "target/release/nearl"))
HERE = Path(__file__).parent
USUAL = (8.0, 3)

RANDOM = 'random={ mass = "1 + 0.3 * uniform", strength = { all = "0.9 + 0.15 * uniform" } }'
NOISE = 'noise={ q = "0.005 * normal", v = "0.05 * normal" }'
DELAY = 'delay={ action = "1.5 + 1.5 * uniform" }'
TASKS = {
    "ANYmal C walks": ("examples/tasks/anymal-walk.toml", "ppo"),
    "xArm7, position drives": ("results/transfer/xarm7.toml", "ppo"),
    "Panda, torques": ("results/transfer/panda.toml", "pid2-ib"),
}


def history(task: str) -> list[str]:
    """The task's recipe of observation with three samples of each term; nothing where the policy reads the whole state."""
    terms = tomllib.loads((ROOT / task).read_text()).get("policy", {}).get("observation")
    if terms is None:
        return []
    inline = (", ".join(f"{k} = {json.dumps(v)}" for k, v in (t | {"history": 3}).items()) for t in terms)
    return [f"policy.observation=[{', '.join(f'{{ {t} }}' for t in inline)}]"]


def busy() -> float:
    """Processor seconds of the whole machine that were not idle."""
    user, nice, system, _, _, irq, soft, steal = map(int, Path("/proc/stat").read_text().split("\n")[0].split()[1:9])
    return (user + nice + system + irq + soft + steal) / os.sysconf("SC_CLK_TCK")


def run(task: str, algo: str, settings: list[str], seconds: float) -> dict:
    words = [NEARL, "bench", "train", str(ROOT / task), "--algo", algo, "--seconds", str(seconds), "--repeat", "1"]
    words += ["--physics-seconds", str(seconds / 2), "--json", *(w for s in settings for w in ("--set", s))]
    start, before = time.monotonic(), busy()
    child = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    out = child.stdout.read()
    _, status, used = os.wait4(child.pid, 0)
    wall = time.monotonic() - start
    if status:
        sys.exit(f"'{' '.join(words)}' failed with status {status}; its message is above")
    line = json.loads(out.strip().splitlines()[-1])
    other = (busy() - before - used.ru_utime - used.ru_stime) / wall
    return {"rate": line["steps_per_s"], "physics": line["physics_steps_per_s"], "update": line["update_share"], "other": other}


def main(seconds: float = USUAL[0], repeats: int = USUAL[1]) -> None:
    folder = HERE if (seconds, repeats) == USUAL else HERE / f"{seconds:g}-{repeats}"
    text = [f"`cost.py {seconds:g} {repeats}`: medians of {repeats} repetitions of {seconds:g} s on {os.cpu_count()} cores.", ""]
    text += ["| task | with | steps/s | cost, % | share of the physics alone, % | updates, % of the time |", "|---|---|---|---|---|---|"]
    left_out = 0
    for name, (task, algo) in TASKS.items():
        recipe = history(task)
        variants = {"nothing": [], "random robots": [RANDOM], "noise": [NOISE], "delay": [DELAY]}
        if recipe:
            variants["a history of 3"] = recipe
        variants["all of it"] = [RANDOM, NOISE, DELAY, *recipe]
        found: dict[str, list[dict]] = {v: [] for v in variants}
        for _ in range(repeats):
            for variant, settings in variants.items():
                line = run(task, algo, settings, seconds)
                print(name, variant, line, flush=True)
                if line["other"] <= 0.3:
                    found[variant].append(line)
                else:
                    left_out += 1
        middle = {v: {k: statistics.median(r[k] for r in rows) for k in rows[0]} for v, rows in found.items() if rows}
        for variant, m in middle.items():
            cost = f"{100 * (1 - m['rate'] / middle['nothing']['rate']):.0f}" if "nothing" in middle and variant != "nothing" else ""
            share, update = 100 * m["rate"] / m["physics"], 100 * m["update"]
            text.append(f"| {name} | {variant} | {m['rate']:.0f} | {cost} | {share:.0f} | {update:.0f} |")
    text += ["", f"Left out because something else used the machine: {left_out} runs."]
    folder.mkdir(exist_ok=True)
    (folder / "cost.md").write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    main(*(t(w) for t, w in zip((float, int), sys.argv[1:])))
