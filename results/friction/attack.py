"""Attacks an arm with dry friction in MuJoCo: attack.py ROBOT.urdf [TICKS] writes friction.csv and table.md beside itself.

Every joint is pushed to and fro by bang-bang proposals, a third of the time all are told to stand. What is counted is the plant's own: accelerations as the
difference of velocities a tick apart, positions, velocities, and the motor forces it was sent.
"""

import csv
import re
import sys
import warnings
from pathlib import Path

import mujoco
import numpy as np

import nearl

HERE = Path(__file__).parent
ACCELERATION = 10.0
SPEED = 3.1  # rad/s
# Name, friction in the plant, friction in the model, and whether the plant rubs by Coulomb's law in steps of 20 us.
CASES = [
    ("none, none", False, False, False),
    ("MuJoCo's, none", True, False, False),
    ("MuJoCo's, modelled", True, True, False),
    ("Coulomb's, none", True, False, True),
    ("Coulomb's, modelled", True, True, True),
]


def robot(text: str, rubs: bool) -> str:
    text = re.sub(r"<(visual|collision)>.*?</\1>", "", text, flags=re.S)
    return text if rubs else re.sub(r'friction="[^"]*"', 'friction="0"', text)


class Plant:
    """MuJoCo with `sub_steps` Euler steps in a period, or one Runge-Kutta step for 0; or Coulomb's friction in steps of 20 us."""

    def __init__(self, text: str, dt: float, sub_steps: int, coulomb: bool) -> None:
        self.model = mujoco.MjModel.from_xml_string(text)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        self.model.opt.tolerance = 1e-12
        self.steps = 1 if sub_steps == 0 else sub_steps
        if coulomb:
            self.steps = max(1, round(dt / 2e-5))
            self.model.dof_solimp[:, :2] = 0.9999
            self.model.dof_solref[:, 0] = 2.1 * dt / self.steps
        elif sub_steps == 0:
            self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        self.model.opt.timestep = dt / self.steps
        self.data = mujoco.MjData(self.model)

    def step(self, tau: np.ndarray) -> None:
        self.data.qfrc_applied[:] = tau
        mujoco.mj_step(self.model, self.data, self.steps)


def attack(text: str, case: tuple, dt: float, sub_steps: int, ticks: int) -> dict:
    _, plant_rubs, model_rubs, coulomb = case
    model = nearl.Model.from_urdf_text(robot(text, model_rubs))
    limits = [
        nearl.PositionLimit(model),
        nearl.VelocityLimit(model, SPEED),
        nearl.AccelerationLimit(model, ACCELERATION),
        nearl.TorqueLimit(model),
    ]
    projector = nearl.Projector(model, limits, dt, sub_steps=sub_steps)
    plant = Plant(robot(text, plant_rubs), dt, sub_steps, coulomb)
    low, high, effort = model.lower_position_limit, model.upper_position_limit, model.effort_limit
    data, rng = plant.data, np.random.default_rng(1)
    data.qpos[:] = 0.5 * (low + high)
    sign, hold = np.ones(model.nv), max(1, round(0.15 / dt))
    over, worst = 0, np.full(4, -np.inf)
    for tick in range(ticks):
        q, v = data.qpos.copy(), data.qvel.copy()
        if tick % hold == 0:
            sign = rng.choice([-1.0, 1.0], model.nv) * (rng.random() > 1 / 3)
        wish = 100.0 * sign
        target = projector.project(q, v, q + dt * wish, wish)
        tau = model.motors(q, v, target.acceleration, dt, sub_steps)
        plant.step(tau)
        q1, v1 = data.qpos, data.qvel
        excess = np.array(
            [
                np.max(np.abs(v1 - v) / dt) - ACCELERATION,
                np.max(np.abs(v1)) - SPEED,
                np.max(np.maximum(low - q1, q1 - high)),
                np.max(np.abs(tau) - effort),
            ]
        )
        over += bool(excess[0] > 0.01 * ACCELERATION or np.any(excess[1:] > 1e-3))
        worst = np.maximum(worst, excess)
    return {
        "friction of plant, model": case[0],
        "period ms": 1000 * dt,
        "sub_steps": sub_steps,
        "ticks": ticks,
        "over": over,
        **dict(zip(["acceleration", "velocity", "position", "torque"], worst, strict=True)),
    }


def main() -> None:
    text, ticks = Path(sys.argv[1]).read_text(), int(sys.argv[2]) if len(sys.argv) > 2 else 4000
    rows = []
    for dt in (0.001, 0.002, 0.01):
        for sub_steps in (1, 5, 0):
            for case in CASES:
                if case[3] and sub_steps != 0:
                    continue
                rows.append(attack(text, case, dt, sub_steps, ticks))
                print(rows[-1], flush=True)
    with (HERE / "friction.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    head = "| friction of plant, model | period | steps | ticks over | acceleration | velocity | position | torque |\n|---|---|---|---|---|---|---|---|\n"
    lines = [
        f"| {r['friction of plant, model']} | {r['period ms']:g} ms | {r['sub_steps']} | {100 * r['over'] / r['ticks']:.2f} % | "
        + " | ".join(f"{r[k]:.2g}" for k in ("acceleration", "velocity", "position", "torque"))
        + " |\n"
        for r in rows
    ]
    (HERE / "table.md").write_text(head + "".join(lines))


if __name__ == "__main__":
    warnings.simplefilter("ignore", UserWarning)
    main()
