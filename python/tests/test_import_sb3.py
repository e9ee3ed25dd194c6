"""Models of Stable-Baselines3 act as they do there, and what else they do is refused by name."""

import json
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT, planar_urdf
from networks import RNG, Hardtanh, LayerNorm, Linear, Sequential, Tanh, numbers_of_its_own, ppo  # noqa: F401

import nearl


def test_a_model_without_its_environment_is_said_to_be_taken_as_it_is() -> None:
    """Only there does nobody know whether a VecNormalize is missing."""
    lost = ppo(17, 6, get_env=lambda: None, get_vec_normalize_env=lambda: None)
    with pytest.warns(UserWarning, match=r"no environment with it .* taken as they are; .* vec_normalize=VecNormalize.load.* vec_normalize=False"):
        taken = nearl.import_sb3(lost, task="HalfCheetah-v5")
    rms = SimpleNamespace(mean=np.ones(17), var=np.ones(17))
    norm = SimpleNamespace(norm_obs=True, clip_obs=10.0, epsilon=1e-8, obs_rms=rms)
    obs = RNG.normal(size=17)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="the limits on states under .constraints. hold for nothing")  # true of this task
        plain, normalised = (nearl.import_sb3(lost, given, task="HalfCheetah-v5") for given in (False, norm))
        with_env = ppo(17, 6, get_env=lambda: SimpleNamespace(has_attr=lambda _: False), get_vec_normalize_env=lambda: None)
        nearl.import_sb3(with_env, task="HalfCheetah-v5")
        with_env.get_vec_normalize_env = lambda: norm
        nearl.import_sb3(with_env, task="HalfCheetah-v5")
    np.testing.assert_allclose(plain.act(obs), normalised.act(obs + 1.0), atol=1e-5)
    assert np.array_equal(taken.act(obs), plain.act(obs)) and not np.allclose(taken.act(obs), normalised.act(obs), atol=1e-2)


def test_the_actors_of_stable_baselines_are_read() -> None:
    """Objects with SB3's attributes; its own are too large a requirement for every test run."""
    box = SimpleNamespace(low=np.full(6, -1.0), high=np.full(6, 1.0))
    norm = SimpleNamespace(norm_obs=True, clip_obs=10.0, epsilon=1e-8, obs_rms=SimpleNamespace(mean=RNG.normal(size=17), var=0.5 + RNG.random(17)))
    latent, head = Sequential([Linear(17, 8), Tanh(), Linear(8, 8), Tanh()]), Linear(8, 6)
    squash = lambda x: np.tanh(x)  # noqa: E731
    policies = {
        "ppo": (SimpleNamespace(mlp_extractor=SimpleNamespace(policy_net=latent), action_net=head), lambda x: np.clip(x, -1, 1)),
        "sac": (SimpleNamespace(actor=SimpleNamespace(latent_pi=latent, mu=head)), squash),
        "td3": (SimpleNamespace(actor=SimpleNamespace(mu=Sequential([*latent, head, Tanh()]))), squash),
    }
    for name, (policy, end) in policies.items():
        controller = nearl.import_sb3(SimpleNamespace(policy=policy, action_space=box), norm, task="HalfCheetah-v5")
        for _ in range(10):
            obs = 3 * RNG.normal(size=17)
            x = np.clip((obs - norm.obs_rms.mean) / np.sqrt(norm.obs_rms.var + 1e-8), -10, 10)
            np.testing.assert_allclose(controller.act(obs), end(head(latent(x))), atol=2e-5, err_msg=name)
    assert sys.modules.get("torch") is None


