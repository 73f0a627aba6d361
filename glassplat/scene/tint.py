"""Reflections with a colour: red, green and blue mirrored more or less strongly than the reflection strength says.

Gold mirrors red light almost wholly and blue light by half: a share for each primary, and what is not mirrored of it is
left to the surface's own colour.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from glassplat.scene.gaussians import Gaussians

TINT = ("logit_tint_red", "logit_tint_green", "logit_tint_blue")
"""Channels: what is added to the logit of the strength, but for the mean of the three. Without them a reflection is
white."""


def has_tint(gaussians: Gaussians) -> bool:
    """Whether the reflections of a set have a colour."""
    return all(name in gaussians.channels for name in TINT)


def with_tint(gaussians: Gaussians) -> Gaussians:
    """The same set with reflections that are still white, but may learn a colour."""
    if has_tint(gaussians):
        return gaussians
    white = {name: torch.zeros_like(gaussians.logit_opacities) for name in TINT}
    return replace(gaussians, channels={**gaussians.channels, **white})


def logit_tints(gaussians: Gaussians) -> Tensor:
    """[N, 3] what the logits of the strengths of red, green and blue have beyond their mean; its own mean is 0."""
    raw = torch.stack([gaussians.channels[name] for name in TINT], dim=1)
    return raw - raw.mean(dim=1, keepdim=True)


def excess_strengths(gaussians: Gaussians) -> Tensor:
    """[N, 3] by how much red, green and blue are mirrored more strongly than the strength says; negative where less."""
    logits = gaussians.channels["logit_strength"][:, None]
    return torch.sigmoid(logits + logit_tints(gaussians)) - torch.sigmoid(logits)
