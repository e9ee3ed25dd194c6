"""A vector is its single environments, on any number of threads; and its constrained form is the controller's path."""

import inspect
import pydoc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from conftest import ROBOTS
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import nearl


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("task", ["Hopper-v5", "Ant-v5", "Panda-reach"])
def test_a_vector_equals_single_environments(task: str, mode: AutoresetMode) -> None:
    steps, n = 150, 5
    make = lambda: gymnasium.make(f"nearl/{task}", max_episode_steps=60)  # noqa: E731
    singles = SyncVectorEnv([make] * n, autoreset_mode=mode)
    vec = nearl.VecEnv(task, n, threads=3, max_episode_steps=60, autoreset_mode=mode)
    assert vec.metadata["autoreset_mode"] is mode
    assert vec.action_space == singles.action_space and vec.observation_space == singles.observation_space
    assert np.array_equal(vec.reset(seed=11)[0], singles.reset(seed=11)[0])
    vec.action_space.seed(5)
    ended = np.zeros(2, int)
    for _ in range(steps):
        actions = vec.action_space.sample()
        ours, theirs = vec.step(actions), singles.step(actions)
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            assert np.array_equal(a, b) and a.dtype == b.dtype
        ended += ours[2].sum(), ours[3].sum()
        assert ("final_obs" in ours[4]) == ("final_obs" in theirs[4])
        if "final_obs" in ours[4]:
            assert np.array_equal(ours[4]["_final_obs"], theirs[4]["_final_obs"])
            for a, b in zip(ours[4]["final_obs"], theirs[4]["final_obs"], strict=True):
                assert (a is None and b is None) or np.array_equal(a, b)
    assert ended[1] > 0, "the comparison covers truncations"
    assert ended[0] > 0 or task != "Hopper-v5", "the comparison covers terminations"


def same_information(ours: dict, theirs: dict) -> None:
    """Everything that Gymnasium's vector says, and beyond it nothing that is not masked out."""
    assert ours.keys() >= theirs.keys()
    for key in ours.keys() - theirs.keys():
        assert not np.any(ours[key]), (key, ours, theirs)
    for key, values in theirs.items():
        if isinstance(values, dict):
            same_information(ours[key], values)
        elif key == "final_obs":
            assert all((a is None and b is None) or np.array_equal(a, b) for a, b in zip(ours[key], values, strict=True))
        else:
            assert np.array_equal(ours[key], values) and ours[key].dtype == values.dtype, (key, ours[key], values)


@pytest.mark.parametrize("ended_by", ["the task", "a function"])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("task", ["Hopper-velocity", "Hopper-v5", "Panda-reach"])
def test_the_information_is_that_of_gymnasiums_vector(task: str, mode: AutoresetMode, ended_by: str) -> None:
    n, far = 4, lambda obs: np.abs(obs[..., 6]) > 0.5

    class Far(gymnasium.Wrapper):
        def step(self, action):
            obs, reward, terminated, truncated, info = self.env.step(action)
            return obs, reward, bool(terminated or far(obs)), truncated, info

    make = lambda: gymnasium.make(f"nearl/{task}", max_episode_steps=25)  # noqa: E731
    kwargs = {} if ended_by == "the task" else {"termination": lambda obs, actions, reached: far(reached)}
    singles = SyncVectorEnv([(lambda: Far(make())) if kwargs else make] * n, autoreset_mode=mode)
    vec = nearl.VecEnv(task, n, max_episode_steps=25, autoreset_mode=mode, **kwargs)
    vec.reset(seed=1), singles.reset(seed=1)
    vec.action_space.seed(2)
    ended, masked = 0, 0
    for _ in range(80):
        actions = vec.action_space.sample()
        ours, theirs = vec.step(actions), singles.step(actions)
        assert all(np.array_equal(a, b) for a, b in zip(ours[:2], theirs[:2], strict=True))
        same_information(ours[4], theirs[4])
        ended += len(theirs[4].get("_final_info", ()))
        masked += "_cost" in theirs[4] and not theirs[4]["_cost"].all()
    assert (ended > 0) == (mode is AutoresetMode.SAME_STEP)
    assert masked > 0 or task != "Hopper-velocity"