def with_motors(tmp_path, box) -> str:
    """A task of a chain of six joints and 17 entries of observation, its motors with the range of ``box``."""
    joints, robot = [f"j{k}" for k in range(6)], ""
    for joint in reversed(joints):
        robot = f'<body pos="0 0 -.3"><joint name="{joint}" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".03" mass="1"/>{robot}</body>'
    motors = "".join(f'<motor joint="{j}" ctrllimited="true" ctrlrange="{a:g} {b:g}"/>' for j, a, b in zip(joints, box.low, box.high))
    (tmp_path / "chain.xml").write_text(f"<mujoco><worldbody>{robot}</worldbody><actuator>{motors}</actuator></mujoco>")
    entries = [*(f"q.{j}" for j in joints), *(f"v.{j}" for j in joints), *(f"sin(q.{j})" for j in joints[:5])]
    task = f'name = "chain"\n[model]\nmjcf = "chain.xml"\n[time]\ndt = 0.01\nsim_dt = 0.002\n[state]\nobservation = {json.dumps(entries)}\n'
    (tmp_path / "chain.toml").write_text(task + '[reward]\nstill = "-q.j0^2"\n[constraints]\nvelocity = { limit = 3.0 }\n[idm]\nkind = "pinocchio"\n')
    return str(tmp_path / "chain.toml")


def test_squashed_means_and_clips_of_stable_baselines_are_kept(tmp_path) -> None:
    """`use_sde=True`: PPO and A2C squash with `squash_output`, SAC clips its mean before it does. The normaliser is the model's own unless one is given."""
    box = SimpleNamespace(low=np.array([-1.0, -1.0, -0.5, -1.0, -1.0, -1.0]), high=np.array([1.0, 0.5, 1.0, 1.0, 1.0, 1.0]))
    task = with_motors(tmp_path, box)
    latent, head = Sequential([Linear(17, 8), Tanh()]), Linear(8, 6)
    rms = SimpleNamespace(mean=RNG.normal(size=17), var=0.5 + RNG.random(17))
    norm = SimpleNamespace(norm_obs=True, clip_obs=3.0, epsilon=1e-8, obs_rms=rms)
    policies = {
        "ppo": (SimpleNamespace(mlp_extractor=SimpleNamespace(policy_net=latent), action_net=head, squash_output=True), lambda x: x),
        "sac": (SimpleNamespace(actor=SimpleNamespace(latent_pi=latent, mu=Sequential([head, Hardtanh()]))), Hardtanh()),
    }
    for name, (policy, clip) in policies.items():
        model = SimpleNamespace(policy=policy, action_space=box, get_vec_normalize_env=lambda: norm)
        own = nearl.import_sb3(model, task=task)
        without = nearl.import_sb3(model, SimpleNamespace(norm_obs=False), task=task)
        for _ in range(20):
            obs = 3 * RNG.normal(size=17)
            x = np.clip((obs - rms.mean) / np.sqrt(rms.var + 1e-8), -3, 3)
            for controller, seen in ((own, x), (without, obs)):
                want = box.low + 0.5 * (np.tanh(clip(head(latent(seen)))) + 1) * (box.high - box.low)
                np.testing.assert_allclose(controller.act(obs), want, atol=2e-5, err_msg=name)


def learned_with(*meanings: str) -> SimpleNamespace:
    """What SB3's vectors hand on of what their environments say an action is."""
    return SimpleNamespace(has_attr=lambda name: bool(meanings) and name == "action_meaning", get_attr=lambda _: list(meanings))


@pytest.mark.parametrize("meaning", ["state", "change"])
def test_what_learned_to_propose_moves_the_robot_as_in_its_environment(tmp_path, meaning) -> None:
    """The environment is given what the model computes, cut to its space; the controller has read the weights, and steers a plant of its own."""
    gymnasium = pytest.importorskip("gymnasium")
    env, plant = gymnasium.make("nearl/Panda-reach", constraints="task", actions=meaning), nearl.Env("Panda-reach")
    latent, head = Sequential([Linear(20, 8), Tanh()]), Linear(8, 14)
    policy = SimpleNamespace(mlp_extractor=SimpleNamespace(policy_net=latent), action_net=head)
    model = SimpleNamespace(policy=policy, action_space=env.action_space, get_vec_normalize_env=lambda: None)
    for told in ({"actions": meaning}, {}):  # loaded without its environment, and with it
        model.get_env = lambda told=told: None if told else learned_with(meaning, meaning)
        nearl.import_sb3(model, False, task="Panda-reach", **told).save(tmp_path / "made.safetensors")
        controller = nearl.Controller.load(tmp_path / "made.safetensors")
        obs, seen = env.reset(seed=3)[0], plant.reset(seed=3)[0]
        begun, cut = obs[:7].copy(), 0
        for _ in range(40):
            asked = head(latent(obs))
            action = np.clip(asked, env.action_space.low, env.action_space.high)
            cut += int((action != asked).any())
            obs, _, _, _, info = env.step(action)
            for _ in range(controller.policy_every):
                torque, _ = controller.update(*plant.state, seen)
                seen = plant.step(torque)[0]
            np.testing.assert_allclose(seen, obs, atol=1e-4)
            assert info["target_violations"] == 0
        assert cut > 5 and np.abs(obs[:7] - begun).max() > 0.1


