"""A Franka arm over its own protocol: attacked policies through the driver of examples/franka, against franky-sim.

    python results/doors/franka.py [TICKS] > results/doors/franka.md

Needs `pip install franky-sim==1.0.4` beside nearl, and `cargo build --release --locked --manifest-path examples/franka/Cargo.toml` (DRIVER names another
place of the program). The simulator (MuJoCo behind the robot's TCP and UDP messages) waits for each command, so that a busy machine changes nothing. What is
counted is the simulator's own state, in each millisecond, against the numbers of the robot's URDF and of the task.
"""

import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path

import franky_sim
import mujoco
import numpy as np
import onnx
from franky_sim.franka_robot_server import ControlMode
from franky_sim.franka_server import ConnectCommand, MessageHeader
from franky_sim.mujoco_simulator import MujocoSimulator
from onnx import TensorProto, helper, numpy_helper

import nearl

ROOT = Path(__file__).parents[2]
DRIVER = os.environ.get("DRIVER", str(ROOT / "examples/franka/target/release/nearl-franka"))
JOINTS = [f"joint{i}" for i in range(1, 8)]
MARGIN, ACCELERATION, JERK, SPEED = 0.01, 8.0, 200.0, 0.95  # rad, rad/s^2, rad/s^3, share of the URDF's
REST = 0.1  # rad/s; the simulator's own hold leaves joint 7 trembling at 0.08
AFTERWARDS = 1500  # ms looked at after a process was killed
PATIENCE = 0.4  # s for which simulated time stands still; the driver gives up after a second without a state
ATTACK = """
import sys
import numpy as np
import nearl
random, k = np.random.default_rng(0), 0
with nearl.Proposer(sys.argv[1], patience=60.0) as proposer:
    for state in proposer.states(patience=10.0):
        k += 1
        side = random.choice([-1.0, 1.0], 7) if k % 300 == 1 else side
        proposer.propose(np.concatenate([state.q + side * random.uniform(0.0, 3.0, 7), side * 10.0]))
"""
ATTACKED = [
    "attack",
    "rotors, friction, hand",
    "ticks led",
    "cut by the robot's limits on torque",
    "broken limits asked for",
    "states outside",
    "furthest into a margin [1e-3 rad]",
    "beyond 95 % of a speed [1e-3 rad/s]",
    "largest torque",
]
KILLED = [
    "killed",
    "fastest joint then [rad/s]",
    "at rest after [ms]",
    "way of the farthest joint [rad]",
    "fastest joint afterwards [rad/s]",
    "states outside in the whole run",
]


def connect_as_libfranka_reads_it(self, server, command_type_struct="I"):
    """The reply to Connect as of version 10 of the protocol: status in one byte, version in two. franky-sim 1.0.4 sends the status in two."""
    payload = bytes([0]) + server.library_version.to_bytes(2, "little") + bytes(5)
    self.client_socket.sendall(MessageHeader(self.command_type, self.command_id, len(payload)).to_bytes(command_type_struct) + payload)
    server._setup_udp_connection(self.network_udp_port)


class Arm(threading.Thread):
    """franky-sim's FR3 on a free loopback address; `states` has q, v and the torques applied in each millisecond."""

    def __init__(self, mended: bool = True):
        super().__init__(daemon=True)
        self.handle = ConnectCommand.handle
        if mended:
            ConnectCommand.handle = connect_as_libfranka_reads_it
        self.states, self.over, self.late = [], threading.Event(), 0
        self.simulator = MujocoSimulator()
        self.simulator.init()
        self.robot = self.simulator.add_robot()
        self.server = franky_sim.SimulationServer(self.simulator)
        self.server.init()
        self.simulator.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # a wild arm would hit itself and the ground
        self.address = self.robot.hostname
        self.start()

    def run(self):
        (server,) = self.server.robot_servers
        wanted = lambda: server._FrankaServer__message_id - 1  # noqa: E731  # the state that was sent last
        got = lambda: server._FrankaRobotServer__current_control_command.message_id  # noqa: E731
        torque_loop = lambda: server._FrankaRobotServer__control_mode == ControlMode.TORQUE  # noqa: E731
        while not self.over.is_set():
            began = time.monotonic()
            server.process_commands()
            while torque_loop() and got() < wanted() and time.monotonic() < began + PATIENCE and not self.over.is_set():
                time.sleep(2e-5)
                server.process_commands()
            self.late += torque_loop() and got() < wanted()
            self.simulator.step()
            state = self.robot.inner_state
            self.states.append((*state.q, *state.dq, *self.robot.state.tau_J_d))
            server.send_state()
            if not torque_loop():
                time.sleep(1e-3)

    def stop(self):
        self.over.set()
        self.join()
        self.server.cleanup()
        self.simulator.cleanup()
        ConnectCommand.handle = self.handle


