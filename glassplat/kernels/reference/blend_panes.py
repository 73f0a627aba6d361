"""The definition of `blend_panes`: the equations, pixel by pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.panes import BlendedPanes
from glassplat.kernels.reference.color_space import linear_from_srgb, srgb_from_linear
from glassplat.kernels.reference.pane_hits import ray_grid


def blend_panes(
    transmission: Tensor, mask: Tensor, reflections: Tensor, pane: Tensor,
    normals: Tensor, base_reflectances: Tensor, intrinsics: Tensor,
    *, fresnel: bool = True, intensity: bool = True, linear: bool = True,
) -> BlendedPanes:  # fmt: skip
    """See `glassplat.kernels.blend_panes.blend_panes`."""
    height, width = mask.shape
    rays = torch.nn.functional.normalize(ray_grid(intrinsics, width, height), dim=-1)
    strength, reflection = torch.zeros_like(mask), torch.zeros_like(transmission)
    for k in range(len(normals)):
        shown = (pane == k) & (mask > 0)
        cosine = (rays @ normals[k]).abs().clamp(max=1)
        base = base_reflectances[k]
        raw = base + (1 - base) * (1 - cosine) ** 5 if fresnel else base
        strength = torch.where(shown, raw * mask, strength)
        gain = reflections[k, ..., 3:] if intensity else torch.ones_like(mask)[..., None]
        color = reflections[k, ..., :3]
        bright = srgb_from_linear(linear_from_srgb(color) * gain) if linear else color * gain
        reflection = torch.where(shown[..., None], bright, reflection)
    share = strength[..., None]
    if linear:
        behind, mirrored = linear_from_srgb(transmission), linear_from_srgb(reflection)
        mixed = srgb_from_linear(behind + share * (mirrored - behind))
    else:
        mixed = transmission + share * (reflection - transmission)
    return BlendedPanes(torch.where(share > 0, mixed, transmission), reflection, strength)
