"""SB3's five lines: learn, predict, save, load; the same weights as `nearl train`; Ctrl-C keeps what was learned."""

import _thread
import functools
import itertools
import resource
import signal
import threading
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from conftest import ROOT

import nearl
from nearl.runs import tomllib

CART_POLE = str(ROOT / "examples" / "tasks" / "cart-pole.toml")


def test_five_lines(tmp_path: Path) -> None:
    agent = nearl.PID2(CART_POLE, algo="pid2-ib", seed=0)
    before = agent.predict(np.zeros(5))[0]
    assert agent.learn(60_000) is agent and agent.num_timesteps >= 60_000
    agent.save(tmp_path / "agent.safetensors")
    loaded = nearl.PID2.load(tmp_path / "agent.safetensors")
    assert loaded.task == "cart-pole" and loaded.algo == "pid2-ib"

    env = gymnasium.make(nearl.register(CART_POLE)[0])
    (obs, _), total, over, state = env.reset(seed=3), 0.0, False, None
    while not over:
        action, state = loaded.predict(obs, state, deterministic=True)
        assert np.array_equal(action, agent.predict(obs)[0]) and action.shape == (1,) and state is None
        obs, reward, terminated, truncated, _ = env.step(action)
        total, over = total + reward, terminated or truncated
    assert total > 400, "it balances"
    assert not np.array_equal(before, agent.predict(np.zeros(5))[0])
    with pytest.raises(ValueError, match="no optimiser state"):
        loaded.learn(1000)


def test_a_run_that_ends_in_its_warm_up_is_told_so() -> None:
    """2048 steps a batch: one for the statistics and eight of the warm-up."""
    agent = nearl.PID2("Hopper-v5", algo="pid2-ib", preset="strong")
    with warnings.catch_warnings(), pytest.raises(UserWarning, match="ends after 4096 steps"):
        warnings.simplefilter("error")
        agent.learn(4096)
    with pytest.warns(UserWarning, match="ends after 4096 steps, and first batch and warm-up take 18432") as warned:
        agent.learn(4096)
    assert [w.filename for w in warned if "warm-up" in str(w.message)] == [__file__]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        agent.learn(16_384)
    assert not [w for w in said if "warm-up" in str(w.message)]


def test_predictions_are_the_controllers_and_come_in_rows(tmp_path: Path) -> None:
    agent = nearl.PID2("HalfCheetah-v5", seed=1, settings={"constraints.velocity.limit": 2.0}).learn(4096)
    agent.save(tmp_path / "a.safetensors")
    controller = nearl.Controller.load(tmp_path / "a.safetensors")
    env = nearl.Env("HalfCheetah-v5")
    rows = []
    for seed in range(5):
        obs, _ = env.reset(seed=seed)
        q, v = env.state
        rows.append((obs, controller.update(q, v, obs)[0]))
    actions, _ = agent.predict(np.stack([obs for obs, _ in rows]))
    assert np.array_equal(actions, np.stack([a for _, a in rows]))
    noisy = [agent.predict(rows[0][0], deterministic=False)[0] for _ in range(200)]
    assert np.std(noisy, axis=0).min() > 0.1 and np.array_equal(agent.predict(rows[0][0])[0], actions[0])


def test_a_policy_of_every_twentieth_tick_keeps_its_proposal() -> None:
    agent = nearl.PID2.load(ROOT / "examples" / "snapshots" / "panda-reach.safetensors")
    envs = [nearl.Env("Panda-reach") for _ in range(2)]
    obs = np.stack([env.reset(seed=i)[0] for i, env in enumerate(envs)])
    controllers = [nearl.Controller.load(ROOT / "examples" / "snapshots" / "panda-reach.safetensors") for _ in envs]
    state, start = None, np.ones(2, bool)
    for tick in range(45):
        if tick == 30:
            start, _ = np.array([False, True]), controllers[1].reset()
        actions, state = agent.predict(obs, state, start)
        expected = [c.update(*env.state, o)[0] for c, env, o in zip(controllers, envs, obs)]
        assert np.array_equal(actions, np.stack(expected))
        obs = np.stack([env.step(a)[0] for env, a in zip(envs, actions)])
        start = np.zeros(2, bool)
    with pytest.raises(ValueError, match="state is of 2 environments, observation of 1"):
        agent.predict(obs[0], state)


