"""A LeRobot robot whose every goal passes position, velocity and acceleration limits: wrap any position-commanded `Robot`.

    pip install lerobot==0.4.4

    robot = GuardedRobot(GuardedRobotConfig(urdf="so101.urdf"), SO101Follower(...))
    robot.connect()
    sent = robot.send_action(policy_action)          # what went to the motors; LeRobot records it

Policies, teleoperators and `lerobot-record` meet the same features. Limits hold for the goals that are sent, one after the other in time:
how well motors follow them is theirs to say. A joint's key is `<joint of the URDF>.pos`; keys of no such joint (a gripper) go through as
they are.
"""

import math
import time
from dataclasses import dataclass

import numpy as np

import nearl

try:
    from lerobot.robots import Robot, RobotConfig
except ImportError as error:
    raise SystemExit(f"guarded_robot.py needs LeRobot, but {error}: pip install lerobot==0.4.4") from None


@RobotConfig.register_subclass("nearl_guarded")
@dataclass
class GuardedRobotConfig(RobotConfig):
    """Where the limits come from."""

    urdf: str = ""
    fps: float = 30.0
    acceleration: float = 10.0  # rad/s^2
    unit: float = math.pi / 180.0  # rad (or m) in one unit of the robot's goals, as with `use_degrees`


class GuardedRobot(Robot):
    """The robot inside, with goals that keep the limits."""

    config_class = GuardedRobotConfig
    name = "nearl_guarded"

    def __init__(self, config: GuardedRobotConfig, robot: Robot):
        super().__init__(config)
        self.config, self.robot, self.dt = config, robot, 1.0 / config.fps
        self.model = nearl.Model.from_urdf(config.urdf)
        self.keys = [f"{joint}.pos" for joint in self.model.joint_names]
        if missing := [key for key in self.keys if key not in robot.action_features]:
            raise ValueError(f"'{missing[0]}' is no goal of {robot.name}; it has {', '.join(robot.action_features)}. Rename the URDF's joints")
        limits = [nearl.PositionLimit(self.model), nearl.VelocityLimit(self.model), nearl.AccelerationLimit(self.model, config.acceleration)]
        self.projector = nearl.Projector(self.model, limits, dt=self.dt)
        self.next = 0.0  # s, earliest time of the next goal

    def send_action(self, action: dict) -> dict:
        """The nearest goals that keep the limits, sent no sooner than a period after those before."""
        time.sleep(max(0.0, self.next - time.perf_counter()))
        goal = np.array([action[key] for key in self.keys]) * self.config.unit
        way = np.clip(goal, self.model.lower_position_limit, self.model.upper_position_limit) - self.q
        # As fast as it can still stop there.
        speed = np.sign(way) * np.minimum(np.abs(way) / self.dt, np.sqrt(self.config.acceleration * np.abs(way)))
        target = self.projector.project(self.q, self.v, q_proposal=self.q + self.dt * speed, v_proposal=speed)
        self.q, self.v = np.array(target.q), np.array(target.v)
        goals = {**action, **dict(zip(self.keys, (self.q / self.config.unit).tolist()))}
        self.robot.send_action(goals)
        self.next = time.perf_counter() + self.dt
        return goals

    def connect(self, calibrate: bool = True) -> None:
        self.robot.connect(calibrate)
        measured = self.robot.get_observation()
        self.q = np.array([measured[key] for key in self.keys]) * self.config.unit
        self.v = np.zeros_like(self.q)

    # What is the inner robot's.

    @property
    def observation_features(self) -> dict:
        return self.robot.observation_features

    @property
    def action_features(self) -> dict:
        return self.robot.action_features

    @property
    def is_connected(self) -> bool:
        return self.robot.is_connected

    @property
    def is_calibrated(self) -> bool:
        return self.robot.is_calibrated

    def calibrate(self) -> None:
        self.robot.calibrate()

    def configure(self) -> None:
        self.robot.configure()

    def get_observation(self) -> dict:
        return self.robot.get_observation()

    def disconnect(self) -> None:
        self.robot.disconnect()
