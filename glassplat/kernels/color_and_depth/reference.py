"""The definition of `glassplat.kernels.color_and_depth.color_and_depth`, in PyTorch."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.records import LEAST_ALPHA


def color_and_depth(image: Tensor, alpha: Tensor, background: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """See `glassplat.kernels.color_and_depth.color_and_depth`."""
    colors, total = image[..., :3], image[..., 3]
    if any(background):
        # Filled in on the device: a tensor of numbers that came from here would make a GPU wait.
        behind = torch.stack([torch.full_like(alpha, value) for value in background], dim=-1)
        colors = colors + (1 - alpha)[..., None] * behind
    return colors, mean_depth(total, alpha)


def mean_depth(depth_sum: Tensor, alpha: Tensor) -> Tensor:
    """Blended depth (TR-Gaussians, Eq. 4): weighted depth sum over total weight; 0 where nothing is."""
    return torch.where(alpha > LEAST_ALPHA, depth_sum / alpha.clamp(min=LEAST_ALPHA), 0)
