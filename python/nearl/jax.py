"""Projections as a JAX function: ``nearl.jax.project(projector)`` makes one that ``jax.grad``, ``jax.jit`` and ``jax.vmap`` take.

    project = nearl.jax.project(projector)
    target_q, target_v = project(q, v, q_proposal, v_proposal)      # arrays (n, nv), or (nv) of one sample

``jax.vmap`` over samples is one projection of the whole batch. The gradient is the projector's vector-Jacobian product: zero along clamped joints, the
weighted projection onto the null space of the active rows otherwise. The measured state is a constant. For robots whose joints have one position each.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

import nearl

try:
    import jax
    import jax.numpy as jnp
except ImportError as error:
    raise ImportError("nearl.jax needs JAX: pip install 'nearl[jax]'") from error


def project(projector: nearl.Projector) -> Callable[[Any, Any, Any, Any], tuple[jax.Array, jax.Array]]:
    """The projection as a function of ``(q, v, q_proposal, v_proposal)``, arrays (..., nv) of one shape, differentiable in the proposals.

    Targets are as exact as the proposals, and float32 at least; JAX has float64 where ``jax_enable_x64`` is on.
    """
    model = projector.model
    if model.nq != model.nv:
        raise ValueError(f"the model has {model.nq} positions for {model.nv} velocities; gradients need joints with one each")

    def forward(*arrays: Any) -> tuple[np.ndarray, np.ndarray]:
        q, v, q_proposal, v_proposal = map(rows, arrays)
        targets = projector.project_batch(q, v, q_proposal, v_proposal)
        return like(targets.q, arrays[2]), like(targets.v, arrays[3])

    def backward(*arrays: Any) -> tuple[np.ndarray, np.ndarray]:
        q, v, q_proposal, v_proposal, q_bar, v_bar = map(rows, arrays)
        dq, dv = projector.vjp_batch(q, v, q_proposal, v_proposal, q_bar, v_bar)
        return like(dq, arrays[2]), like(dv, arrays[3])

    def rows(array: Any) -> np.ndarray:
        return np.asarray(array, dtype=np.float64).reshape(-1, model.nv)

    def like(values: np.ndarray, array: Any) -> np.ndarray:
        return values.reshape(array.shape).astype(array.dtype)

    def call(function: Callable[..., Any], *arrays: Any) -> tuple[jax.Array, jax.Array]:
        shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays[2:4])
        # All arrays come with the axes of every vmap in front, so that they have the same rows.
        return jax.pure_callback(function, shapes, *arrays, vmap_method="broadcast_all")

    @jax.custom_vjp
    def projected(q: Any, v: Any, q_proposal: Any, v_proposal: Any) -> tuple[jax.Array, jax.Array]:
        for name, x in zip(("q", "v", "q_proposal", "v_proposal"), (q, v, q_proposal, v_proposal)):
            if x.shape != q.shape or x.shape[-1:] != (model.nv,):
                raise ValueError(f"{name} has shape {x.shape}; give all four arrays the same one, ({model.nv},) or (n, {model.nv})")
        return call(forward, q, v, q_proposal, v_proposal)

    def run(*arrays: Any) -> tuple[tuple[jax.Array, jax.Array], tuple[Any, ...]]:
        return projected(*arrays), arrays

    def pull_back(arrays: tuple[Any, ...], derivatives: tuple[Any, Any]) -> tuple[Any, ...]:
        dq_proposal, dv_proposal = call(backward, *arrays, *derivatives)
        return jnp.zeros_like(arrays[0]), jnp.zeros_like(arrays[1]), dq_proposal, dv_proposal

    def exact(array: Any) -> jax.Array:
        array = jnp.asarray(array)
        return array.astype(jnp.promote_types(array.dtype, jnp.float32))

    projected.defvjp(run, pull_back)
    return lambda q, v, q_proposal, v_proposal: projected(*map(exact, (q, v, q_proposal, v_proposal)))