def test_callbacks_see_metrics_and_stop_the_learning() -> None:
    seen: list[dict[str, float]] = []

    def third(agent: nearl.PID2, metrics: dict[str, float]) -> bool:
        seen.append(metrics)
        assert agent.num_timesteps == metrics["time/total_timesteps"]
        return len(seen) < 3

    nearl.PID2(CART_POLE, algo="ppo").learn(100_000, callback=[third], progress_bar=True)
    assert [m["time/total_timesteps"] for m in seen] == [1024, 2048, 3072]
    assert {"rollout/ep_rew_mean", "time/fps", "train/approx_kl"} <= seen[-1].keys()


def test_a_callback_sees_what_was_learned_so_far(tmp_path: Path) -> None:
    agent = nearl.PID2(CART_POLE, algo="ppo", seed=3)
    observation, kept = np.full(len(agent.controller.obs_names), 0.1), tmp_path / "kept.safetensors"
    actions, kept_actions = [agent.predict(observation)[0]], []

    def keep(agent: nearl.PID2, _: object) -> None:
        actions.append(agent.predict(observation)[0])
        agent.save(kept)
        kept_actions.append(nearl.PID2.load(kept).predict(observation)[0])

    agent.learn(4096, callback=keep)
    assert len(actions) > 2
    assert all((a != b).any() for a, b in itertools.pairwise(actions))
    np.testing.assert_array_equal(kept_actions, actions[1:])
    np.testing.assert_array_equal(agent.predict(observation)[0], actions[-1])


@pytest.mark.parametrize(("answer", "stops"), [(False, True), (np.False_, True), (np.bool_(True), False), (None, False), (0, False), (0.0, False), ("", False)])
def test_a_callback_stops_by_false_of_python_or_numpy_alone(answer: object, stops: bool) -> None:
    calls: list[int] = []
    agent = nearl.PID2(CART_POLE, algo="ppo", settings=SMALL)
    agent.learn(3 * 256, callback=lambda _, metrics: (calls.append(1), answer)[1])
    assert len(calls) == (1 if stops else 3)
    assert "of Python or NumPy" in (nearl.PID2.learn.__doc__ or "")


def test_the_same_seed_gives_the_same_policy_on_any_number_of_threads() -> None:
    digest = lambda seed, threads: nearl.PID2(CART_POLE, seed=seed, threads=threads).learn(5000).controller.digest  # noqa: E731
    assert digest(0, 1) == digest(0, 3) != digest(1, 1)


def test_ctrl_c_keeps_what_was_learned(tmp_path: Path) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell starts in the background ignores it
    agent = nearl.PID2(CART_POLE, run=tmp_path / "run")
    threading.Timer(1.0, _thread.interrupt_main).start()
    with pytest.raises(KeyboardInterrupt):
        agent.learn(10**9)
    assert 0 < agent.num_timesteps < 10**9
    loaded = nearl.PID2.load(tmp_path / "run")
    assert np.array_equal(loaded.predict(np.zeros(5))[0], agent.predict(np.zeros(5))[0])
    assert loaded.num_timesteps == agent.num_timesteps
    assert (tmp_path / "run" / "metrics.csv").read_text().startswith("time/total_timesteps,")


