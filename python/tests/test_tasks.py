"""Tasks of the user's own and costs, through Gymnasium and through a vector; rewards and terminations by functions."""

import shutil
import warnings
from pathlib import Path
from typing import ClassVar

import gymnasium
import mujoco
import numpy as np
import pytest
from conftest import ROOT
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import nearl
from nearl.runs import tomllib

CART_POLE = ROOT / "examples" / "tasks" / "cart-pole.toml"


def test_a_task_file_is_a_gymnasium_environment() -> None:
    (env_id,) = nearl.register(CART_POLE)
    assert env_id == "nearl/cart-pole"
    env = gymnasium.make(env_id)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.spec.max_episode_steps == 500
    obs, _ = env.reset(seed=1, options={"qpos": [0.2, 0.1], "qvel": [0.3, 0.4]})
    np.testing.assert_allclose(obs, [0.2, np.sin(0.1), np.cos(0.1), 0.3, 0.4], atol=1e-15)
    obs, reward, terminated, _, info = env.step(np.array([0.5], np.float32))
    assert reward == pytest.approx(obs[2] - 0.1 * obs[0] ** 2 - 0.01 * 0.25, abs=1e-12) and not terminated and info == {}
    env.reset(options={"qpos": [0, 0.39], "qvel": [0, 3.0]})
    assert env.step(np.zeros(1))[2], "it fell"


def test_another_file_under_the_same_name_takes_its_id_with_a_warning(tmp_path: Path) -> None:
    shutil.copy(CART_POLE.with_suffix(".xml"), tmp_path)
    other, link = tmp_path / "other.toml", tmp_path / "link.toml"
    other.write_text(CART_POLE.read_text().replace("max_episode_steps = 500", "max_episode_steps = 7"))
    link.symlink_to(other)
    nearl.register(CART_POLE)
    with pytest.warns(UserWarning, match=r"other.toml' takes the id nearl/cart-pole of '.*cart-pole.toml', whose \[name\] is the same"):
        (env_id,) = nearl.register(other)
    assert gymnasium.spec(env_id).max_episode_steps == 7
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        nearl.register(other, str(other), link)
    with pytest.warns(UserWarning, match="takes the id"):
        nearl.register(CART_POLE)


def test_a_task_file_is_a_vector() -> None:
    vec = nearl.make_vec(str(CART_POLE), 3, seed=5)
    assert vec.native.action_names == ["push"] and vec.reset(seed=5)[0].shape == (3, 5)
    single = nearl.Env(str(CART_POLE))
    obs, _ = single.reset(seed=6)
    assert np.array_equal(vec.reset(seed=5)[0][1], obs)
    assert vec.step(np.full((3, 1), 0.3))[1][1] == single.step(np.array([0.3]))[1]


def test_mistakes_name_the_file_and_the_key(tmp_path: Path) -> None:
    shutil.copy(CART_POLE.with_suffix(".xml"), tmp_path)
    file = tmp_path / "mine.toml"
    file.write_text(CART_POLE.read_text().replace('"cos(q.hinge)"\n', '"cos(q.hing)"\n'))
    with pytest.raises(ValueError, match=r"mine.toml \[reward.upright\].*'q.hing'.*did you mean 'q.hinge'"):
        nearl.make_vec(str(file), 2)
    with pytest.raises(OSError, match="nowhere.toml"):
        nearl.Env(str(tmp_path / "nowhere.toml"))


@pytest.mark.parametrize(("task", "threshold"), [("HalfCheetah", 3.2096), ("Hopper", 0.7402), ("Walker2d", 2.3415), ("Ant", 2.6222)])
def test_velocity_tasks_count_as_gymnasiums_speeds_say(task: str, threshold: float) -> None:
    """Safety-Gymnasium: cost = speed > threshold, on the speed that Gymnasium's own environment reports."""
    theirs = gymnasium.make(f"{task}-v5").unwrapped
    ours = gymnasium.make(f"nearl/{task}-velocity").unwrapped
    theirs.action_space.seed(0)
    counts = [0, 0]
    for episode in range(30):
        theirs.reset(seed=episode)
        qpos, qvel = theirs.data.qpos.copy(), theirs.data.qvel.copy()
        qvel[0] = threshold * (episode % 3) * 0.8
        theirs.set_state(qpos, qvel)
        ours.set_state(qpos, qvel)
        for _ in range(4):
            action = theirs.action_space.sample().astype(np.float64)
            info = theirs.step(action)[4]
            speed = np.hypot(info["x_velocity"], info["y_velocity"]) if task == "Ant" else info["x_velocity"]
            cost = ours.step(action)[4]["cost"]
            assert cost == float(speed > threshold)
            counts[int(cost)] += 1
    assert min(counts) > 10, "both sides of the threshold are covered"


