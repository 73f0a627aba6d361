"""Looks up a cube map in directions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.devices import kernels_for
from glassplat.kernels.tensor_checks import check_tensors


def cube_lookup(texels: Tensor, directions: Tensor) -> Tensor:
    """What a cube map shows in directions, by a bilinear filter without seams.

    Faces are +x, -x, +y, -y, +z, -z. On a face of axis a (x, y, z = 0, 1, 2), on either side, columns run along axis
    a + 1 and rows along a + 2, counted round:

        faces       columns towards    rows towards
        +x, -x      +y                 +z
        +y, -y      +z                 +x
        +z, -z      +x                 +y

    A direction d meets the face of its largest coordinate at u = d[a + 1] / |d[a]|, v = d[a + 2] / |d[a]| in [-1, 1];
    texel i has its centre at (2 i + 1) / S - 1. The filter blends the four nearest texels. Across an edge these are
    the neighbouring face's; at a corner of the cube, where only three meet, their mean stands for the fourth. So the
    result is continuous everywhere, and equal for both faces at an edge.

    Differentiable in `texels` and `directions`; the gradient of a direction is orthogonal to it.

    Args:
        texels: [6, S, S, D] faces, rows, columns; S of at least 1.
        directions: [..., 3] in the cube's axes, of any positive length. Where a direction is 0, NaN or infinite, so
            that there is nothing to look up, the result is NaN.

    Returns:
        [..., D] blended texels.

    Raises:
        ValueError: shapes disagree, or the map has no texels.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    check_cube(texels)
    check_tensors({"texels": (texels, tuple(texels.shape)), "directions": (directions, (*directions.shape[:-1], 3))})
    found: Tensor = _CubeLookup.apply(texels, directions.reshape(-1, 3))
    return found.reshape(*directions.shape[:-1], texels.shape[3])


def check_cube(texels: Tensor) -> None:
    """Raises unless a tensor has the shape of a cube map with texels."""
    shape = tuple(texels.shape)
    if len(shape) != 4 or shape[0] != 6 or shape[1] != shape[2] or shape[1] < 1:
        raise ValueError(f"texels has shape {shape}; expected (6, S, S, D), six square faces of at least one texel")


class _CubeLookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, texels: Tensor, directions: Tensor) -> Tensor:
        inputs = (texels.detach().contiguous(), directions.detach().contiguous())
        ctx.save_for_backward(*inputs)
        found: Tensor = kernels_for("cube_lookup", texels.device).cube_lookup(*inputs)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_found: Tensor) -> tuple[Tensor, Tensor]:
        texels, directions = ctx.saved_tensors
        kernels = kernels_for("cube_lookup", texels.device)
        gradients: tuple[Tensor, Tensor] = kernels.cube_lookup_gradients(texels, directions, v_found.contiguous())
        return gradients
