"""Networks to import: graphs of ONNX, and modules as PyTorch has them."""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT, planar_urdf

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


def ppo(n_in: int, n_out: int, **more) -> SimpleNamespace:
    """A model with SB3's attributes."""
    latent, head = Sequential([Linear(n_in, 8), Tanh()]), Linear(8, n_out)
    policy = SimpleNamespace(mlp_extractor=SimpleNamespace(policy_net=latent), action_net=head)
    return SimpleNamespace(policy=policy, action_space=SimpleNamespace(low=np.full(n_out, -1.0), high=np.full(n_out, 1.0)), **more)
