"""Policies in ONNX files give what onnxruntime gives, and what is no policy is refused by name."""

import subprocess

import numpy as np
import pytest
from networks import NEARL, RNG, Net, TensorProto, f32, helper, numbers_of_its_own, numpy_helper, onnx, onnxruntime, planar  # noqa: F401

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


def graph(tmp_path, nodes, constants, n_in: int, n_out: int, opset: int = 17):
    """A file of nodes (op, inputs, outputs, attributes) from ``obs`` to ``actions``."""
    made = [helper.make_node(op, inputs, outputs, **attributes) for op, inputs, outputs, attributes in nodes]
    value = lambda name, n: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, n])  # noqa: E731
    held = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    body = helper.make_graph(made, "policy", [value("obs", n_in)], [value("actions", n_out)], held)
    path = tmp_path / "policy.onnx"
    onnx.save(helper.make_model(body, opset_imports=[helper.make_opsetid("", opset)], ir_version=8), path)
    return path


def is_refused_or_right(path, n_in: int) -> bool:
    """Whether a file is taken; one that is gives what onnxruntime gives."""
    session = onnxruntime.InferenceSession(path)
    try:
        policy = nearl.Policy.from_onnx(path)
    except ValueError:
        return False
    for scale in (0.1, 1.0, 10.0):
        obs = f32(scale * RNG.normal(size=n_in))
        (want,) = session.run(None, {"obs": obs[None]})
        np.testing.assert_allclose(policy(obs), want.ravel(), rtol=0, atol=1e-5 * max(1.0, np.abs(want).max()))
    return True


W, I, A = f32(RNG.normal(size=(4, 2))), np.eye(2, dtype=np.float32), np.array([[1, 2], [3, 4]], np.float32)
X, TO_FLOAT = ("MatMul", ["obs", "W"], ["x"], {}), {"to": TensorProto.FLOAT}


@pytest.mark.parametrize(
    ("nodes", "taken"),
    [
        ([X, ("Tanh", ["x"], ["y"], {}), ("Gemm", ["y", "I", "x"], ["actions"], {})], False),
        ([X, ("Max", ["x", "low", "high"], ["actions"], {})], True),
        ([X, ("Min", ["low", "x", "high"], ["actions"], {})], True),
        ([X, ("Max", ["x"], ["actions"], {})], True),
        ([X, ("Add", ["x", "x"], ["actions"], {})], False),
        ([X, ("Reshape", ["x", "flat"], ["z"], {}), ("Slice", ["z", "from", "to"], ["s"], {}), ("Clip", ["x", "s"], ["actions"], {})], False),
        ([X, ("Cast", ["x"], ["i"], {"to": TensorProto.INT64}), ("Cast", ["i"], ["actions"], TO_FLOAT)], False),
        ([X, ("Cast", ["x"], ["i"], {"to": TensorProto.DOUBLE}), ("Cast", ["i"], ["actions"], TO_FLOAT)], True),
        ([X, ("Max", ["low", "high", "row"], ["c"], {}), ("Add", ["x", "c"], ["actions"], {})], True),
        ([("Cast", ["row"], ["i"], {"to": TensorProto.INT64}), ("Cast", ["i"], ["c"], TO_FLOAT), X, ("Add", ["x", "c"], ["actions"], {})], True),
        ([("Cast", ["row"], ["i"], {"to": TensorProto.BOOL}), ("Cast", ["i"], ["c"], TO_FLOAT), X, ("Add", ["x", "c"], ["actions"], {})], True),
        ([X, ("Transpose", ["A"], ["S"], {"perm": [0, 1]}), ("MatMul", ["x", "S"], ["actions"], {})], True),
        ([X, ("Transpose", ["A"], ["S"], {"perm": [1, 0]}), ("MatMul", ["x", "S"], ["actions"], {})], True),
        ([X, ("Transpose", ["A"], ["S"], {}), ("MatMul", ["x", "S"], ["actions"], {})], True),
        ([X, ("Unsqueeze", ["row", "last"], ["u"], {}), ("Add", ["u", "row"], ["S"], {}), ("MatMul", ["x", "S"], ["actions"], {})], True),
        ([X, ("Unsqueeze", ["row", "last"], ["u"], {}), ("Squeeze", ["u"], ["c"], {}), ("Mul", ["x", "c"], ["actions"], {})], True),
        ([X, ("Reshape", ["x", "column"], ["z"], {}), ("Mul", ["z", "low"], ["y"], {}), ("Reshape", ["y", "flat"], ["actions"], {})], False),
    ],
)
def test_what_is_taken_gives_what_onnxruntime_gives_and_the_rest_is_refused(tmp_path, nodes, taken) -> None:
    """Each of them reads or leaves out something that a policy's usual graph has not."""
    constants = {"W": W, "I": I, "A": A, "low": f32([-0.5]), "high": f32([0.25]), "row": f32([0.9, -1.7])}
    constants |= {"flat": np.array([1, 2]), "column": np.array([-1, 1]), "from": np.array([0, 0]), "to": np.array([1, 1]), "last": np.array([1])}
    path = graph(tmp_path, nodes, constants, 4, 2)
    assert is_refused_or_right(path, 4) == taken


