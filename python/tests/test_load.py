"""A running loop is told what its robot carries: a Panda in MuJoCo takes up two kilograms in flight, under a policy that wants too much."""

import os
import threading

import mujoco
import numpy as np
from conftest import ROBOTS

import nearl

DT, A, MASS, COM = 1e-3, 8.0, 2.0, [0.0, 0.0, 0.1]
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
RECIPE = f"""
[time]
dt = {DT}
sim_dt = {DT}
[policy]
joints = {JOINTS}
action = {{ scale = 1.0 }}
observation = [{{ term = "joint_pos" }}, {{ term = "joint_vel" }}]
[reset]
q = {{ panda_joint4 = -1.5, panda_joint6 = 1.5 }}
[constraints]
guard = true
braking = "stored"
position = {{}}
velocity = {{ scale = 0.5 }}
acceleration = {{ limit = {A} }}
torque = {{ scale = 0.9 }}
""".replace("'", '"')


class Arm:
    """The Panda of its URDF in MuJoCo, one Euler step a tick, with or without the load."""

    def __init__(self) -> None:
        self.bare, self.with_load = self.made(loaded=False), self.made(loaded=True)
        self.model = self.bare
        self.data = mujoco.MjData(self.bare)
        self.data.qpos[[3, 5]] = -1.5, 1.5

    def made(self, loaded: bool) -> mujoco.MjModel:
        spec = mujoco.MjSpec.from_file(str(ROBOTS / "panda" / "panda.urdf"))
        if loaded:
            held = spec.body("panda_link7").add_body(name="load", mass=MASS, ipos=COM, inertia=[0.01] * 3)
            held.explicitinertial = True
        model = spec.compile()
        model.opt.timestep = DT
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        return model

    def step(self, torque: np.ndarray) -> None:
        self.data.qfrc_applied[:] = torque
        mujoco.mj_step(self.model, self.data)


def flight(tmp_path, name: str, ordered: bool) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations [rad/s²] and torques [N m] of the ticks in which the robot carries the load."""
    rng = np.random.default_rng(3)
    layers = [((200 * rng.normal(size=(7, 14))).tolist(), (100 * rng.normal(size=7)).tolist(), "identity")]
    policy = nearl.Policy.from_layers(layers, [0] * 14, [1] * 14, (-np.inf, np.inf), (-np.inf, np.inf))
    (tmp_path / "recipe.toml").write_text(RECIPE)
    snapshot = tmp_path / f"{name}.safetensors"
    policy.controller(ROBOTS / "panda" / "panda.urdf", tmp_path / "recipe.toml", "load").save(snapshot)
    arm, carried, answer = Arm(), [], []
    name = f"py{os.getpid()}-{name}"
    names = [f"q.{j}" for j in JOINTS] + [f"v.{j}" for j in JOINTS]

    def order() -> None:
        with nearl.Link(name, patience=20.0) as link:
            answer.append(link.move_limits(payload=("panda_link7", MASS, COM, [0.01, 0, 0, 0.01, 0, 0.01])))

    operator = threading.Thread(target=order)
    with nearl.Plant(name, JOINTS, names, DT, 7, lockstep=True) as plant, nearl.Loop(snapshot, name, ramp=0.0):
        tick = 0
        while len(carried) < 600:
            assert tick < 10_000, "the order was not answered"
            q, v = arm.data.qpos.copy(), arm.data.qvel.copy()
            # An answer that comes while the action is under way is of the next one.
            carries = tick >= 200 and (bool(answer) or not ordered)
            turn, action = plant.exchange(q, v, [*q, *v], patience=5.0, time=tick * DT)
            if turn != "act" or action is None:
                assert tick == 0, turn
                continue
            if tick == 200 and ordered:
                operator.start()
            if carries:
                arm.model = arm.with_load
            arm.step(action)
            tick += 1
            if arm.model is arm.with_load:
                carried.append(((arm.data.qvel - v) / DT, action))
        if ordered:
            operator.join()
            assert answer[0].accepted, answer[0].text
    accelerations, torques = zip(*carried, strict=True)
    return np.array(accelerations), np.array(torques)


def test_what_is_carried_is_reckoned_with_from_the_order_on(tmp_path) -> None:
    effort = 0.9 * np.array([87.0] * 4 + [12.0] * 3)
    accelerations, torques = flight(tmp_path, "told", ordered=True)
    assert np.abs(accelerations).max() <= A * (1 + 1e-6)
    assert (np.abs(torques) <= effort * (1 + 1e-9)).all()
    accelerations, _ = flight(tmp_path, "untold", ordered=False)
    assert np.abs(accelerations).max() > 1.2 * A
