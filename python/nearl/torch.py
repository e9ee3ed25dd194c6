"""Projections as a PyTorch function: ``nearl.torch.project(projector, q, v, q_proposal, v_proposal)``.

    target_q, target_v = nearl.torch.project(projector, q, v, q_proposal, v_proposal)   # tensors (n, nv), float64
    loss(target_q, target_v).backward()                                                 # reaches q_proposal and v_proposal

The gradient is the projector's vector-Jacobian product: zero along clamped joints, the weighted projection onto the null space of
the active rows otherwise. The measured state is a constant. For robots whose joints have one position each.
"""

from typing import Any

import numpy as np

import nearl

try:
    import torch
except ImportError as error:
    raise ImportError("nearl.torch needs PyTorch: pip install 'nearl[torch]'") from error


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        projector: nearl.Projector,
        q: torch.Tensor,
        v: torch.Tensor,
        q_proposal: torch.Tensor,
        v_proposal: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        arrays = [x.detach().cpu().numpy() for x in (q, v, q_proposal, v_proposal)]
        ctx.projector, ctx.arrays = projector, arrays
        ctx.like = torch.promote_types(q_proposal.dtype, torch.float32), q_proposal.device
        targets = projector.project_batch(*arrays)
        return tuple(_tensor(x, ctx.like) for x in (targets.q, targets.v))  # type: ignore[return-value]

    @staticmethod
    def backward(ctx: Any, *derivatives: torch.Tensor) -> tuple[Any, ...]:
        dq, dv = (x.detach().cpu().numpy() for x in derivatives)
        pulled = ctx.projector.vjp_batch(*ctx.arrays, dq, dv)
        return None, None, None, *(_tensor(x, ctx.like) for x in pulled)


def _tensor(x: np.ndarray, like: tuple[torch.dtype, torch.device]) -> torch.Tensor:
    dtype, device = like
    return torch.from_numpy(np.ascontiguousarray(x)).to(dtype=dtype, device=device)


def project(
    projector: nearl.Projector,
    q: torch.Tensor,
    v: torch.Tensor,
    q_proposal: torch.Tensor,
    v_proposal: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The nearest allowed next states, (n, nq) and (n, nv), differentiable with respect to the proposals."""
    model = projector.model
    if model.nq != model.nv:
        raise ValueError(f"the model has {model.nq} positions for {model.nv} velocities; gradients need joints with one each")
    return _Project.apply(projector, q, v, q_proposal, v_proposal)  # type: ignore[no-any-return]
