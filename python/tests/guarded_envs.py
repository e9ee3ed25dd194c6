"""Environments that are guarded in tests, and what is measured of them."""

from typing import ClassVar

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
mujoco = pytest.importorskip("mujoco")

LIMITS = {"position": {}, "velocity": {"limit": 25.0}}


def outside(env) -> bool:
    """By the robot file's ranges, not by the guard's own words."""
    m, data = env.unwrapped.model, env.unwrapped.data
    ranged = m.jnt_limited.astype(bool)
    q, v = data.qpos[m.jnt_qposadr[ranged]], data.qvel[m.jnt_dofadr[ranged]]
    low, high = m.jnt_range[ranged].T
    return bool((q < low - 1e-9).any() or (q > high + 1e-9).any() or (np.abs(v) > 25.0 + 1e-9).any())


def fastest(env, steps=200, seed=0):
    """The largest speed of the cheetah's joints under wild actions, and the steps beyond 20 rad/s that were not said to end outside."""
    env.reset(seed=seed)
    rng, space = np.random.default_rng(seed), env.action_space
    low, high = np.maximum(space.low, -1), np.minimum(space.high, 1)
    most, silent = 0.0, 0
    for _ in range(steps):
        *_, info = env.step(rng.uniform(low, high).astype(np.float32))
        speed = np.abs(env.unwrapped.data.qvel[3:]).max()
        most, silent = max(most, speed), silent + int(speed > 20 + 1e-9 and info["guard"] != "outside")
    return most, silent


FAST = {"velocity": {"limit": 20.0}}


class Cart(gymnasium.Env):
    """A slide with a range and a hinge without one, each with a motor; `after` may do to it what it likes once a step is done."""

    metadata: ClassVar = {}
    XML = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body><joint name="s" type="slide" axis="1 0 0" range="-1 1"/>
    <inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/><body><joint name="c" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/>
    </body></body></worldbody><actuator><motor joint="s" ctrlrange="-10 10"/><motor joint="c" ctrlrange="-1 1"/></actuator></mujoco>"""

    def __init__(self, gain=1.0, after=lambda env: None, xml=XML):
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data, self.frame_skip, self.gain, self.after, self.steps = mujoco.MjData(self.model), 1, gain, after, 0
        self.action_space = gymnasium.spaces.Box(*self.model.actuator_ctrlrange.T.astype(np.float32))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2 * self.model.nq,), float)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.steps = 0
        return np.concatenate([self.data.qpos, self.data.qvel]), {}

    def step(self, action):
        self.steps += 1
        self.data.ctrl[:] = self.gain * np.asarray(action)
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        self.after(self)
        return np.concatenate([self.data.qpos, self.data.qvel]), 0.0, False, False, {}


SLOW = {"velocity": {"limit": 1.0}}


def bang(env, steps=200):
    """Steps under forces to and fro: the fastest of each joint, and the words of those that did not end within 1 m/s and 1 rad/s."""
    env.reset(seed=0)
    most, words = np.zeros(env.unwrapped.model.nv), []
    for k in range(steps):
        *_, info = env.step(env.action_space.high if k // 60 % 2 == 0 else env.action_space.low)
        speeds = np.abs(env.unwrapped.data.qvel)
        if not (speeds <= 1.0 + 1e-9).all():
            words.append(info["guard"])
        most = np.fmax(most, speeds)
    return most, words


def begun(env):
    """Begins anew every 10 steps, with a clock that shows the time of 20 steps, during which the robot came to rest."""
    if env.steps % 10 == 0:
        mujoco.mj_resetData(env.model, env.data)
        env.data.time = 0.2 * (env.steps // 10 % 2)
