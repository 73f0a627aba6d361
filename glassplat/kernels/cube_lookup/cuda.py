"""Cube maps on the GPU: one thread for each direction."""

from __future__ import annotations

from functools import cache

import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.cube_lookup.cuda_texels import padded_faces, texel_gradients
from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.maths.cube import cube_maths
from glassplat.kernels.tensor_checks import REAL_OF

THREADS = 128


def cube_lookup(texels: Tensor, directions: Tensor) -> Tensor:
    """As `glassplat.kernels.cube_lookup.cpu.cube_lookup`."""
    count = directions.shape[0]
    found = texels.new_empty(count, texels.shape[3])
    kernel_of = cube_lookup_forward(REAL_OF[texels.dtype])
    kernel_of(blocks_for(count, THREADS), THREADS, padded_faces(texels), directions, found)
    return found


def cube_lookup_gradients(texels: Tensor, directions: Tensor, cotangents: Tensor) -> tuple[Tensor, Tensor]:
    """As `glassplat.kernels.cube_lookup.cpu.cube_lookup_gradients`."""
    count = directions.shape[0]
    v_directions, fractions = torch.empty_like(directions), directions.new_empty(count, 2)
    first_cells = torch.empty(count, dtype=torch.int32, device=directions.device)
    cube_lookup_backward(REAL_OF[texels.dtype])(
        blocks_for(count, THREADS), THREADS,
        padded_faces(texels), directions, cotangents, v_directions, first_cells, fractions,
    )  # fmt: skip
    return texel_gradients(first_cells, fractions, cotangents, texels.shape[1]), v_directions


@cache
def cube_lookup_forward(real: type) -> Kernel:
    """Fills what padded faces show."""
    maths = cube_maths(real)
    on_face, cell, between = maths.on_face, maths.cell, maths.between

    @kernel("cube_lookup_forward", real, "real4 real2 real2")
    def forward(padded, directions, found):
        i, size = cuda.grid(1), padded.shape[1] - 2
        if i >= directions.shape[0]:
            return
        _, face, u, v, _ = on_face(directions[i, 0], directions[i, 1], directions[i, 2])
        column, along = cell(u, size)
        row, down = cell(v, size)
        upper, lower = padded[face, row], padded[face, row + 1]
        for d in range(padded.shape[3]):
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

    @kernel("cube_lookup_backward", real, "real4 real2 real2 real2 int1 real2")
    def backward(padded, directions, v_found, v_directions, first_cells, fractions):
        i, side = cuda.grid(1), padded.shape[1]
        if i >= directions.shape[0]:
            return
        place = on_face(directions[i, 0], directions[i, 1], directions[i, 2])
        face = place[1]
        column, along = cell(place[2], side - 2)
        row, down = cell(place[3], side - 2)
        upper, lower = padded[face, row], padded[face, row + 1]
        v_along, v_down = zero, zero
        for d in range(padded.shape[3]):
            by_along, by_down = slopes(
                upper[column, d], upper[column + 1, d], lower[column, d], lower[column + 1, d], along, down
            )
            v_along += v_found[i, d] * by_along
            v_down += v_found[i, d] * by_down
        texels_per_u = half * real(side - 2)
        x, y, z = from_face(place, v_along * texels_per_u, v_down * texels_per_u)
        v_directions[i, 0], v_directions[i, 1], v_directions[i, 2] = x, y, z
        first_cells[i] = (face * side + row) * side + column
        fractions[i, 0], fractions[i, 1] = along, down

    return backward