def test_python_runs_while_it_learns() -> None:
    agent, turns = nearl.PID2("HalfCheetah-v5", threads=1, settings={"train.n_steps": 1024}), 0
    job = threading.Thread(target=lambda: agent.learn(16_384))
    job.start()
    while job.is_alive():
        turns += 1
    assert turns > 1000, "the interpreter was held"


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="no algorithm 'sac'"):
        nearl.PID2(CART_POLE, algo="sac")
    with pytest.raises(ValueError, match="did you mean 'gamma'"):
        nearl.PID2(CART_POLE, settings={"train.gama": 0.9})
    with pytest.raises(ValueError, match="total_timesteps is 0"):
        nearl.PID2(CART_POLE).learn(0)
    with pytest.raises(FileNotFoundError, match="demonstrations '.*nope.npz': it cannot be read"):
        nearl.PID2(CART_POLE, "bc", demos="nope.npz")
    with pytest.raises(OSError, match="demonstrations '.*': it cannot be read: it is a directory"):
        nearl.PID2(CART_POLE, "bc", settings={"train.demos.file": str(ROOT)})


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"algo": None}, "algo is None; give one of ppo, .*pid2-ib"),
        ({"preset": 3}, "preset is 3; give 'paper', 'strong' or 'long'"),
        ({"task": None}, r"task is None; give the name of a task, one of nearl.tasks\(\), or a task file"),
        ({"demos": 3}, "demos is 3; give a file of demonstrations"),
        ({"run": 3}, "run is 3; give a folder to write"),
        ({"start_from": b"runs"}, "start_from is b'runs'; give the folder of a run"),
        ({"algo": "bc"}, r"'bc' learns from demonstrations and was given none; give a file as demos= \("),
        ({"demos": "a.npz"}, r"'pid2-ib' takes no demonstrations; give one of .* as algo=, or leave demos= out"),
        ({"settings": ["a=1"]}, r"settings is \['a=1'\]; give a table by dotted key"),
        ({"reward": 3}, r"reward is 3; give a function, reward\(obs, actions, next_obs\)"),
        ({"reward": "q.yaw"}, "reward is 'q.yaw'; give a function"),
        ({"termination": lambda obs, actions: True}, r"termination is a function of \(obs, actions\) and is called with \(obs, actions, next_obs\)"),
    ],
)
def test_arguments_of_another_kind_are_named_where_they_are_given(wrong: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        nearl.PID2(**{"task": CART_POLE, **wrong})  # type: ignore[arg-type]


def test_other_doors_name_what_is_no_path() -> None:
    for refused, said in [
        (lambda: nearl.make_vec(None, 2), "task is None; give the name"),  # type: ignore[arg-type]
        (lambda: nearl.ProjectedEnv(CART_POLE, constraints=3), "constraints is 3; give 'task'"),  # type: ignore[arg-type]
        (lambda: nearl.register(3), "a task file is 3; give a path"),  # type: ignore[arg-type]
        (lambda: nearl.PID2.load(None), "path is None; give a snapshot file or a run folder"),  # type: ignore[arg-type]
    ]:
        with pytest.raises(ValueError, match=said):
            refused()


def test_functions_are_refused_only_where_they_cannot_be_called(tmp_path: Path) -> None:
    def of_all(obs, actions, next_obs):
        return next_obs[:, 0]

    @functools.wraps(lambda obs: obs)
    def wrapping(*given):
        return given[2][:, 0]

    for reward in (of_all, wrapping, functools.partial(lambda scale, *given: scale * given[0][:, 0], 2.0), np.maximum, lambda a, b, c, d=1: a[:, 0]):
        nearl.PID2(CART_POLE, "ppo", settings=SMALL, reward=reward)
    with pytest.raises(ValueError, match=r"a function of \(obs, \*, goal\) and is called"):
        nearl.PID2(CART_POLE, "ppo", settings=SMALL, reward=lambda obs, *, goal: obs)
    with pytest.raises(ValueError, match="reward is 3; give a function"):
        nearl.PID2.load(tmp_path, reward=3)  # type: ignore[arg-type]
    agent = nearl.PID2(CART_POLE, "ppo", settings=SMALL)
    for callback, said in (
        (3, r"callback is 3; give a function, callback\(agent, metrics\), or a list of them"),
        ([print, None], r"callback\[1\] is None; give a function"),
        (lambda agent: None, r"callback is a function of \(agent\) and is called with \(agent, metrics\)"),
    ):
        with pytest.raises(ValueError, match=said):
            agent.learn(256, callback=callback)  # type: ignore[arg-type]
    assert agent.num_timesteps == 0


def test_a_snapshot_says_from_how_many_steps_it_was_learned(tmp_path: Path) -> None:
    agent = nearl.PID2(CART_POLE, "ppo", settings=SMALL, run=tmp_path / "run").learn(512)
    agent.save(tmp_path / "a.safetensors")
    for file in (tmp_path / "a.safetensors", tmp_path / "run" / "checkpoints" / "final.safetensors", tmp_path / "run"):
        assert nearl.PID2.load(file).num_timesteps == agent.num_timesteps == 512


def test_a_stopped_run_goes_on_exactly(tmp_path: Path) -> None:
    whole = nearl.PID2(CART_POLE, run=tmp_path / "whole", threads=1).learn(8192)
    nearl.PID2(CART_POLE, run=tmp_path / "part").learn(8192, callback=lambda a, _: a.num_timesteps < 4096)
    part = nearl.PID2.load(tmp_path / "part")
    assert part.num_timesteps == 4096
    part.learn(4096)
    assert part.controller.digest == whole.controller.digest


def test_a_training_starts_from_the_networks_of_another(tmp_path: Path) -> None:
    settings = {"train.n_envs": 4, "train.n_steps": 256, "train.pid2.warmup": 1024}
    one = nearl.PID2("Hopper-v5", seed=1, settings=settings, run=tmp_path / "one").learn(4096)
    obs = np.linspace(-1.0, 1.0, 11)
    two = nearl.PID2("Hopper-v5", seed=2, settings=settings, start_from=tmp_path / "one")
    np.testing.assert_array_equal(two.predict(obs)[0], one.predict(obs)[0])
    assert two.num_timesteps == 0
    slower = nearl.PID2("Hopper-v5", settings={**settings, "constraints.velocity.limit": 6.0}, start_from=tmp_path / "one")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it has no warm-up to end in
        slower.learn(2048)
    with pytest.raises(ValueError, match="start_from: the networks of '.*one' do not fit 'Walker2d-v5': entry"):
        nearl.PID2("Walker2d-v5", settings=settings, start_from=tmp_path / "one")


def test_a_run_folder_has_checkpoints_on_the_way(tmp_path) -> None:
    seen = []
    agent = nearl.PID2("examples/tasks/cart-pole.toml", algo="ppo", run=tmp_path / "run", threads=1)
    agent.learn(40_960, callback=lambda *_: seen.append((tmp_path / "run/checkpoints/resume.safetensors").is_file()))
    assert seen and all(seen), "from the first batch on"


def test_an_observation_that_is_not_finite_is_refused_by_name() -> None:
    agent = nearl.PID2("examples/tasks/cart-pole.toml", algo="ppo", threads=1)
    before = agent.predict(np.full(5, 0.1))[0]
    with pytest.raises(ValueError, match=r"obs\[2\] \('.*'\) is NaN"):
        agent.predict(np.array([[0.1] * 5, [0.1, 0.1, np.nan, 0.1, 0.1]]))
    assert (agent.predict(np.full(5, 0.1))[0] == before).all()


def test_refusals_of_files_and_folders_name_them_and_what_python_does_next(tmp_path: Path) -> None:
    run, junk = tmp_path / "run", tmp_path / "junk.safetensors"
    nearl.PID2(CART_POLE, algo="ppo", run=run, threads=1, settings={"train.n_envs": 2, "train.n_steps": 64}).learn(128)
    with pytest.raises(ValueError, match=r"run' already holds a run; go on with nearl.PID2.load\(run\), give another folder as run="):
        nearl.PID2(CART_POLE, algo="ppo", run=run)
    junk.write_bytes(b"not a snapshot at all")
    with pytest.raises(ValueError, match=r"junk.safetensors' is not a safetensors file"):
        nearl.PID2.load(junk)
    with pytest.raises(ValueError, match="an XML file, as robots are described in, not a snapshot; give a snapshot or the folder of a run"):
        nearl.PID2.load(ROOT / "tests" / "fixtures" / "two_link.xml")


def test_two_agents_do_not_mix_their_rows_in_one_run_folder(tmp_path: Path) -> None:
    run = tmp_path / "run"
    first = nearl.PID2(CART_POLE, algo="ppo", run=run, threads=1).learn(4096)
    second = nearl.PID2.load(run)
    busy: list[str] = []

    def intrude(*_: object) -> None:
        with pytest.raises(ValueError, match="another training is at work in") as refused:
            second.learn(2048)
        busy.append(str(refused.value))

    first.learn(2048, callback=intrude)
    assert busy
    with pytest.raises(ValueError, match="has gone on since this agent was made or loaded, at 4096 steps"):
        second.learn(2048)
    third = nearl.PID2.load(run).learn(2048)
    rows = [int(line.split(",")[0]) for line in (run / "metrics.csv").read_text().splitlines()[1:]]
    assert rows == list(range(1024, 8193, 1024))
    assert third.num_timesteps == 8192


def edited(folder: Path, old: str, new: str) -> Path:
    """The cart-pole with ``old`` replaced by ``new``, and its robot beside it."""
    text, task = Path(CART_POLE).read_text(), folder / "task.toml"
    assert old in text
    task.write_text(text.replace(old, new, 1))
    robot = Path(CART_POLE).parent / tomllib.loads(text)["model"]["mjcf"]
    (folder / robot.name).write_text(robot.read_text())
    return task


def test_a_reward_that_is_not_a_number_ends_the_learning(tmp_path: Path) -> None:
    task = edited(tmp_path, "[reward]", '[reward]\nroot = "log(cos(q.hinge) - 2.0)"')
    agent = nearl.PID2(task, algo="ppo", run=tmp_path / "run", threads=1)
    with pytest.raises(ValueError, match="nothing can be learned from it"):
        agent.learn(2048)
    assert (tmp_path / "run/checkpoints/resume.safetensors").is_file()


def test_what_a_policy_sees_and_is_no_number_ends_the_learning(tmp_path: Path) -> None:
    root = '"log(cos(q.hinge) - 2.0)"]'
    for key, old, new in (("observation", '"v.hinge"]', f'"v.hinge", {root}'), ("privileged", "[state]", f"[state]\nprivileged = [{root}")):
        task = edited(tmp_path, old, new)
        with pytest.raises(ValueError, match=rf"{key} 'log\(cos\(q.hinge\) - 2.0\)' of '.*' came out as NaN after .* steps"):
            nearl.PID2(task, algo="ppo", threads=1).learn(2048)
    for section, text, said in (("reward", "log(-1)", "it is NaN always"), ("termination", "2 > 1", "it holds always")):
        with pytest.raises(ValueError, match=rf"\[{section}.never\]: .*{said}"):
            nearl.PID2(edited(tmp_path, f"[{section}]", f'[{section}]\nnever = "{text}"'), algo="ppo")


def test_numbers_that_no_training_has_are_refused() -> None:
    for wrong in ({"seed": -1}, {"seed": 2**64}, {"threads": 0}):
        name, value = next(iter(wrong.items()))
        with pytest.raises(ValueError, match=f"{name} is {value}"):
            nearl.PID2(CART_POLE, **wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"\[train.n_envs\] = 16, \[train.n_steps\] = 1000000000.*give fewer"):
        nearl.PID2(CART_POLE, settings={"train.n_envs": 16, "train.n_steps": 1_000_000_000})


def test_what_is_no_number_is_refused_in_a_sentence() -> None:
    for wrong in ({"seed": None}, {"seed": "0"}, {"threads": "2"}):
        name, value = next(iter(wrong.items()))
        with pytest.raises(ValueError, match=f"{name} is {value!r}; give"):
            nearl.PID2(CART_POLE, **wrong)  # type: ignore[arg-type]
    agent = nearl.PID2(CART_POLE, algo="ppo", threads=1, settings={"train.n_envs": 2, "train.n_steps": 64})
    for steps, said in (("200k", "'200k'"), (None, "None"), (1.5, "1.5, no whole number")):
        with pytest.raises(ValueError, match=f"total_timesteps is {said}; ask for at least one step"):
            agent.learn(steps)  # type: ignore[arg-type]
    assert agent.learn(1e2).num_timesteps == 128  # type: ignore[arg-type]
    for obs, shape in ((np.zeros((0, 5)), r"\(0, 5\)"), (np.zeros((2, 2, 5)), r"\(2, 2, 5\)"), (np.zeros(4), r"\(4,\)"), (None, r"\(\)")):
        with pytest.raises(ValueError, match=f"observation has shape {shape}; give one observation, .5,., or at least one row"):
            agent.predict(obs)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="observation is not an array of numbers but <class 'str'>"):
        agent.predict("abc")  # type: ignore[arg-type]


