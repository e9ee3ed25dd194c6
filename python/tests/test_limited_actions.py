"""Environments whose actions pass limits on actions, and those whose proposals are projected."""

import importlib.util
import pathlib

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

import nearl  # noqa: E402


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
