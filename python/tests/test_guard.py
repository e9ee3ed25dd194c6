"""`nearl.Guard`, and environments whose actions pass the constraints: what is promised is measured on the environment's own state."""

import importlib.util
import pathlib
import warnings
from typing import ClassVar

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
mujoco = pytest.importorskip("mujoco")

from gymnasium import wrappers  # noqa: E402
from gymnasium.envs.mujoco import MujocoEnv  # noqa: E402
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv  # noqa: E402

import nearl  # noqa: E402
from nearl._core import nearest_action  # noqa: E402

LIMITS = {"position": {}, "velocity": {"limit": 25.0}}


def outside(env) -> bool:
    """By the robot file's ranges, not by the guard's own words."""
    m, data = env.unwrapped.model, env.unwrapped.data
    ranged = m.jnt_limited.astype(bool)
    q, v = data.qpos[m.jnt_qposadr[ranged]], data.qvel[m.jnt_dofadr[ranged]]
    low, high = m.jnt_range[ranged].T
    return bool((q < low - 1e-9).any() or (q > high + 1e-9).any() or (np.abs(v) > 25.0 + 1e-9).any())


def test_bang_bang_actions_end_within_the_limits():
    count = {}
    for guarded in (False, True):
        env = gymnasium.make("HalfCheetah-v5")
        env = nearl.Guard(env, LIMITS) if guarded else env
        env.reset(seed=1)
        rng = np.random.default_rng(2)
        count[guarded] = 0
        for _ in range(400):
            action = np.sign(rng.uniform(-1, 1, 6)).astype(np.float32)
            _, _, _, _, info = env.step(action)
            count[guarded] += outside(env)
            if guarded:
                assert (info["guard"] == "outside") == outside(env) == env.outside
                assert info["guard"] != "kept" or (info["action"] == action).all()
    assert count[False] > 40 and count[True] <= 4, count


def test_what_is_allowed_changes_nothing():
    plain, guarded = gymnasium.make("HalfCheetah-v5"), nearl.Guard(gymnasium.make("HalfCheetah-v5"), LIMITS)
    plain.reset(seed=3)
    guarded.reset(seed=3)
    rng = np.random.default_rng(4)
    kept = 0
    for _ in range(60):
        action = rng.uniform(-0.2, 0.2, 6).astype(np.float32)
        expected = plain.step(action)
        obs, reward, *_, info = guarded.step(action)
        if info["guard"] != "kept":
            break
        kept += 1
        assert (obs == expected[0]).all() and reward == expected[1]
    assert kept > 5


def test_the_nearest_action_is_the_solution_of_a_general_solver():
    quadprog = pytest.importorskip("quadprog")
    rng = np.random.default_rng(5)
    for _ in range(50):
        asked, trial, slope = rng.uniform(-1, 1, 4), rng.uniform(-1, 1, 4), rng.normal(size=(3, 4))
        value = slope @ (rng.uniform(-0.9, 0.9, 4) - trial)  # some action has it
        lower, upper = value - 0.1, value + 0.1
        u = nearest_action(asked, trial, slope, lower, upper)
        rows = np.vstack([slope, -slope, np.eye(4), -np.eye(4)])
        least = np.concatenate([lower + slope @ trial, -upper - slope @ trial, -np.ones(8)])
        best = quadprog.solve_qp(np.eye(4), asked, rows.T, least)[0]
        assert np.abs(u - best).max() < 1e-2


@pytest.mark.parametrize(
    ("constraints", "words"),
    [
        ({"torque": {}}, "torque"),
        ({"velocity": {"limit": {"knee": 1.0}}}, "knee"),
        ({"velocity": {"limit": -1.0}}, "-1.0"),
        ({"position": {"margin": 9.0}}, "margin of joint 'bthigh' is 9, .*give at most"),
        ({"velocity": {"limit": "x"}}, "velocity limit of joint 'bthigh' is 'x'; give a number"),
        ({"velocity": {"limit": [1.0, 2.0]}}, "velocity limit of joint 'bthigh' is"),
        ({"velocity": {}}, "limit"),
        ({}, "no joint has a limit to be kept; give constraints"),
    ],
)
def test_what_is_no_limit_is_refused_by_name(constraints, words):
    with pytest.raises(ValueError, match=words):
        nearl.Guard(gymnasium.make("HalfCheetah-v5"), constraints)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (np.full(6, np.nan), r"action\[0\] is nan: every entry must be finite"),
        (np.array([0, 0, 0, 0, -np.inf, 0]), r"action\[4\] is -inf: every entry must be finite"),
        (np.zeros(5), r"action has shape \(5,\), expected \(6,\)"),
        (np.zeros((1, 6)), r"action has shape \(1, 6\), expected \(6,\)"),
        (["a"] * 6, "action is not an array of numbers"),
    ],
)
def test_what_is_no_action_reaches_no_simulator(action, words):
    """As at every other door; the state is the one of before, bit for bit."""
    env = nearl.Guard(gymnasium.make("HalfCheetah-v5"), LIMITS)
    env.reset(seed=1)
    before = env.unwrapped.data.qpos.copy(), env.unwrapped.data.qvel.copy(), env.unwrapped.data.time
    for act in (env.step, env.safe):
        with pytest.raises(ValueError, match=words):
            act(action)
    after = env.unwrapped.data.qpos, env.unwrapped.data.qvel, env.unwrapped.data.time
    assert all(np.array_equal(a, b) for a, b in zip(before, after))


