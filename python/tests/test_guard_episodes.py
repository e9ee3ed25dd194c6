"""`nearl.Guard` over episodes: clocks that stop, states that are none, robots that change."""

import warnings

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
mujoco = pytest.importorskip("mujoco")

from guarded_envs import SLOW, Cart, bang, begun  # noqa: E402

import nearl  # noqa: E402


def stopped(env):
    env.data.time = 0.0


def sawtooth(env):
    env.data.time = 0.01 * (env.steps % 3)


@pytest.mark.parametrize("clock", [stopped, sawtooth])
def test_no_clock_silences_the_comparison(clock):
    """A phase in place of the time: nothing was compared, and 41 of 200 steps beyond the limit were called 'kept' and 'replaced'."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        most, words = bang(nearl.Guard(Cart(after=clock), SLOW))
    assert (most <= 1.0 + 1e-9).all() and not words
    with pytest.warns(UserWarning, match="actuator '1' got .* where the guard had foreseen"):
        most, words = bang(nearl.Guard(Cart(3.0, clock), SLOW))
    assert most[0] > 1.02 and len(words) > 20 and set(words) == {"outside"}
    env = nearl.Guard(Cart(3.0, clock), SLOW)
    env.reset()
    with pytest.raises(ValueError, match="actuator '0' got 6 where the guard had foreseen 2"):
        for _ in range(2):
            env.step(np.array([2.0, 0.2]))


class Ending(gymnasium.Wrapper):
    def step(self, action):
        obs, reward, _, truncated, info = self.env.step(action)
        return obs, reward, self.unwrapped.steps % 10 == 0, truncated, info


def test_a_beginning_within_a_step_is_no_other_step():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        most, words = bang(nearl.Guard(Ending(Cart(after=begun)), SLOW))
    assert (most <= 1.0 + 1e-9).all() and not words


def lost(env):
    if env.steps == 50:
        env.data.qvel[1] = np.nan


def test_a_state_that_is_no_number_is_outside():
    env = nearl.Guard(Cart(after=lost), SLOW)
    env.unwrapped.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    with pytest.warns(UserWarning, match="the velocity of joint 'c' is nan, from which no action leads back: reset the environment"):
        _, words = bang(env)
    assert len(words) == 151 and set(words) == {"outside"} and env.outside
    env.reset()
    assert not env.outside and env.step(np.zeros(2))[4]["guard"] == "kept"


def test_an_action_at_which_mujoco_gives_up_does_not_lead_inside():
    """MuJoCo begins anew by itself above 1e10 m/s², at rest: that looked like the best of all ends, and was called "kept"."""
    xml = Cart.XML.replace('"0.01"', '"1e-6"').replace('"-10 10"', '"-4e9 4e9"').replace('mass="1"', 'mass="0.1"')
    free, asked = Cart(xml=xml), np.array([4e9, 0.0])
    free.step(asked)
    assert not free.data.qvel.any(), "it did not give up"
    env = nearl.Guard(Cart(xml=xml), {"velocity": {"limit": 8e3}})
    env.reset()
    *_, info = env.step(asked)
    speed = np.abs(env.unwrapped.data.qvel).max()
    assert info["guard"] == "replaced" and 0.0 < speed <= 8e3
    env = nearl.Guard(Cart(xml=xml), {"velocity": {"limit": 8e3}}, unavoidable="kept")
    env.reset()
    with pytest.warns(UserWarning, match="MuJoCo gave up in the middle of a step") as told:
        for _ in range(3):
            env.unwrapped.data.qvel[1] = 1e6  # from which nothing leads back
            *_, info = env.step(asked)
            assert info["guard"] == "outside" and not env.unwrapped.data.qvel.any()
    assert len(told) == 1


@pytest.mark.parametrize("name", ["Reacher-v5", "Pusher-v5", "Swimmer-v5"])
def test_one_number_is_for_every_joint_that_an_actuator_moves(name):
    """Reacher's shoulder turns without end: it reached 126 rad/s of 2."""
    env = nearl.Guard(gymnasium.make(name), {"velocity": {"limit": 2.0}})
    env.reset(seed=0)
    driven = env.unwrapped.model.jnt_dofadr[env.unwrapped.model.actuator_trnid[:, 0]]
    rng, most = np.random.default_rng(0), np.zeros(len(driven))
    for _ in range(100):
        *_, info = env.step(rng.choice([-1.0, 1.0]) * env.action_space.high)
        most = np.maximum(most, np.abs(env.unwrapped.data.qvel[driven]))
        assert info["guard"] != "outside"
    assert (most <= 2.0 + 1e-9).all() and most.max() > 1.9