def test_a_run_is_written_where_it_began(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"train.n_envs": 2, "train.n_steps": 64}
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    agent = nearl.PID2(CART_POLE, algo="ppo", run="run", settings=small)
    monkeypatch.chdir(tmp_path / "elsewhere")
    agent.learn(256)
    monkeypatch.chdir(tmp_path)
    again = nearl.PID2.load("run")
    monkeypatch.chdir(tmp_path / "elsewhere")
    again.learn(256)
    assert nearl.PID2.load(tmp_path / "run").num_timesteps == 512 and not list((tmp_path / "elsewhere").iterdir())


def test_a_second_learn_at_the_same_time_is_refused() -> None:
    agent = nearl.PID2(CART_POLE, algo="ppo", threads=1)
    refused: list[str] = []

    def again(*_: object) -> None:
        with pytest.raises(ValueError, match="learning already") as error:
            agent.learn(1024)
        refused.append(str(error.value))

    agent.learn(1024, callback=again)
    assert refused and agent.num_timesteps == 1024


def test_rows_of_a_prediction_do_not_hear_of_each_other(tmp_path: Path) -> None:
    task = edited(tmp_path, 'consistency = "free"', 'consistency = "kinematic"\njerk = { limit = { slider = 50.0 } }')
    with pytest.raises(ValueError, match="straight-through"):
        nearl.PID2(task, algo="pid2-ib", threads=1)
    agent = nearl.PID2(task, algo="pid2-ib", threads=1, settings={"train.pid2.gradient": "straight-through"})
    assert agent.controller.remembers
    obs = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 5))
    actions, state = agent.predict(obs)
    assert state is not None and np.array_equal(agent.predict(obs[::-1])[0][::-1], actions)
    # an episode that begins forgets; one that goes on does not
    begun, state = agent.predict(obs, state, np.ones(8, bool))
    assert np.array_equal(begun, actions)
    assert not np.array_equal(agent.predict(-obs, state)[0], agent.predict(-obs)[0])