def test_an_environment_without_mujoco_is_refused():
    with pytest.raises(ValueError, match="MujocoEnv"):
        nearl.Guard(gymnasium.make("CartPole-v1"), LIMITS)


@pytest.mark.parametrize("actions", ["state", "change", "guarded"])
def test_random_actions_of_every_meaning_break_no_limit_of_the_panda(actions):
    env = gymnasium.make("nearl/Panda-reach", constraints="task", actions=actions)
    assert np.isfinite(env.action_space.low).all() and np.isfinite(env.action_space.high).all()
    env.action_space.seed(6)
    obs, _ = env.reset(seed=7)
    raw = steps = 0
    for _ in range(300):
        obs, _, terminated, truncated, info = env.step(env.action_space.sample())
        assert info["target_violations"] == 0
        raw, steps = raw + info["raw_violations"], steps + 1
        q, v = obs[:7], obs[7:14]
        assert (np.abs(v) <= 2.62).all() and (np.abs(q) <= 3.76).all()
        if terminated or truncated:
            env.reset()
    assert raw > 100, "the actions must be wild for this to mean anything"


def test_a_vector_of_guarded_cheetahs_stays_inside():
    count = {}
    for actions in (None, "guarded"):
        kwargs = {} if actions is None else {"constraints": "task", "actions": actions}
        envs = nearl.make_vec("HalfCheetah-v5", 4, **kwargs)
        envs.reset(seed=8)
        rng = np.random.default_rng(9)
        file = gymnasium.make("HalfCheetah-v5").unwrapped.model
        low, high = file.jnt_range[3:].T
        count[actions] = 0
        for _ in range(200):
            *_, info = envs.step(np.sign(rng.uniform(-1, 1, (4, 6))))
            q, v = envs.native.qpos[:, 3:], envs.native.qvel[:, 3:]
            beyond = (q < low - 1e-9) | (q > high + 1e-9) | (np.abs(v) > 25.0 + 1e-9)
            count[actions] += beyond.any(axis=1).sum()
            if actions:
                assert (beyond.any(axis=1) == (info["target_violations"] > 0)).all()
    assert count[None] > 50 and count["guarded"] <= 8, count


def with_limits(folder: pathlib.Path, limits: str) -> str:
    """HalfCheetah's own task file, with limits on actions."""
    task = pathlib.Path(__file__).parents[2] / "examples/tasks/HalfCheetah-v5.toml"
    (folder / "limited.toml").write_text(task.read_text() + f"\n[constraints.action]\n{limits}\n")
    return str(folder / "limited.toml")


def test_limited_actions_are_the_nearest_ones_of_the_set(tmp_path):
    """Of a ball the nearest point is known by hand: an environment without limits goes the same way under it."""
    limited = nearl.make_vec(with_limits(tmp_path, "square = 0.5"), 1, constraints="task", actions="limited")
    plain = nearl.make_vec("HalfCheetah-v5", 1)
    rng = np.random.default_rng(3)
    for envs in (limited, plain):
        envs.reset(seed=4)
    moved = 0
    for _ in range(100):
        action = rng.uniform(-1, 1, (1, 6)).astype(np.float32).astype(float)
        *_, info = limited.step(action)
        nearest = action * min(1.0, np.sqrt(0.5) / np.linalg.norm(action))
        np.testing.assert_allclose(info["executed"], nearest, rtol=1e-9)
        plain.step(nearest)
        for name in ("qpos", "qvel"):
            np.testing.assert_allclose(getattr(limited.native, name), getattr(plain.native, name), rtol=1e-9, atol=1e-9)
        limited.native.set_state(0, plain.native.qpos[0], plain.native.qvel[0])
        plain.native.set_state(0, plain.native.qpos[0], plain.native.qvel[0])
        assert info["raw_violations"][0] == (np.linalg.norm(action) ** 2 > 0.5)
        assert info["target_violations"][0] == 0
        moved += info["raw_violations"][0]
    assert moved > 80


