"""What a policy sees and what its outputs mean, as a recipe says it, and what is told of limits and gains."""

import json
import os
import signal
import subprocess
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT, planar_urdf
from networks import NEARL, RECIPE, RNG, Linear, Net, Sequential, Tanh, f32, helper, numbers_of_its_own, numpy_helper, onnx, onnxruntime, planar  # noqa: F401

import nearl


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


def test_clips_and_joints_of_a_deployment_are_those_of_unitree(tmp_path) -> None:
    """Their clip is of targets, ``clip(scale x output + offset)``, and ``joint_ids`` number the policy's joints."""
    files = planar(tmp_path)
    deploy = """joint_ids_map: [2, 0, 1]
step_dt: 0.01
stiffness: [40.0, 41.0, 42.0]
damping: [2.0, 2.1, 2.2]
default_joint_pos: [0.3, 0.1, 0.2]
actions:
  JointPositionAction: {clip: [[0.2, 0.6], [0.0, 0.15], [-1.0, 0.25]], scale: [0.5, -0.6, 0.7], offset: [0.3, 0.1, 0.2]}
observations:
  joint_pos_rel: {params: {asset_cfg: {joint_ids: [1, 0]}}, clip: null, scale: 1.0, history_length: 1}
"""
    (tmp_path / "deploy.yaml").write_text(deploy)
    weight = f32(3.0 * np.eye(2, 3))
    path = Net(2).add("Gemm", weight).save(tmp_path / "policy.onnx", 3)
    (tmp_path / "free.toml").write_text("[constraints]\nguard = false\n")
    controller = nearl.import_onnx(path, robot=files["robot"], recipe=[tmp_path / "deploy.yaml", tmp_path / "free.toml"])
    order, scale, offset = [2, 0, 1], np.array([0.5, -0.6, 0.7]), np.array([0.3, 0.1, 0.2])
    for q in RNG.uniform(-0.4, 0.4, size=(20, 3)):
        controller.reset()
        seen = (q[order] - offset)[[1, 0]]
        target = np.clip(scale * (seen @ weight) + offset, [0.2, 0.0, -1.0], [0.6, 0.15, 0.25])
        want = np.zeros(3)
        want[order] = target
        action, _ = controller.update(np.concatenate([np.zeros(6), [1.0], q]), np.zeros(9), np.zeros(len(controller.obs_names)))
        np.testing.assert_allclose(action, want, atol=1e-5)
    with_last = deploy + "  last_action: {params: {}, clip: null, scale: 1.0, history_length: 1}\n"
    (tmp_path / "deploy.yaml").write_text(with_last)
    with pytest.raises(ValueError, match="cuts targets that the policy sees uncut as its last action"):
        nearl.import_onnx(path, robot=files["robot"], recipe=tmp_path / "deploy.yaml")
    (tmp_path / "deploy.yaml").write_text(deploy.replace("[1, 0]", "[1, 7]"))
    with pytest.raises(ValueError, match="joint_ids of 'joint_pos_rel' names a joint that the policy does not have"):
        nearl.import_onnx(path, robot=files["robot"], recipe=tmp_path / "deploy.yaml")


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