def test_what_the_last_step_did_under_constraints_is_final_information_too() -> None:
    vec = nearl.VecEnv("Panda-reach", 2, "task", max_episode_steps=40, autoreset_mode="SameStep", actions="guarded")
    vec.reset(seed=1)
    vec.action_space.seed(2)
    infos = [vec.step(vec.action_space.sample())[4] for _ in range(4)]
    assert all(info["_moved"].all() for info in infos)
    last = [info for info in infos if "final_info" in info]
    assert 0 < len(last) < 4
    for info in last:
        assert info["_final_info"].all()
        for key in ("raw_violations", "target_violations", "recovering", "executed", "moved"):
            assert np.array_equal(info["final_info"][key], info[key]) and info["final_info"][f"_{key}"].all()


def test_signatures_are_those_of_the_source() -> None:
    """NumPy's own types are unions over many lines, which nobody reads in `help`."""
    for function in (nearl.make_vec, nearl.VecEnv, nearl.VecEnv.step, nearl.Env.step, nearl.ProjectedEnv.step, nearl.Guard, nearl.Guard.step, nearl.PID2):
        said = pydoc.plain(pydoc.render_doc(function))
        assert "NestedSequence" not in said and len(str(inspect.signature(function))) < 600, function


def test_actions_may_be_in_any_memory_order() -> None:
    a, b = (nearl.make_vec("Walker2d-v5", 4, seed=1) for _ in range(2))
    a.reset(), b.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 6))
    assert np.array_equal(a.step(actions)[0], b.step(np.asfortranarray(actions))[0])
    assert np.array_equal(a.step(actions.astype(np.float32))[0], b.step(actions.astype(np.float32).astype(float))[0])


def test_threads_do_not_change_a_bit() -> None:
    def run(threads: int) -> np.ndarray:
        vec = nearl.make_vec("Walker2d-v5", 7, seed=2, threads=threads)
        rng = np.random.default_rng(0)
        first, _ = vec.reset()
        return np.concatenate([first, *[vec.step(rng.uniform(-1, 1, (7, 6)))[0] for _ in range(100)]])

    assert np.array_equal(run(1), run(4))


def test_python_runs_while_a_vector_steps() -> None:
    vec = nearl.make_vec("Ant-v5", 32, threads=1)
    vec.reset(seed=0)
    with ThreadPoolExecutor(1) as pool:
        job = pool.submit(lambda: [vec.step(np.zeros((32, 8)))[0] for _ in range(5)])
        turns = 0
        while not job.done():
            turns += 1
        assert len(job.result()) == 5
    assert turns > 100, "the interpreter was held"


def test_learned_inverse_dynamics_needs_a_snapshot() -> None:
    with pytest.raises(ValueError, match="HalfCheetah-v5.*learned inverse model.*snapshot"):
        nearl.make_vec("HalfCheetah-v5", 2, constraints="task")
    with pytest.raises(OSError, match="nowhere.safetensors"):
        nearl.make_vec("HalfCheetah-v5", 2, constraints="nowhere.safetensors")


def chosen(vec: nearl.VecEnv) -> list[int]:
    """Which of the 14 positions and velocities of the arm the task proposes, in its order."""
    state = [f"{half}.panda_joint{i}" for half in "qv" for i in range(1, 8)]
    return [state.index(name) for name in vec.native.action_names]


def test_constraints_hold_in_the_simulator_whatever_is_proposed() -> None:
    vec = nearl.make_vec("Panda-reach", 4, constraints="task", seed=1)
    joints = [f"panda_joint{i}" for i in range(1, 8)]
    assert {name[2:] for name in vec.native.action_names} == set(joints)
    model = nearl.Model.from_urdf(ROBOTS / "panda" / "panda.urdf")
    low, high = model.lower_position_limit, model.upper_position_limit
    rng = np.random.default_rng(3)
    vec.reset(seed=1)
    raw = 0
    for _ in range(120):
        wild = np.concatenate([rng.uniform(low - 1, high + 1, (4, 7)), rng.uniform(-9, 9, (4, 7))], axis=1)
        wild = wild[:, chosen(vec)]
        _, _, terminated, _, info = vec.step(wild)
        raw += info["raw_violations"].sum()
        assert np.array_equal(info["_executed"], np.isfinite(info["executed"]).all(axis=1)), "masked out where a step only began an episode"
        assert not terminated.any() and info["target_violations"].sum() == 0
        assert np.all(vec.native.qpos > low + 0.01 - 1e-9) and np.all(vec.native.qpos < high - 0.01 + 1e-9)
        assert np.all(np.abs(vec.native.qvel) < 0.9 * model.velocity_limit + 1e-9)
    assert raw > 1000, "the proposals would have broken limits"


