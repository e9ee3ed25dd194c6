"""Stable-Baselines3 itself, where it is installed (it brings torch): its five lines, its policies in a loop, its learners behind the limits."""

import importlib.util
import os

import numpy as np
import pytest
from conftest import ROOT

sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed (it brings torch)")
gymnasium = pytest.importorskip("gymnasium")
import torch  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from stable_baselines3.common.vec_env import VecNormalize  # noqa: E402

import nearl  # noqa: E402

TASK = "HalfCheetah-v5"
torch.set_num_threads(1)  # networks of this size are no faster with more
EARLY = {"learning_starts": 50, "buffer_size": 2000}


def example(name: str):
    spec = importlib.util.spec_from_file_location(name, ROOT / f"examples/python/{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def returns(act, seed: int) -> float:
    env = gymnasium.make(TASK)
    obs, over, total = env.reset(seed=seed)[0], False, 0.0
    while not over:
        obs, reward, terminated, truncated, _ = env.step(act(obs))
        total, over = total + float(reward), terminated or truncated
    return total


def test_a_trained_ppo_earns_in_a_loop_what_it_earns_in_sb3(tmp_path):
    """Its own five lines, its normaliser, and Gymnasium's environment as a plant behind a loop."""
    env = VecNormalize(make_vec_env(f"nearl:nearl/{TASK}", n_envs=4, seed=0))
    model = sb3.PPO("MlpPolicy", env, n_steps=128, seed=0, device="cpu").learn(1024)
    env.training = False
    snapshot = tmp_path / "ppo.safetensors"
    nearl.import_sb3(model, env, task=TASK).save(snapshot)
    here = returns(lambda obs: model.predict(env.normalize_obs(obs), deterministic=True)[0], 5)
    (there,) = example("gymnasium_plant").play(str(snapshot), [5], f"sb3-{os.getpid()}")
    # Rounding of single precision in another order, which 1000 contacts of a cheetah let grow.
    assert abs(here - there) <= 0.02 * abs(here) + 1.0, (here, there)


@pytest.mark.parametrize(("kind", "arguments"), [("PPO", {"n_steps": 64}), ("A2C", {}), ("SAC", EARLY), ("TD3", EARLY), ("DDPG", EARLY)])
def test_every_kind_of_policy_comes_over_whole(kind, arguments):
    model = getattr(sb3, kind)("MlpPolicy", gymnasium.make(f"nearl/{TASK}"), seed=0, device="cpu", **arguments).learn(70)
    controller, rng = nearl.import_sb3(model, task=TASK), np.random.default_rng(0)
    for scale in (0.1, 1.0, 5.0):
        for obs in scale * rng.normal(size=(30, 17)):
            np.testing.assert_allclose(controller.act(obs), model.predict(obs, deterministic=True)[0], atol=1e-5)


@pytest.mark.parametrize(("kind", "arguments"), [("PPO", {"n_steps": 64, "policy_kwargs": {"squash_output": True}}), ("A2C", {}), ("SAC", EARLY)])
def test_policies_that_explore_by_their_state_come_over_whole(kind, arguments):
    model = getattr(sb3, kind)("MlpPolicy", gymnasium.make(f"nearl/{TASK}"), use_sde=True, seed=0, device="cpu", **arguments).learn(70)
    head = model.policy.actor.mu[0] if kind == "SAC" else model.policy.action_net
    with torch.no_grad():
        head.weight.mul_(30.0)  # far into what is clipped and squashed
    controller, rng = nearl.import_sb3(model, task=TASK), np.random.default_rng(0)
    for obs in rng.normal(size=(60, 17)):
        np.testing.assert_allclose(controller.act(obs), model.predict(obs, deterministic=True)[0], atol=2e-5)


def test_the_normaliser_that_a_model_learned_behind_is_its_own():
    env = VecNormalize(make_vec_env(f"nearl:nearl/{TASK}", n_envs=2, seed=0))
    model = sb3.PPO("MlpPolicy", env, n_steps=64, seed=0, device="cpu").learn(256)
    env.training = False
    controller, rng = nearl.import_sb3(model, task=TASK), np.random.default_rng(0)
    for obs in 5 * rng.normal(size=(30, 17)):
        np.testing.assert_allclose(controller.act(obs), model.predict(env.normalize_obs(obs), deterministic=True)[0], atol=1e-5)


@pytest.mark.parametrize("algorithm", ["sac", "ppo"])
def test_its_learners_break_no_limit_of_the_arm(algorithm, capsys):
    example("sb3_guarded").main(algorithm, "arm", "300")
    assert capsys.readouterr().out.count(", 0 ticks outside") == 2


def test_the_native_vector_is_a_vec_env_of_theirs():
    """The adapter of the examples: same-step autoreset with the last observation, as SB3's own checker of vectors wants."""
    envs = example("sb3_vec_env").NearlVecEnv("Hopper-v5", 3)
    envs.seed(4)
    obs = envs.reset()
    single = gymnasium.make("nearl/Hopper-v5")
    want, _ = single.reset(seed=4)
    np.testing.assert_array_equal(obs[0], want)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(200):
        actions = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        obs, rewards, dones, infos = envs.step(actions)
        assert obs.shape == (3, 11) and rewards.shape == dones.shape == (3,) and len(infos) == 3
        ended += int(dones.sum())
        assert all(("terminal_observation" in info) == bool(done) for info, done in zip(infos, dones))
    assert ended > 3
