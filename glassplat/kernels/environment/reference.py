"""The definition of the operations on surfaces and cube maps, in PyTorch."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from glassplat.kernels.panes.reference import ray_grid
from glassplat.kernels.project.reference import rotations
from glassplat.kernels.records import NORMAL_AT, NORMAL_MIN, STRENGTH_AT, Shaded


def surface_channels(
    colors: Tensor,
    radii: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    means: Tensor,
    logit_strengths: Tensor,
    camera_center: Tensor,
    extra: Tensor | None = None,
) -> Tensor:
    """See `glassplat.kernels.environment.surface_channels`."""
    squared = quats.detach().square().sum(-1, keepdim=True)
    usable = (squared > 0) & squared.isfinite()
    shortest = log_scales.detach().argmin(dim=-1)
    axes = rotations(torch.where(usable, quats, torch.ones_like(quats)))
    normals = axes.gather(-1, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    away = ((camera_center - means).detach() * normals.detach()).sum(-1, keepdim=True) < 0
    normals = torch.where(usable, torch.where(away, -normals, normals), 0)
    parts = [colors, normals, torch.sigmoid(logit_strengths)[:, None], *([] if extra is None else [extra])]
    return torch.where(radii[:, :1] > 0, torch.cat(parts, dim=-1), 0)


def cube_lookup(texels: Tensor, directions: Tensor) -> Tensor:
    """See `glassplat.kernels.environment.cube_lookup`."""
    size, depth = texels.shape[1], texels.shape[3]
    padded = padded_faces(texels).reshape(-1, depth)
    face, column, row = face_positions(directions, size)
    first_column, first_row = (
        position.detach().nan_to_num(0).clamp(0.5, size + 0.5).long() for position in (column, row)
    )
    along, down = (column - first_column)[..., None], (row - first_row)[..., None]
    corner = (face * (size + 2) + first_row) * (size + 2) + first_column
    upper = padded[corner] * (1 - along) + padded[corner + 1] * along
    lower = padded[corner + size + 2] * (1 - along) + padded[corner + size + 3] * along
    return upper * (1 - down) + lower * down


def face_positions(directions: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Face and (column, row) of directions [..., 3] among padded texels, whose centres are at whole numbers."""
    x, y, z = directions.abs().unbind(-1)
    axis = torch.where((x >= y) & (x >= z), 0, torch.where(y >= z, 1, 2))
    order = (axis[..., None] + torch.arange(3, device=axis.device)) % 3
    major, u, v = directions.gather(-1, order).unbind(-1)
    scale = 0.5 * size / major.abs()
    return 2 * axis + (major < 0), u * scale + 0.5 * (size + 1), v * scale + 0.5 * (size + 1)


def padded_faces(texels: Tensor) -> Tensor:
    """Faces [6, S + 2, S + 2, D] with a ring of their neighbours' texels; a corner is the mean of three."""
    size = texels.shape[1]
    first, second, third = (texels.flatten(0, 2)[index] for index in neighbours(size, texels.device))
    in_ring = torch.arange(size + 2, device=texels.device) % (size + 1) == 0
    corner = (in_ring[:, None] & in_ring)[..., None]
    return torch.where(corner, (first + second + third) / 3, first)


@functools.lru_cache(maxsize=8)
def neighbours(size: int, device: torch.device) -> Tensor:
    """Flat indices [3, 6, S + 2, S + 2] of the sources of padded texels: three at a corner, elsewhere one, repeated.

    Face 2 a + s belongs to axis a, on the negative side for s = 1; its columns run along axis a + 1, its rows along
    a + 2 (mod 3). Beyond its edge towards axis a + 1, it continues on that axis' face, whose columns run along axis a +
    2 and whose rows along a: a row here becomes the column of the same index there, in the row at the shared edge.
    """
    sequence = torch.arange(-1, size + 1, device=device)
    outside = ((sequence < 0) | (sequence == size)).long()
    side = (sequence < 0).long()
    inside = sequence.clamp(0, size - 1)
    face = torch.arange(6, device=device)[:, None, None]
    axis, far = face // 2, (1 - face % 2) * (size - 1)
    row, column = inside[None, :, None], inside[None, None, :]
    own = (face * size + row) * size + column
    over_column = ((2 * ((axis + 1) % 3) + side[None, None, :]) * size + far) * size + row
    over_row = ((2 * ((axis + 2) % 3) + side[None, :, None]) * size + column) * size + far
    beyond_column, beyond_row = outside[None, None, :].bool(), outside[None, :, None].bool()
    corner = beyond_column & beyond_row
    first = torch.where(beyond_column & ~corner, over_column, torch.where(beyond_row & ~corner, over_row, own))
    return torch.stack([first, torch.where(corner, over_column, first), torch.where(corner, over_row, first)])


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
    """See `glassplat.kernels.environment.shade_environment`."""
    height, width = alpha.shape
    normals, strength = blended[..., NORMAL_AT:STRENGTH_AT], blended[..., STRENGTH_AT]
    base = blended[..., :NORMAL_AT] + (1 - alpha)[..., None] * blended.new_tensor(background)
    rays = ray_grid(intrinsics.detach(), width, height) @ world_from_cam.T
    bare = (normals.square().sum(-1, keepdim=True) <= NORMAL_MIN**2) | (strength.abs() < least_strength)[..., None]
    # The ray replaces a missing normal: a NaN that is masked afterwards would still reach the gradients.
    safe = torch.where(bare, rays, normals)
    # The lookup accepts directions of any length, so that neither the ray nor the normal must be normalised.
    mirrored = safe.square().sum(-1, keepdim=True) * rays - 2 * (rays * safe).sum(-1, keepdim=True) * safe
    reflection = torch.where(bare, 0, torch.sigmoid(cube_lookup(texels, mirrored)))
    return Shaded(torch.where(bare, base, base + strength[..., None] * (reflection - base)), base, reflection)
