"""The slopes by PyTorch's own derivatives: the definition of `glassplat.kernels.layer_slopes.layer_slopes`."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.maths.color import linear_from_srgb, srgb_from_linear

GREY = 0.5
"""Any strength and light at which the derivatives are finite, in place of what is left out."""


def layer_slopes(
    strength: Tensor, transmission: Tensor, reflection: Tensor, where: Tensor, *, linear: bool
) -> tuple[Tensor, Tensor]:
    """See `glassplat.kernels.layer_slopes.layer_slopes`; left-out pixels are computed too, as no GPU is asked which."""
    layers = (strength, transmission.mean(dim=-1), reflection.mean(dim=-1))
    share, *greys = (torch.where(where, layer.detach(), GREY) for layer in layers)
    with torch.enable_grad():
        behind, mirror_image = (grey.requires_grad_() for grey in greys)
        if linear:
            light = (1 - share) * linear_from_srgb(behind) + share * linear_from_srgb(mirror_image)
            image = srgb_from_linear(light)
        else:
            image = (1 - share) * behind + share * mirror_image
        through, mirrored = torch.autograd.grad(image.sum(), (behind, mirror_image))
    return torch.where(where, through, 1), torch.where(where, mirrored, 0)


def slopes_at(slopes: Tensor, near: Tensor, means2d: Tensor, depths: Tensor) -> Tensor:
    """See `glassplat.kernels.layer_slopes.slopes_at`."""
    height, width = slopes.shape
    columns, rows = means2d.nan_to_num().floor().long().unbind(-1)
    pixels = rows.clamp(0, height - 1), columns.clamp(0, width - 1)
    return torch.where(depths > near[pixels], slopes[pixels], 1.0)
