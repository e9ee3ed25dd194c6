"""Two policies of somebody else's, one that walks and one that dances, switched in a running loop on a G1 in MuJoCo: what reaches the motors.

    python results/doors/dance.py UNITREE_RL_MJLAB > results/doors/dance.md

UNITREE_RL_MJLAB is a checkout of unitreerobotics/unitree_rl_mjlab; nothing of it is part of this repository. Its `deploy` folder has two policies of the same
G1, with the same gains and different inputs: `velocity` walks at a speed it is told, `mimic/dance1_subject2` follows a motion from wherever it is begun. Both
are switched by hot swap every two seconds for a minute, with a drive of 500 Hz whose own stops are off. Targets go there as they are (raw), clipped to the
joints' ranges (clamped), and behind `guard = "drive"` (guarded). Before that each policy has half a minute of its own, raw. After a fall the robot is put
back on its feet. Needs mujoco and PyYAML.
"""

import re
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
import yaml

import nearl
from switching import in_nearls_words, push

DT, EVERY = 0.002, 10  # s, ticks of a policy
RATE = 10_000.0  # N m/s
SWITCH = 1000  # ticks
GUARD = f'guard = "drive"\ntorque = {{ scale = 1.0 }}\ntorque_rate = {{ limit = {RATE} }}'
# N m and kg m² of each kind of motor, by joint, as its g1_constants.py has them.
MOTORS = {
    "hip_pitch|hip_yaw|waist_yaw": (88.0, 0.010178),
    "hip_roll|knee": (139.0, 0.025102),
    "ankle|waist": (50.0, 0.00722),
    "shoulder|elbow|wrist_roll": (25.0, 0.00361),
    "wrist": (5.0, 0.00425),
}


def motor(joint: str) -> tuple[float, float]:
    return next(of for kind, of in MOTORS.items() if re.search(kind, joint))


class G1:
    """The robot file of the checkout without its meshes, on a floor, with unitree's drives."""

    def __init__(self, checkout: Path, folder: Path):
        self.said = {kind: deployed(checkout, kind) for kind in ("velocity/v0", "mimic/dance1_subject2")}
        said = self.said["velocity/v0"]
        text = (checkout / "mjlab/asset_zoo/robots/unitree_g1/xmls/g1.xml").read_text()
        text = re.sub(r"<geom[^>]* mesh=[^>]*/>|<mesh name[^>]*/>", "", text)
        text = text.replace('condim="6"', 'condim="1"').replace('<geom size="0.01"/>', '<geom size="0.01" condim="3" friction="0.6"/>')
        self.joints = re.findall(r'<joint name="(\w+)"', text)
        for joint in self.joints:
            effort, rotor = motor(joint)
            drive = f'armature="{rotor}" actuatorfrcrange="{-effort} {effort}"'
            text = text.replace(f'<joint name="{joint}"', f'<joint name="{joint}" {drive}')
        self.kp, self.kd, self.pose = (np.array(said[k], float) for k in ("stiffness", "damping", "default_joint_pos"))
        self.effort = np.array([motor(joint)[0] for joint in self.joints])
        drives = "".join(
            f'<position name="{joint}" joint="{joint}" kp="{kp}" kv="{kd}" ctrlrange="-10 10"/>'
            for joint, kp, kd in zip(self.joints, self.kp, self.kd, strict=True)
        )
        text = text.replace("<worldbody>", f'<option timestep="{DT}"/><worldbody><geom type="plane" size="0 0 1" friction="0.6"/>', 1)
        text = text.replace("</worldbody>", f"</worldbody><actuator>{drives}</actuator>", 1)
        self.file = folder / "g1.xml"
        self.file.write_text(text)
        motion = [f"command.{what}_{joint}" for what in ("q", "v") for joint in self.joints]
        self.entries = {"walk": ["command.x", "command.y", "command.yaw"], "motion": motion, "torso": [f"command.torso_{k}" for k in range(6)]}
        self.observation = [f"{what}.{joint}" for what in "qv" for joint in self.joints] + sum(self.entries.values(), [])

    def snapshot(self, kind: str, constraints: str, clamped: bool, folder: Path) -> Path:
        """A policy of the checkout as a snapshot: its recipe is what its deploy.yaml says."""
        said, path = self.said[kind], self.said[kind]["path"]
        action = said["actions"]["JointPositionAction"]
        scale = np.array(action["scale"])
        own = {"velocity_commands": "walk", "motion_command": "motion", "motion_anchor_ori_b": "torso"}
        terms = []
        for name, term in said["observations"].items():
            entries = f'term = "command", entries = {self.entries[own[name]]}' if name in own else f'term = "{name}"'
            terms.append(f"{{ {entries}, scale = {term['scale']} }}")
        model = mujoco.MjModel.from_xml_path(str(self.file))
        low, high = model.jnt_range[1:].T
        clip = f", clip = [{((low - self.pose) / scale).tolist()}, {((high - self.pose) / scale).tolist()}]" if clamped else ""
        gains = [", ".join(f"{j} = {x}" for j, x in zip(self.joints, xs, strict=True)) for xs in (self.kp, self.kd)]
        recipe = folder / "recipe.toml"
        recipe.write_text(f"""
[time]
dt = {DT}
sim_dt = {DT}
policy_every = {EVERY}
[command]
interface = "pd"
stiffness = {{ {gains[0]} }}
damping = {{ {gains[1]} }}
[constraints]
{constraints}
[state]
observation = {self.observation}
[policy]
joints = {self.joints}
pose = {self.pose.tolist()}
action = {{ scale = {scale.tolist()}, offset = {action["offset"]}{clip} }}
observation = [{", ".join(terms)}]
""")
        out = folder / f"{kind.split('/')[0]}.safetensors"
        nearl.import_onnx(path, robot=self.file, recipe=recipe, name="g1").save(out)
        return out


