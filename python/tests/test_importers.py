"""Policies made elsewhere give what onnxruntime gives, and what is no policy is refused by name."""

import json
import os
import re
import signal
import subprocess
import sys
import warnings
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT, planar_urdf

import nearl

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

RNG = np.random.default_rng(7)
BEGUN = RNG.bit_generator.state
NEARL = ROOT / "target" / "release" / "nearl"


@pytest.fixture(autouse=True)
def numbers_of_its_own() -> None:
    """Each test draws the same numbers, whichever ran before it."""
    RNG.bit_generator.state = BEGUN


class Net:
    """A graph that grows node by node."""

    def __init__(self, n_in: int) -> None:
        self.n_in, self.value, self.nodes, self.constants = n_in, "obs", [], []

    def constant(self, array, name: str) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(array), name))
        return name

    def add(self, op: str, *arrays, outputs: int = 1, first: bool = True, **attributes) -> "Net":
        k = len(self.nodes)
        names = [a if isinstance(a, str) else self.constant(a, f"c{k}_{i}") for i, a in enumerate(arrays)]
        out = [f"x{k}_{i}" for i in range(outputs)]
        self.nodes.append(helper.make_node(op, [self.value, *names] if first else [*names, self.value], out, f"{op}{k}", **attributes))
        self.value = out[0]
        return self

    def gemm(self, n_in: int, n_out: int, **attributes) -> "Net":
        shape = (n_out, n_in) if attributes.get("transB") else (n_in, n_out)
        return self.add("Gemm", f32(RNG.normal(size=shape) / np.sqrt(n_in)), f32(RNG.normal(size=n_out)), **attributes)

    def save(self, path, n_out: int, opset: int = 17):
        self.nodes[-1].output[0] = "actions"
        value = lambda name, n: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, n])  # noqa: E731
        graph = helper.make_graph(self.nodes, "policy", [value("obs", self.n_in)], [value("actions", n_out)], self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
        onnx.checker.check_model(model)
        onnx.save(model, path)
        return path


def f32(x) -> np.ndarray:
    return np.asarray(x, np.float32)


def rsl_rl() -> tuple[Net, int]:
    """As rsl_rl exports: normaliser, ELU, transposed weights."""
    net = Net(48).add("Sub", f32(RNG.normal(size=(1, 48)))).add("Div", f32(0.1 + RNG.random((1, 48))))
    for n_in, n_out in ((48, 512), (512, 256), (256, 128)):
        net.gemm(n_in, n_out, transB=1, alpha=0.5, beta=2.0).add("Elu", alpha=1.0)
    return net.gemm(128, 12, transB=1), 12


def brax() -> tuple[Net, int]:
    """As Playground's notebook exports: swish, the first half, tanh."""
    net = Net(52).add("Sub", f32(RNG.normal(size=52))).add("Mul", f32(0.1 + RNG.random(52)))
    for n_in, n_out in ((52, 128), (128, 64)):
        net.gemm(n_in, n_out)
        x = net.value
        net.add("Sigmoid").add("Mul", x)
    return net.gemm(64, 24).add("Split", outputs=2, axis=-1, num_outputs=2).add("Tanh"), 12


def everything() -> tuple[Net, int]:
    """Clips, shapes, arithmetic of constants, a function of its own after each layer, a scaled and shifted output."""
    net = Net(9).add("Reshape", np.array([1, -1])).add("Clip", f32(-2.0), f32(3.0)).add("Sub", f32(RNG.normal(size=9)))
    var, eps = net.constant(f32(RNG.random(9)), "var"), net.constant(f32(1e-8), "eps")
    net.nodes.append(helper.make_node("Add", [var, eps], ["var_eps"]))
    net.nodes.append(helper.make_node("Sqrt", ["var_eps"], ["std"]))
    net.add("Div", "std").add("Clip", f32(-5.0), f32(5.0))
    net.add("MatMul", f32(RNG.normal(size=(9, 16)) / 3)).add("Add", f32(RNG.normal(size=16))).add("Softplus")
    net.gemm(16, 15).add("Relu").add("Identity").gemm(15, 14).add("Sigmoid").gemm(14, 20).add("Tanh")
    net.add("Slice", np.array([2]), np.array([9]), np.array([1])).add("Mul", f32(RNG.normal(size=7))).add("Neg")
    return net.add("Sub", f32(0.3), first=False).add("Min", f32(0.9)).add("Max", f32(-0.8)).add("Flatten"), 7


@pytest.mark.parametrize("make", [rsl_rl, brax, everything])
def test_outputs_are_those_of_onnxruntime(tmp_path, make) -> None:
    net, n_out = make()
    path = net.save(tmp_path / "policy.onnx", n_out, opset=18)
    policy, session = nearl.Policy.from_onnx(path), onnxruntime.InferenceSession(path)
    assert (policy.n_in, policy.n_out) == (net.n_in, n_out)
    for scale in (0.1, 1.0, 10.0):
        for _ in range(50):
            obs = f32(scale * RNG.normal(size=net.n_in))
            (want,) = session.run(None, {"obs": obs[None]})
            np.testing.assert_allclose(policy(obs), want[0], rtol=0, atol=1e-5 * max(1.0, np.abs(want).max()))


def test_external_data_lies_beside_the_file(tmp_path) -> None:
    net, n_out = rsl_rl()
    path = net.save(tmp_path / "policy.onnx", n_out)
    obs = f32(RNG.normal(size=48))
    want = nearl.Policy.from_onnx(path)(obs)
    onnx.save(onnx.load(path), path, save_as_external_data=True, location="policy.onnx.data", size_threshold=0)
    np.testing.assert_array_equal(nearl.Policy.from_onnx(path)(obs), want)
    (tmp_path / "policy.onnx.data").unlink()
    with pytest.raises(ValueError, match=r"constant '.*' lies in 'policy.onnx.data', which cannot be read"):
        nearl.Policy.from_onnx(path)


def unknown(net: Net) -> Net:
    return net.gemm(4, 3).add("LeakyRelu")


def left(net: Net) -> Net:
    return net.gemm(4, 4).add("Gemm", f32(np.eye(4)), first=False, transB=1)


def between(net: Net) -> Net:
    return net.gemm(4, 3).add("Tanh").add("Clip", f32(-0.5), f32(0.5)).gemm(3, 3)


def alpha(net: Net) -> Net:
    return net.gemm(4, 3).add("Elu", alpha=0.5)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (unknown, r"node 'LeakyRelu1' \(LeakyRelu\) is none that a policy's layers consist of"),
        (left, r"node 'Gemm1' \(Gemm\) multiplies from the left"),
        (between, r"node 'Gemm3' \(Gemm\) follows a clip between two layers"),
        (alpha, r"node 'Elu1' \(Elu\) has alpha = 0.5, where 1 is known"),
        (lambda net: net.add("Tanh"), "no layer"),
    ],
)
def test_what_is_not_read_is_named(tmp_path, make, said) -> None:
    path = make(Net(4)).save(tmp_path / "policy.onnx", 4 if make is left or "lambda" in make.__name__ else 3)
    with pytest.raises(ValueError, match=said):
        nearl.Policy.from_onnx(path)


def test_a_node_that_the_action_does_not_need_is_no_matter(tmp_path) -> None:
    net = Net(4).gemm(4, 3)
    net.nodes.append(helper.make_node("LeakyRelu", ["obs"], ["beside"]))
    net.nodes.reverse()
    net.nodes[-1].output[0] = "actions"
    net.nodes.insert(0, net.nodes.pop())
    value = lambda name, n: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, n])  # noqa: E731
    graph = helper.make_graph(net.nodes, "p", [value("obs", 4)], [value("beside", 4), value("actions", 3)], net.constants)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), tmp_path / "p.onnx")
    assert nearl.Policy.from_onnx(tmp_path / "p.onnx").n_out == 3
    with pytest.raises(ValueError, match="it has no output 'other'; its outputs are 'beside', 'actions'"):
        nearl.Policy.from_onnx(tmp_path / "p.onnx", "other")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"PK\x03\x04 archive", "is a zip archive.*nearl.import_sb3"),
        (b"\x80\x04\x95 pickle", "is a Python pickle, which is never opened"),
        (b"<robot name='x'/>", "is an XML file.*--robot"),
        (b"nothing that anybody knows", "of an unknown kind, or damaged"),
        (b"\x08\x08\x12\x03abc", "of an unknown kind, or damaged"),
    ],
)
def test_files_that_are_no_policy_are_named(tmp_path, content, said) -> None:
    file = tmp_path / "policy.onnx"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=said):
        nearl.Policy.from_onnx(file)


RECIPE = """
[time]
dt = 0.01
[policy]
joints = ["joint2", "joint0", "joint1"]
pose = [0.3, 0.1, 0.2]
action = { scale = [1.0, 2.0, 3.0], offset = 0.0 }
observation = [{ term = "joint_pos_rel", clip = [-0.5, 0.5] }, { term = "joint_vel", scale = 0.1, history = 2 }, { term = "actions" },
               { term = "command", entries = ["command.x", "command.y"] }]
"""


def planar(tmp_path) -> dict:
    (tmp_path / "planar.urdf").write_text(planar_urdf())
    (tmp_path / "recipe.toml").write_text(RECIPE)
    return {"robot": tmp_path / "planar.urdf", "recipe": tmp_path / "recipe.toml"}


