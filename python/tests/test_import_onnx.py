"""Policies in ONNX files give what onnxruntime gives, and what is no policy is refused by name."""

import subprocess

import numpy as np
import pytest
from networks import NEARL, RNG, Net, TensorProto, f32, helper, numbers_of_its_own, onnx, onnxruntime, planar  # noqa: F401

import nearl


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