@pytest.mark.parametrize("deterministic", [True, False])
def test_rows_of_a_controller_that_remembers_take_no_memory(tmp_path: Path, deterministic: bool) -> None:
    """As many rows as are wanted are the first ticks of one controller; what each remembers is made where it is asked for."""
    task = edited(tmp_path, 'consistency = "free"', 'consistency = "kinematic"\njerk = { limit = { slider = 50.0 } }')
    agent = nearl.PID2(task, algo="pid2-ib", threads=1, settings={"train.pid2.gradient": "straight-through"})
    obs = np.random.default_rng(1).uniform(-0.5, 0.5, (20_000, 5))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    many, state = agent.predict(obs, deterministic=deterministic)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "kB; a controller a row took 15 GB"
    assert state is not None and len(state) == 20_000

    few = 30
    agent._rng = np.random.default_rng(agent.seed)
    noise = None if deterministic else agent._rng.standard_normal((few, agent.controller.n_noise))
    alone = [agent.controller.another() for _ in range(few)]
    first = np.stack([c.act(row, None if noise is None else noise[i]) for i, (c, row) in enumerate(zip(alone, obs))])
    agent._rng = np.random.default_rng(agent.seed)
    rows = obs[:few].copy()
    actions, state = agent.predict(rows, deterministic=deterministic)
    rows[:] = 0.0  # the caller may fill the same array with what comes next
    assert np.array_equal(actions, first) and np.array_equal(actions, many[:few])
    for _ in range(3):
        actions, again = agent.predict(-obs[:few], state)
        assert np.array_equal(actions, np.stack([c.act(row) for c, row in zip(alone, -obs[:few])])) and again is state


