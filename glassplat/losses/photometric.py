"""How far the image is from the photograph (3DGS; TR-Gaussians, Eq. 18)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from glassplat.data.dataset import View
from glassplat.data.ignored import with_ignored_right
from glassplat.kernels.photometric import photometric
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene
from glassplat.scene.transfer import moved

PATCH = 0.04
"""Side of the patches whose residuals are compared, as a share of the image's width."""
TYPICAL = 0.8
"""Share of the patches whose residual is taken for that of what the scene can explain."""
SAMPLED = 4096
"""Patches from which it is found."""


@dataclass(frozen=True)
class PhotometricLoss:
    """(1 - lambda) L1 + lambda D-SSIM: both from one traversal, with the photograph as bytes.

    Attributes:
        ssim_weight: lambda, in [0, 1]; D-SSIM is 1 - SSIM, window 11, sigma 1.5.
        outliers: leave out patches whose residual is so many times that of the rest, see `outlying`; 0 for none.
    """

    ssim_weight: float
    outliers: float = 0.0

    def __call__(self, frame: Frame, view: View, scene: Scene) -> Tensor:
        """The loss of a view, in the colours of its photograph; scalar. Ignored pixels count as if they were right."""
        image = with_ignored_right(scene.exposures.applied(frame.rgb, view.name), view)
        photo = moved(view.photo, image.device)
        if self.outliers:
            right = photo.to(image.dtype) / 255
            image = torch.where(outlying(image.detach(), right, self.outliers)[..., None], right, image)
        found = photometric(image, photo)
        return found.l1.lerp(1 - found.ssim, self.ssim_weight)


@torch.no_grad()
def outlying(image: Tensor, photo: Tensor, threshold: float) -> Tensor:
    """[H, W] bool, the pixels amid patches in which image and photograph differ far more than elsewhere.

    Args:
        image: [H, W, 3] sRGB.
        photo: the same shape.
        threshold: how many times the residual that `TYPICAL` patches stay below is too much.
    """
    reach = max(round(PATCH * image.shape[1] / 2), 1)
    residual = (image - photo).abs().mean(dim=-1)
    patches = torch.nn.functional.avg_pool2d(
        residual[None], 2 * reach + 1, stride=1, padding=reach, count_include_pad=False
    )[0]
    step = max(math.ceil(math.sqrt(patches.numel() / SAMPLED)), 1)
    return patches > threshold * torch.quantile(patches[::step, ::step], TYPICAL)
