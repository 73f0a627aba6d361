"""The definition of `surface_channels`: a column of the rotation matrix and its side, beside colour and strength."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.project.reference import rotations


def surface_channels(
    colors: Tensor,
    radii: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    means: Tensor,
    logit_strengths: Tensor,
    eye: Tensor,
    extra: Tensor | None = None,
) -> Tensor:
    """See `glassplat.kernels.surface_channels.surface_channels`."""
    squared = quats.detach().square().sum(-1, keepdim=True)
    usable = (squared > 0) & squared.isfinite()
    shortest = log_scales.detach().argmin(dim=-1)
    axes = rotations(torch.where(usable, quats, torch.ones_like(quats)))
    normals = axes.gather(-1, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    away = ((eye - means).detach() * normals.detach()).sum(-1, keepdim=True) < 0
    normals = torch.where(usable, torch.where(away, -normals, normals), 0)
    parts = [colors, normals, torch.sigmoid(logit_strengths)[:, None], *([] if extra is None else [extra])]
    return torch.where(radii[:, :1] > 0, torch.cat(parts, dim=-1), 0)
