"""The definition of `photometric`: five blurs with a full two-dimensional window."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.photometric import Photometric


def photometric(image: Tensor, target: Tensor) -> Photometric:
    """See `glassplat.kernels.photometric.photometric`."""
    photo = target.to(image.dtype) / 255
    return Photometric((image - photo).abs().mean(), _similarity(image, photo).mean())


def _similarity(image: Tensor, target: Tensor) -> Tensor:
    x, y = image.permute(2, 0, 1)[:, None], target.permute(2, 0, 1)[:, None]
    offsets = torch.arange(-5, 6, dtype=image.dtype)
    profile = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    profile = profile / profile.sum()
    window = (profile[:, None] * profile)[None, None]

    def blur(values: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(values, window, padding=5)

    mean_x, mean_y = blur(x), blur(y)
    variance_x, variance_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    return luminance * structure
