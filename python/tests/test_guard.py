"""`nearl.Guard`, and environments whose actions pass the constraints: what is promised is measured on the environment's own state."""

import copy
import importlib.util
import pathlib
import pickle
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


def test_hardly_an_action_that_ends_inside_is_missed():
    """Of 150 wild steps of an ant 59 ended outside, and 400 actions at random had shown a way for 19 of them."""
    env = nearl.Guard(gymnasium.make("Ant-v5"), {"position": {}, "velocity": {"limit": 6.0}})
    env.reset(seed=1)
    rng, model, data = np.random.default_rng(1), env.unwrapped.model, env.unwrapped.data
    low, high = model.jnt_range[1:].T

    def ends_inside(start, ctrl):
        trial = copy.copy(start)
        trial.ctrl[:] = ctrl
        mujoco.mj_step(model, trial, nstep=env.unwrapped.frame_skip)
        return (np.abs(trial.qvel[6:]) <= 6.0).all() and (low <= trial.qpos[7:]).all() and (trial.qpos[7:] <= high).all()

    ended = missed = 0
    for k in range(150):
        if k % 10 == 0:
            action = rng.choice([-1.0, 1.0], 8).astype(np.float32) * (rng.random() < 0.7)
        start = copy.copy(data)
        *_, terminated, truncated, info = env.step(action)
        if info["guard"] == "outside":
            ended += 1
            missed += any(ends_inside(start, rng.uniform(-1, 1, 8) if k % 2 else rng.choice([-1.0, 1.0], 8)) for k in range(400))
        if terminated or truncated:
            env.reset()
    assert missed <= 3 and ended <= 25, (missed, ended)


def test_the_guard_of_a_task_is_that_around_an_environment(tmp_path):
    """From the same states, of the same actions, with no limit on accelerations; one start of the search found nothing in 42 of the ticks."""
    robot = pathlib.Path(__file__).resolve().parents[2] / "examples" / "robots" / "gymnasium" / "ant.xml"
    joints = [f"{name}_{leg}" for leg in (1, 2, 3, 4) for name in ("hip", "ankle")]
    (tmp_path / "ant.toml").write_text(
        f'name = "guarded-ant"\n[model]\nmjcf = "{robot}"\n[state]\ncontrollable = {joints}\n[idm]\nkind = "learned"\n[time]\ndt = 0.05\nsim_dt = 0\n'
        '[constraints]\nguard = "simulator"\nconsistency = "free"\nposition = {}\nvelocity = { limit = 6.0 }\n[reward]\nalive = "1"\n'
    )
    env = gymnasium.make(nearl.register(tmp_path / "ant.toml")[0], constraints="task", actions="guarded")
    around = nearl.Guard(gymnasium.make("Ant-v5", xml_file=str(robot)), {"position": {}, "velocity": {"limit": 6.0}})
    around.reset(seed=1)
    obs, _ = env.reset(seed=1)
    rng, ended, other = np.random.default_rng(1), np.zeros(2, int), 0
    for k in range(150):
        if k % 10 == 0:
            action = rng.choice([-1.0, 1.0], 8).astype(np.float32) * (rng.random() < 0.7)
        around.unwrapped.set_state(obs[:15], obs[15:29])
        *_, found = around.step(action)
        obs, _, terminated, truncated, info = env.step(action)
        ended += info["target_violations"], found["guard"] == "outside"
        other += not np.allclose(found["action"], info["executed"], atol=1e-6)
        if terminated or truncated:
            obs, _ = env.reset()
    assert other <= 3 and (ended <= 15).all(), (other, ended)


def test_a_ctrl_that_fails_is_called_once():
    calls = []

    def fails(action):
        calls.append(action)
        raise RuntimeError("no controls today")

    env = nearl.Guard(gymnasium.make("HalfCheetah-v5"), LIMITS, ctrl=fails)
    env.reset(seed=0)
    with pytest.raises(RuntimeError, match="no controls today"):
        env.step(np.zeros(6, np.float32))
    assert len(calls) == 1


def test_a_step_before_an_episode_is_refused_without_gymnasiums_order_too():
    for env in (HalfCheetahEnv(), wrappers.ClipAction(HalfCheetahEnv()), gymnasium.make("HalfCheetah-v5")):
        guarded, action = nearl.Guard(env, LIMITS), np.zeros(6, np.float32)
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"no episode has begun; call reset\(\) of the guard before step\(\)"):
            guarded.step(action)
        guarded.reset(seed=0)
        guarded.step(action)
    begun = gymnasium.make("HalfCheetah-v5")
    begun.reset(seed=0)
    nearl.Guard(begun, LIMITS).step(action)


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