def test_where_episodes_begin_is_said_for_each_environment() -> None:
    agent = nearl.PID2(CART_POLE)
    assert np.array_equal(agent.predict(np.zeros((2, 5)), None, [True, False])[0], agent.predict(np.zeros((2, 5)), None, True)[0])
    for wrong, shape in (([True, False], "2,"), (np.ones((3, 1), bool), "3, 1"), ([], "0,")):
        with pytest.raises(ValueError, match=rf"episode_start has shape \({shape}\), and observation is of 3 environments; give one true or false for each"):
            agent.predict(np.zeros((3, 5)), None, wrong)


def test_presets_and_algorithms_are_those_of_the_trainer() -> None:
    names = [name for name, _ in nearl.algorithms()]
    assert names[0] == "ppo" and {"nearl", "pid2-gan", "pid2-ib", "ppo-combined"} <= set(names)
    with pytest.raises(ValueError, match="no preset 'weak'; give one of paper, strong, long"):
        nearl.PID2(CART_POLE, preset="weak")
    agent = nearl.PID2(CART_POLE, preset="strong", threads=1, settings={"train.n_envs": 2, "train.n_steps": 256})
    agent.learn(1)
    assert agent.num_timesteps == 512



SMALL = {"train.n_envs": 4, "train.n_steps": 64, "train.ppo.batch_size": 64}