def test_a_urdf_with_settings_for_mujoco_is_imported_as_the_urdf_that_it_is(tmp_path) -> None:
    path, files = Net(14).gemm(14, 3).save(tmp_path / "policy.onnx", 3), planar(tmp_path)
    plain, text = nearl.import_onnx(path, **files), files["robot"].read_text()
    at = text.index(">", text.index("<robot")) + 1
    for urdf in (text[:at] + '<mujoco><compiler fusestatic="false"/></mujoco>' + text[at:], text[:at] + "<!-- <mujoco> -->" + text[at:]):
        files["robot"].write_text(urdf)
        limits = nearl.import_onnx(path, **files).limits
        assert limits.keys() == plain.limits.keys()
        assert all(np.array_equal(limits[key], plain.limits[key]) for key in limits)


def test_the_recipe_is_computed_from_the_state(tmp_path) -> None:
    """Three ticks of an imported policy against NumPy and onnxruntime."""
    net = Net(14).gemm(14, 8).add("Tanh").gemm(8, 3).add("Tanh")
    path = net.save(tmp_path / "policy.onnx", 3)
    controller = nearl.import_onnx(path, **planar(tmp_path))
    assert controller.obs_names == [*(f"{k}.joint{i}" for k in "qv" for i in range(3)), "command.x", "command.y"]
    session, order, pose = onnxruntime.InferenceSession(path), [2, 0, 1], np.array([0.3, 0.1, 0.2])
    last, before = np.zeros(3), None
    for _ in range(3):
        q, v, command = RNG.normal(size=3), RNG.normal(size=3), RNG.normal(size=2)
        now = 0.1 * v[order]
        obs = np.concatenate([np.clip(q[order] - pose, -0.5, 0.5), now if before is None else before, now, last, command])
        before = now
        (out,) = session.run(None, {"obs": f32(obs)[None]})
        last = out[0]
        want = np.zeros(3)
        want[order] = last * [1.0, 2.0, 3.0]
        action, _ = controller.update(q, v, np.concatenate([q, v, command]))
        np.testing.assert_allclose(action, np.clip(want, [-35, -13, -2.6], [35, 13, 2.6]), atol=1e-5)


MOTORS = """<mujoco><option timestep="0.002"/><worldbody>
  <body><joint name="rail" type="slide" axis="1 0 0" range="-1 1" limited="true"/><geom size=".1" mass="3"/>
  <body><joint name="shoulder" axis="0 1 0" range="-1.5 1.5" limited="true"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1.5"/>
  <body pos="0 0 -.4"><joint name="elbow" axis="0 1 0" range="-2 2" limited="true"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1"/>
  </body></body></body></worldbody><actuator>
  <motor joint="elbow" gear="-20" ctrlrange="-1 1"/><motor joint="rail" gear="150" ctrlrange="-1 1"/><motor joint="shoulder" ctrlrange="-50 50"/>
</actuator></mujoco>"""


@pytest.mark.parametrize("guard", ["false", "true"])
def test_commands_in_newtons_go_through_gear_and_order_of_the_motors(tmp_path, guard) -> None:
    """Motors in another order than the joints, which is another than the policy's: MuJoCo's joint forces are the commands asked for."""
    import mujoco

    (tmp_path / "robot.xml").write_text(MOTORS)
    (tmp_path / "recipe.toml").write_text(
        "[time]\ndt = 0.002\n[policy]\njoints = ['shoulder', 'elbow', 'rail']\naction = { scale = [40.0, 15.0, 100.0] }\n"
        "observation = [{ term = 'joint_pos' }]\n"
        f"[constraints]\nguard = {guard}\nvelocity = {{ limit = 5.0 }}\nacceleration = {{ limit = 1000.0 }}\ntorque = {{ scale = 1.0 }}\n"
    )
    asked = np.array([0.5, -0.4, 0.3])
    policy = nearl.Policy.from_layers([(np.zeros((3, 3)), asked, "identity")], np.zeros(3), np.ones(3), (-np.inf, np.inf), (-1.0, 1.0))
    controller = policy.controller(tmp_path / "robot.xml", tmp_path / "recipe.toml", "robot")
    q, v = np.array([0.1, 0.2, -0.3]), np.array([0.05, -0.1, 0.2])
    action, _ = controller.update(q, v, np.concatenate([q, v]))
    np.testing.assert_allclose(action, [15.0 * -0.4 / -20.0, 100.0 * 0.3 / 150.0, 40.0 * 0.5], rtol=1e-6)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, action
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator, [100.0 * 0.3, 40.0 * 0.5, 15.0 * -0.4], rtol=1e-6)
    # What the motors cannot give is cut to what they can.
    policy = nearl.Policy.from_layers([(np.zeros((3, 3)), 1e3 * asked, "identity")], np.zeros(3), np.ones(3), (-np.inf, np.inf), (-9.0, 9.0))
    controller = policy.controller(tmp_path / "robot.xml", tmp_path / "recipe.toml", "robot")
    data.ctrl[:], _ = controller.update(q, v, np.concatenate([q, v]))
    assert np.all(np.abs(data.ctrl) <= [1.0, 1.0, 50.0])


def arm_of_drives(tmp_path, command: str, robot: str = "planar.urdf", dt: float = 0.002) -> nearl.Controller:
    """A policy that swings its targets from end to end, guarded."""
    (tmp_path / "recipe.toml").write_text(
        f"[time]\ndt = {dt}\nsim_dt = 0.002\npolicy_every = 20\n[command]\n{command}\n[policy]\njoints = ['joint2', 'joint0', 'joint1']\n"
        "pose = [0.3, 0.1, 0.2]\nobservation = [{ term = 'joint_pos' }, { term = 'joint_vel' }, { term = 'phase', period = 0.7 }]\n[constraints]\n"
        "guard = true\nposition = { margin = 0.02 }\nvelocity = { limit = 2.0 }\nacceleration = { limit = 15.0 }\ntorque = { scale = 1.0 }\n"
    )
    layers = [(3.0 * RNG.normal(size=(3, 8)), RNG.normal(size=3), "tanh"), (3.0 * np.eye(3), np.zeros(3), "identity")]
    policy = nearl.Policy.from_layers(layers, np.zeros(8), np.ones(8), (-np.inf, np.inf), (-3.0, 3.0))
    return policy.controller(tmp_path / robot, tmp_path / "recipe.toml", "arm")


PD = "interface = 'pd'\nstiffness = { joint0 = 80.0, joint1 = 40.0, joint2 = 10.0 }\ndamping = { joint0 = 4.0, joint1 = 2.0, joint2 = 0.3 }"