def simulated(joint: str) -> dict:
    """What the simulation has for a joint, where its file differs from the URDF that the robot sends."""
    of = ET.parse(Path(franky_sim.__file__).parent / "assets/fr3.xml").getroot()
    return {**of.find("default/default[@class='fr3']/joint").attrib, **of.find(f".//joint[@name='fr3_{joint}']").attrib}


def within_stops(urdf: str) -> str:
    """The URDF that the robot sends, without its friction, and with the ends of the simulated joints: the simulation stops some of them earlier."""
    root = ET.fromstring(urdf)
    for joint in root.iter("joint"):
        for dynamics in list(joint.iter("dynamics")):
            joint.remove(dynamics)
        if joint.get("type") == "revolute":
            limit, ends = joint.find("limit"), [float(x) for x in simulated(joint.get("name"))["range"].split()]
            limit.set("lower", str(max(float(limit.get("lower")), ends[0])))
            limit.set("upper", str(min(float(limit.get("upper")), ends[1])))
    return ET.tostring(root, encoding="unicode")


def arm_file(urdf: str, folder: Path, known: bool) -> Path:
    """The robot as it describes itself; or, if `known`, as it is simulated: rotors, dampers, friction and the hand, whose fingers do not move here."""
    file = folder / ("known.xml" if known else "served.urdf")
    if not known:
        file.write_text(urdf)
        return file
    root = ET.parse(Path(franky_sim.__file__).parent / "assets/fr3.xml").getroot()
    for name in ("asset", "tendon", "equality", "contact", "keyframe"):
        root.remove(root.find(name))
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in ("geom", "site") or child.get("class") == "finger" or (child.tag == "default" and child.get("class") not in (None, "fr3")):
                parent.remove(child)
    actuator = root.find("actuator")
    actuator.clear()
    for joint in root.iter("joint"):
        if "name" in joint.attrib:
            name, effort = joint.get("name").removeprefix("fr3_"), joint.get("actuatorfrcrange")
            joint.set("name", name)
            ET.SubElement(actuator, "motor", name=name, joint=name, ctrlrange=effort)
    root.find("option").clear()  # one Euler step a period; dampers are taken in as with implicitfast
    file.write_text(ET.tostring(root, encoding="unicode"))
    return file


def task(robot: Path, speeds: np.ndarray) -> str:
    """Limits of the attacked arm."""
    kind = "mjcf" if robot.suffix == ".xml" else "urdf"
    observation = [f"{x}.{joint}" for x in "qv" for joint in JOINTS]
    limit = ", ".join(f"{joint} = {SPEED * speed:.4f}" for joint, speed in zip(JOINTS, speeds))
    return f"""name = "fr3"
[model]
{kind} = "{robot.name}"
[time]
dt = 0.001
sim_dt = 0.001
policy_every = 1
[state]
observation = {json.dumps(observation)}
[constraints]
position = {{ margin = {MARGIN} }}
velocity = {{ limit = {{ {limit} }} }}
acceleration = {{ limit = {ACCELERATION} }}
jerk = {{ limit = {JERK}, hard = true }}
torque = {{ scale = 0.95 }}
guard = GUARD
[idm]
kind = "pinocchio"
"""


def network(folder: Path) -> Path:
    """A wild policy of somebody else's: random weights, torques that jump between the ends of the motors."""
    random = np.random.default_rng(0)
    sizes, value, nodes, constants = (14, 64, 7), "obs", [], []
    for k, (n, m) in enumerate(itertools.pairwise(sizes)):
        for name, array in ((f"w{k}", 20.0 * random.normal(size=(n, m))), (f"b{k}", random.normal(size=m))):
            constants.append(numpy_helper.from_array(array.astype(np.float32), name))
        nodes += [helper.make_node("Gemm", [value, f"w{k}", f"b{k}"], [f"x{k}"]), helper.make_node("Tanh", [f"x{k}"], [f"y{k}"])]
        value = f"y{k}"
    nodes[-1].output[0] = "actions"
    info = lambda name, n: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, n])  # noqa: E731
    graph = helper.make_graph(nodes, "policy", [info("obs", 14)], [info("actions", 7)], constants)
    path = folder / "policy.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


def snapshot(kind: str, robot: Path, speeds: np.ndarray, folder: Path) -> Path:
    """Robot and limits, with a random network of torques, or for a process that proposes states."""
    path = folder / f"{kind}-{robot.stem}.safetensors"
    file = folder / f"{kind}-{robot.stem}.toml"
    if kind == "states":
        file.write_text(task(robot, speeds).replace("guard = GUARD\n", ""))
        nearl.blank(str(file), path)
        return path
    policy = f"""[policy]
joints = {json.dumps(JOINTS)}
pose = {[0.0] * 7}
action = {{ scale = [87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0] }}
observation = [{{ term = "joint_pos" }}, {{ term = "joint_vel" }}]
"""
    recipe = task(robot, speeds).replace("GUARD", "true").split("[state]")
    file.write_text(f"[time]\ndt = 0.001\nsim_dt = 0.001\n[constraints]{recipe[1].split('[constraints]')[1].split('[idm]')[0]}{policy}")
    nearl.import_onnx(network(folder), robot=robot, recipe=file, name="fr3").save(path)
    return path


