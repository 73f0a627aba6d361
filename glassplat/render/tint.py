"""Images of reflections with a colour, from the blended excess of their strengths over the grey one."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.scene.gaussians import Gaussians
from glassplat.scene.tint import excess_strengths, has_tint

LEAST_STRENGTH = 1 / 512
"""A pixel that reflects less shows no tint."""


def further_channels(gaussians: Gaussians, depths: Tensor | None) -> Tensor | None:
    """What is blended beside colour, normal and strength: depths [N, 1] and the excess [N, 3], where there are any."""
    parts = [] if depths is None else [depths]
    if has_tint(gaussians):
        parts.append(excess_strengths(gaussians))
    return torch.cat(parts, dim=1) if parts else None


def tinted(rgb: Tensor, base: Tensor, reflection: Tensor, excess: Tensor) -> Tensor:
    """A shaded image [H, W, 3] with the colour of its reflections; nothing changes where the reflection is 0."""
    return rgb + torch.where(reflection > 0, excess * (reflection - base), 0)


@torch.no_grad()
def tint_layer(strength: Tensor, excess: Tensor | None) -> Tensor:
    """[H, W, 3] strengths of red, green and blue as multiples of the strength [H, W]; 1 where nothing reflects."""
    white = torch.ones_like(strength)[..., None].expand(*strength.shape, 3)
    if excess is None:
        return white.clone()
    share = strength[..., None].detach()
    return torch.where(share > LEAST_STRENGTH, 1 + excess / share.clamp(min=LEAST_STRENGTH), white)