def test_a_vector_tells_the_cost() -> None:
    vec = nearl.make_vec("HalfCheetah-velocity", 2)
    vec.reset(seed=0)
    for i, speed in enumerate((0.0, 6.0)):
        vec.set_state(i, vec.native.qpos[i], np.r_[speed, np.zeros(8)])
    assert vec.step(np.zeros((2, 6)))[4]["cost"].tolist() == [0.0, 1.0]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_functions_that_say_what_the_task_says_change_nothing(mode: AutoresetMode, tmp_path: Path) -> None:
    """Hopper's reward and termination in NumPy, on a task file without a termination, against the native Hopper."""
    dt = 0.008

    def reward(obs: np.ndarray, actions: np.ndarray, next_obs: np.ndarray) -> np.ndarray:
        assert obs.shape == next_obs.shape == (4, 12) and actions.shape == (4, 3)
        return (next_obs[:, 11] - obs[:, 11]) / dt + healthy(next_obs) - 1e-3 * (actions**2).sum(1)

    def healthy(obs: np.ndarray) -> np.ndarray:
        return (obs[:, 0] > 0.7) & (np.abs(obs[:, 1]) < 0.2)

    text = (ROOT / "tests" / "fixtures" / "hopper.toml").read_text()
    text = text.replace("[termination]\n", "").replace('low = "q.rootz <= 0.7"\n', "").replace('tilted = "abs(q.rooty) >= 0.2"\n', "")
    text = text.replace('"clamp(v.foot_joint, -10, 10)",\n', '"clamp(v.foot_joint, -10, 10)", "q.rootx",\n')
    text = text.replace("dt = 0.008\n", "dt = 0.008\nmax_episode_steps = 25\n")
    file = tmp_path / "bare.toml"
    file.write_text(text)
    ours = nearl.make_vec(str(file), 4, autoreset_mode=mode, reward=reward, termination=lambda o, a, n: ~healthy(n))
    theirs = nearl.VecEnv("Hopper-v5", 4, max_episode_steps=25, autoreset_mode=mode)
    ours.reset(seed=0), theirs.reset(seed=0)
    rng, ends = np.random.default_rng(1), np.zeros(2, int)
    over = np.zeros(4, bool)

    def align(which: np.ndarray) -> None:
        for i in np.flatnonzero(which):  # starts are drawn differently
            ours.set_state(i, theirs.native.qpos[i], theirs.native.qvel[i])

    align(np.ones(4, bool))
    for _ in range(300):
        actions = rng.uniform(-1, 1, (4, 3))
        a, b = ours.step(actions), theirs.step(actions)
        np.testing.assert_allclose(a[1], b[1], atol=1e-11)
        assert np.array_equal(a[2], b[2]) and np.array_equal(a[3], b[3])
        ends += b[2].sum(), b[3].sum()
        if mode is AutoresetMode.SAME_STEP:
            fresh = b[2] | b[3]
            assert np.array_equal(a[4].get("_final_obs", np.zeros(4, bool)), fresh)
            for i in np.flatnonzero(fresh):
                assert np.array_equal(a[4]["final_obs"][i][:11], b[4]["final_obs"][i])
        else:
            fresh, over = over, b[2] | b[3]
        align(fresh)
    assert ends.min() > 3, "terminations and truncations are covered"


def test_functions_of_the_wrong_shape_are_named() -> None:
    vec = nearl.make_vec(str(CART_POLE), 3, reward=lambda o, a, n: 0.0)
    vec.reset(seed=0)
    with pytest.raises(ValueError, match=r"reward\(obs, actions, next_obs\) gave shape \(\); give one value an environment, \(3,\)"):
        vec.step(np.zeros((3, 1)))
    for answer, said in ((None, "gave None; give one value an environment"), (np.zeros(3) * 1j, "gave complex128 values"), (["a"] * 3, "gave <U1 values")):
        vec = nearl.make_vec(str(CART_POLE), 3, reward=lambda o, a, n, answer=answer: answer)
        vec.reset(seed=0)
        with pytest.raises(ValueError, match=rf"reward\(obs, actions, next_obs\) {said}"):
            vec.step(np.zeros((3, 1)))
    vec = nearl.make_vec(str(CART_POLE), 3, reward=lambda o, a, n: np.array([0, np.nan, 0]))
    vec.reset(seed=0)
    with pytest.raises(ValueError, match=r"\[1\] is nan"):
        vec.step(np.zeros((3, 1)))


