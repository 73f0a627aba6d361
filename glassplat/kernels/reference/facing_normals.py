"""The definition of `facing_normals`: a column of the rotation matrix, and its side."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.reference.project import rotations


def facing_normals(quats: Tensor, log_scales: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """See `glassplat.kernels.facing_normals.facing_normals`."""
    squared = quats.detach().square().sum(-1, keepdim=True)
    usable = (squared > 0) & squared.isfinite()
    shortest = log_scales.detach().argmin(dim=-1)
    axes = rotations(torch.where(usable, quats, torch.ones_like(quats)))
    normals = axes.gather(-1, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    away = ((eye - means).detach() * normals.detach()).sum(-1, keepdim=True) < 0
    return torch.where(usable, torch.where(away, -normals, normals), 0)