def driver(address: str, *words: str, **more) -> subprocess.Popen:
    return subprocess.Popen([DRIVER, address, *words], stdout=subprocess.PIPE, text=True, **more)


class Meter:
    """States against the limits, by numbers of the robot's URDF."""

    def __init__(self, urdf: str):
        limits = [joint.find("limit").attrib for joint in ET.fromstring(urdf).iter("joint") if joint.get("type") == "revolute"]
        self.low, self.high, self.speed, self.effort = (np.array([float(x[key]) for x in limits]) for key in ("lower", "upper", "velocity", "effort"))

    def __call__(self, states: list) -> dict:
        q, v, tau = np.split(np.array(states), 3, axis=1)
        position = np.maximum(self.low - q, q - self.high)
        speed = np.abs(v) - SPEED * self.speed
        return {
            "outside": int(((position > 0).any(1) | (np.abs(v) > self.speed).any(1)).sum()),
            "position": position.max() + MARGIN,
            "speed": speed.max(),
            "torque": float((np.abs(tau) / self.effort).max()),
        }


def attacked(kind: str, known: bool, ticks: int, folder: Path) -> dict:
    """A row of the first table."""
    arm = Arm()
    urdf = within_stops(driver(arm.address, "model").communicate()[0])
    meter, robot = Meter(urdf), arm_file(urdf, folder, known)
    file, name = snapshot(kind, robot, meter.speed, folder), f"franka{os.getpid()}"
    proposer = subprocess.Popen([sys.executable, "-c", ATTACK, name]) if kind == "states" else None
    begin = len(arm.states)
    with driver(arm.address, "drive", name, "--simulated", "--braking", str(ACCELERATION)) as process:
        age = {"proposal_age": 5.0, "proposal_hold": 5.0} if proposer else {}
        with nearl.Loop(file, name, seconds=ticks / 1000, patience=30.0, **age) as loop:
            report = loop.wait()
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        said = json.loads(process.communicate()[0])
    if proposer:
        proposer.kill(), proposer.wait()
    arm.stop()
    found, c = meter(arm.states[begin:]), report["counters"]
    print(report["modes"], said, found, arm.late, file=sys.stderr)
    cells = (
        "states of a process" if proposer else "torques of a network",
        "known" if known else "not known",
        said["acted"],
        said["limited"],
        c["raw_violations"],
        found["outside"],
        f"{1e3 * found['position']:.2f}",
        f"{1e3 * found['speed']:.2f}",
        f"{100 * found['torque']:.0f} %",
    )
    return dict(zip(ATTACKED, cells))


def line(cells: Iterable) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def killed(who: str, folder: Path, after: float) -> dict:
    """A row of the second table: `who` is killed in the midst of a wild motion."""
    arm = Arm()
    urdf = within_stops(driver(arm.address, "model").communicate()[0])
    meter = Meter(urdf)
    file, name = snapshot("torques", arm_file(urdf, folder, True), meter.speed, folder), f"franka{os.getpid()}"
    process = driver(arm.address, "drive", name, "--simulated", "--braking", str(ACCELERATION))
    loop = subprocess.Popen([sys.executable, "-m", "nearl", "run", str(file), "--plant", name], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    begin = len(arm.states)
    moving = lambda: np.abs(np.array(arm.states[-1][7:14])).max() > 1.0  # noqa: E731
    deadline = time.monotonic() + 120.0
    while (len(arm.states) < begin + 1000 * after or not moving()) and time.monotonic() < deadline:
        time.sleep(2e-3)
    (loop if who == "loop" else process).kill()
    at = len(arm.states)
    while len(arm.states) < at + AFTERWARDS and time.monotonic() < deadline:
        time.sleep(0.01)
    for each in (loop, process):
        each.kill(), each.wait()
    arm.stop()
    found, end = meter(arm.states[begin:]), np.array(arm.states[at:])
    fast = np.abs(end[:, 7:14]).max(1)
    still = int(np.flatnonzero(fast > REST)[-1]) + 1 if (fast > REST).any() else 0
    way = np.abs(end[-1, :7] - end[0, :7]).max()
    print(who, at, len(end), still, found, file=sys.stderr)
    return dict(zip(KILLED, (who, f"{fast[0]:.2f}", still, f"{way:.3f}", f"{fast[still:].max():.4f}", found["outside"])))


def head(cells: list[str]) -> str:
    return f"{line(cells)}\n|{'---|' * len(cells)}"


def main(ticks: int = 10_000) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(head(ATTACKED), flush=True)
        for kind in ("torques", "states"):
            for known in (True, False):
                print(line(attacked(kind, known, ticks, folder).values()), flush=True)
        print(f"\n{head(KILLED)}")
        for who, after in [("loop", 1.0 + 0.4 * k) for k in range(6)] + [("driver", 1.0), ("driver", 2.0)]:
            print(line(killed(who, folder, after).values()), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
