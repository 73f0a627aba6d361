"""Layers of a frame as people look at them."""

from __future__ import annotations

from torch import Tensor

from glassplat.evaluate.colormap import depth_colors, normal_colors
from glassplat.render.frame import Frame


def layer_image(frame: Frame, layer: str) -> Tensor:
    """A layer as an image [H, W] or [H, W, 3] in [0, 1]; depth is colour-mapped (near bright), normals (n + 1) / 2."""
    if layer in ("rgb", "photographed"):
        image: Tensor = getattr(frame, layer)
        return image.clamp(0, 1)
    image = frame.layers[layer]
    if layer == "normal":
        return normal_colors(image)
    if layer in ("depth", "median_depth"):
        return depth_colors(image, frame.layers["alpha"])
    return image.clamp(0, 1)
