"""Cube maps on the CPU, one direction at a time."""

from __future__ import annotations

from functools import cache

import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.cube_lookup.cpu_texels import padded_faces, texel_gradients
from glassplat.kernels.maths.cube import cube_maths
from glassplat.kernels.tensor_checks import REAL_OF


def cube_lookup(texels: Tensor, directions: Tensor) -> Tensor:
    """What texels [6, S, S, D] show in directions [P, 3], as [P, D]."""
    found = texels.new_empty(directions.shape[0], texels.shape[3])
    cube_lookup_forward(REAL_OF[texels.dtype])(padded_faces(texels).numpy(), directions.numpy(), found.numpy())
    return found


def cube_lookup_gradients(texels: Tensor, directions: Tensor, cotangents: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of texels and directions."""
    v_directions = torch.empty_like(directions)
    first_cells = torch.empty(directions.shape[0], 2, dtype=torch.int32)
    fractions = directions.new_empty(directions.shape[0], 2)
    inputs = (padded_faces(texels), directions, cotangents)
    outputs = (v_directions, first_cells, fractions)
    cube_lookup_backward(REAL_OF[texels.dtype])(*(tensor.numpy() for tensor in (*inputs, *outputs)))
    return texel_gradients(first_cells, fractions, cotangents, texels.shape[1]), v_directions


@cache
def cube_lookup_forward(real: type) -> Kernel:
    """Fills what padded faces show."""
    maths = cube_maths(real)
    on_face, cell, between = maths.on_face, maths.cell, maths.between

    @kernel("cube_lookup_forward", real)
    def forward(padded, directions, found):
        side, depth = padded.shape[1], padded.shape[3]
        size = side - 2
        for i in prange(directions.shape[0]):
            _, face, u, v, _ = on_face(directions[i, 0], directions[i, 1], directions[i, 2])
            column, along = cell(u, size)
            row, down = cell(v, size)
            upper, lower = padded[face, row], padded[face, row + 1]
            for d in range(depth):
                found[i, d] = between(
                    upper[column, d], upper[column + 1, d], lower[column, d], lower[column + 1, d], along, down
                )

    return forward


@cache
def cube_lookup_backward(real: type) -> Kernel:
    """Fills the gradients of the directions, and which cells each lookup blends at which fractions."""
    maths = cube_maths(real)
    on_face, from_face, cell, slopes = maths.on_face, maths.from_face, maths.cell, maths.slopes
    zero, half = real(0.0), real(0.5)

    @kernel("cube_lookup_backward", real)
    def backward(padded, directions, v_found, v_directions, first_cells, fractions):
        side, depth = padded.shape[1], padded.shape[3]
        size = side - 2
        texels_per_u = half * real(size)
        for i in prange(directions.shape[0]):
            place = on_face(directions[i, 0], directions[i, 1], directions[i, 2])
            face = place[1]
            column, along = cell(place[2], size)
            row, down = cell(place[3], size)
            upper, lower = padded[face, row], padded[face, row + 1]
            v_along, v_down = zero, zero
            for d in range(depth):
                by_along, by_down = slopes(
                    upper[column, d], upper[column + 1, d], lower[column, d], lower[column + 1, d], along, down
                )
                v_along += v_found[i, d] * by_along
                v_down += v_found[i, d] * by_down
            x, y, z = from_face(place, v_along * texels_per_u, v_down * texels_per_u)
            v_directions[i, 0], v_directions[i, 1], v_directions[i, 2] = x, y, z
            first_cells[i, 0], first_cells[i, 1] = face * side + row, column
            fractions[i, 0], fractions[i, 1] = along, down

    return backward
