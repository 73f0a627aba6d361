"""Builds the hierarchy of boxes through which rays find Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.devices import kernels_for
from glassplat.kernels.trace.records import Bvh, Shapes


@torch.no_grad()
def build_bvh(shapes: Shapes, *, flat: bool, order: Tensor | None = None) -> Bvh:
    """Orders Gaussians along a curve through space, and puts boxes around eight of them, around eight boxes, and so on.

    A Gaussian that rays meet nowhere gets an empty box: its opacity is too low, or something of it is not finite.

    Args:
        shapes: activated Gaussians, float32 or float64.
        flat: whether they are discs.
        order: [N] int32, of an earlier hierarchy: refits its boxes, which stays exact however far Gaussians have moved,
            and fast to search while the order still holds.
    """
    return kernels_for("build_bvh", shapes.means.device).build_bvh(shapes, flat=flat, order=order)
