"""How far the image is from the photograph (3DGS; TR-Gaussians, Eq. 18)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from glassplat.data.dataset import View
from glassplat.data.ignored import with_ignored_right
from glassplat.kernels.photometric import photometric
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene
from glassplat.scene.transfer import moved


@dataclass(frozen=True)
class PhotometricLoss:
    """(1 - lambda) L1 + lambda D-SSIM: both from one traversal, with the photograph as bytes.

    Attributes:
        ssim_weight: lambda, in [0, 1]; D-SSIM is 1 - SSIM, window 11, sigma 1.5.
    """

    ssim_weight: float

    def __call__(self, frame: Frame, view: View, scene: Scene) -> Tensor:
        """The loss of a view, in the colours of its photograph; scalar. Ignored pixels count as if they were right."""
        image = with_ignored_right(scene.exposures.applied(frame.rgb, view.name), view)
        found = photometric(image, moved(view.photo, image.device))
        return found.l1.lerp(1 - found.ssim, self.ssim_weight)
