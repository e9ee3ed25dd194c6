"""Our environments against Gymnasium 1.4.0's v5 on MuJoCo 3.17.0."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from conftest import LOCOMOTION
from gymnasium.utils.env_checker import check_env

import nearl
import nearl.render

STEPS = 1000


@pytest.mark.parametrize("task", LOCOMOTION)
def test_same_states_and_actions_give_the_same_trajectory(task: str) -> None:
    theirs = gymnasium.make(task).unwrapped
    ours = gymnasium.make(f"nearl/{task}").unwrapped
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.dt == pytest.approx(theirs.dt, abs=1e-15)
    theirs.action_space.seed(7)

    def restart(seed: int | None = None) -> None:
        obs, _ = theirs.reset(seed=seed)
        np.testing.assert_allclose(ours.set_state(theirs.data.qpos, theirs.data.qvel), obs, rtol=0, atol=1e-12)

    restart(seed=7)
    ends = 0
    for _ in range(STEPS):
        # Gymnasium sums float32 actions in float32; the same numbers in float64 leave no rounding between the two.
        action = theirs.action_space.sample().astype(np.float64)
        obs, reward, terminated, _, _ = theirs.step(action)
        our_obs, our_reward, our_terminated, truncated, info = ours.step(action)
        assert np.array_equal(ours.qpos, theirs.data.qpos) and np.array_equal(ours.qvel, theirs.data.qvel)
        np.testing.assert_allclose(our_obs, obs, rtol=0, atol=1e-12)
        assert our_reward == pytest.approx(reward, abs=1e-12, rel=1e-12)
        assert our_terminated == terminated and not truncated and info == {}
        if terminated:
            ends += 1
            restart()
    assert ends > 0 or task in ("HalfCheetah-v5", "Ant-v5"), "the comparison covers terminations"


def test_an_ant_in_the_air_ends_its_episode() -> None:
    """Random actions hardly ever make it fall, so it is thrown."""
    theirs = gymnasium.make("Ant-v5").unwrapped
    ours = gymnasium.make("nearl/Ant-v5").unwrapped
    theirs.reset(seed=0)
    qpos, qvel = theirs.data.qpos.copy(), np.zeros(14)
    for height, ended in ((0.9, False), (1.3, True)):
        qpos[2] = height
        theirs.set_state(qpos, qvel)
        ours.set_state(qpos, qvel)
        assert ours.step(np.zeros(8))[2] == theirs.step(np.zeros(8))[2] == ended


@pytest.mark.parametrize("task", [name for name, _ in nearl.tasks()])
def test_gymnasium_s_own_checker_is_content(task: str) -> None:
    env = gymnasium.make(f"nearl/{task}")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.spec.max_episode_steps == env.unwrapped.native.max_episode_steps


def test_the_time_limit_truncates_and_does_not_terminate() -> None:
    env = gymnasium.make("nearl/HalfCheetah-v5", max_episode_steps=5)
    env.reset(seed=0)
    flags = [env.step(np.zeros(6))[2:4] for _ in range(5)]
    assert flags == [(False, False)] * 4 + [(False, True)]


def test_the_same_seed_gives_the_same_episode() -> None:
    a, b = gymnasium.make("nearl/Ant-v5"), gymnasium.make("nearl/Ant-v5")
    assert np.array_equal(a.reset(seed=3)[0], b.reset(seed=3)[0])
    assert np.array_equal(a.reset()[0], b.reset()[0])
    assert not np.array_equal(a.reset(seed=4)[0], b.reset(seed=3)[0])


def test_reset_options_place_the_robot() -> None:
    env = gymnasium.make("nearl/Panda-reach").unwrapped
    qpos, goal = np.linspace(-0.5, -0.2, 7), [0.4, 0.1, 0.5]
    obs, _ = env.reset(seed=0, options={"qpos": qpos, "qvel": np.zeros(7), "goal": goal})
    assert np.array_equal(obs[:7], qpos) and np.array_equal(obs[14:17], goal)
    hand = obs[14:17] - obs[17:]
    assert 0.0 < np.linalg.norm(hand) < 1.3
    with pytest.raises(ValueError, match=r"\['qpso'\] are not known"):
        env.reset(options={"qpso": qpos})


def test_gymnasium_makes_our_vector_by_its_own_name() -> None:
    vec = gymnasium.make_vec("nearl/Hopper-v5", num_envs=3, vectorization_mode="vector_entry_point")
    assert isinstance(vec.unwrapped, nearl.VecEnv) and vec.reset(seed=0)[0].shape == (3, 11)


def drawn(env: gymnasium.Env) -> np.ndarray:
    try:
        return env.render()
    except nearl.render.VideoError as error:
        pytest.skip(str(error))


def test_a_seed_of_numpy_is_that_of_python() -> None:
    for env in (nearl.Env("HalfCheetah-v5"), nearl.ProjectedEnv("Panda-reach")):
        assert np.array_equal(env.reset(seed=np.int64(3))[0], env.reset(seed=3)[0])
        with pytest.raises(ValueError, match="seed is 'a'; give a whole number"):
            env.reset(seed="a")  # type: ignore[arg-type]


def test_a_step_before_an_episode_is_refused_without_wrappers_too() -> None:
    for env in (nearl.Env("HalfCheetah-v5"), nearl.ProjectedEnv("Panda-reach")):
        with pytest.raises(gymnasium.error.ResetNeeded, match="no episode has begun; call reset"):
            env.step(env.action_space.sample())
        env.reset(seed=0)
        env.step(env.action_space.sample())
    env = nearl.Env("HalfCheetah-v5")
    env.set_state(env.qpos, env.qvel)
    env.step(np.zeros(6))


def test_a_closed_environment_neither_steps_nor_begins_an_episode() -> None:
    for env in (nearl.Env("HalfCheetah-v5"), nearl.ProjectedEnv("Panda-reach")):
        env.reset(seed=0)
        env.close()
        env.close()
        for use in (env.reset, lambda env=env: env.step(env.action_space.sample())):
            with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="the environment was closed, .*; make another one"):
                use()
    env = nearl.Env("HalfCheetah-v5")
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        env.set_state(env.qpos, env.qvel)


def test_warnings_of_a_task_point_at_the_line_that_made_it(tmp_path) -> None:
    (tmp_path / "arm.xml").write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body><joint name="hinge" axis="0 1 0" range="-1 1"/><geom size=".1" mass="1"/></body></worldbody>'
        '<actuator><motor joint="hinge" ctrlrange="-9 9"/></actuator></mujoco>'
    )
    task = tmp_path / "arm.toml"
    task.write_text(
        'name = "arm"\n[model]\nmjcf = "arm.xml"\n[time]\ndt = 0.01\nsim_dt = 0.002\n[state]\nobservation = ["q.hinge", "v.hinge"]\n'
        '[reward]\nstill = "-q.hinge^2"\n[constraints]\nvelocity = { limit = 900.0 }\n[idm]\nkind = "pinocchio"\n'
    )
    env_id = nearl.register(str(task))[0]
    with pytest.warns(UserWarning, match="is it degrees") as said:
        gymnasium.make(env_id, constraints="task")
        nearl.make_vec(str(task), 2, constraints="task")
    assert {Path(w.filename) for w in said if "degrees" in str(w.message)} == {Path(__file__)}


def test_an_environment_draws_its_state() -> None:
    env = gymnasium.make("nearl:nearl/Hopper-v5", render_mode="rgb_array", width=160, height=120)
    env.reset(seed=0)
    first = drawn(env)
    assert first.shape == (120, 160, 3) and first.dtype == np.uint8 and first.std() > 5
    assert np.array_equal(drawn(env), first)
    qpos = env.unwrapped.qpos.copy()
    env.unwrapped.set_state(qpos + [0, 0, 0.5, 0.3, -0.5, 0.3], np.zeros(6))
    assert (drawn(env) != first).any(axis=2).mean() > 0.02, "the robot moved in the picture"
    env.close()
    with pytest.raises(ValueError, match="give 'rgb_array'"):
        nearl.Env("Hopper-v5", render_mode="human")
    env = nearl.Env("Hopper-v5", render_mode="rgb_array", width=-5)
    with pytest.raises(ValueError, match="width is -5; give pixels, from 1 to 8192"):
        env.render()


def test_libraries_that_ask_for_pictures_first_get_their_environments() -> None:
    """SB3's make_vec_env hands `render_mode` to every constructor."""
    one = {"render_mode": "rgb_array"}
    envs = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make("nearl:nearl/HalfCheetah-v5", **one) for _ in range(4)])
    obs, _ = envs.reset(seed=0)
    assert obs.shape == (4, 17) and not np.array_equal(obs[0], obs[1])
