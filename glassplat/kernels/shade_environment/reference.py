"""The definition of `shade_environment`: the equation, pixel by pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.cube_lookup.reference import cube_lookup
from glassplat.kernels.pane_hits.reference import ray_grid
from glassplat.kernels.shade_environment.shaded import NORMAL_AT, NORMAL_MIN, STRENGTH_AT, Shaded


def shade_environment(
    blended: Tensor,
    alpha: Tensor,
    texels: Tensor,
    intrinsics: Tensor,
    world_from_cam: Tensor,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    least_strength: float = 0.0,
) -> Shaded:
    """See `glassplat.kernels.shade_environment.shade_environment`."""
    height, width = alpha.shape
    normals, strength = blended[..., NORMAL_AT:STRENGTH_AT], blended[..., STRENGTH_AT]
    base = blended[..., :NORMAL_AT] + (1 - alpha)[..., None] * blended.new_tensor(background)
    rays = ray_grid(intrinsics.detach(), width, height) @ world_from_cam.T
    bare = (normals.square().sum(-1, keepdim=True) <= NORMAL_MIN**2) | (strength.abs() < least_strength)[..., None]
    # Where there is no normal, a harmless one stands in: a NaN masked afterwards would still reach the gradients.
    safe = torch.where(bare, rays, normals)
    # The lookup takes a direction of any length, so that neither the ray nor the normal needs to be of length 1.
    mirrored = safe.square().sum(-1, keepdim=True) * rays - 2 * (rays * safe).sum(-1, keepdim=True) * safe
    reflection = torch.where(bare, 0, torch.sigmoid(cube_lookup(texels, mirrored)))
    return Shaded(torch.where(bare, base, base + strength[..., None] * (reflection - base)), base, reflection)