def test_other_limits_hold_from_the_next_step_on_and_wrong_ones_change_nothing():
    env = nearl.Guard(gymnasium.make("HalfCheetah-v5"), {"velocity": {"limit": 1000.0}})
    env.reset(seed=1)
    rng, most = np.random.default_rng(2), {1000.0: 0.0, 15.0: 0.0}
    for limit in (1000.0, 15.0):
        env.set_constraints({"velocity": {"limit": limit}})
        # What is faster than the new limit may need steps to come below it.
        for step in range(300):
            _, _, _, _, info = env.step(np.sign(rng.uniform(-1, 1, 6)).astype(np.float32))
            fastest = np.abs(env.unwrapped.data.qvel[3:]).max()
            assert (info["guard"] == "outside") == bool(fastest > limit + 1e-9)
            if step >= 20:
                most[limit] = max(most[limit], fastest)
    assert most[15.0] <= 15.0 + 1e-9 < 20.0 < most[1000.0], most
    with pytest.raises(ValueError, match="velocity has no 'limits'"):
        env.set_constraints({"velocity": {"limits": 1000.0}})
    for _ in range(50):
        env.step(np.sign(rng.uniform(-1, 1, 6)).astype(np.float32))
        assert np.abs(env.unwrapped.data.qvel[3:]).max() <= 15.0 + 1e-9
    envs = gymnasium.vector.SyncVectorEnv([lambda: nearl.Guard(gymnasium.make("HalfCheetah-v5"), LIMITS)] * 2)
    envs.reset(seed=3)
    envs.call("set_constraints", {"velocity": {"limit": 5.0}})
    for _ in range(60):
        envs.step(np.sign(rng.uniform(-1, 1, (2, 6))).astype(np.float32))
        assert all(np.abs(env.unwrapped.data.qvel[3:]).max() <= 5.0 + 1e-9 for env in envs.envs)


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
        ({"velocity": {"limit": "x"}}, "velocity limit of joint 'bthigh' is 'x'; give a finite number"),
        ({"velocity": {"limit": [1.0, 2.0]}}, "velocity limit of joint 'bthigh' is"),
        ({"velocity": {}}, "limit"),
        ({"velocity": 3.0}, r"velocity is 3.0; give a table, e.g. {'limit': 3.0}"),
        ({"position": True}, r"position is True; give a table, e.g. {}"),
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


def begun(env):
    """Begins anew every 10 steps, with a clock that shows the time of 20 steps, during which the robot came to rest."""
    if env.steps % 10 == 0:
        mujoco.mj_resetData(env.model, env.data)
        env.data.time = 0.2 * (env.steps // 10 % 2)


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


def test_actions_of_any_shape_are_taken_where_ctrl_says_what_they_are():
    env = Cart()
    env.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2, 1), np.float32)
    env.step = lambda action: Cart.step(env, np.array([10.0, 1.0]) * np.asarray(action).ravel())
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        most, words = bang(nearl.Guard(env, SLOW, ctrl=lambda action: np.array([10.0, 1.0]) * action[:, 0]))
    assert (most <= 1.0 + 1e-9).all() and most.min() > 0.9 and not words


@pytest.mark.parametrize("again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_of_a_guard_guards(again):
    env = nearl.Guard(gymnasium.make("HalfCheetah-v5"), FAST)
    first = fastest(env)
    twin = again(env)
    assert fastest(twin) == first == fastest(env) and first[0] <= 20.0 + 1e-9
    assert twin.unwrapped.data is not env.unwrapped.data


def test_a_vector_is_not_guarded_as_a_whole():
    envs = gymnasium.make_vec("HalfCheetah-v5", 2, vectorization_mode="sync", wrappers=[lambda env: nearl.Guard(env, FAST)])
    envs.reset(seed=0)
    *_, info = envs.step(envs.action_space.sample())
    assert set(info["guard"]) <= {"kept", "replaced"}
    with pytest.raises(ValueError, match="SyncVectorEnv is no gymnasium.Env; in a vector put a guard around each environment"):
        nearl.Guard(envs, FAST)