def test_joint_targets_of_a_urdf_move_its_drives_in_a_plant(tmp_path) -> None:
    """Without a reward or a scene a plant has the drives of [command] all the same, and the limits hold in MuJoCo."""
    planar(tmp_path)
    arm_of_drives(tmp_path, PD).save(tmp_path / "arm.safetensors")
    name = f"drives{os.getpid()}"
    plant = [NEARL, "plant", tmp_path / "arm.safetensors", "--name", name, "--lockstep", "--seconds", "60", "--endless", "--json"]
    with subprocess.Popen(plant, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as robot:
        run = [NEARL, "run", tmp_path / "arm.safetensors", "--plant", name, "--seconds", "4", "--json"]
        loop = subprocess.run(run, capture_output=True, text=True, check=False)
        robot.send_signal(signal.SIGINT)
        said, _ = robot.communicate()
    assert loop.returncode == 0, loop.stderr
    found = json.loads(said.splitlines()[-1])
    assert found["report"]["ticks"] >= 2000 and not any(found["violations"].values()), found
    assert json.loads(loop.stdout)["counters"]["raw_violations"] > 500


def test_a_simulation_without_the_drives_that_are_commanded_is_refused(tmp_path) -> None:
    def refused(controller: nearl.Controller, said: str) -> None:
        controller.save(tmp_path / "arm.safetensors")
        done = subprocess.run([NEARL, "plant", tmp_path / "arm.safetensors", "--name", "nobody"], capture_output=True, text=True, check=False)
        assert done.returncode != 0 and said in done.stderr, done.stderr

    planar(tmp_path)
    refused(arm_of_drives(tmp_path, "interface = 'position'"), "joint 'joint0' is sent 'position' commands, and the simulated robot has no such drive")
    joints = "".join(f"<body><joint name='joint{i}' axis='0 1 0' range='-2 2' limited='true'/><geom size='.1' mass='1'/>" for i in range(3))
    drives = "".join(f"<position joint='joint{i}' kp='40' kv='2' ctrlrange='-3 3' forcerange='-20 20'/>" for i in range(3))
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{joints}</body></body></body></worldbody><actuator>{drives}</actuator></mujoco>")
    gains = "interface = 'pd'\nstiffness = 40.0\ndamping = 3.0"
    refused(arm_of_drives(tmp_path, gains, "arm.xml"), "has stiffness 40 and damping 3 here, and the simulated robot's has 40 and 2")


def test_a_recipe_that_does_not_fit_is_refused_by_name(tmp_path) -> None:
    files = planar(tmp_path)
    path = Net(14).gemm(14, 3).save(tmp_path / "policy.onnx", 3)

    def refused(change: tuple[str, str], said: str) -> None:
        files["recipe"].write_text(RECIPE.replace(*change))
        with pytest.raises(ValueError, match=said):
            nearl.import_onnx(path, **files)

    refused(("joint_pos_rel", "height_scan"), r"recipe.toml:8 \[policy.observation\[0\].term\]: unknown variant `height_scan`")
    refused(("joint_pos_rel", "projected_gravity"), r"term 1 \('projected_gravity'\): the robot's base is fixed")
    refused(('"joint2"', '"elbow"'), "elbow")
    refused((", history = 2", ""), r"has 11 entries \(joint_pos 3, joint_vel 3, last_action 3, command 2\), but the policy's input 'obs' has 14")
    refused(("dt = 0.01", ""), "the control period is not known")
    refused(("scale = 0.1", "scale = [1, 2]"), r"term 2 \('joint_vel'\): its scale has 2 numbers for 3 entries")
    files["robot"].write_text(planar_urdf().replace('name="joint0" type="revolute"', 'name="joint0" type="continuous"'))
    refused(("", ""), "joint 'joint0' has 2 position and 1 velocity entries.*make a continuous joint of a URDF a revolute one with lower and upper")
    files["recipe"] = None
    with pytest.raises(ValueError, match="does not say what the 14 entries of its input 'obs' are; give a recipe"):
        nearl.import_onnx(path, **files)
    files["recipe"] = tmp_path / "task.toml"
    files["recipe"].write_text('name = "r"\n[constraints]\nvelocity = { limit = 1.0 }\n')
    with pytest.raises(ValueError, match=r"'.*task.toml' has no \[policy\], which says what the 14 entries .* give the file as task= to nearl.import_torch"):
        nearl.import_onnx(path, **files)


DEPLOY = """
joint_ids_map: [2, 0, 1]
step_dt: 0.02
stiffness: [20, 30.0, 40.0]
damping: [1, 2, 3]
default_joint_pos: [0.3, 0.1, 0.2]
commands: {base_velocity: {ranges: {lin_vel_x: [-0.5, 1.0], heading: null}}}
actions:
  JointPositionAction: {clip: null, joint_names: [.*], scale: [0.5, 0.6,
    0.7], offset: [0.3, 0.1, 0.2], joint_ids: null}
observations:
  projected_gravity: {params: {}, clip: null, scale: [1.0, 1.0, 1.0], history_length: 1}
  joint_vel_rel: {params: {}, clip: [-0.2, 0.2], scale: [0.05, 0.05, 0.05], history_length: 2}
  velocity_commands: {params: {command_name: base_velocity}, clip: null, scale: null, history_length: 1}
  joint_pos_rel: {params: {}, clip: null, scale: 2.0, history_length: 1}
"""


def test_a_deployment_of_unitree_is_a_recipe(tmp_path) -> None:
    """From state to targets against NumPy and onnxruntime; a second recipe comes before it."""
    path, files = Net(15).gemm(15, 3).save(tmp_path / "policy.onnx", 3), planar(tmp_path)
    (tmp_path / "deploy.yaml").write_text(DEPLOY)
    (tmp_path / "over.toml").write_text("[time]\ndt = 0.01\n[constraints]\nguard = false\n")
    guarded = nearl.import_onnx(path, files["robot"], tmp_path / "deploy.yaml")
    files["recipe"] = [tmp_path / "deploy.yaml", tmp_path / "over.toml"]
    controller = nearl.import_onnx(path, **files)
    assert (guarded.dt, controller.dt) == (0.02, 0.01)
    session, order, pose = onnxruntime.InferenceSession(path), [2, 0, 1], np.array([0.3, 0.1, 0.2])
    before = None
    for _ in range(3):
        q, v, command = np.array([0, 0, 0, 0, 0, 0, 1, *RNG.normal(size=3)]), 0.1 * RNG.normal(size=9), RNG.normal(size=3)
        now = 0.05 * np.clip(v[6:][order], -0.2, 0.2)
        obs = np.concatenate([[0, 0, -1], now if before is None else before, now, command, 2 * (q[7:][order] - pose)])
        before = now
        (out,) = session.run(None, {"obs": f32(obs)[None]})
        want = np.zeros(3)
        want[order] = pose + out[0] * [0.5, 0.6, 0.7]
        action, _ = controller.update(q, v, np.concatenate([q[7:], v[6:], command]))
        np.testing.assert_allclose(action, want, atol=1e-5)
        # By itself the file has its drives bounded, with the gains of its motors.
        action, _ = guarded.update(q, v, np.concatenate([q[7:], v[6:], command]))
        force = np.array([20, 30, 40]) * (action - q[7:]) - np.array([1, 2, 3]) * v[6:]
        assert np.all(np.abs(force) <= np.array([35, 13, 2.6]) * (1 + 1e-9)) and np.any(action != want)

    def refused(change: tuple[str, str], said: str) -> None:
        (tmp_path / "deploy.yaml").write_text(DEPLOY.replace(*change))
        with pytest.raises(ValueError, match=said):
            nearl.import_onnx(path, planar(tmp_path)["robot"], tmp_path / "deploy.yaml")

    refused(("joint_ids_map: [2, 0, 1]", "joint_ids_map: [2, 0, 3]"), "there is no motor 3 in a robot of 3 joints")
    refused(("joint_ids_map: [2, 0, 1]", "joint_ids_map: [2, 0, 0]"), "no motor 0 .*twice")
    refused(("projected_gravity", "gait_phase"), "'gait_phase' depends on the command")
    refused(("projected_gravity", "height_scan"), "unknown variant `height_scan`")
    refused(("damping: [1, 2, 3]", "damping: [1, 2]"), "damping: 2 numbers for a robot of 3 joints")
    refused(("JointPositionAction", "JointVelocityAction"), "none but JointPositionAction")
    refused(("step_dt: 0.02", "step_dt: fast"), "it is no deploy.yaml")
    refused(("step_dt: 0.02", "*alias"), "it is no deploy.yaml")


def test_the_metadata_of_mjlab_is_a_recipe(tmp_path) -> None:
    path = Net(12).gemm(12, 3).save(tmp_path / "policy.onnx", 3)
    model = onnx.load(path)
    said = {
        "joint_names": "joint0,joint1,joint2",
        "joint_stiffness": "20.000,30.000,40.000",
        "joint_damping": "1.000,2.000,3.000",
        "default_joint_pos": "0.100,0.200,0.300",
        "action_scale": "0.5",
        "observation_names": "joint_pos,joint_vel,actions,command",
        "command_names": "twist",
    }
    helper.set_model_props(model, said)
    onnx.save(model, path)
    files = planar(tmp_path)
    files["recipe"].write_text("[time]\ndt = 0.02\n[command]\ninterface = 'effort'\n")
    controller = nearl.import_onnx(path, **files)
    assert controller.obs_names[-3:] == ["command.lin_vel_x", "command.lin_vel_y", "command.ang_vel_z"]
    helper.set_model_props(model, said | {"observation_names": "joint_pos,height_scan"})
    onnx.save(model, path)
    with pytest.raises(ValueError, match="policy.onnx': metadata 'observation_names': term 'height_scan' is none"):
        nearl.import_onnx(path, **files)
    # As mjlab 1.6.0 writes them: a scale for each entry, a clip for each term; both had been left out or refused.
    more = {
        "observation_terms_scale": "1.000,0.500;2.000;3.000,1.000,2.000;4.000;0.250",
        "observation_terms_clip": "-0.500;0.500,-inf;inf,-inf;inf,-inf;0.700",
        "observation_terms_history_length": "0,0,0,0",
    }
    helper.set_model_props(model, said | more)
    onnx.save(model, path)
    weight, bias = (numpy_helper.to_array(of).astype(float) for of in model.graph.initializer)
    controller, (q, v, command) = nearl.import_onnx(path, **files), RNG.normal(size=(3, 3))
    seen = np.concatenate([np.clip(q - [0.1, 0.2, 0.3], -0.5, 0.5), [0.5, 2, 3] * v, np.zeros(3), [2, 4, 0.25] * np.minimum(command, 0.7)])
    action, _ = controller.update(q, v, np.concatenate([q, v, command]))
    np.testing.assert_allclose(action, 0.5 * (seen @ weight + bias), rtol=1e-5, atol=1e-5)
    helper.set_model_props(model, said | more | {"observation_terms_scale": "1.000,0.500"})
    onnx.save(model, path)
    with pytest.raises(ValueError, match="policy.onnx': metadata 'observation_terms_scale': '1.000,0.500' has 2 entries for the 4 terms"):
        nearl.import_onnx(path, **files)


def test_the_command_line_imports_and_run_says_what_an_onnx_file_is(tmp_path) -> None:
    path = Net(14).gemm(14, 3).save(tmp_path / "policy.onnx", 3)
    files = planar(tmp_path)
    run = lambda *args: subprocess.run([NEARL, *args], capture_output=True, text=True, check=False)  # noqa: E731
    out = tmp_path / "policy.safetensors"
    done = run("import", path, "--robot", files["robot"], "--recipe", files["recipe"], "--out", out)
    assert done.returncode == 0 and "14 inputs" in done.stdout, done.stderr
    assert nearl.Controller.load(out).algo == "import"
    refused = run("run", path, "--plant", "nobody")
    assert refused.returncode != 0 and "is an ONNX model" in refused.stderr and "nearl import" in refused.stderr
    report = run("doctor", out)
    assert "joint_vel" in report.stdout and "scale 0.1" in report.stdout and "history 2" in report.stdout, report.stdout


@pytest.mark.parametrize("kind", ["direct", "proposing", "imported"])
def test_export_is_the_policy(tmp_path, kind) -> None:
    """Through onnxruntime, and back through import."""
    snapshot = tmp_path / "policy.safetensors"
    if kind == "imported":
        net, files = Net(14).gemm(14, 8).add("Tanh").gemm(8, 3).add("Clip", f32(-0.7), f32(0.6)), planar(tmp_path)
        source = nearl.Policy.from_onnx(net.save(tmp_path / "source.onnx", 3))
        source.controller(**files).save(snapshot)
    else:
        algo = "ppo" if kind == "direct" else "nearl"
        subprocess.run([NEARL, "train", "HalfCheetah-v5", "--algo", algo, "--steps", "4096", "--out", tmp_path / "run"], check=True)
        nearl.Controller.load(tmp_path / "run").save(snapshot)
    path = tmp_path / "exported.onnx"
    subprocess.run([NEARL, "export", snapshot, "--out", path], check=True)
    onnx.checker.check_model(onnx.load(path))
    session, controller = onnxruntime.InferenceSession(path), nearl.Controller.load(snapshot)
    n_in = session.get_inputs()[0].shape[1]
    for _ in range(50):
        obs = f32(3.0 * RNG.normal(size=n_in))
        (out,) = session.run(None, {"obs": obs[None]})
        if kind == "imported":
            np.testing.assert_allclose(out[0], source(obs), atol=1e-5)
        elif kind == "direct":
            np.testing.assert_allclose(np.clip(out[0], -1, 1), controller.act(obs), atol=1e-5)
        else:
            controller.act(obs)
            np.testing.assert_allclose(out[0], controller.proposal - obs, atol=1e-4)
    if kind != "proposing":
        back = nearl.Policy.from_onnx(path)
        obs = f32(RNG.normal(size=n_in))
        (out,) = session.run(None, {"obs": obs[None]})
        np.testing.assert_allclose(back(obs), out[0], atol=1e-5)
        assert back.metadata["joint_names"] and "dt = " in back.metadata["nearl_recipe"]
    if kind == "imported":
        again = nearl.import_onnx(path, robot=files["robot"])
        q, v = RNG.normal(size=3), RNG.normal(size=3)
        both = [c.update(q, v, np.concatenate([q, v, [0.1, 0.2]]))[0] for c in (again, controller)]
        np.testing.assert_allclose(*both, atol=1e-5)


class Linear:
    def __init__(self, n_in: int, n_out: int) -> None:
        self.weight, self.bias = RNG.normal(size=(n_out, n_in)), RNG.normal(size=n_out)

    def __call__(self, x):
        return self.weight @ x + self.bias


class Tanh:
    def __call__(self, x):
        return np.tanh(x)


class ReLU:
    def __call__(self, x):
        return np.maximum(x, 0)


class Hardtanh:
    min_val, max_val = -0.5, 2.0

    def __call__(self, x):
        return np.clip(x, self.min_val, self.max_val)


class LayerNorm:
    pass


class Sequential(list):
    def __call__(self, x):
        for part in self:
            x = part(x)
        return x


def test_live_modules_are_read(tmp_path) -> None:
    files = planar(tmp_path)
    net = Sequential([Linear(14, 9), Sequential([Tanh(), Linear(9, 5)]), ReLU(), Linear(5, 3)])
    mean, std = RNG.normal(size=14), 0.5 + RNG.random(14)
    nearl.import_torch(net, **files, mean=mean, std=std, clip=2.0).save(tmp_path / "p.safetensors")
    subprocess.run([NEARL, "export", tmp_path / "p.safetensors", "--out", tmp_path / "p.onnx"], check=True)
    policy = nearl.Policy.from_onnx(tmp_path / "p.onnx")
    for _ in range(20):
        obs = 2 * RNG.normal(size=14)
        np.testing.assert_allclose(policy(obs), net(np.clip((obs - mean) / std, -2, 2)), rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match="module LayerNorm is none that a policy's layers consist of"):
        nearl.import_torch(Sequential([Linear(14, 3), LayerNorm()]), **files)


def test_what_works_in_the_place_of_a_module_of_ones_own_is_said(tmp_path) -> None:
    """Modules by what torch calls them and their parts; `test_torch_modules_are_read` has torch itself where it is installed."""
    files = planar(tmp_path)
    net = Sequential([Linear(14, 9), Tanh(), Linear(9, 3)])

    class Own:
        def __init__(self, **parts):
            self.parts = parts

        def named_children(self):
            return self.parts.items()

    for module, said in (
        (Own(net=net), r"module Own runs its parts \(net\) .* nothing but module.net, give nearl.import_torch this; else export it, torch.onnx.export\(module"),
        (SimpleNamespace(actor=Own(net=net)), "nothing but module.actor.net, give"),
        (Own(first=Linear(14, 9), last=Linear(9, 3)), r"module Own runs its parts \(first, last\) in its own forward, which is code and not read; export it"),
        (type("RecursiveScriptModule", (), {"original_name": "Policy"})(), "module Policy is TorchScript .* made from, or export it, .*dynamo=False"),
    ):
        with pytest.raises(ValueError, match=said):
            nearl.import_torch(module, **files)
    with zipfile.ZipFile(tmp_path / "script.pt", "w") as archive:
        archive.writestr("script/data.pkl", b"never read")
        archive.writestr("script/code/__torch__/policy.py", "")
    with pytest.raises(ValueError, match=r"script.pt' is a file of TorchScript, .*torch.onnx.export\(torch.jit.load\('.*script.pt'\), .*nearl.import_onnx"):
        nearl.import_torch(tmp_path / "script.pt", **files)


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


def test_limits_that_nothing_holds_are_said_by_every_import(tmp_path) -> None:
    """In the words of `nearl import`, once, at the line that imports; a guard that holds them has nothing to say."""
    onnx_file, files = Net(14).gemm(14, 3).save(tmp_path / "policy.onnx", 3), planar(tmp_path)
    loose = RECIPE + "[constraints]\nvelocity = { limit = 3.0 }\nacceleration = { limit = 50.0 }\ntorque = {}\n"
    guarded = loose.replace("velocity", "guard = true\nvelocity")
    torch_net, box = Sequential([Linear(14, 9), Tanh(), Linear(9, 3)]), SimpleNamespace(low=np.full(6, -1.0), high=np.full(6, 1.0))
    actor = SimpleNamespace(mlp_extractor=SimpleNamespace(policy_net=Sequential([Linear(17, 8)])), action_net=Linear(8, 6))
    sb3 = SimpleNamespace(policy=actor, action_space=box)

    def hold_for_nothing(make) -> list[str]:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            make()
        return [w.filename for w in said if "hold for nothing: this policy gives actions, and guard is off; add guard = true" in str(w.message)]

    for text, expected in ((loose, [__file__]), (guarded, [])):
        files["recipe"].write_text(text)
        assert hold_for_nothing(lambda: nearl.import_onnx(onnx_file, **files)) == expected
        assert hold_for_nothing(lambda: nearl.import_torch(torch_net, **files)) == expected
    assert hold_for_nothing(lambda: nearl.import_sb3(sb3, False, task="HalfCheetah-v5")) == [__file__]


def test_layers_of_complex_numbers_are_refused(tmp_path) -> None:
    files, layer = planar(tmp_path), Linear(14, 3)
    layer.weight = SimpleNamespace(detach=lambda: np.ones((3, 14), complex))
    with pytest.raises(ValueError, match="0.weight holds complex numbers, and the layers of a policy are real"):
        nearl.import_torch(Sequential([layer]), **files)
    for name in ("mean", "std"):
        with pytest.raises(ValueError, match=f"{name} holds complex numbers"):
            nearl.import_torch(Sequential([Linear(14, 3)]), **files, **{name: np.ones(14, complex)})


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


def ppo(n_in: int, n_out: int, **more) -> SimpleNamespace:
    """A model with SB3's attributes."""
    latent, head = Sequential([Linear(n_in, 8), Tanh()]), Linear(8, n_out)
    policy = SimpleNamespace(mlp_extractor=SimpleNamespace(policy_net=latent), action_net=head)
    return SimpleNamespace(policy=policy, action_space=SimpleNamespace(low=np.full(n_out, -1.0), high=np.full(n_out, 1.0)), **more)


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


def test_a_network_of_next_states_is_imported_into_the_task_of_ones_own_robot(tmp_path) -> None:
    """By the command line, and in Python; its proposals are those of onnxruntime, clip included."""
    (tmp_path / "planar.urdf").write_text(planar_urdf())
    entries = json.dumps([f"{half}.joint{k}" for half in "qv" for k in range(3)])
    (tmp_path / "task.toml").write_text(
        f'name = "planar"\n[model]\nurdf = "planar.urdf"\n[time]\ndt = 0.004\nsim_dt = 0.0\n[state]\nobservation = {entries}\npropose = {entries}\n'
        '[constraints]\nvelocity = { limit = 1.0 }\nacceleration = { limit = 5.0 }\n[idm]\nkind = "pinocchio"\n'
    )
    net = Net(6).gemm(6, 16, transB=1).add("Tanh").gemm(16, 6, transB=1).add("Clip", f32(-0.6), f32(0.9))
    file = net.save(tmp_path / "next.onnx", 6)
    out = tmp_path / "arm.safetensors"
    asked = [NEARL, "import", file, "--task", tmp_path / "task.toml", "--out", out]
    done = subprocess.run([*asked, "--actions", "state"], capture_output=True, text=True)
    assert done.returncode == 0 and "6 proposed entries" in done.stdout, done.stderr
    session = onnxruntime.InferenceSession(file)
    own = nearl.import_onnx(file, task=tmp_path / "task.toml", actions="state")
    for controller in (nearl.Controller.load(out), own):
        ends = set()
        for _ in range(50):
            obs = RNG.normal(size=6)
            want = session.run(None, {"obs": f32(obs)[None]})[0][0]
            controller.reset()
            controller.update(obs[:3], obs[3:], obs)
            np.testing.assert_allclose(controller.proposal, want, atol=2e-6)
            ends |= {float(x) for x in want if x in (f32(-0.6), f32(0.9))}
        assert len(ends) == 2
    refused = subprocess.run(asked, capture_output=True, text=True)
    assert refused.returncode == 1 and "6 observation and 3 action entries; one that proposes states is imported with actions" in refused.stderr, refused.stderr
    with pytest.raises(ValueError, match=r"give task=FILE in place of robot= and recipe="):
        nearl.import_onnx(file, robot=tmp_path / "planar.urdf", actions="state")


def test_a_model_that_learned_behind_a_wrapper_of_observations_is_not_taken_for_one_without() -> None:
    """Its actions were off by a tenth of the motors' range, and nothing was said."""
    gymnasium = pytest.importorskip("gymnasium")
    wrappers = gymnasium.wrappers

    def learned(wrap):
        envs = SimpleNamespace(envs=[wrap(gymnasium.make("HalfCheetah-v5"))], has_attr=lambda _: False)
        return ppo(17, 6, get_env=lambda: SimpleNamespace(venv=envs, has_attr=lambda _: False), get_vec_normalize_env=lambda: None)

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


def test_numbers_that_no_policy_has_are_named_as_they_were_given(tmp_path) -> None:
    files, net = planar(tmp_path), Sequential([Linear(14, 9), Tanh(), Sequential([Linear(9, 3)])])
    for given, said in (({"std": np.zeros(14)}, r"std\[0\] of the observation is 0"), ({"std": -np.ones(14)}, r"std\[0\] .* is -1"),
                        ({"mean": np.full(14, np.nan)}, r"mean\[0\] .* is nan"), ({"std": "x"}, "std is of str and holds what is no number")):  # fmt: skip
        with pytest.raises(ValueError, match=f"{said}.*; give"):
            nearl.import_torch(net, **files, **given)
    with pytest.raises(ValueError, match=r"table of weights .* network.load_state_dict\(...\), and give nearl.import_torch that"):
        nearl.import_torch({"0.weight": np.zeros((9, 14))}, **files)
    last = next(iter(list(net)[2]))
    last.weight[1, 3] = np.nan
    with pytest.raises(ValueError, match=r"the module's tensor '2.0.weight' is nan at \[1, 3\]; the training diverged"):
        nearl.import_torch(net, **files)
    model = ppo(17, 6)
    model.policy.action_net.bias[4] = np.inf
    with pytest.raises(ValueError, match=r"tensor 'action_net.bias' is inf at \[4\]"):
        nearl.import_sb3(model, task="HalfCheetah-v5")


def test_robot_recipe_and_output_are_named_as_what_they_are(tmp_path) -> None:
    files, path = planar(tmp_path), Net(14).gemm(14, 3).save(tmp_path / "policy.onnx", 3)
    for name, said in (("robot", "cannot read robot 'no.xml': it does not exist; give a URDF"), ("recipe", "cannot read recipe 'no.xml': it does not exist")):
        with pytest.raises(ValueError, match=said):
            nearl.import_onnx(path, **files | {name: "no.xml"})
    with pytest.raises(ValueError, match=r"policy.onnx': .*no output 'foo'"):
        nearl.import_onnx(path, **files, output="foo")
    for recipe in ({"time": {"dt": 0.02}}, 3, ["a.toml", None]):
        with pytest.raises(ValueError, match=r"recipe is .*; give the path of a TOML file or of unitree's deploy.yaml, or a list of paths"):
            nearl.import_onnx(path, **files | {"recipe": recipe})
    with pytest.raises(ValueError, match="robot is 3; give the path of a URDF or MJCF file"):
        nearl.import_onnx(path, **files | {"robot": 3})


@pytest.mark.parametrize("model", [None, 3, SimpleNamespace(action_space=None)])
def test_what_is_no_model_of_stable_baselines_is_refused(model) -> None:
    with pytest.raises(ValueError, match=r"model is .*, no model of Stable-Baselines3 \(no (action_space|policy)\); give the live object"):
        nearl.import_sb3(model, task="HalfCheetah-v5")


@pytest.mark.parametrize("read", [nearl.import_sb3, nearl.import_torch])
def test_a_file_in_the_place_of_a_live_object_is_named_and_not_opened(read) -> None:
    with pytest.raises(ValueError, match=r"'nowhere.zip' is a file, .* never opened here; load it .*\.load\('nowhere.zip'\)"):
        read("nowhere.zip", task="HalfCheetah-v5")


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


def test_where_drives_alone_are_bounded_a_robot_need_not_hold_every_pose(tmp_path) -> None:
    """On legs nothing is promised of the motion: motors too weak for some pose are a warning, where a promise rests on them a failure."""
    path = Net(6).gemm(6, 3).save(tmp_path / "policy.onnx", 3)
    (tmp_path / "planar.urdf").write_text(planar_urdf())
    found = {}
    for guard, limits in (('"drive"', ""), ("true", "acceleration = { limit = 10.0 }\nvelocity = { scale = 1.0 }\nposition = {}")):
        recipe = tmp_path / "recipe.toml"
        recipe.write_text(
            f"""[time]
dt = 0.004
[command]
interface = "pd"
stiffness = 40.0
damping = 1.0
[constraints]
torque = {{ scale = 0.2 }}
guard = {guard}
{limits}
[policy]
joints = ["joint0", "joint1", "joint2"]
observation = [{{ term = "joint_pos" }}, {{ term = "joint_vel" }}]
"""
        )
        snapshot = tmp_path / "policy.safetensors"
        nearl.import_onnx(path, robot=tmp_path / "planar.urdf", recipe=recipe).save(snapshot)
        report = subprocess.run([NEARL, "doctor", snapshot], capture_output=True, text=True, check=False)
        found[guard] = {line.split()[1]: line.split()[0] for line in report.stdout.splitlines() if line[:4].strip() in ("ok", "warn", "fail")}
    assert found["true"]["holding"] == "fail"
    assert [found['"drive"'][check] for check in ("projection", "holding", "braking")] == ["ok", "warn", "ok"]


def test_what_is_wrong_in_a_recipe_is_told_with_its_line(tmp_path) -> None:
    policies = ROOT / "examples" / "policies"
    right = (policies / "reacher.toml").read_text()
    recipe = tmp_path / "recipe.toml"
    for old, new, said in [
        ("velocity = { limit = 2.0 }", "velocity = { limt = 2.0 }", "unknown field `limt`"),
        ("guard = true", 'guard = "yes"', "expected true, false"),
        ("dt = 0.02 ", "dt = .02 ", "invalid mantissa"),
        ('joints = ["joint0", "joint1"]', "joints = [1, 2]", "it is 1; give a text in quotes"),
    ]:
        assert right.count(old) == 1
        recipe.write_text(right.replace(old, new))
        line = 1 + recipe.read_text().split("\n").index(next(at for at in recipe.read_text().split("\n") if new.strip() in at))
        with pytest.raises(ValueError) as told:
            nearl.import_onnx(policies / "reacher.onnx", robot=policies / "reacher.xml", recipe=recipe)
        assert f"{recipe}:{line}" in str(told.value) and said in str(told.value), (line, told.value)


@pytest.mark.parametrize(("interface", "added"), [("effort", False), ("velocity", False), ("position", True), ("pd", True)])
def test_the_pose_is_added_to_positions_alone(tmp_path, interface: str, added: bool) -> None:
    """It is in rad, and a policy of velocities or forces that puts out zeros asks for nothing."""
    robot = tmp_path / "arm.urdf"
    robot.write_text(planar_urdf())
    gains = "stiffness = 40.0\ndamping = 2.0\n" if interface == "pd" else ""
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(
        f'[time]\ndt = 0.01\n[command]\ninterface = "{interface}"\n{gains}[policy]\njoints = ["joint1", "joint0", "joint2"]\npose = [0.3, -0.2, 0.1]\n'
        "observation = [{ term = 'joint_pos' }]\n[constraints]\n"
    )
    policy = tmp_path / "zero.onnx"
    Net(3).add("Gemm", f32(np.zeros((3, 3))), f32(np.zeros(3))).save(policy, 3)
    controller = nearl.import_onnx(policy, robot=robot, recipe=recipe)
    action, _ = controller.update(np.zeros(3), np.zeros(3), np.zeros(6))
    assert action == pytest.approx([-0.2, 0.3, 0.1] if added else [0.0, 0.0, 0.0], abs=1e-7)
    recipe.write_text(recipe.read_text().replace("[0.3, -0.2, 0.1]", "[0.3]"))
    with pytest.raises(ValueError, match="policy.pose has 1 positions for 3 joints"):
        nearl.import_onnx(policy, robot=robot, recipe=recipe)


def test_torch_modules_are_read(tmp_path) -> None:
    torch = pytest.importorskip("torch")
    files = planar(tmp_path)

    class Own(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = torch.nn.Sequential(torch.nn.Linear(14, 9), torch.nn.Tanh(), torch.nn.Linear(9, 3))

        def forward(self, x):
            return self.net(x)

    own = Own()
    nearl.import_torch(own.net, **files)
    with pytest.raises(ValueError, match="nothing but module.net, give nearl.import_torch this"):
        nearl.import_torch(own, **files)
    script = torch.jit.trace(own, torch.zeros(1, 14))
    with pytest.raises(ValueError, match="module Own is TorchScript"):
        nearl.import_torch(script, **files)
    script.save(tmp_path / "own.pt")
    with pytest.raises(ValueError, match="is a file of TorchScript"):
        nearl.import_torch(tmp_path / "own.pt", **files)
    torch.onnx.export(script, (torch.zeros(1, 14),), tmp_path / "own.onnx", dynamo=False)
    nearl.import_onnx(tmp_path / "own.onnx", **files)


class Actor:
    """A module with an actor, as libraries have them; ``act`` is what it does with one observation."""

    def __init__(self, act=None, **parts) -> None:
        self.actor, self.critic, self.std = Sequential([Linear(14, 9), Tanh(), Linear(9, 3)]), Sequential([Linear(14, 1)]), np.ones(3)
        vars(self).update(parts)
        if act is not None:
            self.act_inference = lambda rows: np.stack([act(self, x) for x in rows])


class EmpiricalNormalization:
    """Of rsl_rl."""

    eps = 1e-2

    def __init__(self) -> None:
        self._mean, self._std = RNG.normal(size=(1, 14)), 0.2 + RNG.random((1, 14))

    def forward(self, x):
        return (x - self._mean) / (self._std + self.eps)


class BatchNorm1d:
    eps, training = 1e-5, False

    def __init__(self) -> None:
        self.running_mean, self.running_var = RNG.normal(size=14), 0.2 + RNG.random(14)
        self.weight, self.bias = 0.5 + RNG.random(14), RNG.normal(size=14)

    def forward(self, x):
        return self.weight * (x - self.running_mean) / np.sqrt(self.running_var + self.eps) + self.bias


class Clamped(EmpiricalNormalization):
    def forward(self, x):
        return np.clip(super().forward(x), -2, 2)


class Encoder:
    def forward(self, x):
        return 2 * x


class Identity:
    pass


@pytest.mark.parametrize("norm", [EmpiricalNormalization, BatchNorm1d])
@pytest.mark.parametrize("runs", [False, True])
def test_what_normalises_beside_an_actor_is_read_exactly(tmp_path, norm, runs) -> None:
    """Under whatever name, whether the module can be run or not."""
    for name in ("actor_obs_normalizer", "obs_rms"):
        normaliser = norm()
        act = lambda m, x, n=normaliser: m.actor(n.forward(x).ravel())  # noqa: E731
        module = Actor(act if runs else None, **{name: normaliser})
        controller = nearl.import_torch(module, **planar(tmp_path))
        controller.save(tmp_path / "p.safetensors")
        subprocess.run([NEARL, "export", tmp_path / "p.safetensors", "--out", tmp_path / "p.onnx"], check=True)
        session = onnxruntime.InferenceSession(tmp_path / "p.onnx")
        for _ in range(20):
            obs = 2 * RNG.normal(size=14)
            (found,) = session.run(None, {"obs": f32(obs)[None]})
            np.testing.assert_allclose(found[0], module.actor(normaliser.forward(obs).ravel()), rtol=1e-5, atol=2e-5)


def test_a_normaliser_that_is_not_known_is_refused_by_its_class(tmp_path) -> None:
    """It had been left out without a word."""
    files, learning = planar(tmp_path), BatchNorm1d()
    learning.training = True
    negative = BatchNorm1d()
    negative.weight[3] = -0.5
    for parts, said in (
        ({"actor_obs_normalizer": LayerNorm()}, r"module Actor has actor_obs_normalizer \(LayerNorm\) beside its actor, which is not read; give mean="),
        ({"obs_rms": SimpleNamespace(mean=np.zeros(14))}, r"obs_rms \(SimpleNamespace\) beside its actor, which is not read; give mean= and std="),
        ({"obs_mean": np.zeros(14)}, r"obs_mean \(ndarray\) beside its actor, which is not read"),
        ({"pre": LayerNorm()}, r"pre \(LayerNorm\) beside its actor, which is not read"),
        ({"normalizer": Clamped()}, r"normalizer \(Clamped\) .* computes something else than \(observation - mean\) / \(std \+ eps\) and is not read; give"),
        ({"obs_normalizer": EmpiricalNormalization(), "norm": BatchNorm1d()}, r"\(EmpiricalNormalization\) beside its actor, and norm, of which nobody"),
        ({"obs_norm": learning}, r"obs_norm \(BatchNorm1d\) .* from each batch while it learns; call module.eval\(\) first"),
        ({"obs_norm": negative}, r"tensor 'obs_norm.weight' is -0.5 at \[3\], and a standard deviation is above 0; export it"),
        ({"encoder": Encoder()}, r"encoder \(Encoder\) beside its actor, and no forward that tells whether the action depends on it; where the actor is all"),
        ({"shift": np.ones(14)}, r"shift \(ndarray\) beside its actor, and no forward"),
    ):
        with pytest.raises(ValueError, match=said):
            nearl.import_torch(Actor(**parts), **files)
    for parts in ({"obs_normalizer": Identity()}, {"critic_obs_normalizer": LayerNorm()}, {"value_norm": LayerNorm()}, {"obs_norm": None, "normalize": True}):
        nearl.import_torch(Actor(**parts), **files)
    nearl.import_torch(Actor(obs_rms=LayerNorm()), **files, mean=np.zeros(14))


def test_a_module_that_does_more_than_its_actor_is_refused(tmp_path) -> None:
    """By as much as its own output differs; what is given beside it may be in it or around it."""
    files, mean, std = planar(tmp_path), RNG.normal(size=14), 0.5 + RNG.random(14)
    normed = lambda m, x: m.actor(np.clip((x - mean) / std, -1, 1))  # noqa: E731
    for act in (
        lambda m, x: 0.1 * np.tanh(m.actor(x)),
        lambda m, x: 1.001 * m.actor(x),
        lambda m, x: m.actor(x - mean),
        lambda m, x: np.clip(m.actor(x), -3, 3),
        lambda m, x: m.actor(np.subtract(x, mean, out=x)),
        normed,
    ):
        module = Actor(act)
        with pytest.raises(ValueError, match=r"module Actor does more than module.actor: its act_inference gives .*; where the actor is all") as told:
            nearl.import_torch(module, **files)
        words = re.search(r"gives (\S+) as output\[(\d)\] where the layers that are read give (\S+), off by (\S+) on", str(told.value))
        theirs, _, ours, off = map(float, words.groups())
        assert abs(theirs - ours) == pytest.approx(off, abs=2e-3 * abs(ours)) and off > 0
    for act, given in (
        (lambda m, x: m.actor(x), {}),
        (lambda m, x: m.actor(x), {"mean": mean, "std": std, "clip": 2.0, "output_clip": (-1, np.ones(3))}),
        (lambda m, x: m.actor((x - mean) / std), {"mean": mean, "std": std, "output_clip": (-1, 1)}),
        (normed, {"mean": mean, "std": std, "clip": 1.0}),
        (lambda m, x: np.clip(m.actor(x), -3, 3), {"output_clip": (-3, 3)}),
    ):
        nearl.import_torch(Actor(act, encoder=Encoder()), **files, **given)  # of which the output says that it has no part in it
    with pytest.raises(ValueError, match="does more than module.actor"):
        nearl.import_torch(Actor(normed), **files, mean=mean, std=std, clip=0.5)
    with pytest.raises(ValueError, match=r"two outputs for the same observation \(act_inference: it draws, or remembers\), so nobody can hold module.actor"):
        nearl.import_torch(Actor(lambda m, x: m.actor(x) + RNG.normal(size=3)), **files)
    with pytest.raises(ValueError, match=r"cannot be run on observations of 14 entries \(act_inference: KeyError: 'x'\), so nobody knows .*\(module.actor\)"):
        nearl.import_torch(Actor(lambda m, x: {}["x"]), **files)

    grouped = Actor(obs_groups={"policy": ["a", "b"]})
    grouped.act_inference = lambda groups: np.stack([grouped.actor(x) for x in np.hstack([groups["a"], groups["b"]])])
    nearl.import_torch(grouped, **files)


class Model:
    """As rsl_rl 5.4.2 has them: it takes a dict of groups, joins them, normalises what comes out and runs its mlp."""

    is_recurrent = False

    def __init__(self, norm, factor: float = 1.0) -> None:
        self.obs_normalizer, self.mlp, self.factor = norm, Sequential([Linear(14, 9), Tanh(), Linear(9, 3)]), factor
        self.obs_groups, self.distribution = ["policy", "heights"], SimpleNamespace(std=np.ones(3))

    def forward(self, obs):
        rows = np.hstack([obs[group] for group in self.obs_groups])
        return np.stack([self.factor * self.mlp(x) for x in self.obs_normalizer.forward(rows)])

    def as_onnx(self, verbose): ...


def exported(controller, tmp_path):
    """What `nearl export` makes of it, as a function of an observation."""
    controller.save(tmp_path / "p.safetensors")
    subprocess.run([NEARL, "export", tmp_path / "p.safetensors", "--out", tmp_path / "p.onnx"], check=True)
    session = onnxruntime.InferenceSession(tmp_path / "p.onnx")
    return lambda obs: session.run(None, {"obs": f32(obs)[None]})[0][0]


def test_models_of_rsl_rl_are_read_with_their_normaliser(tmp_path) -> None:
    """They were refused, with the advice to export what takes no tensor."""
    files, same = planar(tmp_path), type("Identity", (), {"forward": lambda self, x: x})()
    for norm in (EmpiricalNormalization(), same):
        model = Model(norm)
        policy = exported(nearl.import_torch(model, **files), tmp_path)
        for obs in 2 * RNG.normal(size=(20, 14)):
            np.testing.assert_allclose(policy(obs), model.mlp(norm.forward(obs).ravel()), rtol=1e-5, atol=2e-5)
    export = r"export it, torch.onnx.export\({}.as_onnx\(False\), \(torch.zeros\(1, n\),\), 'policy.onnx', dynamo=False\) with n inputs"
    recurrent = Model(same)
    recurrent.is_recurrent = True
    for model, said in (
        (Model(same, 0.9), "module Model does more than module.mlp: its forward gives .*; where the mlp is all .*" + export.format("module")),
        (Model(Clamped()), r"obs_normalizer \(Clamped\) beside its mlp, which computes something else .*" + export.format("module")),
        (recurrent, "module Model is recurrent, and only networks without memory are read; train one without"),
        (
            Actor(actor=Model(same)),
            r"module.actor \(Model\) has a normaliser .* give nearl.import_torch\(module.actor\); else " + export.format("module.actor"),
        ),
    ):
        with pytest.raises(ValueError, match=said):
            nearl.import_torch(model, **files)


def test_a_model_of_rsl_rl_itself_gives_what_it_gives(tmp_path) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("tensordict")
    models = pytest.importorskip("rsl_rl.models", exc_type=ImportError)
    files, sizes = planar(tmp_path), {"policy": 10, "heights": 4}
    see = lambda n: {name: 3 * torch.randn(n, size) + 1 for name, size in sizes.items()}  # noqa: E731
    gaussian = {"class_name": "rsl_rl.modules.distribution:GaussianDistribution", "init_std": 1.0}
    model = models.MLPModel(see(8), {"actor": list(sizes)}, "actor", 3, (9, 7), "elu", True, gaussian)
    for _ in range(20):
        model.update_normalization(see(16))
    for module in (model, model.as_onnx(False), model.as_jit()):
        policy = exported(nearl.import_torch(module, **files), tmp_path)
        for _ in range(20):
            obs = see(1)
            with torch.no_grad():
                want = model(obs).numpy()[0]
            np.testing.assert_allclose(policy(torch.cat(list(obs.values()), 1).numpy()[0]), want, rtol=1e-5, atol=2e-5)
    torch.onnx.export(model.as_onnx(False), (torch.zeros(1, 14),), tmp_path / "model.onnx", dynamo=False)
    nearl.import_onnx(tmp_path / "model.onnx", **files)


class Squashed:
    """A distribution that says of its mean that it is not known, as torch's TransformedDistribution."""

    def __init__(self, of) -> None:
        self.of = of

    @property
    def mean(self):
        raise NotImplementedError


def test_what_a_module_does_not_say_is_not_taken_for_its_actor(tmp_path) -> None:
    """A function that raises is there, an output that cannot be read is none, and an `act` of its own may add anything."""
    files = planar(tmp_path)

    def none(_):
        raise NotImplementedError("export me")

    alone = r"where the actor is all of the policy, give nearl.import_torch\(module.actor\)"
    for parts, said in (
        ({"act_inference": none}, r"cannot be run on observations of 14 entries \(act_inference: NotImplementedError: export me\), so nobody knows"),
        ({"forward": none}, r"cannot be run on observations of 14 entries \(forward: NotImplementedError: export me\)"),
        ({"forward": Squashed}, r"against: its forward gives a Squashed, of which the action cannot be read \(NotImplementedError: no reason given\)"),
        ({"forward": lambda rows: {"action": rows}}, r"its forward gives a dict, of which the action cannot be read \(ValueError: "),
        ({"forward": lambda rows: ()}, r"its forward gives a tuple, of which the action cannot be read \(IndexError: "),
        ({"act_on": none}, "Actor has neither forward nor act_inference, and its own act_on is not read, so nobody knows whether"),
        ({"predict": none, "get_actions": none}, "its own get_actions, predict are not read, so nobody knows whether the action is what module.actor gives"),
    ):
        with pytest.raises(ValueError, match=f"{said}.*{alone}"):
            nearl.import_torch(Actor(**parts), **files)
    same = Actor(lambda m, x: m.actor(x), get_action=none)
    nearl.import_torch(same, **files)  # of which act_inference says what it does
    nearl.import_torch(Actor(get_actions_log_prob=none, evaluate=none, action_std=np.ones(3)), **files)
    same.act_inference, inference = (lambda rows: SimpleNamespace(mean=inference(rows))), same.act_inference
    nearl.import_torch(same, **files)  # a distribution that has one


@pytest.mark.parametrize("size", [1.0, 1e-8, 1e-20])
def test_outputs_are_held_against_each_other_by_their_size(tmp_path, size) -> None:
    net = Sequential([Linear(14, 9), Tanh(), Linear(9, 3)])
    net[2].weight, net[2].bias = size * f32(net[2].weight), size * f32(net[2].bias)
    for factor in (1.0, 2.0, 1.001):
        module = Actor(lambda m, x, factor=factor: factor * m.actor(x), actor=net)
        if factor == 1.0:
            nearl.import_torch(module, **planar(tmp_path))
            continue
        with pytest.raises(ValueError, match="module Actor does more than module.actor"):
            nearl.import_torch(module, **planar(tmp_path))


def test_a_distribution_of_torch_and_parts_in_half_precision(tmp_path) -> None:
    torch = pytest.importorskip("torch")
    nn, of, files = torch.nn, torch.distributions, planar(tmp_path)

    class Agent(nn.Module):
        def __init__(self, around, critic=torch.float32, actor=torch.float32) -> None:
            super().__init__()
            self.critic = nn.Linear(14, 1).to(critic)
            self.actor, self.around = nn.Sequential(nn.Linear(14, 9), nn.ELU(), nn.Linear(9, 3)).to(actor), around

        def forward(self, x):
            return self.around(self.actor(x))

    class Silent(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.actor = nn.Sequential(nn.Linear(14, 3))

    nearl.import_torch(Silent(), **files)
    Silent.get_action = lambda self, x: torch.tanh(self.actor(x))
    with pytest.raises(ValueError, match="module Silent has neither forward nor act_inference, and its own get_action is not read"):
        nearl.import_torch(Silent(), **files)
    normal = lambda x: of.Normal(x, 0.1)  # noqa: E731
    squashed = lambda x: of.TransformedDistribution(normal(x), [of.TanhTransform(), of.AffineTransform(0.0, 2.0)])  # noqa: E731
    for around in (squashed, lambda x: of.Independent(squashed(x), 1)):
        with pytest.raises(ValueError, match=r"its forward gives a \w+, of which the action cannot be read \(NotImplementedError"):
            nearl.import_torch(Agent(around), **files)
    half = {torch.float16: 1.03, torch.bfloat16: 1.2}
    for around in (lambda x: x, normal):
        for kind in half:
            nearl.import_torch(Agent(around, critic=kind), **files)
            nearl.import_torch(Agent(around, actor=kind), **files)
    for kind, factor in half.items():
        for more, kinds in ((1.001, {"critic": kind}), (factor, {"actor": kind})):
            with pytest.raises(ValueError, match="module Agent does more than module.actor"):
                nearl.import_torch(Agent(lambda x, more=more: more * x, **kinds), **files)
    module = Agent(lambda x: 1.001 * x)
    module.obs_norm = nn.LayerNorm(14).half()  # which is not read where mean is given
    with pytest.raises(ValueError, match="module Agent does more than module.actor"):
        nearl.import_torch(module, **files, mean=np.zeros(14))


def test_a_pipe_is_no_file_of_torchscript(tmp_path) -> None:
    """It had been waited for."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe' is a file, and files of PyTorch .* are pickles"):
        nearl.import_torch(tmp_path / "pipe", **planar(tmp_path))


@pytest.mark.parametrize("hooks", ["_forward_hooks", "_forward_pre_hooks"])
def test_hooks_are_refused(tmp_path, hooks) -> None:
    files, net = planar(tmp_path), Sequential([Linear(14, 9), Tanh(), Linear(9, 3)])

    def doubled(*_):
        pass

    setattr(net[1], hooks, {0: doubled})
    for module, name in ((net, "1"), (Actor(actor=net), "actor.1")):
        with pytest.raises(ValueError, match=rf"module {name} \(Tanh\) has a hook at its forward \(doubled\), which is code and not read; remove it"):
            nearl.import_torch(module, **files)
    normaliser = EmpiricalNormalization()
    setattr(normaliser, hooks, {0: doubled})
    with pytest.raises(ValueError, match=r"module obs_norm \(EmpiricalNormalization\) has a hook"):
        nearl.import_torch(Actor(obs_norm=normaliser), **files)


def test_clips_that_are_none_are_named(tmp_path) -> None:
    files, net = planar(tmp_path), Sequential([Linear(14, 3)])
    for clip in (0, -1, np.nan, "x", None, True, [1, 2], 10**400):
        with pytest.raises(ValueError, match=r"clip is .*; give a number above 0, the standard deviations that inputs are cut to, or leave it out"):
            nearl.import_torch(net, **files, clip=clip)
    give = r"; give \(low, high\), each a number or one for each of the 3 outputs, and low not above high"
    for clip, said in (
        ((1, -1), r"output_clip is \(1, -1\) for output\[0\]"),
        ((np.nan, 1), r"output_clip is \(nan, 1\) for output\[0\]"),
        (([0, 0, 2], 1), r"output_clip is \(2, 1\) for output\[2\]"),
        ((0, [1, 1]), r"output_clip\[1\] has shape \(2,\)"),
        (("a", "b"), r"output_clip is \('a', 'b'\)"),
        ("ab", "output_clip is 'ab'"),
        (1.0, "output_clip is 1.0"),
        ((np.inf, np.inf), r"output_clip is \(inf, inf\) for output\[0\]"),
    ):
        with pytest.raises(ValueError, match=said + give):
            nearl.import_torch(net, **files, output_clip=clip)


def test_modules_of_torch_are_held_against_themselves_and_left_as_they_were(tmp_path) -> None:
    torch = pytest.importorskip("torch")
    nn, files = torch.nn, planar(tmp_path)

    class ActorCritic(nn.Module):
        def __init__(self, norm=None, factor=1.0) -> None:
            super().__init__()
            self.actor = nn.Sequential(nn.Linear(14, 9), nn.Dropout(0.5), nn.ELU(), nn.Linear(9, 3))
            self.log_std, self.factor, self.norm = nn.Parameter(torch.zeros(3)), factor, norm or nn.Identity()

        def forward(self, x):
            return self.factor * self.actor(self.norm(x))

    class Running(nn.Module):
        """A normaliser of rsl_rl that learns whenever it is called in training."""

        def __init__(self) -> None:
            super().__init__()
            self.eps = 1e-2
            self.register_buffer("_mean", torch.randn(1, 14))
            self.register_buffer("_std", 0.5 + torch.rand(1, 14))

        def forward(self, x):
            if self.training:
                self._mean += 1.0
            return (x - self._mean) / (self._std + self.eps)

    batch = nn.BatchNorm1d(14).eval()
    batch.running_mean += torch.randn(14)
    nn.init.uniform_(batch.weight, 0.5, 2.0)
    for norm in (None, Running(), batch):
        module = ActorCritic(norm)
        if norm is batch:
            module.eval()
        kept = ([part.training for part in module.modules()], {name: of.clone() for name, of in module.state_dict().items()}, torch.get_rng_state())
        nearl.import_torch(module, **files).save(tmp_path / "p.safetensors")
        assert [part.training for part in module.modules()] == kept[0] and torch.equal(torch.get_rng_state(), kept[2])
        assert all(torch.equal(of, kept[1][name]) for name, of in module.state_dict().items())
        subprocess.run([NEARL, "export", tmp_path / "p.safetensors", "--out", tmp_path / "p.onnx"], check=True)
        session, obs = onnxruntime.InferenceSession(tmp_path / "p.onnx"), 2 * torch.randn(1, 14)
        with torch.no_grad():
            np.testing.assert_allclose(session.run(None, {"obs": obs.numpy()})[0], module.eval()(obs).numpy(), rtol=1e-5, atol=2e-5)
    for norm, factor, said in ((None, 0.9, "does more than module.actor"), (nn.LayerNorm(14), 1.0, r"norm \(LayerNorm\) beside its actor, which is not read")):
        with pytest.raises(ValueError, match=said):
            nearl.import_torch(ActorCritic(norm, factor), **files)

    class Linear(nn.Linear):
        def forward(self, x):
            return 2 * super().forward(x)

    with pytest.raises(ValueError, match="module Sequential does more than its layers: its forward gives"):
        nearl.import_torch(nn.Sequential(Linear(14, 3)), **files)
    with pytest.raises(ValueError, match=r"module 0 \(Linear\) has a hook at its forward \(WeightNorm\)"):
        nearl.import_torch(nn.Sequential(nn.utils.weight_norm(nn.Linear(14, 3))), **files)


def one_joint(tmp_path, actuator: str, recipe: str, hanging: str = "") -> nearl.Controller:
    """A slide with what hangs on it, whose policy asks for nothing."""
    (tmp_path / "slide.xml").write_text(
        "<mujoco><compiler angle='radian'/><worldbody><body><joint name='slide' type='slide' axis='1 0 0' range='-1 1'/><geom size='.1' mass='1'/>"
        f"{hanging}</body></worldbody><actuator>{actuator}</actuator></mujoco>"
    )
    (tmp_path / "slide.toml").write_text(
        f"[time]\ndt = 0.002\nsim_dt = 0.002\n[policy]\njoints = ['slide']\nobservation = [{{ term = 'joint_pos' }}]\n{recipe}"
    )
    Net(1).add("Gemm", f32(np.zeros((1, 1))), f32(np.zeros(1))).save(tmp_path / "zero.onnx", 1)
    return nearl.import_onnx(tmp_path / "zero.onnx", robot=tmp_path / "slide.xml", recipe=tmp_path / "slide.toml")


GUARDED = "[constraints]\nguard = true\nposition = { margin = 0.02 }\nvelocity = { limit = 3.0 }\nacceleration = { limit = 5.0 }\ntorque = { scale = 1.0 }\n"


@pytest.mark.parametrize(("kp", "kv", "told"), [(80.0, 4.0, False), (40.0, 4.0, True), (80.0, 2.0, True)])
def test_gains_other_than_the_robot_files_are_told(tmp_path, kp, kv, told) -> None:
    actuator = "<position joint='slide' kp='80' kv='4' ctrlrange='-9 9' forcerange='-30 30'/>"
    drive = f"[command]\ninterface = 'pd'\nstiffness = {kp}\ndamping = {kv}\n"
    text = f"'slide' has stiffness {kp:.0f} and damping {kv:.0f} by [command], 80 and 4 by the robot file"
    for limits in ("[constraints]\n", GUARDED):
        assert any(text in note for note in one_joint(tmp_path, actuator, drive + limits).notes) == told


@pytest.mark.parametrize(("limits", "told"), [(GUARDED, False), (GUARDED + "braking = 'certified'\n", True)])
def test_a_range_that_cuts_targets_promises_no_velocity_without_a_stored_brake(tmp_path, limits, told) -> None:
    drive = "[command]\ninterface = 'pd'\nstiffness = 80.0\ndamping = 4.0\n"
    actuator = "<position joint='slide' kp='80' kv='4' ctrlrange='-1 1' forcerange='-30 30'/>"
    notes = one_joint(tmp_path, actuator, drive + limits).notes
    assert any("limits on acceleration, velocity and position are not promised" in note for note in notes) == told, notes


def test_a_joint_that_swings_is_told_of(tmp_path) -> None:
    pole = "<body><joint name='hinge' axis='0 1 0'/><geom size='.1' pos='0 0 -.5' mass='1'/></body>"
    motor = "<motor joint='slide' ctrlrange='-30 30'/>"
    swinging, alone = (one_joint(tmp_path, motor, GUARDED, hanging) for hanging in (pole, ""))
    text = "they may push the others harder than their motors can hold, which then leave their limits on position, velocity and acceleration"
    assert [any(text in note for note in c.notes) for c in (swinging, alone)] == [True, False]
    for controller, rests in ((swinging, True), (alone, False)):
        controller.save(tmp_path / "slide.safetensors")
        said = subprocess.run([NEARL, "doctor", tmp_path / "slide.safetensors"], capture_output=True, text=True).stdout
        assert "'slide' might need" in said
        assert ("to brake while 'hinge', which nothing commands, stand still" in said) == rests, said


@pytest.mark.parametrize("interface", ["effort", "position"])
def test_a_recipe_without_limits_has_none(tmp_path, interface) -> None:
    """It is the recipe with an empty [constraints], and import says that nothing holds."""
    actuator = "<motor joint='slide' ctrlrange='-30 30'/>" if interface == "effort" else "<position joint='slide' kp='80' kv='4'/>"
    command = f"[command]\ninterface = '{interface}'\n"
    without, empty = (one_joint(tmp_path, actuator, command + limits) for limits in ("", "[constraints]\n"))
    assert without.notes == empty.notes
    assert any("no limit holds" in note for note in without.notes)


@pytest.mark.parametrize(("guard", "times"), [("false", 1), ("true", 0)])
def test_a_training_of_actions_says_once_that_limits_hold_for_nothing(tmp_path, guard, times) -> None:
    command = [NEARL, "train", "Hopper-v5", "--algo", "ppo", "--steps", "2048", "--out", tmp_path / "run", "--set", f"constraints.guard={guard}"]
    command += ["--set", "constraints.torque={ scale = 1.0 }", "--set", "constraints.consistency=kinematic"]
    said = subprocess.run(command, capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    assert said.stderr.count("hold for nothing") == times, said.stderr


def test_a_sweep_says_for_each_task_what_its_trainings_would_say(tmp_path) -> None:
    command = [NEARL, "sweep", "--tasks", "Hopper-v5", "--algos", "ppo,nearl", "--seeds", "0,1", "--steps", "2048", "--out", tmp_path / "runs", "--json"]
    said = subprocess.run(command, capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    assert said.stderr.count("nearl: warning: Hopper-v5: the limits on states under [constraints] hold for nothing") == 1, said.stderr
    again = subprocess.run(command, capture_output=True, text=True)
    assert (again.returncode, again.stderr) == (0, ""), again.stderr
