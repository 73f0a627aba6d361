"""The definition of the curves in `maths.color_space`: sRGB as photographed, and linear radiance."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.maths.color_space import GAMMA, OFFSET, SLOPE, THRESHOLD_LINEAR, THRESHOLD_SRGB


def linear_from_srgb(color: Tensor) -> Tensor:
    """Linear radiance of sRGB values (IEC 61966-2-1); continued beyond 1, and linearly below 0."""
    curved = ((color.clamp(min=THRESHOLD_SRGB) + OFFSET) / (1 + OFFSET)) ** GAMMA
    return torch.where(color > THRESHOLD_SRGB, curved, color / SLOPE)


def srgb_from_linear(radiance: Tensor) -> Tensor:
    """sRGB values of linear radiance, the inverse of `linear_from_srgb`."""
    curved = (1 + OFFSET) * radiance.clamp(min=THRESHOLD_LINEAR) ** (1 / GAMMA) - OFFSET
    return torch.where(radiance > THRESHOLD_LINEAR, curved, SLOPE * radiance)
