"""Robots whose base floats: what is read of it from an observation, and where gravity points."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

import nearl

ROBOT = """<mujoco><compiler angle="radian"/><option timestep="0.004" gravity="{gravity}"/><worldbody>
  <body name="trunk" pos="0 0 1"><freejoint name="root"/><geom type="box" size=".2 .1 .05" mass="6"/>
    <body pos=".2 0 0"><joint name="hip" axis="0 1 0" range="-1 1"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1"/></body>
    <body pos="-.2 0 0"><joint name="tail" axis="1 0 0" range="-1 1"/><geom type="capsule" fromto="0 0 0 -.2 0 0" size=".02" mass=".5"/></body>
  </body></worldbody>
  <actuator><motor name="hip" joint="hip" ctrlrange="-40 40"/><motor name="tail" joint="tail" ctrlrange="-20 20"/></actuator></mujoco>"""
TASK = """
name = "floats"
[model]
mjcf = "floats.xml"
[time]
dt = 0.004
sim_dt = 0.004
max_episode_steps = 50
[state]
{observation}propose = ["v.hip", "v.tail"]
controllable = ["hip", "tail"]
[reward]
up = "-gravity.z"
[constraints]
velocity = {{ limit = 4.0 }}
acceleration = {{ limit = 50.0 }}
torque = {{}}
[idm]
kind = "pinocchio"
[train]
n_envs = 4
n_steps = 32
[train.ppo]
batch_size = 64
"""


def task(folder: Path, gravity: str = "0 0 -9.81", observation: list[str] | None = None) -> Path:
    (folder / "floats.xml").write_text(ROBOT.format(gravity=gravity))
    listed = "" if observation is None else f"observation = {observation}\n"
    (folder / "floats.toml").write_text(TASK.format(observation=listed))
    return folder / "floats.toml"


def tumbling(env: nearl.Env, rng: np.random.Generator) -> np.ndarray:
    """The observation somewhere in the air, turned and turning."""
    qpos = np.concatenate([rng.normal(size=3), rng.normal(size=4), rng.uniform(-0.5, 0.5, 2)])
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    return env.set_state(qpos, rng.normal(size=8))


def test_the_state_of_a_base_is_read_from_an_observation_that_holds_all_of_it(tmp_path) -> None:
    """``predict`` gives what the controller gives for the state itself, whatever the order of the entries."""
    path = task(tmp_path)
    names = nearl.Env(path).native.obs_names
    for observation in (None, list(np.random.default_rng(0).permutation(names))):
        path = task(tmp_path, observation=observation and [str(name) for name in observation])
        agent = nearl.PID2(path, seed=0)
        agent.learn(512)
        env, rng = nearl.Env(path), np.random.default_rng(1)
        for _ in range(20):
            obs = tumbling(env, rng)
            agent.controller.reset()
            action, _ = agent.predict(obs)
            agent.controller.reset()
            want, _ = agent.controller.update(*env.state, obs)
            np.testing.assert_allclose(action, want, rtol=1e-9, atol=1e-9)


def test_what_an_observation_lacks_of_a_base_is_named(tmp_path) -> None:
    names = [name for name in nearl.Env(task(tmp_path)).native.obs_names if name != "v.root.wy"]
    path = task(tmp_path, observation=names)
    agent = nearl.PID2(path, seed=0)
    agent.learn(512)
    with pytest.raises(ValueError, match=r"the observation of 'floats' has no 'v\.root\.wy', .* use update\(q, v, obs\) of the controller"):
        agent.predict(nearl.Env(path).reset(seed=0)[0])


def test_gravity_points_where_the_robot_file_lets_things_fall(tmp_path) -> None:
    """By MuJoCo: a body in free fall moves that way, in its own axes as an accelerometer has them."""
    for gravity in ("4.9 0 -8.5", "0 0 9.81", "0 0 -9.81", "0 0 0"):
        path = task(tmp_path, gravity, [f"gravity.{axis}" for axis in "xyz"] + ["v.hip", "v.tail"])
        env, model = nearl.Env(path), mujoco.MjModel.from_xml_path(str(tmp_path / "floats.xml"))
        falls = np.array([float(x) for x in gravity.split()])
        data, rng = mujoco.MjData(model), np.random.default_rng(2)
        for _ in range(5):
            seen = tumbling(env, rng)[:3]
            data.qpos[:] = env.qpos
            mujoco.mj_forward(model, data)
            size = np.linalg.norm(falls)
            down = falls / size if size > 0 else np.array([0.0, 0.0, -1.0])
            np.testing.assert_allclose(seen, data.body("trunk").xmat.reshape(3, 3).T @ down, atol=1e-12)


def test_a_rotation_that_is_none_is_refused(tmp_path) -> None:
    env = nearl.Env(task(tmp_path))
    qpos = np.concatenate([[0, 0, 1], np.zeros(4), np.zeros(2)])
    with pytest.raises(ValueError, match=r"qpos\[3\] to \[6\] are 0, and a quaternion has the length 1"):
        env.set_state(qpos, np.zeros(8))


def test_a_goal_beside_a_state_stays_and_a_cost_is_of_what_the_action_did(tmp_path) -> None:
    """A state begins an episode, which draws commands; a push comes after the step that reward and cost are of."""
    (tmp_path / "cart.xml").write_text(
        '<mujoco><option timestep="0.02"/><worldbody><body><joint name="j" type="slide" axis="1 0 0" range="-9 9"/>'
        '<geom size=".1" mass="1"/></body></worldbody><actuator><motor name="j" joint="j" ctrlrange="-1 1"/></actuator></mujoco>'
    )
    (tmp_path / "cart.toml").write_text(
        'name = "cart"\n[model]\nmjcf = "cart.xml"\n[time]\ndt = 0.02\nsim_dt = 0.02\nmax_episode_steps = 50\n[commands]\nx = "uniform"\n'
        '[pushes]\nevery = 0.02\njoints = "2.0"\n[reward]\nspeed = "v.j"\n[cost]\nspeed = "v.j"\n[constraints]\n[idm]\nkind = "learned"\n'
    )
    env = nearl.Env(tmp_path / "cart.toml")
    names = env.native.obs_names
    obs, _ = env.reset(seed=0, options={"goal": [0.5], "qpos": [0.2], "qvel": [0.0]})
    assert (obs[names.index("command.x")], obs[names.index("q.j")]) == (0.5, 0.2)
    for _ in range(5):
        _, reward, _, _, info = env.step(np.array([0.3]))
        assert info["cost"] == reward, (info, reward)


def test_the_gravity_that_an_imported_policy_sees_is_that_of_the_robot_file(tmp_path) -> None:
    """A network that puts it out, on a base that is turned: the file's direction in the base's axes, by MuJoCo."""
    onnx = pytest.importorskip("onnx")
    weight = onnx.numpy_helper.from_array(np.eye(3, 2, dtype=np.float32), "w")
    value = lambda name, n: onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, n])  # noqa: E731
    node = onnx.helper.make_node("MatMul", ["obs", "w"], ["actions"])
    body = onnx.helper.make_graph([node], "policy", [value("obs", 3)], [value("actions", 2)], [weight])
    onnx.save(onnx.helper.make_model(body, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8), tmp_path / "p.onnx")
    (tmp_path / "recipe.toml").write_text(
        '[time]\ndt = 0.004\nsim_dt = 0.004\n[policy]\njoints = ["hip", "tail"]\nobservation = [{ term = "projected_gravity" }]\n'
    )
    for gravity in ("4.9 0 -8.5", "0 0 -9.81"):
        env = nearl.Env(task(tmp_path, gravity))
        controller = nearl.import_onnx(tmp_path / "p.onnx", robot=tmp_path / "floats.xml", recipe=tmp_path / "recipe.toml")
        falls = np.array([float(x) for x in gravity.split()])
        data, rng = mujoco.MjData(mujoco.MjModel.from_xml_path(str(tmp_path / "floats.xml"))), np.random.default_rng(3)
        for _ in range(5):
            tumbling(env, rng)
            data.qpos[:] = env.qpos
            mujoco.mj_forward(data.model, data)
            controller.reset()
            action, _ = controller.update(*env.state, np.zeros(len(controller.obs_names)))
            seen = data.body("trunk").xmat.reshape(3, 3).T @ (falls / np.linalg.norm(falls))
            np.testing.assert_allclose(action, seen[:2], atol=1e-6)
