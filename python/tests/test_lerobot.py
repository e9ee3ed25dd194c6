"""The wrapper of a LeRobot robot, with LeRobot itself: what reaches the motors keeps the limits, in time."""

import importlib.util
import time

import numpy as np
import pytest
from conftest import ROOT, planar_urdf

pytest.importorskip("lerobot", reason="lerobot is not installed (it brings torch)")
from lerobot.robots import Robot, RobotConfig

JOINTS = ["joint0", "joint1", "joint2"]
LOW, HIGH, SPEED, ACCELERATION, FPS = -2.0, 1.8, np.array([3.0, 4.0, 5.0]), 8.0, 100.0


class Recorder(Robot):
    """Reaches every goal at once, and remembers goals [degrees] and times."""

    config_class, name = RobotConfig, "recorder"

    def __init__(self, folder):
        super().__init__(RobotConfig(id="r", calibration_dir=folder))
        self.goals, self.times, self.on = [[10.0, -20.0, 5.0]], [], False
        self.grips = []

    observation_features = action_features = property(lambda self: {**{f"{joint}.pos": float for joint in JOINTS}, "gripper.pos": float})
    is_connected, is_calibrated = property(lambda self: self.on), property(lambda self: True)

    def connect(self, calibrate=True):
        self.on = True

    def get_observation(self):
        return {**{f"{joint}.pos": goal for joint, goal in zip(JOINTS, self.goals[-1])}, "gripper.pos": 0.0}

    def send_action(self, action):
        self.goals.append([action[f"{joint}.pos"] for joint in JOINTS])
        self.times.append(time.perf_counter())
        self.grips.append(action["gripper.pos"])
        return action

    def disconnect(self):
        self.on = False

    def calibrate(self): ...
    def configure(self): ...


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("guarded_robot", ROOT / "examples/lerobot/guarded_robot.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_wild_goals_reach_the_motors_within_the_limits(tmp_path, example):
    (tmp_path / "arm.urdf").write_text(planar_urdf())
    config = example.GuardedRobotConfig(urdf=str(tmp_path / "arm.urdf"), fps=FPS, acceleration=ACCELERATION, calibration_dir=tmp_path)
    inner, rng = Recorder(tmp_path), np.random.default_rng(0)
    with example.GuardedRobot(config, inner) as robot:
        goal = np.zeros(3)
        for k in range(300):
            goal = rng.uniform(-400.0, 400.0, 3) if k % 25 == 0 else goal
            sent = robot.send_action({**dict(zip((f"{joint}.pos" for joint in JOINTS), goal)), "gripper.pos": float(k)})
            assert sent == {**dict(zip((f"{joint}.pos" for joint in JOINTS), inner.goals[-1])), "gripper.pos": float(k)}
    assert not inner.is_connected and inner.grips == list(map(float, range(300)))
    q, dt = np.radians(inner.goals), 1.0 / FPS
    v = np.diff(q, axis=0, prepend=q[:1]) / dt
    assert (q >= LOW - 1e-9).all() and (q <= HIGH + 1e-9).all() and np.ptp(q, axis=0).min() > 1.5, "and it moves"
    assert (np.abs(v) <= SPEED + 1e-6).all()
    # The difference of two means over a period is the acceleration between their middles.
    assert (np.abs(np.diff(v, axis=0)) <= ACCELERATION * dt + 1e-6).all()
    assert np.diff(inner.times).min() >= dt * 0.999, "no goal comes before its period is over"


def test_a_goal_within_the_limits_is_reached_and_kept(tmp_path, example):
    (tmp_path / "arm.urdf").write_text(planar_urdf())
    config = example.GuardedRobotConfig(urdf=str(tmp_path / "arm.urdf"), fps=FPS, acceleration=ACCELERATION, calibration_dir=tmp_path)
    inner = Recorder(tmp_path)
    goal = {"joint0.pos": 40.0, "joint1.pos": 10.0, "joint2.pos": -30.0, "gripper.pos": 0.0}
    with example.GuardedRobot(config, inner) as robot:
        for _ in range(200):
            robot.send_action(goal)
    np.testing.assert_allclose(inner.goals[-1], [40.0, 10.0, -30.0], atol=0.5)
    overshoot = np.max(np.array(inner.goals) - [40.0, 10.0, -30.0], axis=0)[:2]
    assert (overshoot < 0.5).all(), overshoot


def test_a_robot_of_other_joints_is_refused_by_name(tmp_path, example):
    (tmp_path / "arm.urdf").write_text(planar_urdf().replace("joint1", "elbow"))
    with pytest.raises(ValueError, match=r"'elbow.pos' is no goal of recorder"):
        example.GuardedRobot(example.GuardedRobotConfig(urdf=str(tmp_path / "arm.urdf"), calibration_dir=tmp_path), Recorder(tmp_path))
