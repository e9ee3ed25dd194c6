"""Constrained rollouts from a server on this machine: `nearl serve` in a process of its own, a client here."""

import os
import subprocess
import sys
import time

import nearl

name = f"example{os.getpid()}"
command = [sys.executable, "-m", "nearl", "serve", "examples/snapshots/panda-reach.safetensors", "--name", name]
server = subprocess.Popen(command, stdout=subprocess.DEVNULL)
try:
    for _ in range(100):
        try:
            link = nearl.Link(name)
            chunks = list(link.rollout(seed=0, n_steps=1000))
            break
        except (OSError, RuntimeError, TimeoutError):
            time.sleep(0.1)  # it is not up yet
    print(f"{sum(len(c.reward) for c in chunks)} steps, reward {sum(c.reward.sum() for c in chunks):.2f}")
finally:
    server.terminate()
    server.wait()
