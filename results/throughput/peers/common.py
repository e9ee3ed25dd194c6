"""Arguments and timing shared by the peers."""
import argparse
import json
import time


def parser():
    p = argparse.ArgumentParser()
    p.add_argument("--env", default="HalfCheetah-v5")
    p.add_argument("--seconds", type=float, default=6.0, help="stop at the first iteration after this time")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--n-envs", type=int, default=8)
    p.add_argument("--batch", type=int, default=2048, help="environment steps per iteration, over all environments")
    p.add_argument("--minibatch", type=int, default=64)
    p.add_argument("--epochs", type=int, default=10)
    return p


def arguments():
    return parser().parse_args()


class Meter:
    """`tick(steps)` at the start of every iteration; the first one (lazy initialisation, compilation) is not counted."""

    def __init__(self, seconds):
        self.seconds, self.ticks = seconds, []

    def tick(self, steps):
        self.ticks.append((time.perf_counter(), steps))

    def is_done(self):
        return len(self.ticks) > 2 and self.ticks[-1][0] - self.ticks[1][0] >= self.seconds

    def report(self, returns):
        (t0, n0), (t1, n1) = self.ticks[1], self.ticks[-1]
        last = returns[-100:]
        print(json.dumps({"steps_per_s": round((n1 - n0) / (t1 - t0), 1), "timed_steps": n1 - n0,
                          "return": round(float(sum(last) / len(last)), 1) if last else None}), flush=True)
