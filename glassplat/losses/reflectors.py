"""Where the Gaussians may reflect (3DGS-DR, Section 4), and what it costs them."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.data.dataset import View
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene


def strength_outside(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Mean reflection strength of the Gaussians outside of the environment's region; None where it has none.

    What only a few views saw looks reflective, because nothing contradicts it, and would spoil the environment.
    """
    if scene.environment.region is None:
        return None
    means = scene.primary.means.detach()
    *center, radius = scene.environment.region
    outside = (means - means.new_tensor(center)).norm(dim=1) > radius
    strengths = torch.sigmoid(scene.primary.channels["logit_strength"])
    return (strengths * outside).sum() / outside.sum().clamp(min=1)


def mean_strength(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Mean reflection strength of all Gaussians: a price, so that what a colour explains as well does not reflect."""
    return torch.sigmoid(scene.primary.channels["logit_strength"]).mean()