def test_a_graph_of_any_nodes_is_refused_or_right(tmp_path) -> None:
    """Chains of nodes drawn at random, with inputs that may be constants, the value before or one from further back."""
    taken = 0
    for _ in range(400):
        nodes, constants, width, values = [], {}, 4, ["obs"]

        def constant(array, held=constants) -> str:
            name = f"c{len(held)}"
            held[name] = np.asarray(array)
            return name

        def row(n: int) -> str:
            folded = constant(f32(RNG.normal(size=(n,) if RNG.random() < 0.7 else (1, n) if RNG.random() < 0.5 else (1,))))
            if RNG.random() < 0.3:
                out = f"f{len(nodes)}"  # noqa: B023
                op = RNG.choice(["Neg", "Exp", "Identity", "Max", "Add"])
                inputs = [folded] if op in ("Neg", "Exp", "Identity") else [folded, constant(f32(RNG.normal(size=1)))]
                inputs += [constant(f32(RNG.normal(size=1)))] * int(op == "Max")
                nodes.append((op, inputs, [out], {}))  # noqa: B023
                return out
            return folded

        for _ in range(RNG.integers(2, 9)):
            x, out = values[-1], f"x{len(nodes)}"
            ops = ["Gemm", "MatMul", "Tanh", "Relu", "Add", "Sub", "Mul", "Div", "Clip", "Max", "Min", "Slice", "Sigmoid", "Cast", "Elu"]
            op, attributes = str(RNG.choice(ops, p=[0.2, 0.15, *[0.05] * 13])), {}
            back = [v for v in values if v != x and RNG.random() < 0.05]
            if op in ("Gemm", "MatMul"):
                wide = int(RNG.integers(1, 5))
                turned = op == "Gemm" and RNG.random() < 0.5
                weight = constant(f32(RNG.normal(size=(wide, width) if turned else (width, wide))))
                inputs = [x, weight] + [row(wide)] * int(op == "Gemm" and RNG.random() < 0.8)
                attributes = {"transB": 1, "alpha": 0.5} if turned else {}
                values, width = [], wide
            elif op in ("Tanh", "Relu", "Sigmoid", "Elu"):
                inputs = [x]
            elif op == "Cast":
                inputs, attributes = [x], TO_FLOAT
            elif op == "Clip":
                inputs = [x, constant(f32(-0.4)), constant(f32(0.6))][: int(RNG.integers(1, 4))]
            elif op == "Slice":
                width = int(RNG.integers(1, width + 1))
                inputs, values = [x, constant([0]), constant([width]), constant([1])], []
            else:
                inputs = [x, back[0] if back else row(width)]
                inputs = inputs[::-1] if RNG.random() < 0.4 else inputs
                inputs += [row(width)] * int(op in ("Max", "Min") and RNG.random() < 0.4)
            nodes.append((op, inputs, [out], attributes))
            values.append(out)
        nodes.append(("Identity", [values[-1]], ["actions"], {}))
        taken += is_refused_or_right(graph(tmp_path, nodes, constants, 4, width), 4)
    assert taken > 40, f"{taken} of 400 are taken"


def test_constants_that_grow_node_by_node_are_refused_before_they_fill_the_memory(tmp_path) -> None:
    """Sums of a column and a row of 2000: a file of some kilobytes that asks for gigabytes."""
    column, row = f32(np.zeros((2000, 1))), f32(np.zeros((1, 2000)))
    nodes = [("Add", ["column", "row"], [f"s{k}"], {}) for k in range(100)]
    nodes += [("MatMul", ["obs", "W"], ["x"], {}), ("Slice", ["s99", "from", "to"], ["cut"], {}), ("Add", ["x", "cut"], ["actions"], {})]
    constants = {"W": W, "column": column, "row": row, "from": np.array([0, 0]), "to": np.array([1, 2])}
    path = graph(tmp_path, nodes, constants, 4, 2)
    with pytest.raises(ValueError, match="makes more constants than any policy has"):
        nearl.Policy.from_onnx(path)