@pytest.mark.parametrize("env_id", ["InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Swimmer-v5", "Reacher-v5", "Pusher-v5", "Humanoid-v5"])
def test_gymnasiums_mujoco_environments_become_task_files(env_id: str, tmp_path: Path) -> None:
    file = nearl.from_gymnasium(env_id, tmp_path)
    theirs, ours = gymnasium.make(env_id).unwrapped, nearl.Env(str(file))
    assert ours.action_space == theirs.action_space and ours.dt == pytest.approx(theirs.dt, abs=1e-12)
    assert ours.native.max_episode_steps == gymnasium.spec(env_id).max_episode_steps
    theirs.action_space.seed(0)
    theirs.reset(seed=0)
    ours.set_state(theirs.data.qpos, theirs.data.qvel)
    # Gymnasium's own reset has run a step's worth of derived quantities; from a set state both begin alike.
    theirs.set_state(theirs.data.qpos.copy(), theirs.data.qvel.copy())
    for _ in range(50):
        action = theirs.action_space.sample().astype(np.float64)
        theirs.step(action)
        obs = ours.step(action)[0]
        assert np.array_equal(ours.qpos, theirs.data.qpos) and np.array_equal(ours.qvel, theirs.data.qvel)
    assert np.array_equal(obs, np.r_[ours.qpos, ours.qvel])
    with pytest.raises(FileExistsError, match="is there already"):
        nearl.from_gymnasium(env_id, tmp_path)


def test_an_environment_of_gymnasium_becomes_the_task_file_of_its_name(tmp_path: Path) -> None:
    by_name = nearl.from_gymnasium("Hopper-v5", tmp_path / "a", ctrl_cost_weight=0.5, max_episode_steps=70)
    env = gymnasium.make("Hopper-v5", ctrl_cost_weight=0.5, max_episode_steps=70)
    for k, instance in enumerate((env, gymnasium.wrappers.FlattenObservation(env))):
        assert nearl.from_gymnasium(instance, tmp_path / f"b{k}").read_text() == by_name.read_text()
    bare = nearl.from_gymnasium(env.unwrapped, tmp_path / "c").read_text()  # of which Gymnasium knows no length but that of the name
    assert bare == by_name.read_text().replace("max_episode_steps = 70", "max_episode_steps = 1000")
    assert "max_episode_steps = 70" in by_name.read_text() and "0.5" in by_name.read_text()
    unnamed = type(env.unwrapped)()
    for what in (unnamed, 5):
        with pytest.raises(ValueError, match="was not made by a name; register it with gymnasium.register and give that name"):
            nearl.from_gymnasium(what, tmp_path)


OWN_TASKS = ["InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Swimmer-v5", "Reacher-v5", "Pusher-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5"]
OWN_TASKS += ["Ant-v5", "Humanoid-v5", "HumanoidStandup-v5"]
# Of Gymnasium's reward functions these read places of bodies, which after a step are those before its last physics step.
LAGGING = ("InvertedDoublePendulum-v5", "Reacher-v5", "Pusher-v5", "Ant-v5", "Humanoid-v5")


def place(env: gymnasium.Env) -> np.ndarray:
    """Where Gymnasium's Ant and Humanoid measure their speed, at the present state."""
    mujoco.mj_kinematics(env.model, env.data)
    if type(env).__name__ == "AntEnv":
        return env.data.body(env._main_body).xpos.copy()
    return np.average(env.data.xipos, axis=0, weights=env.model.body_mass)


def reward_again(env: gymnasium.Env, action: np.ndarray, before: np.ndarray) -> float:
    """Gymnasium's own reward function, with places of bodies that are those of the new state."""
    name = type(env).__name__
    if name in ("AntEnv", "HumanoidEnv"):
        return env._get_rew((place(env) - before)[0] / env.dt, action)[0]
    mujoco.mj_forward(env.model, env.data)
    if name != "InvertedDoublePendulumEnv":
        return env._get_rew(action)[0]
    x, _, y = env.data.site_xpos[0]
    return env._get_rew(x, y, bool(y <= 1))[0]


def again(theirs: gymnasium.Env, ours: nearl.Env) -> None:
    """Both go on from Gymnasium's state, with nothing else of what was before: contact forces begin where the solver last was."""
    q, v = theirs.data.qpos.copy(), theirs.data.qvel.copy()
    mujoco.mj_resetData(theirs.model, theirs.data)
    theirs.set_state(q, v)
    ours.set_state(q, v)


