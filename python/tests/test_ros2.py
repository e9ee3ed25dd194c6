"""The ROS 2 bridge between a robot that speaks ROS and a loop: what is commanded keeps the limits, and a loop that goes leaves the robot at rest."""

import importlib.util
import os
import threading
import time

import numpy as np
import pytest
from conftest import ROOT, planar_urdf

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed; examples/ros2/bridge.py says how")
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402

import nearl  # noqa: E402

DT, SPEED, MOST, LOW, HIGH = 0.02, np.array([3.0, 4.0, 5.0]), 20.0, -2.0, 1.8
TASK = f"""name = "planar"
[model]
urdf = "planar.urdf"
[time]
dt = {DT}
sim_dt = {DT}
policy_every = 1
[state]
observation = ["q.joint0", "q.joint1", "q.joint2", "v.joint0", "v.joint1", "v.joint2"]
[command]
interface = "position"
[constraints]
position = {{ margin = 0.0 }}
velocity = {{ scale = 1.0 }}
acceleration = {{ limit = {MOST} }}
[idm]
kind = "pinocchio"
"""


class Robot(threading.Thread):
    """Publishes its joints in an order of its own and reaches what is commanded within a period. Every ninth message is late and comes with the next."""

    def __init__(self, node):
        super().__init__(daemon=True)
        self.q, self.v, self.goal, self.commands, self.over = np.zeros(3), np.zeros(3), np.zeros(3), [], threading.Event()
        self.sender = node.create_publisher(JointState, "joint_states", 1)
        node.create_subscription(Float64MultiArray, "forward_position_controller/commands", self.take, 1)

    def take(self, message):
        self.goal = np.array(message.data)
        self.commands.append(self.goal)

    def run(self):
        begin = time.monotonic()
        for k in range(10**6):
            if self.over.is_set():
                return
            goal = self.goal
            self.q, self.v = goal, (goal - self.q) / DT
            message = JointState(name=["joint2", "joint0", "joint1"], position=self.q[[2, 0, 1]].tolist(), velocity=self.v[[2, 0, 1]].tolist())
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(k * DT * 1e9), 10**9)
            if k % 9 == 8:
                time.sleep(0.9 * DT)  # on its way
            self.sender.publish(message)
            time.sleep(max(0.0, begin + (k + 1) * DT - time.monotonic()))


def test_a_robot_of_ros_obeys_and_rests_when_the_loop_goes(tmp_path):
    spec = importlib.util.spec_from_file_location("bridge", ROOT / "examples/ros2/bridge.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    (tmp_path / "planar.urdf").write_text(planar_urdf())
    (tmp_path / "planar.toml").write_text(TASK)
    snapshot = tmp_path / "blank.safetensors"
    nearl.blank(str(tmp_path / "planar.toml"), snapshot)
    name = f"ros{os.getpid()}"
    rclpy.init(domain_id=os.getpid() % 100)
    node = rclpy.create_node("robot")
    robot, bridge, executor = Robot(node), example.Bridge(name, ["joint0", "joint1", "joint2"], DT, np.full(3, MOST)), SingleThreadedExecutor()
    sent, publish = [], bridge.sender.publish
    bridge.sender.publish = lambda message: (sent.append((bridge.sent, *message.data)), publish(message))  # with the time on which it was computed
    executor.add_node(node)
    executor.add_node(bridge)
    spinning = threading.Thread(target=executor.spin, daemon=True)
    spinning.start()
    robot.start()
    try:
        with nearl.Loop(snapshot, name, patience=30.0, ramp=0.0, proposal_age=2.0, proposal_hold=2.0), nearl.Proposer(name, patience=30.0) as proposer:
            for k, _ in enumerate(proposer.states(patience=30.0)):
                side = 1.0 if k // 60 % 2 == 0 else -1.0
                proposer.propose([9.0 * side] * len(proposer.entries))
                if len(robot.commands) > 400:
                    break
        led = len(robot.commands)
        begin = time.monotonic()
        while len(robot.commands) < led + 40 and time.monotonic() < begin + 30.0:
            time.sleep(0.05)
        rest = np.array(robot.commands[led + 20 :])
    finally:
        robot.over.set()
        executor.shutdown()
        bridge.destroy_node()
        node.destroy_node()
        rclpy.shutdown()
    q = np.array(robot.commands)
    assert bridge.turns["act"] > 200, bridge.turns
    assert (q >= LOW - 1e-6).all() and (q <= HIGH + 1e-6).all() and np.ptp(q, axis=0).min() > 1.0, "within the limits, and it moves"
    times, sent = np.array(sent)[:, 0], np.array(sent)[:, 1:]
    speeds = np.diff(sent, axis=0) / DT
    assert (np.abs(speeds) <= SPEED + 1e-6).all(), "no command is further from the one before than the speed limits allow in a period"
    assert (np.abs(np.diff(speeds, axis=0)) <= MOST * DT + 1e-6).all(), "nor faster or slower than the acceleration limits allow, held or led"
    assert np.diff(times).min() > 0.9 * DT, "and none is closer upon it, though messages come in bunches"
    assert len(rest) > 10 and np.ptp(rest, axis=0).max() == 0.0, "without a loop it holds one position"
