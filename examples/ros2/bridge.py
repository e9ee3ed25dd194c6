"""A ROS 2 robot as the plant of a loop: `sensor_msgs/JointState` in, `std_msgs/Float64MultiArray` out, as ros2_control's forward controllers take it.

    pip install ros-rclpy==9.1.2 ros-rmw-fastrtps-cpp ros-rmw-implementation ros-fastdds ros-sensor-msgs     # or a ROS 2 of the system
    python examples/ros2/bridge.py arm policy.safetensors        # beside: nearl run policy.safetensors --plant arm

Positions are commanded (`[command] interface = "position"` in the task file): the projected target is the command, and a brake holds the
last one. For 50 to 200 Hz: a message through ROS takes a millisecond or two, and now and then ten. Joints are joined by name, whatever
order the robot publishes them in. Each command is within a period's motion of the measured position that it answers; where messages are
late by a period, two of them may reach the robot in one, and its speed is up to twice the limit for that period: give velocities a scale
that leaves room, or use a control PC that keeps time.
"""

import sys

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

import nearl

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class Bridge(Node):
    """One exchange with the loop for each measurement that ROS brings."""

    def __init__(self, name: str, joints: list[str], dt: float, states: str = "joint_states", commands: str = "forward_position_controller/commands"):
        super().__init__(f"nearl_{name}".replace("-", "_"))
        self.joints, self.dt, self.turns = joints, dt, {"act": 0, "hold": 0, "brake": 0}
        self.command: list[float] | None = None
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
        time = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        turn, action = self.plant.exchange(q, v, [*q, *v], patience=0.6 * self.dt, time=time)
        self.turns[turn] += 1
        if turn != "brake":
            self.command = [float(x) for x in action]
        elif self.command is None:  # nobody has led it yet
            self.command = list(q)
        self.sender.publish(Float64MultiArray(data=self.command))

    def destroy_node(self) -> None:
        self.plant.close()
        super().destroy_node()


def main(name: str, snapshot: str) -> None:
    controller = nearl.Controller.load(snapshot)
    joints = [entry[2:] for entry in controller.obs_names if entry.startswith("q.")]
    rclpy.init()
    bridge = Bridge(name, joints, controller.dt)
    try:
        rclpy.spin(bridge)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    finally:
        bridge.destroy_node()


if __name__ == "__main__":
    main(*sys.argv[1:])
