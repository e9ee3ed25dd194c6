"""`nearl.Guard` around environments that do something else with an action than it reckons with: they are refused, or warned of."""

import warnings
from typing import ClassVar

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
mujoco = pytest.importorskip("mujoco")

from guarded_envs import FAST, SLOW, Cart, fastest  # noqa: E402
from gymnasium import wrappers  # noqa: E402
from gymnasium.envs.mujoco import MujocoEnv  # noqa: E402
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv  # noqa: E402

import nearl  # noqa: E402


class Doubled(HalfCheetahEnv):
    """An environment that scales its actions, as many do."""

    def step(self, action):
        return super().step(np.clip(2.0 * np.asarray(action), -1, 1))


class Repeated(gymnasium.Wrapper):
    def step(self, action):
        self.env.step(action)
        return self.env.step(action)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: wrappers.RescaleAction(gymnasium.make("HalfCheetah-v5"), np.float32(-0.1), np.float32(0.1)), "actuator 'bthigh' got .* give ctrl="),
        (lambda: wrappers.TransformAction(gymnasium.make("HalfCheetah-v5"), lambda a: -a, None), "put the wrapper around the guard, or give ctrl="),
        (Doubled, "actuator 'bthigh' got .* give ctrl="),
        (lambda: Repeated(gymnasium.make("HalfCheetah-v5")), "took 0.1 s and its frame_skip says 0.05 s; put the wrapper that repeats"),
    ],
)
def test_an_environment_that_makes_other_controls_of_its_actions_is_refused_at_once(make, words):
    env = nearl.Guard(make(), FAST)
    env.reset(seed=0)
    env.action_space.seed(0)
    with pytest.raises(ValueError, match=words):
        env.step(np.zeros(6, np.float32))  # of which every factor makes the same
        for _ in range(3):
            env.step(env.action_space.sample())


@pytest.mark.parametrize(
    "make",
    [
        lambda: nearl.Guard(Doubled(), FAST, ctrl=lambda a: 2.0 * a),
        lambda: wrappers.RescaleAction(nearl.Guard(gymnasium.make("HalfCheetah-v5"), FAST), np.float32(-0.1), np.float32(0.1)),
        lambda: nearl.Guard(wrappers.ClipAction(gymnasium.make("HalfCheetah-v5")), FAST),
    ],
)
def test_ctrl_and_wrappers_around_the_guard_keep_the_limits(make):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        most, silent = fastest(make())
    assert most <= 20.0 + 1e-9 and silent == 0


def test_controls_that_differ_now_and_then_are_warned_of_once_and_never_called_kept():
    env = nearl.Guard(wrappers.StickyAction(gymnasium.make("HalfCheetah-v5"), repeat_action_probability=0.5), {"velocity": {"limit": 12.0}})
    env.reset(seed=0)
    rng, silent, said = np.random.default_rng(0), 0, 0
    with pytest.warns(UserWarning, match="limits do not hold in such steps") as told:
        for _ in range(300):
            *_, info = env.step(rng.choice([-1, 1], 6).astype(np.float32))
            over = np.abs(env.unwrapped.data.qvel[3:]).max() > 12.0
            silent, said = silent + (over and info["guard"] != "outside"), said + (info["guard"] == "outside")
    assert silent == 0 and said > 3 and len(told) == 1
    # an action of zeros that is repeated before any other one is no reason to refuse it
    repeated = 0
    for seed in range(20):
        env = nearl.Guard(wrappers.StickyAction(gymnasium.make("HalfCheetah-v5"), repeat_action_probability=0.25), FAST)
        env.reset(seed=seed)
        env.step(np.zeros(6, np.float32))
        env.step(rng.uniform(0.1, 1, 6).astype(np.float32))
        repeated += not env.unwrapped.data.ctrl.any()
    assert repeated > 0


class Unmoved(HalfCheetahEnv):
    """An environment whose actions are forces of its own."""

    def step(self, action):
        self.data.qfrc_applied[3:] = 50.0 * np.asarray(action)
        return super().step(np.zeros(6))


def test_an_environment_that_leaves_its_actuators_alone_is_refused():
    env = nearl.Guard(Unmoved(), FAST)
    env.reset(seed=0)
    env.action_space.seed(0)
    with pytest.raises(ValueError, match="got 0 where the guard had foreseen"):
        for _ in range(6):
            env.step(env.action_space.sample())


class Pushed(HalfCheetahEnv):
    """Wind, which no action tells of."""

    def step(self, action):
        self.data.qfrc_applied[3:] = self.np_random.choice([-300.0, 300.0], 6)
        return super().step(action)


class Looked(HalfCheetahEnv):
    """Forward dynamics before the step: the contact solver begins elsewhere."""

    def step(self, action):
        self.data.qacc_warmstart[:] = 0
        mujoco.mj_forward(self.model, self.data)
        return super().step(np.float32(action))


def test_other_forces_are_warned_of_and_a_warm_start_is_not():
    env = nearl.Guard(Pushed(), FAST)
    with pytest.warns(UserWarning, match="moves the robot by something else too"):
        _, silent = fastest(env)
    assert silent == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert fastest(nearl.Guard(Looked(), FAST))[1] == 0


