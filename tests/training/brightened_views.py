"""Photographs that differ from each other in one half."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.captures.view import View
from glassplat.scene.camera import Camera


def brightened_views(base: Tensor, camera: Camera, grey: float, *left: float) -> list[View]:
    """Photographs [H, W, 3] of a uniformly grey object, each with the left half brighter by the given amount."""
    photos = []
    for brighter in left:
        photo = base.clone()
        photo[:, : camera.width // 2] *= 1 + brighter / grey
        photos.append((255 * photo).round().to(torch.uint8))
    return [View.in_memory(f"{number}.png", camera, photo=photo) for number, photo in enumerate(photos)]
