"""Reference of `glassplat.kernels.trace.trace` in plain PyTorch, which tests every ray against every Gaussian."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from glassplat.kernels.maths.disc import EDGE_ON, MOST_DEVIATIONS
from glassplat.kernels.project.reference import sh_basis
from glassplat.kernels.records import FLAT, Bvh, RawGaussians, Rays, Shapes, Traced
from glassplat.kernels.trace import shapes_of


class _Hits(NamedTuple):
    """Distance parameter and coverage [R, N] of every Gaussian on every ray; coverage is 0 without a hit."""

    t: Tensor
    alpha: Tensor


class _Contributions(torch.autograd.Function):
    """Returns alphas unchanged; the gradient of `contributions` [N, 2] is `sums` [N, 2] for any gradient of alphas."""

    @staticmethod
    def forward(ctx: Any, alphas: Tensor, contributions: Tensor, sums: Tensor) -> Tensor:
        ctx.save_for_backward(sums)
        return alphas.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        return gradients[0], ctx.saved_tensors[0], None


def trace(
    gaussians: RawGaussians,
    rays: Rays,
    bvh: Bvh | None,
    *,
    sh_degree: int,
    near: float,
    contributions: Tensor | None = None,
) -> Traced:
    """Traces rays; see `glassplat.kernels.trace.trace`. The hierarchy is ignored."""
    flat = gaussians.log_scales.shape[1] == FLAT
    shapes = shapes_of(gaussians)
    with torch.no_grad():
        length = rays.directions.square().sum(-1)
        seen = rays.origins.isfinite().all(dim=1) & length.isfinite() & (length > 0)
    origins, directions = (torch.where(seen[:, None], x, torch.ones_like(x)) for x in rays)
    hits = _intersect(shapes, origins, directions, flat, near)
    valid = seen[:, None] & (hits.alpha > 0)
    alpha = torch.where(valid, hits.alpha, torch.zeros_like(hits.alpha))
    order = torch.argsort(torch.where(valid, hits.t.detach(), torch.inf), dim=1, stable=True)
    alpha = alpha.gather(1, order)
    after = torch.cumprod(1 - alpha, dim=1)
    blended = (after.detach() >= TRANSMITTANCE_MIN) & (alpha > 0)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    weights = torch.where(blended, alpha * before, torch.zeros_like(alpha))
    length = directions.square().sum(-1, keepdim=True).sqrt()
    t = torch.where(blended, hits.t.gather(1, order), torch.zeros_like(alpha)) * length
    colors = _colors(shapes.sh, directions / length, sh_degree)
    colors = colors.gather(1, order[..., None].expand(-1, -1, 3))
    alphas = weights.sum(1)
    if contributions is not None:
        added = torch.stack([weights, weights * t], dim=-1).detach()
        sums = torch.zeros_like(contributions).index_add(0, order.flatten(), added.flatten(0, 1))
        alphas = _Contributions.apply(alphas, contributions, sums)
    return Traced((weights[..., None] * colors).sum(1), alphas, (weights * t).sum(1), blended.sum(1, dtype=torch.int32))


def _intersect(shapes: Shapes, origins: Tensor, directions: Tensor, flat: bool, near: float) -> _Hits:
    """Intersections of rays with Gaussians, and the coverage there."""
    offsets = shapes.means - origins[:, None]
    local_offset = torch.einsum("nij,rnj->rni", shapes.frames, offsets)
    local_direction = torch.einsum("nij,rj->rni", shapes.frames, directions)
    if flat:
        slope = local_direction[..., 2]
        facing = slope.square() > EDGE_ON**2 * directions.square().sum(-1, keepdim=True)
        t = local_offset[..., 2] / torch.where(facing, slope, torch.ones_like(slope))
        q = (t[..., None] * local_direction - local_offset)[..., :2]
    else:
        squared_length = local_direction.square().sum(-1)
        facing = squared_length > 0
        t = (local_offset * local_direction).sum(-1) / torch.where(
            facing, squared_length, torch.ones_like(squared_length)
        )
        q = t[..., None] * local_direction - local_offset
    squared = q.square().sum(-1)
    is_hit = facing & (t > near) & (squared <= MOST_DEVIATIONS**2)
    coverage = shapes.opacities * torch.exp(-0.5 * torch.where(is_hit, squared, torch.zeros_like(squared)))
    alpha = torch.where(is_hit & (coverage >= ALPHA_MIN), coverage.clamp(max=ALPHA_MAX), torch.zeros_like(coverage))
    return _Hits(t, alpha)


def _colors(sh: Tensor, directions: Tensor, sh_degree: int) -> Tensor:
    """Colours [R, N, 3] along unit directions [R, 3]; zero where there are no coefficients."""
    if sh.shape[1] == 0:
        return torch.zeros(directions.shape[0], sh.shape[0], 3, dtype=sh.dtype)
    count = (sh_degree + 1) ** 2
    return (0.5 + torch.einsum("rk,nkd->rnd", sh_basis(directions)[:, :count], sh[:, :count])).clamp(min=0)
