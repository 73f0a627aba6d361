"""How far the image is from the photograph (3DGS; TR-Gaussians, Eq. 18)."""

from __future__ import annotations

from torch import Tensor

from glassplat.data.dataset import View
from glassplat.kernels.ssim import ssim
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene


def l1(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Mean absolute colour difference."""
    return (frame.rgb - view.photo.to(frame.rgb.device).to(frame.rgb.dtype) / 255).abs().mean()


def dssim(frame: Frame, view: View, scene: Scene) -> Tensor:
    """1 - SSIM, window 11, sigma 1.5."""
    return 1 - ssim(frame.rgb, view.photo.to(frame.rgb.device))
