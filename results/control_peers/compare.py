"""Whole controllers on the same arm with the same limits, following the same wish in turns.

python compare.py ROBOT TICKS

Each tick a controller gets the measured state and a wished next state (a sum of sines in each joint that goes 1.5 times as fast and
as far as allowed), and returns the velocity to have at the end of the period: ours through the Python call `Projector.project`, the peers
through their own calls. The plant is MuJoCo, as in attack.py. Only the controller is timed, tick by tick and in turns; placo in its own
process, by the clock there.

The distance of an answer from the optimum: where the optimum of our problem at the controller's own state exists (quadprog, on the rows that
`Projector.problem` gives), the answer's distance to the wish less the optimum's [rad/s]. It is negative for answers that break a limit.
"""

import logging
import os
import sys
import time
import warnings

import mujoco
import numpy as np
import pinocchio as pin
from quadprog import solve_qp

from attack import TOLERANCE
from rules import DT, Remote, arm, make, ours, plant, rules

# Written down again in Python: their time says nothing.
UNTIMED = ("tsid", "ros2_control, saturation", "ros2_control, range")


def optimum(problem, v, q, q_wish, v_wish):
    """The optimum's distance to the wish, or None where the problem has no answer."""
    h, c, rows, most, _, _ = problem(q, v, q_wish, v_wish)
    try:
        change = solve_qp(h, -c, -rows.T, -most)[0]
    except ValueError:
        return None
    return distance(q, v + change, q_wish, v_wish)


def distance(q, v_next, q_wish, v_wish):
    return np.sqrt((((q + DT * v_next - q_wish) / DT) ** 2 + (v_next - v_wish) ** 2).sum())


class Loop:
    """One controller and its own plant."""

    def __init__(self, robot, rule, model, limits, problem):
        self.rule, self.model, self.limits, self.problem = rule, model, limits, problem
        self.sim, self.dynamics = plant(robot), model.createData()
        self.state = mujoco.MjData(self.sim)
        self.state.qpos[:] = (limits.low + limits.high) / 2
        mujoco.mj_forward(self.sim, self.state)
        self.times, self.beyond, self.way, self.broken, self.silent = [], [], [], np.zeros(4, int), 0

    def tick(self, q_wish, v_wish):
        q, v, limits = self.state.qpos.copy(), self.state.qvel.copy(), self.limits
        begin = time.perf_counter_ns()
        try:
            v_next = self.rule(q, v, q_wish, v_wish)
        except Exception:  # whatever a package raises when it has no answer
            v_next = None
        took = time.perf_counter_ns() - begin
        self.times.append(self.rule.elapsed if isinstance(self.rule, Remote) else took)
        if v_next is None or not np.all(np.isfinite(v_next)):
            self.silent += 1
            v_next = v - np.sign(v) * np.minimum(limits.braking * DT, np.abs(v))
        best = optimum(self.problem, v, q, q_wish, v_wish)
        if best is not None:
            self.beyond.append(distance(q, v_next, q_wish, v_wish) - best)
        a = (v_next - v) / DT
        tau = pin.rnea(self.model, self.dynamics, q, v, a)
        self.state.qfrc_applied[:] = tau
        mujoco.mj_step(self.sim, self.state)
        self.way.append(np.linalg.norm(self.state.qpos - q))
        share = lambda x, limit: ((x - limit) / np.maximum(np.abs(limit), 1)).max()  # noqa: E731
        reached = (self.state.qvel - v) / DT
        self.broken += ~(np.array([
            max(share(self.state.qpos, limits.high), share(-self.state.qpos, -limits.low)), share(np.abs(self.state.qvel), limits.speed),
            share(np.abs(reached), limits.acceleration), share(np.abs(tau), limits.effort)]) <= TOLERANCE)  # fmt: skip


def main() -> None:
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    robot, ticks = sys.argv[1], int(float(sys.argv[2]))
    model, limits = arm(robot)
    problem = ours(robot, limits, "stored").projector.problem
    loops = {name: Loop(robot, make(robot, name), model, limits, problem) for name in rules(robot)}
    rng = np.random.default_rng(1)
    frequency, phase = rng.uniform(0.1, 0.6, len(limits.low)), rng.uniform(0, 2 * np.pi, len(limits.low))
    middle, half = (limits.low + limits.high) / 2, 0.75 * (limits.high - limits.low)
    names = list(loops)
    for tick in range(ticks):
        angle = 2 * np.pi * frequency * tick * DT + phase
        wish, speed = middle + half * np.sin(angle), half * 2 * np.pi * frequency * np.cos(angle)
        for k in range(len(names)):
            loop = loops[names[(k + tick) % len(names)]]
            q = loop.state.qpos
            v_wish = np.clip(speed + 5.0 * (wish - q), -1.5 * limits.speed, 1.5 * limits.speed)
            loop.tick(q + DT * v_wish, v_wish)
    base = np.percentile(loops[names[0]].times, 50)
    print(f"{ticks} ticks each, in turns, {os.cpu_count()} cores\n")
    print("| controller | p50 [us] | p99 [us] | p50, share of ours | position | velocity | acceleration | torque | no answer "
          "| mean distance from the optimum [rad/s] | ticks with an optimum | way gone [rad] |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for name, loop in loops.items():
        p50, p99 = np.percentile(loop.times, [50, 99]) / 1000
        broken = " | ".join(map(str, loop.broken))
        timed = f"{p50:.1f} | {p99:.1f} | {1000 * p50 / base:.1f}" if name not in UNTIMED else "not timed | not timed | not timed"
        beyond = f"{np.mean(loop.beyond):.2g}" if loop.beyond else "no such tick"
        print(f"| {name} | {timed} | {broken} | {loop.silent} | {beyond} | {len(loop.beyond)} | {np.sum(loop.way):.1f} |")


if __name__ == "__main__":
    main()
