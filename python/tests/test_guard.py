"""`nearl.Guard`: what is promised is measured on the environment's own state."""

import copy
import pathlib
import pickle
import warnings

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
mujoco = pytest.importorskip("mujoco")

from guarded_envs import FAST, LIMITS, SLOW, Cart, bang, fastest, outside  # noqa: E402
from gymnasium import wrappers  # noqa: E402
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv  # noqa: E402

import nearl  # noqa: E402
from nearl._core import nearest_action  # noqa: E402


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