def test_what_a_model_says_of_its_actions_is_what_it_is_imported_as() -> None:
    """As SB3's vectors hand it on; a vector that says nothing is one of actions."""
    for meanings in (["guarded"], ["actuators"], []):
        nearl.import_sb3(ppo(17, 6, get_env=lambda m=meanings: learned_with(*m)), task="HalfCheetah-v5")
    proposes = ppo(20, 14, get_env=lambda: learned_with("change", "change"))
    for model, how, said in (
        (proposes, {"task": "Panda-reach", "actions": "state"}, "learned with actions 'change', and it is imported with actions='state'"),
        (proposes, {"task": "HalfCheetah-v5"}, "the policy takes 20 entries and gives 14, but the task has 17 observation"),
        (proposes, {"robot": "a.urdf", "recipe": "b.toml"}, "a recipe is of a policy that gives actions"),
        (ppo(20, 14, get_env=lambda: learned_with("state", "change")), {"task": "Panda-reach"}, "actions 'change' and 'state'"),
        (ppo(17, 17), {"task": "HalfCheetah-v5", "actions": "state"}, "learned inverse model, which is not in the policy's file"),
        (ppo(20, 14), {"task": "Panda-reach", "actions": "states"}, "actions is 'states', and what a policy gives is one of 'actuators', 'state', 'change'"),
    ):
        with pytest.raises(ValueError, match=said):
            nearl.import_sb3(model, False, **how)
    proposes.action_space.high[3] = 2.0
    with pytest.raises(ValueError, match="range from -1 to 2, and changes of the state from -1 to 1"):
        nearl.import_sb3(proposes, False, task="Panda-reach")
    gymnasium = pytest.importorskip("gymnasium")
    for meaning in ("state", "change", "guarded"):
        env = gymnasium.make("nearl/Panda-reach", constraints="task", actions=meaning)
        vector = nearl.make_vec("Panda-reach", 2, constraints="task", actions=meaning)
        assert env.get_wrapper_attr("action_meaning") == vector.action_meaning == meaning
    assert nearl.make_vec("HalfCheetah-v5", 2).action_meaning == "actuators"