def deployed(checkout: Path, kind: str) -> dict:
    folder = checkout / "deploy/robots/g1/config/policy" / kind
    return yaml.safe_load((folder / "params" / "deploy.yaml").read_text()) | {"path": folder / "exported" / "policy.onnx"}


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of two quaternions w x y z."""
    out = np.empty(4)
    mujoco.mju_mulQuat(out, a, b)
    return out


def torso(base: np.ndarray, waist: np.ndarray) -> np.ndarray:
    """Rotation of the torso: that of the base (w x y z), then the waist's yaw, roll and pitch."""
    for angle, axis in zip(waist, np.eye(3)[[2, 0, 1]], strict=True):
        turn = np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, axis, angle)
        base = multiply(base, turn)
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, base)
    return out.reshape(3, 3)


def heading(turn: np.ndarray) -> np.ndarray:
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])


class Motion:
    """The clip at 50 frames a second (its file has 30), and what unitree's State_Mimic.cpp tells the policy of it."""

    def __init__(self, checkout: Path):
        rows = np.loadtxt(checkout / "mjlab/motions/g1/dance1_subject2.csv", delimiter=",")
        at = np.arange(0.0, len(rows) - 1, 30 * DT * EVERY)
        whole, part = at.astype(int), (at % 1.0)[:, None]
        frames = (1 - part) * rows[whole] + part * rows[whole + 1]
        base = frames[:, [6, 3, 4, 5]]
        self.base, self.q = base / np.linalg.norm(base, axis=1, keepdims=True), frames[:, 7:]
        self.v = np.gradient(self.q, DT * EVERY, axis=0)
        self.turn = np.eye(3)

    def begin(self, base: np.ndarray, q: np.ndarray) -> None:
        """The clip turned to where the robot looks."""
        self.turn = heading(torso(base, q[12:15])) @ heading(torso(self.base[0], np.zeros(3))).T

    def tell(self, tick: int, base: np.ndarray, q: np.ndarray) -> list[float]:
        """Reference positions and velocities of the joints, and two columns of the rotation from the torso to that of the reference."""
        k = min(tick // EVERY, len(self.q) - 1)
        reference = self.turn @ torso(self.base[k], self.q[k, 12:15])
        between = torso(base, q[12:15]).T @ reference
        return [*self.q[k], *self.v[k], *between[:, :2].ravel()]


def fly(robot: G1, motion: Motion, snapshots: list[Path], name: str, seconds: float) -> list[str]:
    """Peak torque as a share of the motors', peak change of it [N m/s], both whenever and in 0.1 s behind a switch, falls, switches."""
    model = mujoco.MjModel.from_xml_path(str(robot.file))
    # The drives without their own stops: what is asked of the motors is what is looked at.
    model.jnt_actfrclimited[:] = 0
    d = mujoco.MjData(model)

    def stand() -> None:
        mujoco.mj_resetData(model, d)
        d.qpos[2], d.qpos[7:] = 0.78, robot.pose

    stand()
    peak, rate, falls, episode, begins, before, since = np.zeros(2), np.zeros(2), 0, 0, True, None, 0
    pushing = ThreadPoolExecutor(1)
    with (
        nearl.Plant(name, ["floating_base_joint", *robot.joints], robot.observation, DT, 29, nq=36, nv=35, lockstep=True) as plant,
        nearl.Loop(snapshots[0], name, patience=30.0, ramp=0.0, rollback_window=0) as loop,
    ):
        motion.begin(d.qpos[3:7], d.qpos[7:])
        acted, pushes, pushed = 0, 0, 0
        while acted < seconds / DT:
            q, v = in_nearls_words(d)
            observation = [*d.qpos[7:], *d.qvel[6:], 0.4, 0.0, 0.0, *motion.tell(since, d.qpos[3:7], d.qpos[7:])]
            turn, target = plant.exchange(q, v, observation, patience=0.5, time=d.time, episode=episode, begins=begins)
            if turn != "act" or target is None:
                if acted == 0 and not loop.running:
                    loop.stop()  # raises what the loop refused
                continue
            begins, acted, since = False, acted + 1, since + 1
            torque = robot.kp * (target - d.qpos[7:]) - robot.kd * d.qvel[6:]
            share = np.abs(torque / robot.effort).max()
            change = 0.0 if before is None else np.abs(torque - before).max() / DT
            at = [0, 1] if pushes and acted - pushed < 0.1 / DT else [0]
            peak[at], rate[at], before = np.maximum(peak[at], share), np.maximum(rate[at], change), torque
            d.ctrl[:] = target
            mujoco.mj_step(model, d)
            if d.qpos[2] < 0.4:
                falls, episode, begins, before, since = falls + 1, episode + 1, True, None, 0
                stand()
                motion.begin(d.qpos[3:7], d.qpos[7:])
            if len(snapshots) > 1 and acted % SWITCH == 0:
                # From another thread: the loop answers behind a tick, and the ticks are this one's.
                pushes, pushed, since = pushes + 1, acted, 0
                motion.begin(d.qpos[3:7], d.qpos[7:])
                pushing.submit(push, name, snapshots[pushes % 2])
        pushing.shutdown(wait=False, cancel_futures=True)
        swaps = loop.stop()["counters"]["swaps"]
    behind = [f"{peak[1]:.3f}", f"{rate[1]:.0f}"] if swaps else ["", ""]
    return [f"{peak[0]:.3f}", f"{rate[0]:.0f}", *behind, str(falls), str(swaps)]


def main(checkout: Path) -> None:
    if not (checkout / "deploy/robots/g1").is_dir():
        sys.exit(f"dance.py: '{checkout}' is no checkout of unitree_rl_mjlab: it has no folder deploy/robots/g1")
    print("| policy | targets | peak torque (motors' = 1) | its peak rate [N m/s] | peak torque behind a switch | its peak rate | falls | switches |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        robot, motion = G1(checkout, Path(scratch)), Motion(checkout)
        kinds = list(robot.said)
        for how, constraints, clamped in (("raw", "guard = false", False), ("clamped", "guard = false", True), ("guarded", GUARD, False)):
            pair = [robot.snapshot(kind, constraints, clamped, Path(scratch)) for kind in kinds]
            flights = {"switched": (pair, 60.0)}
            if not clamped:
                flights = {"walks": (pair[:1], 30.0), "dances": (pair[1:], 30.0)} | flights
            for what, (snapshots, seconds) in flights.items():
                cells = fly(robot, motion, snapshots, f"g1-{how}-{what}", seconds)
                print(f"| {what} | {how} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