def test_a_limited_environment_passes_no_more_than_its_power(tmp_path):
    env = nearl.ProjectedEnv(with_limits(tmp_path, "power = 5.0"), "task", "limited")
    env.action_space.seed(5)
    env.reset(seed=6)
    raw = 0
    for _ in range(300):
        velocity = env.native.qvel[0, 3:]
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        assert np.abs(velocity * info["executed"]).sum() <= 5.0 + 1e-9
        assert info["target_violations"] == 0 and not terminated and not truncated
        raw += info["raw_violations"]
    assert raw > 200


def test_a_step_that_only_begins_an_episode_executes_nothing(tmp_path):
    file = with_limits(tmp_path, "square = 0.5")
    action = np.full((1, 6), 0.1)
    for mode, executed in (("NextStep", [True, True, False, True]), ("SameStep", [True] * 4)):
        env = nearl.VecEnv(file, 1, "task", autoreset_mode=mode, actions="limited", max_episode_steps=2)
        _, info = env.reset(seed=1)
        assert "executed" not in info
        for wanted in executed:
            *_, info = env.step(action)
            np.testing.assert_allclose(info["executed"], action if wanted else np.full((1, 6), np.nan), rtol=1e-6)


def test_limited_actions_want_a_limit(tmp_path):
    with pytest.raises(ValueError, match=r"limits no actions; write power, delivered, square or rate"):
        nearl.make_vec("HalfCheetah-v5", 1, constraints="task", actions="limited")
    with pytest.raises(ValueError, match='give constraints="task"'):
        nearl.make_vec("HalfCheetah-v5", 1, constraints="some.safetensors", actions="limited")


def test_actions_of_an_unknown_meaning_are_refused():
    with pytest.raises(ValueError, match="'torque'"):
        nearl.make_vec("Panda-reach", 1, constraints="task", actions="torque")
    with pytest.raises(ValueError, match="without constraints"):
        nearl.make_vec("Panda-reach", 1, actions="change")
    with pytest.raises(ValueError, match="without constraints"):
        gymnasium.make("nearl/Panda-reach", actions="guarded")


def test_an_action_that_nothing_helps_is_kept_where_that_is_asked_for():
    """A speed that no motor stops within a step: the least far outside is another action, and is not taken."""
    impossible = {"velocity": {"limit": 0.5}}
    least, kept = (nearl.Guard(gymnasium.make("Hopper-v5"), impossible, unavoidable=how) for how in ("least", "kept"))
    for env in (least, kept):
        env.reset(seed=3)
        env.unwrapped.set_state(env.unwrapped.data.qpos, np.full(6, 9.0))
    action = np.full(3, 0.9, np.float32)
    other, verdict = least.safe(action)
    assert verdict == "outside" and not np.array_equal(other, action)
    same, verdict = kept.safe(action)
    assert verdict == "outside" and np.array_equal(same, action)
    with pytest.raises(ValueError, match="unavoidable is 'never'"):
        nearl.Guard(gymnasium.make("Hopper-v5"), impossible, unavoidable="never")


def test_a_projected_environment_has_a_length_of_its_own_and_draws_itself():
    env = nearl.ProjectedEnv("Panda-reach", max_episode_steps=60, render_mode="rgb_array", width=96, height=64)
    env.reset(seed=1)
    ends = [env.step(env.action_space.sample())[3] for _ in range(3)]
    assert ends == [False, False, True], "three policy periods of 20 control periods"
    try:
        picture = env.render()
    except nearl.render.VideoError as error:
        pytest.skip(str(error))
    assert picture.shape == (64, 96, 3) and picture.std() > 5
    env.close()
    with pytest.raises(ValueError, match="max_episode_steps is 0"):
        nearl.ProjectedEnv("Panda-reach", max_episode_steps=0)
    with pytest.raises(ValueError, match="give 'rgb_array'"):
        gymnasium.make("nearl/Panda-reach", constraints="task", render_mode="human")


@pytest.fixture
def example():
    spec = importlib.util.spec_from_file_location("sb3_guarded", pathlib.Path(__file__).parents[2] / "examples/python/sb3_guarded.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_learner_on_the_arm_improves_and_breaks_nothing(example):
    """Hill climbing on a linear policy: what stands in for a learner of another library."""
    env = example.make("arm")
    rng = np.random.default_rng(1)
    n_obs, n_act = env.observation_space.shape[0], env.action_space.shape[0]

    def score(policy):
        return example.run(env, lambda obs: np.clip(policy @ obs, -1, 1), 1)

    best = np.zeros((n_act, n_obs))
    first, broken = score(best)
    best_return = first
    for _ in range(15):
        trial = best + 0.1 * rng.normal(size=best.shape)
        value, outside = score(trial)
        broken += outside
        if value > best_return:
            best, best_return = trial, value
    assert broken == 0 and best_return > first, (first, best_return)


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
