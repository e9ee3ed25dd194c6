"""Modules with an actor and models of rsl_rl are held against themselves: what they do beyond their layers is refused."""

import re
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest
from networks import NEARL, RNG, LayerNorm, Linear, Sequential, Tanh, f32, numbers_of_its_own, onnxruntime, planar  # noqa: F401

import nearl


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
