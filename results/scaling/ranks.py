"""What ranks say to each other: one training of pid2-ib, batch 16384, minibatch 2048, by one process, and by two and four of torch.distributed (gloo).

    pip install torch
    python results/scaling/ranks.py --iterations 6 > results/scaling/ranks.md          # quiet machine

Bytes are counted where they are handed over. Processor seconds of handing over are those of the thread that does it; seconds on the clock
also hold the wait for the other ranks, and tell of the machine where others use it too. More ranks than cores wait for each other in any
case. All ranks of all sizes must end with the same weights, or there is no table.
"""

import argparse
import hashlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SETTINGS = {"train.n_envs": 64, "train.n_steps": 256, "train.ppo.batch_size": 2048}


class Counted:
    """Ranks whose exchanges are counted."""

    def __init__(self, inner: object):
        self.inner, self.rank, self.size = inner, inner.rank, inner.size  # type: ignore[attr-defined]
        self.calls = self.sent = 0
        self.wall = self.busy = 0.0

    def gather(self, mine: bytes) -> bytes:
        wall, busy = time.perf_counter(), time.thread_time()
        everything = self.inner.gather(mine)  # type: ignore[attr-defined]
        self.calls, self.sent = self.calls + 1, self.sent + len(mine)
        self.wall, self.busy = self.wall + time.perf_counter() - wall, self.busy + time.thread_time() - busy
        return everything


def rank(iterations: int) -> None:
    """One of them: prints what an iteration takes after the first two, in the means."""
    import nearl

    ranks = Counted(nearl.Ranks()) if int(os.environ["WORLD_SIZE"]) > 1 else None
    agent = nearl.PID2("HalfCheetah-v5", "pid2-ib", seed=0, threads=1, settings=SETTINGS, ranks=ranks)
    seen = []

    def look(*_: object) -> None:
        own = [0, 0, 0.0, 0.0] if ranks is None else [ranks.calls, ranks.sent, ranks.wall, ranks.busy]
        seen.append([*own, time.perf_counter(), time.process_time()])

    agent.learn((iterations + 2) * 16384, callback=look)
    with tempfile.TemporaryDirectory() as folder:
        agent.save(f"{folder}/weights.safetensors")
        weights = hashlib.sha256(Path(folder, "weights.safetensors").read_bytes()).hexdigest()
    each = [(last - first) / iterations for first, last in zip(seen[1], seen[-1])]
    print(json.dumps({"weights": weights, **dict(zip(("calls", "sent", "wall", "busy", "seconds", "processor"), each))}))


def start(size: int, iterations: int) -> list[dict]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    common = {**os.environ, "WORLD_SIZE": str(size), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "--iterations", str(iterations), "--rank"]
    processes = [subprocess.Popen(command, env={**common, "RANK": str(r)}, stdout=subprocess.PIPE, text=True) for r in range(size)]
    return [json.loads(process.communicate()[0].splitlines()[-1]) for process in processes]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--iterations", type=int, default=6)
    parser.add_argument("--rank", action="store_true", help="this process is one of the ranks")
    given = parser.parse_args()
    if given.rank:
        rank(given.iterations)
        return
    print(f"Means of {given.iterations} iterations after the first two; a thread a rank. Load of the machine: {os.getloadavg()[0]:.1f}.\n")
    print("| ranks | exchanges | sent by a rank [MB] | processor seconds of a rank | of it exchanging | seconds | of it exchanging and waiting |")
    print("|---|---|---|---|---|---|---|")
    weights = set()
    for size in (1, 2, 4):
        told = start(size, given.iterations)
        weights |= {one.pop("weights") for one in told}
        if len(weights) > 1:
            sys.exit(f"ranks.py: the weights of {size} ranks are not those of fewer")
        mean = {name: sum(one[name] for one in told) / size for name in told[0]}
        shares = f"{100 * mean['busy'] / mean['processor']:.1f} %", f"{100 * mean['wall'] / mean['seconds']:.0f} %"
        cells = [size, f"{mean['calls']:.0f}", f"{mean['sent'] / 1e6:.1f}", f"{mean['processor']:.2f}", shares[0], f"{mean['seconds']:.2f}", shares[1]]
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
