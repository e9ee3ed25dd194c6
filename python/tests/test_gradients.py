"""Derivatives of projections against central differences, and through PyTorch and JAX where they are installed."""

from pathlib import Path

import numpy as np
import pytest

import nearl

PANDA = Path(__file__).parents[2] / "examples/robots/panda/panda.urdf"


def projector() -> nearl.Projector:
    model = nearl.Model.from_urdf(PANDA)
    limits = [
        nearl.PositionLimit(model),
        nearl.VelocityLimit(model, scale=0.6),
        nearl.AccelerationLimit(model, 10.0, braking=2.0),
        nearl.TorqueLimit(model, scale=0.3),
    ]
    return nearl.Projector(model, limits, dt=1e-3)


def cases(n: int, seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    q = np.array([0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3]) + rng.uniform(-0.2, 0.2, (n, 7))
    v = rng.uniform(-0.2, 0.2, (n, 7))
    v_proposal = v + rng.uniform(-0.012, 0.012, (n, 7))
    q_proposal = q + 1e-3 * v + rng.uniform(-1e-5, 1e-5, (n, 7))
    return q, v, q_proposal, v_proposal


def loss(targets: nearl.Targets, weights: tuple[np.ndarray, np.ndarray]) -> float:
    return float(np.sum(weights[0] * targets.q) + np.sum(weights[1] * targets.v))


def test_the_product_is_the_derivative() -> None:
    p, (q, v, q_hat, v_hat) = projector(), cases(200, 0)
    rng = np.random.default_rng(1)
    weights = rng.normal(size=(200, 7)), rng.normal(size=(200, 7))
    dq, dv = p.vjp_batch(q, v, q_hat, v_hat, *weights)
    direction = rng.normal(size=(2, 200, 7))
    solved = sum(t == "solved" for t in p.project_batch(q, v, q_hat, v_hat).status)
    assert solved > 20
    step, compared = 1e-8, 0
    for i in range(200):
        one = [x[i : i + 1] for x in (q, v, q_hat, v_hat)]

        def value(sign: float, i: int = i, one: list[np.ndarray] = one) -> tuple[float, object]:
            moved_v = one[3] + sign * step * direction[1, i]
            moved_q = one[2] + sign * step * 1e-3 * direction[0, i]
            t = p.project(q[i], v[i], moved_q[0], moved_v[0])
            rows = [(r["row"], r["side"]) for r in t.active]
            return float(weights[0][i] @ t.q + weights[1][i] @ t.v), rows

        (above, rows_above), (below, rows_below) = value(1.0), value(-1.0)
        if rows_above != rows_below:
            continue
        compared += 1
        expected = 1e-3 * dq[i] @ direction[0, i] + dv[i] @ direction[1, i]
        assert abs((above - below) / (2 * step) - expected) < 1e-5 * (1 + abs(expected))
    assert compared > 150


def test_threads_give_the_same_bits() -> None:
    p, arrays = projector(), cases(101, 2)
    rng = np.random.default_rng(3)
    weights = rng.normal(size=(101, 7)), rng.normal(size=(101, 7))
    one, two = p.vjp_batch(*arrays, *weights, threads=1), p.vjp_batch(*arrays, *weights, threads=2)
    assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))


def test_torch() -> None:
    torch = pytest.importorskip("torch")
    import nearl.torch

    p, (q, v, q_hat, v_hat) = projector(), cases(20, 4)
    tensors = [torch.tensor(x) for x in (q, v)] + [torch.tensor(x, requires_grad=True) for x in (q_hat, v_hat)]
    target_q, target_v = nearl.torch.project(p, *tensors)
    (3.0 * target_q.sum() + (target_v**2).sum()).backward()
    dq, dv = p.vjp_batch(q, v, q_hat, v_hat, np.full((20, 7), 3.0), 2 * target_v.detach().numpy())
    np.testing.assert_array_equal(tensors[2].grad.numpy(), dq)
    np.testing.assert_array_equal(tensors[3].grad.numpy(), dv)