MOVED = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body name="base"><freejoint name="root"/><geom size=".1"/><site name="jet"/>
<body><joint name="a" axis="0 1 0"/><geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
<body pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
<body pos=".3 0 0"><joint name="ball" type="ball" range="0 30" limited="true"/><geom size=".05"/>
<body pos=".3 0 0"><joint name="loose" axis="0 1 0"/><geom size=".05"/></body></body></body></body></body></worldbody>
<tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>
<actuator><motor tendon="t" ctrlrange="-1 1"/>{jet}</actuator></mujoco>"""


def test_joints_that_one_number_cannot_hold_are_named():
    """A tendon's joints are among those that are driven; a ball and a free joint cannot be held, and a loose one was never asked for."""
    jet = '<motor site="jet" gear="0 0 1 0 0 0" ctrlrange="-1 1"/>'
    with pytest.warns(UserWarning, match="keeps the velocity of hinges and slides alone; of 'root', 'ball', a ball or free joint each, nothing is kept"):
        env = nearl.Guard(Cart(xml=MOVED.format(jet=jet)), SLOW)
    env.reset()
    data = env.unwrapped.data
    for joint, outside in (("a", True), ("b", True), ("loose", False), ("root", False), ("ball", False)):
        data.joint(joint).qvel[0] = 1.5
        assert env.outside == outside, joint
        data.joint(joint).qvel[0] = 0.0
    with pytest.warns(UserWarning, match="keeps the position of hinges and slides alone; of 'ball'"):
        nearl.Guard(Cart(xml=MOVED.format(jet="").replace('name="loose"', 'name="loose" range="-9 9" limited="true"')), {"position": {}})
    with pytest.raises(
        ValueError, match="velocity limit: joint 'ball' has more than one degree of freedom; take it out of the table, which may have a, b, loose"
    ):
        nearl.Guard(Cart(xml=MOVED.format(jet="")), {"velocity": {"limit": {"ball": 1.0}}})
    with pytest.raises(ValueError, match="position margin: joint 'c' has no range in the robot file; take it out of the table, which may have s"):
        nearl.Guard(Cart(), {"position": {"margin": {"c": 0.1}}})


class Drawn(Cart):
    """Every episode has a robot of its own: another model, other masses in it, or another range."""

    def reset(self, *, seed=None, options=None):
        how, mass = options or ("same", 1.0)
        if how == "model":
            self.model = mujoco.MjModel.from_xml_string(Cart.XML.replace('mass="1"', f'mass="{mass}"'))
            self.data = mujoco.MjData(self.model)
        if how == "mass":
            self.model.body_mass[1:], self.model.actuator_gear[:, 0] = mass, 1.5
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        if how == "range":
            self.model.jnt_range[0] = -0.3, 0.3
        return super().reset(seed=seed)


def test_another_robot_in_every_episode_is_guarded_as_it_is():
    env = nearl.Guard(Drawn(), {"position": {}, **SLOW})
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        for how, mass, end in (("same", 1.0, 1.0), ("model", 0.1, 1.0), ("mass", 0.3, 1.0), ("range", 1.0, 0.3), ("model", 2.0, 1.0)):
            env.reset(options=(how, mass))
            data, most, farthest = env.unwrapped.data, 0.0, 0.0
            for k in range(150):
                *_, info = env.step(np.array([3.0 if k < 20 else 0.02 if k < 100 else -0.02, 0.02]))
                most, farthest = max(most, np.abs(data.qvel).max()), max(farthest, abs(data.qpos[0]))
                assert info["guard"] == "outside" or (np.abs(data.qvel).max() <= 1.0 + 1e-9 and abs(data.qpos[0]) <= end + 1e-9), how
            assert most <= 1.0 + 1e-9, how


def test_an_actuator_that_comes_back_has_its_joint_limited_again():
    env = Cart()
    env.model.actuator_gear[1, 0] = 0.0
    guard = nearl.Guard(env, SLOW)
    bang(guard)
    env.model.actuator_gear[1, 0] = 1.0
    most, words = bang(guard)
    assert (most <= 1.0 + 1e-9).all() and most[1] > 0.9 and not words


def test_limits_that_do_not_fit_another_range_are_refused_in_every_step():
    env = nearl.Guard(Drawn(), {"position": {"margin": 0.5}})
    env.reset()
    words = "position margin of joint 's' is 0.5, which leaves nothing from -0.3 to 0.3; give at most 0.3"
    with pytest.raises(ValueError, match=words):
        env.reset(options=("range", 1.0))
    with pytest.raises(ValueError, match=words):
        env.step(np.zeros(2))


class Writes(Cart):
    """Works in the array that it is given."""

    def step(self, action):
        result = super().step(action)
        action[:] = 7.0
        return result


def test_what_is_said_of_an_action_stays_true():
    """An environment that writes into its action, and a policy that uses one array over again."""
    env = nearl.Guard(Writes(), SLOW)
    env.reset()
    action = np.array([0.5, 0.05])
    *_, first = env.step(action)
    action[:] = -1.0, -0.01
    *_, second = env.step(action)
    assert first["guard"] == second["guard"] == "kept"
    assert first["action"].tolist() == [0.5, 0.05] and second["action"].tolist() == [-1.0, -0.01]
