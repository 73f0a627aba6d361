"""Shapes that rays meet, from raw Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.discs import FLAT, SOLID
from glassplat.kernels.maths.blending import ALPHA_MIN
from glassplat.kernels.maths.ray_hit import MOST_DEVIATIONS
from glassplat.kernels.project.reference import rotations
from glassplat.kernels.splats import RawGaussians
from glassplat.kernels.trace.records import Shapes

__all__ = ["FLAT", "SOLID", "shapes_of"]

MOST_LOG_SCALE = 40.0
"""Beyond, squares of deviations and of their inverses leave the range of float32."""


def shapes_of(gaussians: RawGaussians) -> Shapes:
    """Activated shapes; differentiable. With `log_scales` [N, 2] they are discs, with [N, 3] ellipsoids.

    What has no size, no orientation or something that is not finite becomes invisible and gets no gradient.
    """
    usable = _usable(gaussians)
    # Harmless stand-ins: a NaN masked afterwards would still reach the gradients, as NaN times zero.
    tensors = (torch.where(_over(usable, x), x, torch.ones_like(x)) for x in gaussians)
    means, quats, log_scales, logit_opacities, sh = tensors
    inverse = torch.exp(-log_scales)
    if log_scales.shape[1] == FLAT:
        inverse = torch.cat([inverse, torch.ones_like(inverse[:, :1])], dim=1)
    opacities = torch.where(usable, torch.sigmoid(logit_opacities), torch.zeros_like(logit_opacities))
    return Shapes(means, rotations(quats).mT * inverse[:, :, None], opacities, sh)


@torch.no_grad()
def _usable(gaussians: RawGaussians) -> Tensor:
    """[N] whether a Gaussian has a place, a size and an orientation."""
    everything = torch.cat([tensor.flatten(1) if tensor.dim() > 1 else tensor[:, None] for tensor in gaussians], dim=1)
    norm = gaussians.quats.square().sum(-1)
    sized = (gaussians.log_scales.abs() <= MOST_LOG_SCALE).all(dim=1)
    return everything.isfinite().all(dim=1) & norm.isfinite() & (norm > 0) & sized


def _over(mask: Tensor, tensor: Tensor) -> Tensor:
    return mask.reshape(mask.shape + (1,) * (tensor.dim() - 1))


def reach(opacities: Tensor) -> Tensor:
    """[N] distance in standard deviations up to which Gaussians are met; 0 where they are met nowhere."""
    squared = 2 * torch.log(opacities / ALPHA_MIN)
    return squared.clamp(min=0, max=MOST_DEVIATIONS**2).sqrt().nan_to_num()