def test_a_constrained_step_is_cubic_projection_and_inverse_dynamics() -> None:
    """The same step put together from the parts in Python."""
    vec = nearl.make_vec("Panda-reach", 1, constraints="task", seed=4)
    obs = vec.reset(seed=4)[0][0]
    model = nearl.Model.from_urdf(ROBOTS / "panda" / "panda.urdf")
    limits = [
        nearl.PositionLimit(model, 0.01),
        nearl.VelocityLimit(model, scale=0.9),
        nearl.AccelerationLimit(model, 10.0),
        nearl.TorqueLimit(model, 0.95),
    ]
    projector = nearl.Projector(model, limits, dt=1e-3, sub_steps=1)
    env = nearl.Env("Panda-reach")
    env.reset(seed=4)
    rng = np.random.default_rng(8)
    for _ in range(10):
        q0, v0 = env.state
        period, v1 = 0.02, rng.uniform(-1, 1, 7)
        q1 = q0 + period * (v0 + v1) / 2  # at constant acceleration, which is also what follows from a velocity alone
        if len(chosen(vec)) == 14:
            q1 += rng.uniform(-0.1, 0.1, 7)
        obs = vec.step(np.concatenate([q1, v1])[None, chosen(vec)])[0][0]
        for j in range(1, 21):
            s = j / 20
            # Hermite's cubic through (q0, v0) and (q1, v1), in its basis functions.
            h = [2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s, -2 * s**3 + 3 * s**2, s**3 - s**2]
            d = [6 * s**2 - 6 * s, 3 * s**2 - 4 * s + 1, -6 * s**2 + 6 * s, 3 * s**2 - 2 * s]
            ends = [q0, period * v0, q1, period * v1]
            proposal = [sum(a * b for a, b in zip(f, ends, strict=True)) for f in (h, d)]
            q, v = env.state
            target = projector.project(q, v, proposal[0], proposal[1] / period)
            tau = model.rnea(q, v, target.acceleration) - model.passive(q, v)
            env.step(tau)
        np.testing.assert_allclose(obs[:14], np.concatenate(env.state), atol=2e-6)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"num_envs": 0}, "num_envs is 0; ask for at least one environment"),
        ({"num_envs": "4"}, "num_envs is '4'; ask for at least one environment"),
        ({"num_envs": 2.0}, "num_envs is 2.0, no int; ask for at least one environment"),
        ({"num_envs": np.float64(2)}, r"num_envs is .*2.0.*, no int"),
        ({"threads": 0}, "threads is 0; give at least 1"),
        ({"threads": "2"}, "threads is '2'; give at least 1"),
        ({"seed": -1}, r"seed is -1; give a whole number from 0 to 2\*\*64 - 2"),
        ({"seed": 2**64 - 1}, r"seed is 18446744073709551615; give a whole number from 0 to 2\*\*64 - 2"),
        ({"seed": None}, "seed is None; give a whole number"),
        ({"max_episode_steps": 0}, "max_episode_steps is 0; give at least one control period"),
        ({"autoreset_mode": "SAME_STEP"}, "autoreset_mode is 'SAME_STEP'; give 'NextStep' or 'SameStep'"),
        ({"autoreset_mode": None}, "autoreset_mode is None; give 'NextStep' or 'SameStep'"),
        ({"reward": 3}, r"reward is 3; give a function, reward\(obs, actions, next_obs\)"),
        ({"termination": lambda obs, actions: True}, r"termination is a function of \(obs, actions\) and is called with \(obs, actions, next_obs\); give one"),
    ],
)
def test_what_no_vector_has_is_refused(arguments, words) -> None:
    with pytest.raises(ValueError, match=words):
        nearl.VecEnv("Hopper-v5", **{"num_envs": 2} | arguments)


