"""The definition of `blend_panes`: the equations, pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from glassplat.kernels.color_space import linear_from_srgb, srgb_from_linear
from glassplat.kernels.fresnel import Fresnel
from glassplat.kernels.pane_hits.reference import ray_grid
from glassplat.kernels.panes import BlendedPanes


def two_surfaces(base: Tensor, cosine: Tensor) -> Tensor:
    """Snell's and Fresnel's laws at a surface, for both polarisations, and light going to and fro between two."""
    one_surface = torch.sqrt(base / (2 - base))
    inverse_index = (1 - one_surface) / (1 + one_surface)
    inside = torch.sqrt(1 - inverse_index**2 * (1 - cosine**2))
    across = ((inverse_index * cosine - inside) / (inverse_index * cosine + inside)) ** 2
    along = ((cosine - inverse_index * inside) / (cosine + inverse_index * inside)) ** 2
    return across / (1 + across) + along / (1 + along)


REFLECTANCE: dict[Fresnel, Callable[[Tensor, Tensor], Tensor]] = {
    "pane": two_surfaces,
    "schlick": lambda base, cosine: base + (1 - base) * (1 - cosine) ** 5,
    "none": lambda base, cosine: base,
}


def blend_panes(
    transmission: Tensor, mask: Tensor, reflections: Tensor, pane: Tensor,
    normals: Tensor, base_reflectances: Tensor, intrinsics: Tensor,
    *, fresnel: Fresnel = "pane", intensity: bool = True, linear: bool = True,
) -> BlendedPanes:  # fmt: skip
    """See `glassplat.kernels.blend_panes.blend_panes`."""
    height, width = mask.shape
    rays = torch.nn.functional.normalize(ray_grid(intrinsics, width, height), dim=-1)
    strength, reflection = torch.zeros_like(mask), torch.zeros_like(transmission)
    for k in range(len(normals)):
        shown = (pane == k) & (mask > 0)
        cosine = (rays @ normals[k]).abs().clamp(max=1)
        base = base_reflectances[k]
        strength = torch.where(shown, REFLECTANCE[fresnel](base, cosine) * mask, strength)
        gain = 1 + reflections[k, ..., 3:] if intensity else torch.ones_like(mask)[..., None]
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