@pytest.mark.parametrize("env_id", OWN_TASKS)
def test_gymnasiums_own_tasks_bring_their_rewards_and_ends(env_id: str, tmp_path: Path) -> None:
    theirs, ours = gymnasium.make(env_id).unwrapped, nearl.Env(str(nearl.from_gymnasium(env_id, tmp_path)))
    theirs.action_space.seed(1)
    theirs.reset(seed=1)
    again(theirs, ours)
    ends = contacts = 0
    for _ in range(300):
        action = theirs.action_space.sample().astype(np.float64)
        before = place(theirs)
        _, reward, terminated, _, _ = theirs.step(action)
        _, our_reward, our_terminated, _, _ = ours.step(action)
        contacts += bool(np.any(theirs.data.cfrc_ext))
        if env_id in LAGGING:
            reward = reward_again(theirs, action, before)
        assert our_reward == pytest.approx(reward, abs=1e-12, rel=1e-12)
        if "Inverted" not in env_id:
            assert our_terminated == terminated
        elif terminated or our_terminated:  # a tip that crosses the line within a physics step may be seen one period apart
            assert our_terminated == (reward <= 1)
        if terminated or our_terminated:
            ends += 1
            theirs.reset()
        again(theirs, ours)
    assert ends > 0 or env_id in ("Swimmer-v5", "Reacher-v5", "Pusher-v5", "HalfCheetah-v5", "Ant-v5", "HumanoidStandup-v5")
    assert contacts > 20 or env_id not in ("Ant-v5", "Humanoid-v5", "HumanoidStandup-v5")
    drawn = np.array([np.r_[ours.reset(seed=seed)[0], 0] for seed in range(20)])
    assert drawn.std(axis=0).max() > 0, "episodes begin at random places"


def test_arguments_of_a_task_of_gymnasium_are_in_its_reward(tmp_path: Path) -> None:
    """Weights and ranges of one's own, an episode that does not end, and a force that is not cut."""
    given = {"forward_reward_weight": 2.0, "healthy_z_range": (0.4, float("inf")), "contact_force_range": (-float("inf"), 5.0)}
    given |= {"contact_cost_weight": 0.01, "terminate_when_unhealthy": False}
    theirs, ours = gymnasium.make("Ant-v5", **given).unwrapped, nearl.Env(str(nearl.from_gymnasium("Ant-v5", tmp_path, **given)))
    theirs.action_space.seed(2)
    theirs.reset(seed=2)
    unhealthy = 0
    for _ in range(200):
        again(theirs, ours)
        action, before = theirs.action_space.sample().astype(np.float64), place(theirs)
        _, _, terminated, _, _ = theirs.step(action)
        _, our_reward, our_terminated, _, _ = ours.step(action)
        assert our_reward == pytest.approx(reward_again(theirs, action, before), rel=1e-12) and not terminated and not our_terminated
        unhealthy += not theirs.is_healthy
    assert 0 < unhealthy < 200


def test_an_environment_without_mujoco_has_no_robot(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'CartPole-v1' is not built on Gymnasium's MujocoEnv"):
        nearl.from_gymnasium("CartPole-v1", tmp_path)


def test_a_step_that_changes_the_action_is_told(tmp_path: Path) -> None:
    class Scaled(InvertedPendulumEnv):
        def step(self, action):
            return super().step(0.3 * np.asarray(action))

    gymnasium.register("Scaled-v0", entry_point=Scaled)
    try:
        with pytest.warns(UserWarning, match=r"after one step 'Scaled-v0' is .* away from where its MuJoCo model goes with that action: its step\(\) changes"):
            nearl.from_gymnasium("Scaled-v0", tmp_path / "scaled")
    finally:
        gymnasium.registry.pop("Scaled-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        nearl.from_gymnasium("InvertedPendulum-v5", tmp_path / "plain")


@pytest.mark.parametrize(("integrator", "step"), [("Euler", 0.002), ("implicitfast", 0.002), ("implicit", 0.0), ("RK4", 0.0)])
def test_a_task_states_the_steps_that_limits_can_count_on(integrator: str, step: float, tmp_path: Path) -> None:
    """Where joints alone damp, `implicitfast` makes Euler's steps."""
    model = tmp_path / "slide.xml"
    model.write_text(f"""<mujoco><option timestep="0.002" integrator="{integrator}"/><worldbody><body><joint name="a" type="slide" axis="1 0 0"
        range="-1 1" limited="true" damping="0.3"/><geom size=".1"/></body></worldbody>
        <actuator><motor name="push" joint="a" ctrlrange="-9 9"/></actuator></mujoco>""")

    class Slide(gymnasium.envs.mujoco.MujocoEnv):
        metadata: ClassVar = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 100}

        def __init__(self, **kwargs):
            super().__init__(str(model), 5, gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64), **kwargs)

        def _get_obs(self):
            return np.concatenate([self.data.qpos, self.data.qvel])

        reset_model = _get_obs

        def step(self, action):
            self.do_simulation(action, self.frame_skip)
            return self._get_obs(), 0.0, False, False, {}

    gymnasium.register("Slide-v0", entry_point=Slide)
    try:
        file = nearl.from_gymnasium("Slide-v0", tmp_path / "out")
    finally:
        gymnasium.registry.pop("Slide-v0")
    assert tomllib.loads(file.read_text())["time"]["sim_dt"] == step