def test_what_learned_behind_rescaled_actions_proposes_what_its_environment_was_asked_for(tmp_path) -> None:
    """SB3 wants actions in [-1, 1]; the wrapper lies between the model and the environment, and the task has to be the one that it learned."""
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("nearl/Panda-reach", constraints="task", actions="state")
    rescaled = gymnasium.wrappers.RescaleAction(env, np.full(14, -1.0), np.full(14, 1.0))
    model = ppo(20, 14)
    model.action_space, model.get_vec_normalize_env = rescaled.action_space, lambda: None
    model.get_env = lambda: SimpleNamespace(envs=[rescaled], **vars(learned_with("state")))
    controller = nearl.import_sb3(model, task="Panda-reach")
    for _ in range(20):
        obs = RNG.normal(size=20)
        action = np.clip(model.policy.action_net(model.policy.mlp_extractor.policy_net(obs)), -1, 1)
        controller.reset()
        controller.update(obs[:7], obs[7:14], obs)
        half = (env.action_space.high - env.action_space.low) / 2  # what the network gives, in single precision, counts in these
        np.testing.assert_allclose((controller.proposal - rescaled.action(action)) / half, 0, atol=3e-6)
    text = (ROOT / "examples" / "tasks" / "Panda-reach.toml").read_text()
    for change, said in (
        (("policy_every = 20", "policy_every = 10"), "proposes for 0.02 s where the task has 0.01 s"),
        (('"q.panda_joint1", "q.panda_joint2"', '"q.panda_joint2", "q.panda_joint1"'), "proposes q.panda_joint1 where the task has q.panda_joint2"),
    ):
        assert change[0] in text
        (tmp_path / "other.toml").write_text(text.replace(*change))
        with pytest.raises(ValueError, match=said):
            nearl.import_sb3(model, task=tmp_path / "other.toml")
    twice = gymnasium.wrappers.TransformAction(env, lambda action: 2.0 * action, env.action_space)
    for envs in ([twice], [rescaled, twice]):  # in any of them
        model.get_env = lambda envs=envs: SimpleNamespace(envs=envs, **vars(learned_with("state")))
        with pytest.raises(ValueError, match=r"behind the wrapper TransformAction, which changes actions, .* or with RescaleAction"):
            nearl.import_sb3(model, task="Panda-reach")


def test_a_model_that_learned_behind_a_wrapper_of_observations_is_not_taken_for_one_without() -> None:
    """Its actions were off by a tenth of the motors' range, and nothing was said."""
    gymnasium = pytest.importorskip("gymnasium")
    wrappers = gymnasium.wrappers

    def learned(wrap):
        envs = SimpleNamespace(envs=[wrap(gymnasium.make("HalfCheetah-v5"))], has_attr=lambda _: False)
        return ppo(17, 6, get_env=lambda: type("VecMonitor", (SimpleNamespace,), {})(venv=envs, has_attr=lambda _: False), get_vec_normalize_env=lambda: None)

    for wrap in (
        wrappers.NormalizeObservation,
        lambda env: wrappers.TransformObservation(env, lambda o: 10 * o, None),
        lambda env: wrappers.RecordEpisodeStatistics(wrappers.NormalizeObservation(env)),
    ):
        with pytest.raises(ValueError, match="learned behind the wrapper (Normalize|Transform)Observation, .*learn with VecNormalize"):
            nearl.import_sb3(learned(wrap), task="HalfCheetah-v5")
    for wrap in (wrappers.RecordEpisodeStatistics, wrappers.FlattenObservation, lambda env: wrappers.DtypeObservation(env, np.float32)):
        nearl.import_sb3(learned(wrap), task="HalfCheetah-v5")


def test_a_model_acts_as_often_as_where_it_learned() -> None:
    """nearl/Panda-reach steps one control period, and the task's own policies act once in twenty of them."""
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("nearl/Panda-reach")
    model = ppo(20, 7, get_env=lambda: SimpleNamespace(envs=[env], has_attr=lambda _: False), get_vec_normalize_env=lambda: None)
    model.action_space = env.action_space
    controller = nearl.import_sb3(model, task="Panda-reach")
    assert controller.policy_every == 1
    obs = env.reset(seed=4)[0]
    for _ in range(30):
        asked = np.clip(model.policy.action_net(model.policy.mlp_extractor.policy_net(obs)), env.action_space.low, env.action_space.high)
        torque, _ = controller.update(*env.unwrapped.state, obs)
        np.testing.assert_allclose(torque, asked, rtol=1e-5, atol=1e-5)
        obs = env.step(asked)[0]
    vector = nearl.make_vec("Panda-reach", 2)
    model.get_env = lambda: SimpleNamespace(native=vector.native, has_attr=lambda _: False)
    every = vector.native.dt / controller.dt
    assert nearl.import_sb3(model, task="Panda-reach").policy_every == pytest.approx(every)

    class Repeat(gymnasium.Wrapper):
        """A wrapper of somebody's own."""

    model.get_env = lambda: SimpleNamespace(envs=[Repeat(env)], has_attr=lambda _: False)
    with pytest.warns(UserWarning, match="behind the wrapper Repeat, of which only its environment knows what it does") as told:
        nearl.import_sb3(model, task="Panda-reach")
    assert {one.filename for one in told if "Repeat" in str(one.message)} == {__file__}


