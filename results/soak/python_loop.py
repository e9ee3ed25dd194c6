"""The same tick in Python: numpy policy, Pinocchio, a quadprog problem through qpsolvers, on a time grid of its own.

    python results/soak/python_loop.py --seconds 60 --rate 1000

The arm is simulated in the loop (semi-implicit Euler), so that nothing is waited for but the next slot. Asks for the same rights as
the Rust loop: SCHED_FIFO and locked memory. Prints one JSON object; times in ns.
"""

import argparse
import ctypes
import gc
import json
import os
import re
import time
from pathlib import Path

import numpy as np
import pinocchio as pin
import qpsolvers

ROOT = Path(__file__).resolve().parents[2]
URDF = ROOT / "examples" / "robots" / "panda" / "panda.urdf"
# The Rust loop's own priority, where it is stated.
PRIORITY = int(re.search(r"const PRIORITY: i32 = (\d+);", (ROOT / "runtime" / "src" / "thread.rs").read_text())[1])
ACCELERATION, MARGIN, SPEED, TORQUE = 10.0, 0.01, 0.9, 0.95  # as in examples/tasks/Panda-reach.toml
POLICY_HZ = 50


class Policy:
    """Two hidden layers of 64, random: what it says does not matter for the time it takes."""

    def __init__(self, n_in: int, n_out: int) -> None:
        rng = np.random.default_rng(0)
        sizes = [n_in, 64, 64, n_out]
        self.layers = [(rng.normal(0, 1 / np.sqrt(a), (b, a)).astype(np.float32), np.zeros(b, np.float32)) for a, b in zip(sizes, sizes[1:])]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        for weight, bias in self.layers[:-1]:
            x = np.tanh(weight @ x + bias)
        weight, bias = self.layers[-1]
        return weight @ x + bias


class Loop:
    """A tick: policy, box of accelerations, torque rows, quadprog, one step of the arm."""

    def __init__(self, rate: float) -> None:
        self.model = pin.buildModelFromUrdf(str(URDF))
        self.data, self.dt, n = self.model.createData(), 1.0 / rate, self.model.nv
        self.q, self.v = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8]), np.zeros(n)
        self.policy, self.every, self.tick = Policy(2 * n, n), max(1, round(rate / POLICY_HZ)), 0
        self.wish, self.eye, self.failed, self.worst = np.zeros(n), np.eye(n), 0, 0.0
        self.speed, self.effort = SPEED * self.model.velocityLimit, TORQUE * self.model.effortLimit
        self.low, self.high = self.model.lowerPositionLimit + MARGIN, self.model.upperPositionLimit - MARGIN

    def update(self) -> None:
        q, v, dt = self.q, self.v, self.dt
        if self.tick % self.every == 0:
            self.wish = 2.0 * self.policy(np.concatenate([q, v]).astype(np.float32))
        mass = pin.crba(self.model, self.data, q)
        bias = pin.nonLinearEffects(self.model, self.data, q, v)
        away = lambda gap: np.sqrt(2.0 * ACCELERATION * np.maximum(gap, 0.0))
        upper = np.minimum(ACCELERATION, (np.minimum(self.speed, away(self.high - q)) - v) / dt)
        lower = np.maximum(-ACCELERATION, (-np.minimum(self.speed, away(q - self.low)) - v) / dt)
        lower, upper = np.minimum(lower, ACCELERATION), np.maximum(upper, -ACCELERATION)
        g = np.vstack([mass, -mass])
        h = np.concatenate([self.effort - bias, self.effort + bias])
        wish = (self.wish - v) / dt
        a = qpsolvers.solve_qp(self.eye, -wish, g, h, lb=lower, ub=np.maximum(lower, upper), solver="quadprog")
        if a is None:
            self.failed += 1
            a = np.clip(-v / dt, -ACCELERATION, ACCELERATION)
        self.v = v + dt * a
        self.q = pin.integrate(self.model, q, dt * self.v)
        self.worst = max(self.worst, float(np.max(np.abs(mass @ a + bias) - self.model.effortLimit)))
        self.tick += 1


def ask_for_rights(priority: int) -> list[str]:
    """What the system refused."""
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        refused.append(f"SCHED_FIFO: {error}")
    if ctypes.CDLL(None, use_errno=True).mlockall(3) != 0:
        refused.append(f"mlockall: {os.strerror(ctypes.get_errno())}")
    return refused


def percentiles(times: np.ndarray) -> dict[str, float]:
    p50, p99, p999 = np.percentile(times, [50, 99, 99.9])
    return {"count": len(times), "p50": p50, "p99": p99, "p999": p999, "max": float(np.max(times))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--priority", type=int, default=PRIORITY)
    parser.add_argument("--collect", action="store_true", help="leave the garbage collector on")
    arguments = parser.parse_args()
    loop, period = Loop(arguments.rate), round(1e9 / arguments.rate)
    refused = ask_for_rights(arguments.priority)
    for _ in range(300):
        loop.update()
    if not arguments.collect:
        gc.disable()
    ticks = int(arguments.rate * arguments.seconds)
    wake, compute = np.zeros(ticks), np.zeros(ticks)
    begin, slot, overruns, skipped, n = time.monotonic_ns() + period, 0, 0, 0, 0
    while slot < ticks:
        due = begin + slot * period
        wait = due - time.monotonic_ns()
        if wait > 0:
            time.sleep(wait * 1e-9)
        start = time.monotonic_ns()
        loop.update()
        end = time.monotonic_ns()
        wake[n], compute[n], n = start - due, end - start, n + 1
        late = end - (due + period)
        lost = -(-late // period) if late > 0 else 0
        overruns, skipped, slot = overruns + (lost > 0), skipped + lost, slot + 1 + lost
    report = {"ticks": n, "overruns": overruns, "skipped": skipped, "wake_ns": percentiles(wake[:n]), "compute_ns": percentiles(compute[:n])}
    print(json.dumps({"rate_hz": arguments.rate, **report, "no_answer": loop.failed, "worst_torque_excess": loop.worst, "refused": refused}))


if __name__ == "__main__":
    main()
