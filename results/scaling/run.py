"""How training grows: environments, widths of the networks, observation entries; on one thread and on two.

    cargo build --release --locked --bins
    python3 results/scaling/run.py target/release       # quiet machine; writes runs.jsonl and table.md beside this file

Each line is a process of its own (`nearl bench train`, pid2-ib with its limits). Its processor time and peak memory come from the system. `busy` is how many
cores the rest of the machine used meanwhile: where that is not near zero, read the column of steps per processor second and not steps per second. Other
`--seconds` than 10 go into a folder of their number, and lines of what is not measured stay.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
BATCH, SECONDS = 16384, 10.0
ORDER = ["environments", "width", "observation"]


def used() -> float:
    """Processor seconds of the whole machine so far."""
    user, nice, system, *rest = map(int, Path("/proc/stat").read_text().split("\n")[0].split()[1:])
    return (user + nice + system + sum(rest[2:4])) / os.sysconf("SC_CLK_TCK")


def cases() -> list[dict]:
    def sizes(n: int, batch: int = BATCH) -> list[str]:
        return [f"train.n_envs={n}", f"train.n_steps={max(batch // n, 8)}", "train.ppo.batch_size=2048"]

    def nets(width: int) -> list[str]:
        return [f"train.nets.{name}=[{width},{width}]" for name in ("policy", "idm", "value", "discriminator")]

    cheetah, found = "HalfCheetah-v5", []
    for n in (1, 4, 16, 64, 256, 1024, 4096):
        found.append({"what": "environments", "value": n, "task": cheetah, "set": [*sizes(n), *nets(64)]})
    for width in (32, 64, 128, 256, 512):
        found.append({"what": "width", "value": width, "task": cheetah, "set": [*sizes(64), *nets(width)]})
    for n in (17, 100, 300, 1000):
        state = ["q.slider", "q.hinge", "v.slider", "v.hinge"]
        entries = [*state, *(f"sin({k} * q.hinge)" for k in range(1, n - 3))]
        told = [f"state.observation={json.dumps(entries)}", f"state.propose={json.dumps(state)}"]
        found.append({"what": "observation", "value": n, "task": "examples/tasks/cart-pole.toml", "set": [*sizes(64), *nets(64), *told]})
    return found


def measure(case: dict, threads: int, nearl: Path, seconds: float) -> dict:
    command = [nearl, "bench", "train", case["task"], "--algo", "pid2-ib", "--seconds", str(seconds), "--repeat", "1", "--physics-seconds", "0", "--json"]
    command += [word for setting in case["set"] for word in ("--set", setting)]
    cores = sorted(os.sched_getaffinity(0))[:threads]
    begin, machine = time.monotonic(), used()
    process = subprocess.Popen(list(map(str, command)), cwd=ROOT, stdout=subprocess.PIPE, text=True, preexec_fn=lambda: os.sched_setaffinity(0, cores))
    out = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(map(str, command))} ended with status {status}")
    told, own = json.loads(out), usage.ru_utime + usage.ru_stime
    wall, machine = time.monotonic() - begin, used() - machine
    return {
        "what": case["what"], "value": case["value"], "threads": told["threads"], "steps_per_s": round(told["steps_per_s"]),
        "update_share": round(told["update_share"], 3), "memory_mb": usage.ru_maxrss >> 10, "cores_used": round(own / wall, 2),
        "steps_per_cpu_s": round(told["steps_per_s"] * wall / own) if own else None, "busy": round((machine - own) / wall, 2),
    }


def table(rows: list[dict]) -> str:
    busy = max(r["busy"] for r in rows)
    lines = [f"pid2-ib, batch {BATCH}, minibatch 2048. The rest of the machine used up to {busy:.1f} cores meanwhile.", ""]
    for what, about in (
        ("environments", "HalfCheetah-v5, 64 x 64, from 1 to 4096 environments (4096 with 8 steps each: a batch of 32768)"),
        ("width", "HalfCheetah-v5, 64 environments, all networks W x W"),
        ("observation", "cart-pole, 64 environments, 64 x 64, entries of the observation"),
    ):
        lines += [f"## {about}", "", f"| {what} | threads | steps/s | steps per processor second | of it learning | peak memory [MB] |"]
        lines.append("|---|---|---|---|---|---|")
        lines += [
            f"| {r['value']} | {r['threads']} | {r['steps_per_s']} | {r['steps_per_cpu_s']} | {100 * r['update_share']:.0f} % | {r['memory_mb']} |"
            for r in rows if r["what"] == what
        ]
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("programs", type=Path, help="folder of the program nearl")
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--only", choices=ORDER, help="these anew; lines of what is not measured stay")
    a = parser.parse_args()
    folder = HERE if a.seconds == SECONDS else HERE / f"{a.seconds:g}"
    folder.mkdir(exist_ok=True)
    file = folder / "runs.jsonl"
    todo = [(case, threads) for case in cases() if a.only in (None, case["what"]) for threads in map(int, a.threads.split(","))]
    anew = {(case["what"], case["value"], threads) for case, threads in todo}
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    rows = [row for row in rows if (row["what"], row["value"], row["threads"]) not in anew]
    for case, threads in todo:
        rows.append(measure(case, threads, a.programs.resolve() / "nearl", a.seconds))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    rows.sort(key=lambda row: (ORDER.index(row["what"]), row["value"], row["threads"]))
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "table.md").write_text(table(rows))


if __name__ == "__main__":
    main()