def test_actions_of_another_range_than_the_motors_are_refused() -> None:
    model = ppo(17, 6)
    model.action_space.high[2] = 2.0
    with pytest.raises(ValueError, match=r"largest action\[2\] of the model is 2, and that of actuator 'bfoot' of 'HalfCheetah-v5' is 1; train the model"):
        nearl.import_sb3(model, task="HalfCheetah-v5")


@pytest.mark.parametrize("model", [None, 3, SimpleNamespace(action_space=None)])
def test_what_is_no_model_of_stable_baselines_is_refused(model) -> None:
    with pytest.raises(ValueError, match=r"model is .*, no model of Stable-Baselines3 \(no (action_space|policy)\); give the live object"):
        nearl.import_sb3(model, task="HalfCheetah-v5")


def test_what_else_a_model_of_stable_baselines_does_is_refused_by_name() -> None:
    box, latent, head = SimpleNamespace(low=-np.ones(6), high=np.ones(6)), Sequential([Linear(17, 8), Tanh()]), Linear(8, 6)
    policy = SimpleNamespace(mlp_extractor=SimpleNamespace(policy_net=latent), action_net=head, features_extractor=LayerNorm())
    with pytest.raises(ValueError, match="module LayerNorm"):
        nearl.import_sb3(SimpleNamespace(policy=policy, action_space=box), task="HalfCheetah-v5")
    with pytest.raises(ValueError, match="recurrent"):
        nearl.import_sb3(SimpleNamespace(policy=SimpleNamespace(lstm_actor=None), action_space=box), task="HalfCheetah-v5")
    with pytest.raises(ValueError, match="'vec.pkl' and no VecNormalize"):
        del policy.features_extractor
        nearl.import_sb3(SimpleNamespace(policy=policy, action_space=box), "vec.pkl", task="HalfCheetah-v5")


def test_outputs_that_a_recipe_reads_are_cut_as_the_model_cuts_them(tmp_path) -> None:
    """A mean of 3 is an action of 1 there, of which the recipe makes a target: no motor cuts at an output of 1."""
    (tmp_path / "arm.urdf").write_text(planar_urdf())
    recipe = '[time]\ndt = 0.01\n[command]\ninterface = "pd"\nstiffness = 40.0\ndamping = 2.0\n[policy]\njoints = ["joint0", "joint1", "joint2"]\n'
    recipe += 'pose = [0.1, 0.2, 0.3]\naction = { scale = 0.25 }\nobservation = [{ term = "joint_pos" }]\n'
    (tmp_path / "recipe.toml").write_text(recipe)
    model = ppo(3, 3)
    model.policy.action_net.bias = np.array([3.0, -3.0, 0.5]) + 0.0 * model.policy.action_net.bias
    model.policy.action_net.weight = 0.0 * model.policy.action_net.weight
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        controller = nearl.import_sb3(model, False, robot=tmp_path / "arm.urdf", recipe=tmp_path / "recipe.toml")
    action, _ = controller.update(np.zeros(3), np.zeros(3), np.zeros(6))
    np.testing.assert_allclose(action, [0.1 + 0.25, 0.2 - 0.25, 0.3 + 0.125], atol=1e-6)


def test_a_wrapper_of_a_vector_that_nobody_knows_is_refused_by_its_name() -> None:
    class Halved:
        def __init__(self, venv):
            self.venv = venv

    class VecMonitor(Halved):
        pass

    vector = SimpleNamespace(envs=[])
    model = ppo(17, 6, get_env=lambda: Halved(VecMonitor(vector)), get_vec_normalize_env=lambda: None)
    with pytest.raises(ValueError, match="behind the wrapper Halved of its vector"):
        nearl.import_sb3(model, task="HalfCheetah-v5")
    nearl.import_sb3(ppo(17, 6, get_env=lambda: VecMonitor(vector), get_vec_normalize_env=lambda: None), task="HalfCheetah-v5")