def test_a_vector_begins_with_a_reset() -> None:
    vec, actions = nearl.make_vec("Hopper-v5", 2), np.zeros((2, 3))
    with pytest.raises(ResetNeeded, match=r"no episode has begun in environment 0; call reset\(\) before step\(\)"):
        vec.step(actions)
    vec.set_state(0, vec.native.qpos[0], vec.native.qvel[0])
    with pytest.raises(ResetNeeded, match="in environment 1;"):
        vec.step(actions)
    vec.set_state(1, vec.native.qpos[1], vec.native.qvel[1])
    vec.step(actions)


def test_a_reward_that_is_no_number_is_told_and_not_handed_on() -> None:
    envs = nearl.make_vec("HalfCheetah-v5", 3, threads=1)
    envs.reset(seed=7)
    actions = np.zeros((3, 6))
    assert np.isfinite(envs.step(actions)[1]).all()
    actions[1] = 1e300
    with pytest.raises(ValueError, match="the reward of environment 1 came out as -inf, and nothing can be learned"):
        envs.step(actions)


def test_a_closed_vector_neither_steps_nor_resets() -> None:
    """As an `AsyncVectorEnv` of Gymnasium: the error is Gymnasium's own."""
    vec = nearl.make_vec("Hopper-v5", 2)
    vec.reset(seed=0)
    qpos, qvel = vec.native.qpos[0], vec.native.qvel[0]
    vec.close()
    vec.close()
    for use in (vec.reset, lambda: vec.step(np.zeros((2, 3))), lambda: vec.set_state(0, qpos, qvel)):
        with pytest.raises(ClosedEnvironmentError, match="the vector was closed, .*; make another one with nearl.make_vec"):
            use()


def test_a_run_folder_is_its_newest_policy(tmp_path: Path) -> None:
    """Of vectors and of single environments; actions are projected as by the file itself."""
    run = tmp_path / "run"
    small = {"train.n_envs": 2, "train.n_steps": 64, "train.ppo.batch_size": 32, "train.ppo.n_epochs": 1}
    nearl.PID2("HalfCheetah-v5", "pid2-ib", run=run, settings=small).learn(256)
    (snapshot,) = (file for file in (run / "checkpoints").glob("*.safetensors") if file.stem in ("final", "latest"))
    results = []
    for constraints in (run, snapshot):
        vec = nearl.make_vec("HalfCheetah-v5", 2, constraints)
        vec.reset(seed=3)
        vec.action_space.seed(3)
        results.append([vec.step(vec.action_space.sample())[0] for _ in range(5)])
    assert np.array_equal(*results)
    assert nearl.ProjectedEnv("HalfCheetah-v5", str(run)).action_space.shape == vec.single_action_space.shape
    for make in (lambda: nearl.make_vec("HalfCheetah-v5", 2, tmp_path), lambda: nearl.ProjectedEnv("HalfCheetah-v5", tmp_path)):
        with pytest.raises(ValueError, match="a folder without checkpoints/final.safetensors or latest.safetensors; give a run folder"):
            make()


def test_a_folder_called_task_is_not_the_tasks_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "task").mkdir()
    monkeypatch.chdir(tmp_path)
    assert nearl.make_vec("Panda-reach", 1, "task").num_envs == 1


def test_seeds_of_a_reset_are_whole_numbers() -> None:
    vec = nearl.make_vec("Hopper-v5", 2, seed=np.int64(3))
    assert np.array_equal(vec.reset(seed=np.array([3, 4]))[0], vec.reset(seed=3)[0])
    for seed, words in ((-1, "seed is -1;"), ([0, -1], r"seed\[1\] is -1;"), ("ab", "seed is 'ab';"), (2**64 - 1, "seed is 18446744073709551615;")):
        with pytest.raises(ValueError, match=words):
            vec.reset(seed=seed)