@pytest.mark.parametrize("algo", ["ppo", "pid2-ib"])
def test_rewards_and_ends_may_be_functions(algo) -> None:
    """What the functions say is what episodes are worth and how long they are, whatever the task says."""
    agent = nearl.PID2(CART_POLE, algo, settings=SMALL, reward=lambda obs, actions, next_obs: 3.0 + 0.0 * obs[:, 0])
    metrics: list[dict[str, float]] = []
    agent.learn(2048, callback=lambda agent, row: metrics.append(row))
    last = metrics[-1]
    assert last["rollout/ep_rew_mean"] == pytest.approx(3.0 * last["rollout/ep_len_mean"], rel=1e-9)
    short = nearl.PID2(CART_POLE, algo, settings=SMALL, termination=lambda obs, actions, next_obs: np.abs(next_obs[:, 0]) < np.inf)
    short.learn(1024, callback=lambda agent, row: metrics.append(row))
    assert metrics[-1]["rollout/ep_len_mean"] == 1.0


def test_functions_that_say_what_the_task_says_give_the_same_weights() -> None:
    """Their arguments are the observations before and after, and the action: the reward of a period of HalfCheetah is made of these."""

    def cheetah(obs, actions, next_obs):
        return 0.0 * next_obs[:, 8] - 0.1 * (actions**2).sum(axis=1)

    seen: list[tuple[np.ndarray, ...]] = []
    settings = {"train.n_envs": 1, "train.n_steps": 64, "train.ppo.batch_size": 64}
    keep = lambda *arguments: seen.append([np.array(a) for a in arguments]) or cheetah(*arguments)  # noqa: E731
    nearl.PID2("HalfCheetah-v5", "ppo", settings=settings, reward=keep, threads=1).learn(64)
    env = nearl.Env("HalfCheetah-v5")
    assert len(seen) == 64 and all(a.shape == (1, n) for step in seen for a, n in zip(step, (17, 6, 17)))
    for (_, _, after), (before, _, _) in itertools.pairwise(seen):
        np.testing.assert_array_equal(after, before)
    # The same actions from the same start in an environment of its own.
    q = np.concatenate([[0.0], seen[0][0][0, :8]])
    env.reset(seed=0)
    obs = env.set_state(q, seen[0][0][0, 8:])
    for before, action, after in seen[:20]:
        np.testing.assert_allclose(obs, before[0], atol=1e-9)
        obs = env.step(action[0])[0]
        np.testing.assert_allclose(obs, after[0], atol=1e-9)


