"""Live modules of PyTorch are read layer by layer, and what is no layer is refused by name."""

import json
import os
import subprocess
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import planar_urdf
from networks import NEARL, RNG, LayerNorm, Linear, Net, ReLU, Sequential, Tanh, f32, numbers_of_its_own, onnxruntime, planar, ppo  # noqa: F401

import nearl


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


def test_layers_of_complex_numbers_are_refused(tmp_path) -> None:
    files, layer = planar(tmp_path), Linear(14, 3)
    layer.weight = SimpleNamespace(detach=lambda: np.ones((3, 14), complex))
    with pytest.raises(ValueError, match="0.weight holds complex numbers, and the layers of a policy are real"):
        nearl.import_torch(Sequential([layer]), **files)
    for name in ("mean", "std"):
        with pytest.raises(ValueError, match=f"{name} holds complex numbers"):
            nearl.import_torch(Sequential([Linear(14, 3)]), **files, **{name: np.ones(14, complex)})


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


@pytest.mark.parametrize("read", [nearl.import_sb3, nearl.import_torch])
def test_a_file_in_the_place_of_a_live_object_is_named_and_not_opened(read) -> None:
    with pytest.raises(ValueError, match=r"'nowhere.zip' is a file, .* never opened here; load it .*\.load\('nowhere.zip'\)"):
        read("nowhere.zip", task="HalfCheetah-v5")


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


def test_a_pipe_is_no_file_of_torchscript(tmp_path) -> None:
    """It had been waited for."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe' is a file, and files of PyTorch .* are pickles"):
        nearl.import_torch(tmp_path / "pipe", **planar(tmp_path))


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
