"""The bundled Panda snapshot from Python: the numbers of its file, its limits, its sentences."""

import json
import struct

import numpy as np
import pytest
from conftest import ROBOTS, ROOT

import nearl

SNAPSHOT = ROOT / "examples" / "snapshots" / "panda-reach.safetensors"


@pytest.fixture
def controller() -> nearl.Controller:
    return nearl.Controller.load(SNAPSHOT)


@pytest.fixture
def env() -> nearl.Env:
    env = nearl.Env("Panda-reach")
    env.reset(seed=5)
    return env


def tensors() -> dict[str, np.ndarray]:
    """The file by its specification: header length, JSON header, bytes."""
    data = SNAPSHOT.read_bytes()
    (n,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + n])
    kinds = {"F32": np.float32, "F64": np.float64}
    return {
        name: np.frombuffer(data[8 + n :][slice(*t["data_offsets"])], kinds[t["dtype"]]).reshape(t["shape"])
        for name, t in header.items()
        if name != "__metadata__"
    }


def test_the_proposal_is_the_policy_of_the_file(controller, env) -> None:
    t = tensors()
    layers = sorted(int(name.split(".")[1]) for name in t if name.startswith("policy.") and name.endswith(".weight"))
    obs = env.native.observe()
    x = np.clip((obs - t["normaliser.mean"]) / t["normaliser.std"], -10, 10)
    for i in layers:
        x = t[f"policy.{i}.weight"].astype(float) @ x + t[f"policy.{i}.bias"]
        x = np.tanh(x) if i < layers[-1] else x
    measured = np.array([obs[controller.obs_names.index(name)] for name in controller.state_names])
    controller.update(*env.state, obs)
    change = (controller.proposal - measured) / t["normaliser.scale"]
    np.testing.assert_allclose(change, x, atol=1e-5 * max(1.0, np.abs(x).max()))


def test_the_action_is_inverse_dynamics_of_the_target(controller, env) -> None:
    model = nearl.Model.from_urdf(ROBOTS / "panda" / "panda.urdf")
    for _ in range(200):
        q, v = env.state
        action, ledger = controller.update(q, v, env.native.observe())
        assert ledger.is_ok and sum(ledger.target_violations.values()) == 0
        target = dict(zip(controller.state_names, controller.target, strict=True))
        v_next = np.array([target[f"v.{name}"] for name in model.joint_names])
        tau = model.rnea(q, v, (v_next - v) / controller.dt) - model.passive(q, v)
        np.testing.assert_allclose(action, tau, atol=1e-8)
        env.step(action)
        np.testing.assert_allclose(env.state[1], v_next, atol=1e-10)  # the robot gets where it was sent


def test_an_episode_stays_inside_and_is_repeatable(controller) -> None:
    model = nearl.Model.from_urdf(ROBOTS / "panda" / "panda.urdf")

    def episode() -> tuple[float, np.ndarray]:
        env = nearl.Env("Panda-reach")
        obs, _ = env.reset(seed=9)
        controller.reset()
        total, actions = 0.0, []
        for _ in range(2000):
            action, _ = controller.update(*env.state, obs)
            obs, reward, *_ = env.step(action)
            total += reward
            actions.append(action)
            q, v = env.state
            assert np.all(q > model.lower_position_limit) and np.all(q < model.upper_position_limit)
            assert np.all(np.abs(v) < model.velocity_limit)
        assert np.all(np.abs(actions) < model.effort_limit)
        return total, np.array(actions)

    first, second = episode(), episode()
    assert first[0] == second[0] and np.array_equal(first[1], second[1])
    idle = nearl.Env("Panda-reach")
    idle.reset(seed=9)
    still = sum(idle.step(model.rnea(q, v, -20 * v))[1] for _ in range(2000) for q, v in [idle.state])
    assert first[0] > still + 3, f"it goes to the goal: {first[0]} against {still} for holding still"


def test_a_vector_takes_the_snapshot_s_inverse_model() -> None:
    vec = nearl.make_vec("Panda-reach", 2, constraints=SNAPSHOT)
    obs, _ = vec.reset(seed=0)
    wanted = [nearl.Controller.load(SNAPSHOT).obs_names.index(name) for name in vec.native.action_names]
    start = obs[:, wanted]
    obs, _, _, _, info = vec.step(start)  # to stay where it is
    assert info["target_violations"].sum() == 0 and info["raw_violations"].sum() == 0
    np.testing.assert_allclose(obs[:, wanted], start, atol=1e-6)
    with pytest.raises(ValueError, match="was trained on 'Panda-reach', not on 'Hopper-v5'"):
        nearl.make_vec("Hopper-v5", 2, constraints=SNAPSHOT)


def test_a_changed_file_is_refused(tmp_path) -> None:
    data = bytearray(SNAPSHOT.read_bytes())
    data[-1] ^= 1
    file = tmp_path / "changed.safetensors"
    file.write_bytes(data)
    with pytest.raises(ValueError, match=r"safetensors.*: .*digest mismatch"):
        nearl.Controller.load(file)


def test_wrong_shapes_are_named(controller, env) -> None:
    q, v = env.state
    with pytest.raises(ValueError, match=r"obs has shape \(3,\), expected \(20,\)"):
        controller.update(q, v, np.zeros(3))
    with pytest.raises(ValueError, match=r"noise\[0\] is NaN; give standard normal numbers"):
        controller.act(env.native.observe(), np.full(controller.n_noise, np.nan))
    held, ledger = controller.update(q, np.full(7, np.nan), env.native.observe())
    assert np.isfinite(held).all() and ledger.status == "refused" and "NaN" in ledger.reason