def test_an_actuator_that_drives_no_joint_is_named(tmp_path: Path) -> None:
    model = tmp_path / "fingers.xml"
    model.write_text("""<mujoco><worldbody><body><joint name="a"/><geom size=".1"/></body><body><joint name="b"/><geom size=".1"/></body></worldbody>
        <tendon><fixed name="both"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>
        <actuator><motor name="grip" tendon="both" ctrlrange="-1 1"/></actuator></mujoco>""")

    class Fingers(gymnasium.envs.mujoco.MujocoEnv):
        metadata: ClassVar = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 100}

        def __init__(self, **kwargs):
            super().__init__(str(model), 5, gymnasium.spaces.Box(-np.inf, np.inf, (4,)), **kwargs)

    gymnasium.register("Fingers-v0", entry_point=Fingers)
    try:
        with pytest.raises(ValueError, match="actuator 'grip' of 'Fingers-v0' drives no joint, and the actions of a task are those of joints"):
            nearl.from_gymnasium("Fingers-v0", tmp_path / "out")
        assert not (tmp_path / "out" / "Fingers.toml").exists()
    finally:
        gymnasium.registry.pop("Fingers-v0")


@pytest.mark.parametrize("env_id", OWN_TASKS)
def test_every_task_of_gymnasium_trains(env_id: str, tmp_path: Path) -> None:
    """A few iterations through the environment, the constraints and the learner: weights move and stay numbers."""
    agent = nearl.PID2(nearl.from_gymnasium(env_id, tmp_path), settings={"train.n_envs": 4, "train.n_steps": 64})
    obs = np.linspace(-0.1, 0.1, len(agent.controller.obs_names))
    before, rows = agent.predict(obs)[0], []
    agent.learn(768, callback=lambda _, metrics: rows.append(dict(metrics)))
    after = agent.predict(obs)[0]
    assert len(rows) == 3 and np.isfinite(after).all() and not np.array_equal(before, after)
    assert all(np.isfinite(value) for row in rows for value in row.values())


@pytest.mark.parametrize("env_id", ["Humanoid-v5", "HumanoidStandup-v5"])
def test_tasks_whose_reward_is_code_train_with_functions(env_id: str, tmp_path: Path) -> None:
    agent = nearl.PID2(
        nearl.from_gymnasium(env_id, tmp_path),
        "ppo",
        settings={"train.n_envs": 4, "train.n_steps": 64},
        reward=lambda obs, actions, next_obs: next_obs[:, 2] - 0.1 * (actions**2).sum(axis=1),
        termination=lambda obs, actions, next_obs: next_obs[:, 2] < 0.05,
    )
    rows: list[dict[str, float]] = []
    agent.learn(768, callback=lambda _, metrics: rows.append(dict(metrics)))
    assert len(rows) == 3 and all(np.isfinite(value) for row in rows for value in row.values())


class OfSomebody(HopperEnv):
    """A class whose reward nobody knows here."""


def test_a_task_from_gymnasium_learns(tmp_path: Path) -> None:
    gymnasium.register("OfSomebody-v0", OfSomebody)
    with pytest.raises(ValueError, match=r"\[reward\] of 'OfSomebody' is 0 whatever happens"):
        nearl.PID2(nearl.from_gymnasium("OfSomebody-v0", tmp_path))
    file = nearl.from_gymnasium("InvertedPendulum-v5", tmp_path)
    seen: list[float] = []
    nearl.PID2(file, settings={"train.n_envs": 8}).learn(40_000, callback=lambda _, m: seen.append(m.get("rollout/ep_rew_mean", 0.0)))
    assert seen[1] < 100 < 200 < seen[-1], "Gymnasium's reward: 1 while it stands"