@pytest.mark.parametrize(
    ("functions", "said"),
    [
        ({"reward": lambda obs, actions, next_obs: [1.0, 2.0]}, r"reward\(obs, actions, next_obs\) gave shape \(2,\)"),
        ({"reward": lambda obs, actions, next_obs: obs[:, 0] + np.nan}, r"reward\(obs, actions, next_obs\)\[0\] is nan"),
        ({"termination": lambda obs, actions, next_obs: next_obs[:, 0]}, "gave float64 values"),
    ],
)
def test_functions_that_say_nothing_usable_are_named(functions, said) -> None:
    with pytest.raises(ValueError, match=said):
        nearl.PID2(CART_POLE, "ppo", settings=SMALL, **functions).learn(512)


def test_what_a_function_raises_is_raised() -> None:
    def broken(obs, actions, next_obs):
        raise KeyError("no such sensor")

    with pytest.raises(KeyError, match="no such sensor"):
        nearl.PID2(CART_POLE, "ppo", settings=SMALL, reward=broken).learn(512)


def test_a_training_from_functions_goes_on_with_them_alone(tmp_path) -> None:
    """Bit for bit, and not in silence with the task's own reward."""
    reward = lambda obs, actions, next_obs: -np.abs(next_obs[:, 0])  # noqa: E731
    agent = nearl.PID2(CART_POLE, "ppo", settings=SMALL, reward=reward, run=tmp_path / "whole")
    agent.learn(1024)
    half = nearl.PID2(CART_POLE, "ppo", settings=SMALL, reward=reward, run=tmp_path / "half")
    half.learn(1024, callback=lambda agent, row: agent.num_timesteps < 512)
    with pytest.raises(ValueError, match=r"from Python functions, which no file holds; go on in Python with nearl.PID2.load"):
        nearl.PID2.load(tmp_path / "half")
    again = nearl.PID2.load(tmp_path / "half", reward=reward).learn(512)
    obs = np.random.default_rng(0).normal(size=(20, len(agent.controller.obs_names)))
    np.testing.assert_array_equal(agent.predict(obs)[0], again.predict(obs)[0])


@pytest.mark.parametrize("learned", [("reward",), ("termination",), ("reward", "termination")])
def test_a_function_that_a_run_learned_from_is_asked_for_by_its_name(tmp_path: Path, learned: tuple[str, ...]) -> None:
    """The other one alone is not taken for it, also after the run has gone on."""
    functions = {"reward": lambda obs, actions, next_obs: 0.0 * next_obs[:, 0] - 7.0, "termination": lambda obs, actions, next_obs: next_obs[:, 0] > 1e9}
    given = {name: functions[name] for name in learned}
    nearl.PID2(CART_POLE, "ppo", settings=SMALL, run=tmp_path / "run", **given).learn(512)
    for _ in range(2):
        for missing in learned:
            others = {name: function for name, function in functions.items() if name != missing}
            with pytest.raises(ValueError, match=rf"has its {missing} from Python functions, .* nearl.PID2.load\(run, {'=..., '.join(learned)}=...\)"):
                nearl.PID2.load(tmp_path / "run", **others)
        nearl.PID2.load(tmp_path / "run", **given).learn(256)
