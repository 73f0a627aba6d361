"""Telling transmission from reflection (TR-Gaussians, Section III-B)."""

from __future__ import annotations

from torch import Tensor

from glassplat.data.dataset import View
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene


def sobel(image: Tensor) -> tuple[Tensor, Tensor]:
    """Horizontal and vertical Sobel derivatives [H-2, W-2, C] of an image [H, W, C], borders left out."""
    across = image[:, 2:] - image[:, :-2]
    down = image[2:] - image[:-2]
    horizontal = across[:-2] + 2 * across[1:-1] + across[2:]
    vertical = down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]
    return horizontal, vertical


def gradient_conflict(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Gradient conflict loss L_c (TR-Gaussians, Eq. 15).

    The image mean of H |grad C_t . sg(grad C_r)|, per colour channel: an edge of the reflection should
    not appear in the transmission. No gradient reaches the reflection.
    """
    transmission = sobel(frame.layers["transmission"])
    reflection = sobel(frame.layers["reflection"].detach())
    product = transmission[0] * reflection[0] + transmission[1] * reflection[1]
    return (product.abs() * frame.layers["hit"][1:-1, 1:-1, None]).mean()


def mask_loss(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Reflection mask loss L_m (TR-Gaussians, Eq. 16), on annotated views only."""
    if view.pane_labels is None:
        return None
    annotated = (view.pane_labels > 0).to(frame.rgb.device).to(frame.rgb.dtype)
    return (frame.layers["mask"] - annotated).abs().mean()
