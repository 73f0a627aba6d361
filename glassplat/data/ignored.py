"""Comparing images with photographs of which parts do not count."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.data.view import View
from glassplat.scene.transfer import moved


def with_ignored_right(image: Tensor, view: View) -> Tensor:
    """An image [H, W, 3] that shows the photograph itself where the view ignores pixels: no error, no gradient."""
    if view.ignored is None:
        return image
    photo = moved(view.photo, image.device).to(image.dtype) / 255
    return torch.where(moved(view.ignored, image.device)[..., None], photo, image)
