"""Projections as a JAX function: ``nearl.jax.project(projector)`` makes one that ``jax.grad``, ``jax.jit`` and ``jax.vmap`` take.

    project = nearl.jax.project(projector)
    target_q, target_v = project(q, v, q_proposal, v_proposal)      # arrays (n, nv)

The gradient is the projector's vector-Jacobian product: zero along clamped joints, the weighted projection onto the null space of
the active rows otherwise. The measured state is a constant. For robots whose joints have one position each.
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
    """The projection as a function of ``(q, v, q_proposal, v_proposal)``, arrays (n, nv), differentiable in the proposals."""
    model = projector.model
    if model.nq != model.nv:
        raise ValueError(f"the model has {model.nq} positions for {model.nv} velocities; gradients need joints with one each")

    def forward(*arrays: Any) -> tuple[np.ndarray, np.ndarray]:
        q, v, q_proposal, v_proposal = (np.asarray(x, dtype=np.float64) for x in arrays)
        targets = projector.project_batch(q, v, q_proposal, v_proposal)
        return targets.q.astype(arrays[2].dtype), targets.v.astype(arrays[3].dtype)

    def backward(*arrays: Any) -> tuple[np.ndarray, np.ndarray]:
        q, v, q_proposal, v_proposal, q_bar, v_bar = (np.asarray(x, dtype=np.float64) for x in arrays)
        dq, dv = projector.vjp_batch(q, v, q_proposal, v_proposal, q_bar, v_bar)
        return dq.astype(arrays[2].dtype), dv.astype(arrays[3].dtype)

    def call(function: Callable[..., Any], *arrays: Any) -> tuple[jax.Array, jax.Array]:
        shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays[2:4])
        return jax.pure_callback(function, shapes, *arrays, vmap_method="sequential")

    @jax.custom_vjp
    def projected(q: Any, v: Any, q_proposal: Any, v_proposal: Any) -> tuple[jax.Array, jax.Array]:
        return call(forward, q, v, q_proposal, v_proposal)

    def run(*arrays: Any) -> tuple[tuple[jax.Array, jax.Array], tuple[Any, ...]]:
        return projected(*arrays), arrays

    def pull_back(arrays: tuple[Any, ...], derivatives: tuple[Any, Any]) -> tuple[Any, ...]:
        dq_proposal, dv_proposal = call(backward, *arrays, *derivatives)
        return jnp.zeros_like(arrays[0]), jnp.zeros_like(arrays[1]), dq_proposal, dv_proposal

    projected.defvjp(run, pull_back)
    return projected
