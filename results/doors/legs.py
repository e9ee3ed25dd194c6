"""Somebody else's walking policy in its own simulation and in `nearl plant` with `nearl run`, and what the guard does when policies are switched.

    python results/doors/legs.py MUJOCO_PLAYGROUND > results/doors/legs.md

MUJOCO_PLAYGROUND is a checkout; nothing of it is part of this repository. Its Go1 joystick policy gets the same command on flat ground from the same start:

- *its own simulation*: the loop of its `play_go1_joystick.py` (observation, onnxruntime, position targets, five physics steps a policy tick);
- *nearl*: the policy imported with a recipe, in a loop of 250 Hz (a policy tick every fifth) on MuJoCo as a plant process.

Then the two policies "walk" and "walk backwards as fast as it can" (the same network under another command) are switched every 0.3 s, in the simulation of
the first, with targets as they are (raw), clipped to the joints' ranges (clamped), and behind `guard = "drive"` with a torque rate (guarded). Needs mujoco
and onnxruntime.
"""

import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime

import nearl
from switching import in_nearls_words, push

GO1 = "mujoco_playground/_src/locomotion/go1/xmls"
JOINTS = [f"{leg}_{part}_joint" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf")]
POSE = np.array([0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2)
SIM_DT, EVERY, SCALE, KP = 0.004, 5, 0.5, 35.0
EFFORT = np.array([23.7, 23.7, 35.55] * 4)
RATE = 4000.0  # N m/s
RAW = "guard = false"
DRIVE = f'guard = "drive"\ntorque = {{ scale = 1.0 }}\ntorque_rate = {{ limit = {RATE} }}'
SECONDS = 8.0
COMMANDS = [(1.0, 0.0, 0.0), (0.0, 0.4, 0.0), (0.5, 0.0, 1.0)]


def robot(playground: Path, folder: Path) -> Path:
    """The robot without its meshes (its feet alone collide), on a plane, beginning at the height of its own start.

    ``own.xml`` is that of its own simulation. Ours is without the option ``eulerdamp="disable"``, with which MuJoCo's step is not the one a controller
    reckons with, and with MuJoCo's own number of solver iterations in place of one: with implicit damping one does not hold the feet.
    """
    text = (playground / GO1 / "go1_mjx_feetonly.xml").read_text()
    text = re.sub(r"<geom class=\"visual\"[^>]*/>", "", text)
    text = re.sub(r"<mesh class[^>]*/>", "", text).replace('<body name="trunk" pos="0 0 0.445"', '<body name="trunk" pos="0 0 0.278"')
    floor = '<geom name="floor" size="0 0 0.01" type="plane" contype="1" conaffinity="0" priority="1" friction="0.6" condim="3"/>'
    text = text.replace("<worldbody>", "<worldbody>" + floor, 1)
    (folder / "own.xml").write_text(text)
    file = folder / "go1.xml"
    file.write_text(text.replace('iterations="1" ls_iterations="5" ', "").replace('<flag eulerdamp="disable"/>', ""))
    return file


def recipe(command: tuple[float, float, float], imu: np.ndarray, constraints: str, clip: str) -> str:
    """What the policy sees and what its outputs mean."""
    each = ", ".join(f"{joint} = {{}}" for joint in JOINTS)
    point = [float(x) for x in imu]
    return f"""
[time]
dt = {SIM_DT}
policy_every = {EVERY}
[command]
interface = "pd"
stiffness = {{ {each.format(*[KP] * 12)} }}
damping = {{ {each.format(*[0.0] * 12)} }}
[constraints]
{constraints}
[reset]
q = {{ {each.format(*POSE)} }}
[policy]
joints = {JOINTS}
pose = {POSE.tolist()}
action = {{ scale = {SCALE}{clip} }}
observation = [
    {{ term = "base_lin_vel", point = {point} }}, {{ term = "base_ang_vel" }}, {{ term = "projected_gravity" }},
    {{ term = "joint_pos" }}, {{ term = "joint_vel" }}, {{ term = "last_action" }},
    {{ term = "command", value = {list(command)} }},
]
"""


class Theirs:
    """The loop of play_go1_joystick.py, without its window."""

    def __init__(self, file: Path, policy: Path):
        self.model = mujoco.MjModel.from_xml_path(str(file))
        self.model.opt.timestep = SIM_DT
        self.data = mujoco.MjData(self.model)
        self.session = onnxruntime.InferenceSession(policy)
        self.reset()

    def reset(self) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[7:] = POSE
        mujoco.mj_forward(self.model, self.data)
        self.last = np.zeros(12, np.float32)

    def observe(self, command: tuple[float, float, float]) -> np.ndarray:
        d = self.data
        imu = d.site("imu").xmat.reshape(3, 3)
        gravity = imu.T @ np.array([0, 0, -1])
        parts = [d.sensor("local_linvel").data, d.sensor("gyro").data, gravity, d.qpos[7:] - POSE, d.qvel[6:], self.last, command]
        return np.hstack(parts).astype(np.float32)

    def target(self, command: tuple[float, float, float]) -> np.ndarray:
        mujoco.mj_forward(self.model, self.data)  # its callback runs behind the sensors of the same state
        self.last = self.session.run(["continuous_actions"], {"obs": self.observe(command)[None]})[0][0]
        return self.last * SCALE + POSE


def base_velocity(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Forward, sideways and yaw rate in the base's own axes, of MuJoCo's state."""
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, q[3:7])
    body = turn.reshape(3, 3).T @ v[:3]
    return np.array([body[0], body[1], v[5]])


def walk_theirs(theirs: Theirs, command: tuple[float, float, float]) -> tuple[np.ndarray, float]:
    theirs.reset()
    speeds, lowest = [], np.inf
    for tick in range(round(SECONDS / SIM_DT)):
        if tick % EVERY == 0:
            theirs.data.ctrl[:] = theirs.target(command)
        mujoco.mj_step(theirs.model, theirs.data)
        speeds.append(base_velocity(theirs.data.qpos, theirs.data.qvel))
        lowest = min(lowest, theirs.data.qpos[2])
    return np.mean(speeds[len(speeds) // 2 :], axis=0), lowest


def walk_ours(snapshot: Path, name: str) -> tuple[np.ndarray, float, int]:
    """The same through two processes' worth of NEARL: `nearl plant`, and the loop."""
    plant = subprocess.Popen([sys.executable, "-m", "nearl", "plant", str(snapshot), "--name", name, "--lockstep", "--endless"], stdout=subprocess.DEVNULL)
    try:
        q, v, lost = [], [], 0
        with nearl.Loop(snapshot, name, patience=30.0, ramp=0.0, seconds=SECONDS) as loop, nearl.Link(name, patience=5.0) as link:
            while loop.running:
                try:
                    states = link.states()
                except TimeoutError:
                    break
                active = states.mode == "active"  # behind the last second the loop brakes
                q, v, lost = [*q, *states.q[active]], [*v, *states.v[active]], states.lost
                time.sleep(0.001)
        # The base's velocity is that of its own axes there: x y z, roll pitch yaw.
        speeds = np.array(v)[:, [0, 1, 5]]
        return speeds[len(speeds) // 2 :].mean(axis=0), float(np.array(q)[:, 2].min()), lost
    finally:
        plant.terminate()
        plant.wait()


def switched(theirs: Theirs, snapshots: list[Path], name: str, seconds: float) -> tuple[float, float, float, int, int]:
    """Peak torque as a share of the motors', peak change of it [N m/s], mean forward speed, falls and hot swaps, while two policies are pushed in turn."""
    m, d = theirs.model, theirs.data
    # The drives without their own stops: what is asked of the motors is what is looked at.
    m.actuator_forcelimited[:] = 0
    m.actuator_ctrllimited[:] = 0
    theirs.reset()
    joints = ["joint0", *JOINTS]  # MuJoCo's base has no name in the file
    observation = [f"q.{joint}" for joint in JOINTS] + [f"v.{joint}" for joint in JOINTS]
    peak, rate, falls, speeds, before, episode, begins = 0.0, 0.0, 0, [], None, 0, True
    pushing = ThreadPoolExecutor(1)
    with nearl.Plant(name, joints, observation, SIM_DT, 12, nq=19, nv=18, lockstep=True) as plant:
        with nearl.Loop(snapshots[0], name, patience=30.0, ramp=0.0) as loop:
            acted, pushes = 0, 0
            while acted < seconds / SIM_DT:
                q, v = in_nearls_words(d)
                turn, target = plant.exchange(q, v, [*d.qpos[7:], *d.qvel[6:]], patience=0.5, time=d.time, episode=episode, begins=begins)
                if turn != "act" or target is None:
                    if acted == 0 and not loop.running:
                        loop.stop()  # raises what the loop refused
                    continue
                begins, acted = False, acted + 1
                torque = KP * (target - d.qpos[7:])
                peak = max(peak, float((np.abs(torque) / EFFORT).max()))
                if before is not None:
                    rate = max(rate, float(np.abs(torque - before).max()) / SIM_DT)
                before = torque
                d.ctrl[:] = target
                mujoco.mj_step(m, d)
                speeds.append(base_velocity(d.qpos, d.qvel)[0])
                if d.qpos[2] < 0.12 or d.site("imu").xmat.reshape(3, 3)[2, 2] < 0.3:
                    falls, before, episode, begins = falls + 1, None, episode + 1, True
                    theirs.reset()
                if acted % 75 == 0:
                    # From another thread: the loop answers behind a tick, and the ticks are this one's.
                    pushes += 1
                    pushing.submit(push, name, snapshots[pushes % 2])
            pushing.shutdown(wait=False, cancel_futures=True)
            swaps = loop.stop()["counters"]["swaps"]
    return peak, rate, float(np.mean(speeds)), falls, swaps


def main(playground: Path) -> None:
    policy = playground / "mujoco_playground/experimental/sim2sim/onnx/go1_policy.onnx"
    if not policy.is_file():
        sys.exit(f"legs.py: '{playground}' is no checkout of mujoco_playground: it has no {policy.relative_to(playground)}")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        file = robot(playground, folder)
        theirs = Theirs(folder / "own.xml", policy)
        imu = theirs.model.site("imu").pos.copy()

        def snapshot(what: str, command: tuple[float, float, float], constraints: str, clip: str = "") -> Path:
            (folder / f"{what}.toml").write_text(recipe(command, imu, constraints, clip))
            nearl.import_onnx(policy, robot=file, recipe=folder / f"{what}.toml", name="go1").save(folder / f"{what}.safetensors")
            return folder / f"{what}.safetensors"

        print("| command | what | asked | in its own simulation | in nearl |")
        print("|---|---|---|---|---|")
        for k, command in enumerate(COMMANDS):
            own, low = walk_theirs(theirs, command)
            ours, ours_low, _ = walk_ours(snapshot(f"walk{k}", command, RAW), f"go1-{k}")
            for what, *three in zip(("forward [m/s]", "sideways [m/s]", "yaw [rad/s]"), command, own, ours, strict=True):
                print(f"| {k + 1} | {what} | {' | '.join(f'{x:+.3f}' for x in three)} |")
            print(f"| {k + 1} | lowest height of the base [m] | | {low:.3f} | {ours_low:.3f} |", flush=True)
        low, high = theirs.model.jnt_range[1:].T
        clip = f", clip = [{((low - POSE) / SCALE).tolist()}, {((high - POSE) / SCALE).tolist()}]"
        print("\n| targets | peak torque (motors' = 1) | peak torque rate [N m/s] | mean forward speed [m/s] | falls | swaps |")
        print("|---|---|---|---|---|---|")
        for how, constraints, clipped in (("raw", RAW, ""), ("clamped to the joints' ranges", RAW, clip), ("guarded", DRIVE, "")):
            pair = [snapshot(f"{how[:3]}{k}", command, constraints, clipped) for k, command in enumerate(((1.5, 0.0, 0.0), (-1.5, 0.0, -2.0)))]
            peak, rate, speed, falls, swaps = switched(Theirs(file, policy), pair, f"go1-{how[:3]}", 60.0)
            print(f"| {how} | {peak:.3f} | {rate:.0f} | {speed:+.3f} | {falls} | {swaps} |", flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
