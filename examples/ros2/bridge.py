"""A ROS 2 robot as the plant of a loop: `sensor_msgs/JointState` in, `std_msgs/Float64MultiArray` out, as ros2_control's forward controllers take it.

    pip install ros-rclpy==9.1.2 ros-rmw-fastrtps-cpp ros-rmw-implementation ros-fastdds ros-sensor-msgs     # or a ROS 2 of the system
    python examples/ros2/bridge.py arm policy.safetensors        # beside: nearl run policy.safetensors --plant arm

Positions are commanded (`[command] interface = "position"` in the task file): the projected target is the command. Where no answer comes, and
where the loop says brake, commands go on slower and slower, by what the acceleration limits allow. For 50 to 200 Hz: a message through ROS
takes a millisecond or two, and now and then ten. Joints are joined by name, whatever order the robot publishes them in. Where messages come in
bunches, a command waits until the one before has had its period, but for 5 %: speeds may be so much above their limit and no more. What
the network does to commands on their way to the robot the bridge cannot know.
"""

import math
import sys
import time

import numpy as np

import nearl

try:
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray
except ImportError as error:
    packages = "ros-rclpy==9.1.2 ros-rmw-fastrtps-cpp ros-rmw-implementation ros-fastdds ros-sensor-msgs"
    raise SystemExit(f"bridge.py needs ROS 2, but {error}: pip install {packages}, or source the system's") from None

SHARE = 0.95  # of a period, which a command has at least before the next
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class Bridge(Node):
    """One exchange with the loop for each measurement that ROS brings."""

    def __init__(
        self,
        name: str,
        joints: list[str],
        dt: float,
        most: np.ndarray,
        states: str = "joint_states",
        commands: str = "forward_position_controller/commands",
    ):
        super().__init__(f"nearl_{name}".replace("-", "_"))
        self.joints, self.dt, self.turns = joints, dt, {"act": 0, "hold": 0, "brake": 0}
        self.most = most  # rad/s² or m/s², the acceleration limits
        self.command: np.ndarray | None = None  # sent last, and its mean speed on the way there
        self.speed = np.zeros(len(joints))
        self.sent = -math.inf  # s, when the last command went out
        observation = [f"q.{joint}" for joint in joints] + [f"v.{joint}" for joint in joints]
        self.plant = nearl.Plant(name, joints, observation, dt, len(joints), watchdog=10 * dt)
        self.sender = self.create_publisher(Float64MultiArray, commands, NEWEST)
        self.create_subscription(JointState, states, self.measured, NEWEST)

    def measured(self, message: JointState) -> None:
        place = {joint: i for i, joint in enumerate(message.name)}
        if missing := [joint for joint in self.joints if joint not in place]:
            raise ValueError(f"joint_states has no '{missing[0]}'; it has {', '.join(message.name)}")
        q = [message.position[place[joint]] for joint in self.joints]
        v = [message.velocity[place[joint]] for joint in self.joints]
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        turn, action = self.plant.exchange(q, v, [*q, *v], patience=0.6 * self.dt, time=stamp)
        self.turns[turn] += 1
        if self.command is None:  # nobody has led it yet
            self.command = np.array(q)
        slower = np.copysign(np.maximum(np.abs(self.speed) - self.most * self.dt, 0.0), self.speed)
        self.speed = (action - self.command) / self.dt if turn == "act" else slower
        self.send(self.command + self.dt * self.speed)

    def send(self, command: np.ndarray) -> None:
        time.sleep(max(0.0, self.sent + SHARE * self.dt - time.monotonic()))
        self.command, self.sent = command, time.monotonic()
        self.sender.publish(Float64MultiArray(data=command.tolist()))

    def destroy_node(self) -> None:
        self.plant.close()
        super().destroy_node()


def main(name: str, snapshot: str) -> None:
    controller = nearl.Controller.load(snapshot)
    joints = [entry[2:] for entry in controller.obs_names if entry.startswith("q.")]
    rclpy.init()
    bridge = Bridge(name, joints, controller.dt, controller.limits["acceleration"])
    try:
        rclpy.spin(bridge)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    finally:
        bridge.destroy_node()


if __name__ == "__main__":
    main(*sys.argv[1:])
