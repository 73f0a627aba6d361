"""Where the primary Gaussians lie along a pixel's ray."""

from __future__ import annotations

from torch import Tensor

from glassplat.data.dataset import View
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene


def depth_deviation_loss(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Depth variance loss L_d over the hit mask (TR-Gaussians, Eq. 14).

    The image mean of H(u) sum_i |z_i - D_t(u)| w_i, the `deviation` layer, divided by the scene extent so that its
    weight does not depend on the capture's units.
    """
    return frame.layers["deviation"].mean() / scene.extent