def test_jax() -> None:
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    import nearl.jax

    p, (q, v, q_hat, v_hat) = projector(), cases(20, 5)
    project = nearl.jax.project(p)

    def scalar(q_hat: object, v_hat: object) -> object:
        target_q, target_v = project(q, v, q_hat, v_hat)
        return 3.0 * target_q.sum() + (target_v**2).sum()

    dq, dv = jax.jit(jax.grad(scalar, argnums=(0, 1)))(q_hat, v_hat)
    targets = p.project_batch(q, v, q_hat, v_hat)
    expected = p.vjp_batch(q, v, q_hat, v_hat, np.full((20, 7), 3.0), 2 * targets.v)
    np.testing.assert_allclose(dq, expected[0], rtol=1e-12)
    np.testing.assert_allclose(dv, expected[1], rtol=1e-12)


def test_jax_maps_over_samples_as_a_loop_does() -> None:
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    import nearl.jax

    p, (q, v, q_hat, v_hat) = projector(), cases(20, 6)
    project = nearl.jax.project(p)

    def scalar(q: object, v: object, q_hat: object, v_hat: object) -> object:
        target_q, target_v = project(q, v, q_hat, v_hat)
        return 3.0 * target_q.sum() + (target_v**2).sum()

    gradient = jax.grad(scalar, argnums=(2, 3))
    loop = [gradient(*of) for of in zip(q, v, q_hat, v_hat)]
    expected = p.vjp_batch(q, v, q_hat, v_hat, np.full((20, 7), 3.0), 2 * p.project_batch(q, v, q_hat, v_hat).v)
    for mapped in (jax.vmap(gradient), jax.jit(jax.vmap(gradient))):
        for k, product in enumerate(mapped(q, v, q_hat, v_hat)):
            np.testing.assert_array_equal(product, np.stack([np.asarray(of[k]) for of in loop]))
            np.testing.assert_allclose(product, expected[k], rtol=1e-12)
    # one state and many proposals; and two axes
    mapped = jax.vmap(gradient, in_axes=(None, None, 0, 0))(q[0], v[0], q_hat[:5], v_hat[:5])
    for k in range(2):
        np.testing.assert_array_equal(mapped[k], np.stack([np.asarray(gradient(q[0], v[0], a, b)[k]) for a, b in zip(q_hat[:5], v_hat[:5])]))
    blocks = [x.reshape(4, 5, 7) for x in (q, v, q_hat, v_hat)]
    np.testing.assert_array_equal(jax.vmap(jax.vmap(project))(*blocks)[0].reshape(20, 7), p.project_batch(q, v, q_hat, v_hat).q)
    np.testing.assert_array_equal(jax.vmap(project)(*blocks)[1].reshape(20, 7), p.project_batch(q, v, q_hat, v_hat).v)
    with pytest.raises(ValueError, match=r"q_proposal has shape \(6,\); give all four arrays the same one, \(7,\) or \(n, 7\)"):
        project(q[0], v[0], q_hat[0, :6], v_hat[0])


def test_jax_rounds_no_target_to_the_numbers_of_a_coarse_proposal() -> None:
    """A proposal in whole numbers had targets in whole numbers: 0 where 0.5 rad/s was the nearest."""
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    import nearl.jax

    p, (q, v, _, v_hat) = projector(), cases(20, 7)
    project, ones = nearl.jax.project(p), np.ones((20, 7))
    for coarse in (np.int32, np.float16, jax.numpy.bfloat16):
        target_q, target_v = project(q, v, ones.astype(coarse), ones.astype(coarse))
        expected = p.project_batch(q, v, ones, ones)
        assert target_q.dtype in (np.float32, np.float64) and target_v.dtype == target_q.dtype
        np.testing.assert_allclose(target_q, expected.q, atol=1e-5)
        np.testing.assert_allclose(target_v, expected.v, atol=1e-5)
    slopes = jax.grad(lambda v_hat: project(q, v, q, v_hat)[1].sum())(v_hat.astype(np.float32))
    assert slopes.dtype == np.float32
