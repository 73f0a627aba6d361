"""The definition of `cube_lookup`: a bilinear filter on faces that are padded by their neighbours' texels."""

from __future__ import annotations

import functools

import torch
from torch import Tensor


def cube_lookup(texels: Tensor, directions: Tensor) -> Tensor:
    """See `glassplat.kernels.cube_lookup.cube_lookup`."""
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
    """Face, and (column, row) among its padded texels, whose centres lie at whole numbers, of directions [..., 3]."""
    x, y, z = directions.abs().unbind(-1)
    axis = torch.where((x >= y) & (x >= z), 0, torch.where(y >= z, 1, 2))
    order = (axis[..., None] + torch.arange(3, device=axis.device)) % 3
    major, u, v = directions.gather(-1, order).unbind(-1)
    scale = 0.5 * size / major.abs()
    return 2 * axis + (major < 0), u * scale + 0.5 * (size + 1), v * scale + 0.5 * (size + 1)


def padded_faces(texels: Tensor) -> Tensor:
    """Faces [6, S + 2, S + 2, D] with a ring of their neighbours' texels; at a corner, the mean of the three there."""
    size = texels.shape[1]
    first, second, third = (texels.flatten(0, 2)[index] for index in neighbours(size, texels.device))
    in_ring = torch.arange(size + 2, device=texels.device) % (size + 1) == 0
    corner = (in_ring[:, None] & in_ring)[..., None]
    return torch.where(corner, (first + second + third) / 3, first)


@functools.lru_cache(maxsize=8)
def neighbours(size: int, device: torch.device) -> Tensor:
    """Flat texel indices [3, 6, S + 2, S + 2] of what padded texels show: three at a corner, elsewhere one, thrice.

    Face 2 a + s looks along axis a, to the negative side for s = 1; its columns run along axis a + 1, its rows along
    a + 2 (mod 3). Beyond its edge towards axis a + 1, it continues on that axis' face, whose columns run along axis
    a + 2 and whose rows along a: the same row here is the same column there, in the row at the edge that is shared.
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
