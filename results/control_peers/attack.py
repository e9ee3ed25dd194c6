"""The adversary of `trainer/examples/adversary` against the rules of others, on the same plant: an arm in MuJoCo.

python attack.py ROBOT TICKS [SEED]

ROBOT is `panda` or `z1`.
TICKS for each rule and attack. All rules meet the same seeds, starts and attacks; what they are asked for depends on where they went.
Where a rule has no answer, or one that is no number, its joints brake by what the motors can always give; what the proposal holds that
is no number reaches the rule as it is.
"""

import logging
import sys
import warnings

import mujoco
import numpy as np
import pinocchio as pin

from rules import DT, arm, make, plant, rules

EPISODE, TOLERANCE = 5000, 1e-9
ATTACKS = ("network", "bang-bang", "gradient", "bursts")
BAD = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e12])


class Attack:
    def __init__(self, kind, limits, model, seed):
        self.kind, self.limits, self.rng, self.n = kind, limits, np.random.default_rng(seed), len(limits.low)
        self.model, self.data, self.burst = model, model.createData(), 0
        self.middle, self.half = (limits.low + limits.high) / 2, (limits.high - limits.low) / 2

    def propose(self, tick, q, v):
        with np.errstate(over="ignore", invalid="ignore"):
            return getattr(self, self.kind.replace("-", "_"))(tick, q, v)

    def network(self, tick, q, v):
        rng, n = self.rng, self.n
        if tick % 5000 == 0:
            gain = rng.uniform(0.5, 4.0)
            self.first, self.second = gain * rng.uniform(-1, 1, (32, 2 * n + 1)), gain * rng.uniform(-1, 1, (2 * n, 32))
        seen = np.concatenate([(q - self.middle) / self.half, v / self.limits.speed, [1.0]])
        out = 2 * np.tile(self.limits.speed, 2) * np.tanh(self.second @ np.tanh(self.first @ seen))
        return q + DT * out[:n], out[n:]

    def bang_bang(self, tick, q, v):
        turn = self.rng.random(self.n) < (1.0 if tick % 700 == 0 else 1 / 300)
        new = np.where(self.rng.random(self.n) < 0.5, -1.0, 1.0)
        self.side = np.where(turn, new, self.side) if tick else new
        speed = 3 * self.side * self.limits.speed
        return q + DT * speed, speed

    def gradient(self, tick, q, v):
        if tick % 400 == 0:
            self.goal, self.joint, self.sign = self.rng.integers(4), self.rng.integers(self.n), self.rng.choice([-1.0, 1.0])
        place, speed = (q - self.middle) / self.half, v / self.limits.speed
        force = pin.nonLinearEffects(self.model, self.data, q, v) / self.limits.effort
        goal, joint, sign = self.goal, self.joint, self.sign
        if goal == 3:
            uses = np.concatenate([place, speed, force])
            most = int(np.abs(uses).argmax())
            goal, joint, sign = (2 if most >= 2 * self.n else 4), most % self.n, np.sign(uses[most])
        mass = pin.crba(self.model, self.data, q)
        row = (np.triu(mass) + np.triu(mass, 1).T)[joint]
        slope = {0: np.sign(place), 1: np.sign(speed), 2: sign * row / np.abs(row).max(), 4: sign * (np.arange(self.n) == joint)}[int(goal)]
        v_hat = v + 10 * DT * self.limits.acceleration * slope
        return q + DT * v_hat, v_hat

    def bursts(self, tick, q, v):
        proposal = np.concatenate(self.bang_bang(tick, q, v))
        if self.burst == 0 and self.rng.random() < 1 / 40:
            self.burst = self.rng.integers(1, 21)
        if self.burst:
            self.burst -= 1
            bad = self.rng.choice(BAD[3:] if self.rng.random() < 0.5 else BAD, 2 * self.n)
            proposal = np.where(self.rng.random(2 * self.n) < 0.3, bad, proposal)
        return proposal[: self.n], proposal[self.n :]


def start(limits, model, rng):
    data = model.createData()
    while True:
        q = limits.low + (limits.high - limits.low) * rng.uniform(0.02, 0.98, len(limits.low))
        if np.all(np.abs(pin.computeGeneralizedGravity(model, data, q)) < 0.8 * limits.effort):
            return q


def run(robot, rule, kind, ticks, seed):
    model, limits = arm(robot)
    sim = plant(robot)
    state, dynamics = mujoco.MjData(sim), model.createData()
    rng, attack = np.random.default_rng(seed + 1000), Attack(kind, limits, model, seed)
    broken, worst, silent = np.zeros(4, int), np.full(4, -np.inf), 0
    for tick in range(ticks):
        if tick % EPISODE == 0:
            mujoco.mj_resetData(sim, state)
            state.qpos[:] = start(limits, model, rng)
            mujoco.mj_forward(sim, state)
        q, v = state.qpos.copy(), state.qvel.copy()
        q_hat, v_hat = attack.propose(tick, q, v)
        try:
            v_next = rule(q, v, q_hat, v_hat)
        except Exception:  # whatever a package raises when it has no answer
            v_next = None
        if v_next is None or not np.all(np.isfinite(v_next)):
            v_next, silent = v - np.sign(v) * np.minimum(limits.braking * DT, np.abs(v)), silent + 1
        tau = pin.rnea(model, dynamics, q, v, (v_next - v) / DT)
        state.qfrc_applied[:] = tau
        mujoco.mj_step(sim, state)
        share = lambda x, limit: ((x - limit) / np.maximum(np.abs(limit), 1)).max()  # noqa: E731
        a = (state.qvel - v) / DT
        excess = np.array([
            max(share(state.qpos, limits.high), share(-state.qpos, -limits.low)), share(np.abs(state.qvel), limits.speed),
            share(np.abs(a), limits.acceleration), share(np.abs(tau), limits.effort)])  # fmt: skip
        broken += ~(excess <= TOLERANCE)
        worst = np.maximum(worst, excess)
        if np.any(state.warning.number) or not np.all(np.abs(state.qpos) < 1e6):
            mujoco.mj_resetData(sim, state)  # the simulation blew up; go on from a new start
            state.qpos[:] = start(limits, model, rng)
    return broken, worst, silent


def main() -> None:
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    robot, ticks, seed = sys.argv[1], int(float(sys.argv[2])), int(sys.argv[3]) if len(sys.argv) > 3 else 1
    print("| rule | attack | ticks | position | velocity | acceleration | torque "
          "| worst: position [share] | velocity | acceleration | torque | no answer |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for name in rules(robot):
        for k, kind in enumerate(ATTACKS):
            broken, worst, silent = run(robot, make(robot, name), kind, ticks, seed + k)
            excess = " | ".join(f"{max(w, 0):.1g}" for w in worst)
            print(f"| {name} | {kind} | {ticks} | " + " | ".join(map(str, broken)) + f" | {excess} | {silent} |", flush=True)


if __name__ == "__main__":
    main()