def test_a_proposed_velocity_ranges_over_the_tasks_limit_where_the_robot_file_has_none() -> None:
    vec = nearl.make_vec("tests/fixtures/two_link.toml", 1, constraints="task")  # an MJCF, which states no speed; the task says 4 rad/s
    assert np.isfinite(vec.single_action_space.low).all()
    assert vec.single_action_space.high[2:] == pytest.approx([4.0, 4.0]) and vec.single_action_space.low[2:] == pytest.approx([-4.0, -4.0])


DAMPED = """name = "r"
[model]
urdf = "r.urdf"
[scene]
timestep = 0.001
solids = false
[time]
dt = 0.001
sim_dt = 0.001
max_episode_steps = 10000
[state]
controllable = ["j"]
[command]
interface = "pd"
stiffness = 100
damping = 20
[reward]
still = "1"
[policy]
joints = ["j"]
observation = [{ term = "joint_pos" }, { term = "joint_vel" }, { term = "last_action" }]
[constraints]
guard = true
position = { margin = 0.02 }
velocity = { limit = 3.0 }
acceleration = { limit = 10.0 }
torque = {}
[idm]
kind = "pinocchio"
"""
LINK = """<robot name="r"><link name="base"/><link name="arm">
<inertial><mass value="1"/><inertia ixx=".2" iyy=".2" izz=".2" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="6" velocity="3"/></joint></robot>"""


def test_a_drive_whose_damping_is_the_stronger_brake_is_sent_far_enough(tmp_path: Path) -> None:
    """Its own damping brakes at 300 rad/s² of 10 from full speed: a gentle brake needs a target far beyond the joint's range. The task's recipe is for
    its policy, and whoever gives the actions has another."""
    (tmp_path / "r.urdf").write_text(LINK)
    (tmp_path / "r.toml").write_text(DAMPED)
    env = nearl.make_vec(str(tmp_path / "r.toml"), 1, constraints="task", actions="guarded")
    env.reset(seed=0)
    worst = fastest = 0.0
    for tick in range(2800):
        before = env.native.qvel[0, 0]
        env.step([env.native.action_high if tick // 700 % 2 == 0 else env.native.action_low])
        worst, fastest = max(worst, abs(env.native.qvel[0, 0] - before) / 1e-3), max(fastest, abs(before))
    assert worst < 10.0 + 1e-6
    assert fastest > 2.8


def test_what_changes_stops_and_friction_is_told() -> None:
    def notes(option: str, joint: str) -> str:
        text = f"""<mujoco><compiler angle="radian"/>{option}<worldbody><body><joint name="j" axis="0 1 0" range="-1 1" {joint}/>
        <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/></body></worldbody><actuator><motor joint="j" ctrlrange="-40 40"/></actuator></mujoco>"""
        return "; ".join(nearl.Model.from_mjcf_text(text).notes)

    assert notes("", 'frictionloss="2"') == ""
    assert "stops that act before the range ends (margin of a joint) are not modelled: 'j' by 0.05" in notes("", 'margin="0.05"')
    assert "noslip_iterations change dry friction" in notes('<option noslip_iterations="5"/>', 'frictionloss="2"')
    assert notes('<option noslip_iterations="5"/>', "") == ""
    for hurried in ('iterations="1"', 'ls_iterations="1"', 'tolerance="1e-2"'):
        assert "its dry friction is then not what is modelled" in notes(f"<option {hurried}/>", 'frictionloss="2"')
    unconstrained = '<option><flag constraint="disable"/></option>'
    model = nearl.Model.from_mjcf_text(
        f"""<mujoco>{unconstrained}<worldbody><body><joint name="j" frictionloss="2"/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    assert model.friction[0] == 0.0


@pytest.mark.parametrize("text", ["2.5N", "1,5", "nan", "inf", "0x10", ""])
def test_friction_and_damping_that_are_no_numbers_are_refused(text: str) -> None:
    for key in ("friction", "damping"):
        urdf = LINK.replace("</joint>", f'<dynamics {key}="{text}"/></joint>')
        with pytest.raises(ValueError, match=f"joint 'j' has <dynamics> {key} '{text}', not a number"):
            nearl.Model.from_urdf_text(urdf)