@pytest.mark.parametrize("name", ["Ant", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum", "InvertedPendulum", "Pusher", "Reacher"])
def test_no_environment_of_gymnasium_is_called_another_one(name):
    """Also where it is begun anew within a step."""
    env = nearl.Guard(wrappers.Autoreset(gymnasium.make(f"{name}-v5", max_episode_steps=30)), {"velocity": {"limit": 8.0}})
    env.action_space.seed(1)
    env.reset(seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        for _ in range(70):
            before = env.unwrapped.data.time
            *_, info = env.step(env.action_space.sample())
            assert (info["guard"] == "outside") == env.outside or env.unwrapped.data.time <= before


BAR = '<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" contype="0" conaffinity="0"/>'
CHAIN = f"""<mujoco><compiler angle="radian"/><option timestep="0.005" gravity="0 0 0"/><worldbody>
<body><joint name="c" axis="0 0 1" range="-9 9" limited="true"/>{BAR}
<body pos=".3 0 0"><joint axis="0 0 1" range="-9 9" limited="true"/>{BAR}
<body pos=".3 0 0"><joint axis="0 0 1" range="-9 9" limited="true"/>{BAR}</body></body></body></worldbody>
<actuator><motor joint="c" ctrlrange="-3 3" ctrllimited="true"/></actuator></mujoco>"""


class Chain(MujocoEnv):
    metadata: ClassVar = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 100}

    def __init__(self, file, actions=1):
        MujocoEnv.__init__(self, str(file), 2, gymnasium.spaces.Box(-9, 9, (6,)))
        if actions != 1:
            self.action_space = gymnasium.spaces.Box(-1, 1, (actions,), np.float32)

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self._get_obs(), 0.0, False, False, {}

    def _get_obs(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset_model(self):
        self.set_state(self.init_qpos, self.init_qvel)
        return self._get_obs()


def test_joints_without_a_name_are_guarded_each(tmp_path):
    (tmp_path / "chain.xml").write_text(CHAIN)
    most = {}
    for limit in (1.0, {"c": 1.0, 1: 1.2, 2: 1.0}):
        env = nearl.Guard(Chain(tmp_path / "chain.xml"), {"velocity": {"limit": limit}})
        env.reset(seed=0)
        rng, speeds = np.random.default_rng(0), np.zeros(3)
        for _ in range(400):
            *_, info = env.step(rng.choice([-0.9, 0.9], 1))
            speeds = np.maximum(speeds, np.abs(env.unwrapped.data.qvel))
            assert info["guard"] != "outside"
        most[str(limit)] = speeds
    every, last = most.values()
    assert (every <= 1.0 + 1e-9).all() and (last <= np.array([1.0, 1.2, 1.0]) + 1e-9).all() and last[1] > 1.1, (every, last)
    with pytest.raises(ValueError, match="no such joint 'd'; it has c, 1, 2"):
        nearl.Guard(Chain(tmp_path / "chain.xml"), {"velocity": {"limit": {"d": 1.0}}})


def test_actuators_with_a_delay_are_named_once(tmp_path):
    """A step ahead shows nothing of an action that arrives after it."""
    (tmp_path / "chain.xml").write_text(CHAIN.replace("<motor ", '<motor nsample="5" delay="0.01" ', 1))
    with pytest.warns(UserWarning, match=r"act with a delay: '?\w+'? \(0\.01 s\); the guard looks one step ahead"):
        env = nearl.Guard(Chain(tmp_path / "chain.xml"), FAST)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset(seed=0)
        env.set_constraints(FAST)


def test_a_ctrl_that_fits_no_actuators_is_refused(tmp_path):
    (tmp_path / "chain.xml").write_text(CHAIN)
    with pytest.raises(ValueError, match=r"the action has shape \(2,\) and the robot 1 actuators; give ctrl="):
        nearl.Guard(Chain(tmp_path / "chain.xml", actions=2), FAST)
    env = nearl.Guard(Chain(tmp_path / "chain.xml"), FAST, ctrl=lambda a: np.zeros(2))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"ctrl gives shape \(2,\) for an action, expected \(1,\)"):
        env.step(np.zeros(1))
    (tmp_path / "free.xml").write_text(CHAIN.replace('ctrlrange="-3 3" ctrllimited="true"', ""))
    with pytest.raises(ValueError, match="unbounded in entry 0 and actuator '0' has no ctrlrange; give it one"):
        nearl.Guard(wrappers.ClipAction(Chain(tmp_path / "free.xml")), FAST)
    with pytest.raises(ValueError, match="unbounded in entry 0 and ctrl= makes others of them"):
        nearl.Guard(wrappers.ClipAction(gymnasium.make("HalfCheetah-v5")), FAST, ctrl=lambda a: a)


class Nothing(gymnasium.Env):
    model, data, frame_skip, action_space = None, None, 1, gymnasium.spaces.Box(-1, 1, (2,))


class Skips(Cart):
    def step(self, action):
        self.frame_skip = 3
        return super().step(action)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: nearl.Guard(Nothing(), SLOW), r"is no MuJoCo environment with continuous actions \(no model, data\)"),
        (lambda: nearl.Guard(Cart(), SLOW, ctrl=3), "ctrl is 3; give the function"),
        (lambda: nearl.Guard(Cart(), SLOW, ctrl=lambda a: a * [1, np.nan]), "ctrl gives nan for actuator '1': every entry must be finite"),
        (lambda: nearl.Guard(Cart(), SLOW, seed=-1), "seed is -1; give a whole number"),
        (lambda: nearl.Guard(Skips(), SLOW), "took 0.03 s and its frame_skip says 0.01 s"),
    ],
)
def test_what_no_guard_can_be_made_of_is_refused_in_a_sentence(make, words):
    with pytest.raises(ValueError, match=words):
        env = make()
        env.reset(seed=0)
        env.step(np.ones(2))
