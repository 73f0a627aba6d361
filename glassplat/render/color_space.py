"""sRGB as photographed, and linear radiance."""

from __future__ import annotations

import torch
from torch import Tensor

THRESHOLD_SRGB, THRESHOLD_LINEAR = 0.04045, 0.0031308


def linear_from_srgb(color: Tensor) -> Tensor:
    """Linear radiance of sRGB values (IEC 61966-2-1); continued beyond 1, and linearly below 0."""
    curved = ((color.clamp(min=THRESHOLD_SRGB) + 0.055) / 1.055) ** 2.4
    return torch.where(color > THRESHOLD_SRGB, curved, color / 12.92)


def srgb_from_linear(radiance: Tensor) -> Tensor:
    """sRGB values of linear radiance, the inverse of `linear_from_srgb`."""
    curved = 1.055 * radiance.clamp(min=THRESHOLD_LINEAR) ** (1 / 2.4) - 0.055
    return torch.where(radiance > THRESHOLD_LINEAR, curved, 12.92 * radiance)
