"""Telling transmission from reflection (TR-Gaussians, Section III-B)."""

from __future__ import annotations

from torch import Tensor

from glassplat.data.dataset import View
from glassplat.kernels.gradient_conflict import gradient_conflict as shared_edges
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene
from glassplat.scene.transfer import moved

PAPER_PIXELS = 960 * 720
"""Size of the photographs for which the paper's weight of L_c was chosen."""
SIZE_POWER = 0.8
"""How L_c shrinks as photographs grow, as a power of their number of pixels: between 0.5, where all slopes are steps
between two pixels, and 1, where all are ramps. Measured on one scene from 100x75 to 800x600: 0.0525, 0.0193, 0.0062,
0.0018."""


def gradient_conflict(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Gradient conflict loss L_c (TR-Gaussians, Eq. 15).

    The image mean of H |grad C_t . sg(grad C_r)|, per colour channel: an edge of the reflection should
    not appear in the transmission. No gradient reaches the reflection. C_t is the image without any pane, also where
    panes are seen through one another. H leaves out the pixels where the reflection ends or passes to another pane's:
    that edge is the pane's own, and the frame behind it has every right to be there.

    Slopes per pixel are steeper in a smaller photograph of the same view. The loss is scaled to what it would be in
    one of `PAPER_PIXELS`, so that one weight serves photographs of any size.
    """
    layers = frame.layers
    hit = layers["inner"]
    size = (hit.numel() / PAPER_PIXELS) ** SIZE_POWER
    return size * shared_edges(layers["without_panes"], layers["reflection"], hit)


def mask_loss(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Reflection mask loss L_m (TR-Gaussians, Eq. 16), on annotated views only."""
    if view.pane_labels is None:
        return None
    annotated = moved(view.pane_labels > 0, frame.rgb.device).to(frame.rgb.dtype)
    return (frame.layers["mask"] - annotated).abs().mean()


def intensity_departure(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Mean square of log a(u) over the Gaussians: how far reflections are from as bright as what they mirror.

    A dim reflection of a bright thing looks like a bright reflection by a pane of lower R0. Photographs tell the two
    apart by little; this decides where they do not (not in the paper).
    """
    return scene.primary.channels["log_intensity"].square().mean()


def tint_departure(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Mean square of the logarithms of the panes' transmittances: how far the glass is from clear (not in the paper).

    Where all that is behind a pane is seen through it, its tint may as well be that of the things.
    """
    logarithms = scene.planes.log_transmittances
    return None if logarithms is None or not len(logarithms) else logarithms.square().mean()
