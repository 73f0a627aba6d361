"""Texels of cube maps on the CPU: padding the faces, and summing gradients in an order that no thread count changes.

Lookups are sorted by the row of cells that they begin in. Each row of the gradient is then one task, which goes through
the lookups that begin in it and in the row before, in the order of their numbers.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths_cube import edge_maths
from glassplat.kernels.tensor_checks import REAL_OF

NO_LOOKUP = np.int32(-1)
"""Stands for the first cell where nothing was looked up."""


def padded_faces(texels: Tensor) -> Tensor:
    """Faces [6, S + 2, S + 2, D] with a ring of their neighbours' texels, as the twin's."""
    size, depth = texels.shape[1], texels.shape[3]
    padded = texels.new_empty(6, size + 2, size + 2, depth)
    pad_faces(REAL_OF[texels.dtype])(texels.numpy(), padded.numpy())
    return padded


def texel_gradients(first_cells: Tensor, fractions: Tensor, gradients: Tensor, size: int) -> Tensor:
    """Gradient [6, S, S, D] of the texels.

    Args:
        first_cells: [P] int32 flat index of the first of the four cells that each lookup blends, or `NO_LOOKUP`.
        fractions: [P, 2] of the way to the next column and to the next row.
        gradients: [P, D] gradient of each lookup's result.
        size: texels along the side of a face, S.
    """
    real, side, depth = REAL_OF[gradients.dtype], size + 2, gradients.shape[1]
    starts = torch.zeros(6 * side + 1, dtype=torch.int64)
    order = torch.empty(first_cells.shape[0], dtype=torch.int32)
    sort_lookups(real)(first_cells.numpy(), side, starts.numpy(), order.numpy())
    padded = gradients.new_zeros(6, side, side, depth)
    lookups = (first_cells.numpy(), fractions.numpy(), gradients.numpy())
    sum_lookups(real)(*lookups, starts.numpy(), order.numpy(), padded.numpy())
    texels = gradients.new_empty(6, size, size, depth)
    fold_faces(real)(padded.numpy(), texels.numpy())
    return texels


@cache
def pad_faces(real: type) -> Kernel:
    """Fills padded faces from texels."""
    over_column, over_row = edge_maths()
    third = real(1.0 / 3.0)

    @kernel("cube_pad_faces", real)
    def pad(texels, padded):
        size, depth = texels.shape[1], texels.shape[3]
        for task in prange(6 * (size + 2)):
            face, row = task // (size + 2), task % (size + 2) - 1
            low, outside = 1 if row < 0 else 0, row < 0 or row == size
            inner = min(max(row, 0), size - 1)
            target = padded[face, row + 1]
            for column in range(size):
                from_face, from_row, from_column = face, inner, column
                if outside:
                    from_face, from_row, from_column = over_row(face, low, column, size)
                for d in range(depth):
                    target[column + 1, d] = texels[from_face, from_row, from_column, d]
            for side in range(2):
                column, cell = (size - 1, size + 1) if side == 0 else (0, 0)
                f, r, c = over_column(face, side, inner, size)
                g, s, e = over_row(face, low, column, size)
                for d in range(depth):
                    beside = texels[f, r, c, d]
                    target[cell, d] = (
                        (texels[face, inner, column, d] + beside + texels[g, s, e, d]) * third if outside else beside
                    )

    return pad


@cache
def sort_lookups(real: type) -> Kernel:
    """Fills the order of the lookups, without those of nothing, and where each row of cells begins in it."""

    @kernel("cube_sort_lookups", real, parallel=False)
    def sort(first_cells, side, starts, order):
        for lookup in range(first_cells.size):
            if first_cells[lookup] >= 0:
                starts[first_cells[lookup] // side + 1] += 1
        for row in range(starts.size - 1):
            starts[row + 1] += starts[row]
        # Filling moves each row's start to its end, which is the start of the next row.
        for lookup in range(first_cells.size):
            if first_cells[lookup] >= 0:
                row = first_cells[lookup] // side
                order[starts[row]] = lookup
                starts[row] += 1
        for row in range(starts.size - 1, 0, -1):
            starts[row] = starts[row - 1]
        starts[0] = 0

    return sort


@cache
def sum_lookups(real: type) -> Kernel:
    """Adds to padded faces, which start at zero, the gradients of the lookups."""
    one = real(1.0)

    @kernel("cube_sum_lookups", real)
    def add(first_cells, fractions, gradients, starts, order, padded):
        side, depth = padded.shape[1], padded.shape[3]
        rows = 6 * side
        cells = padded.reshape(rows, side * depth)
        stride = even_stride(rows)
        for task in prange(rows):
            row = task * stride % rows
            target = cells[row]
            # No lookup begins in a face's last row, so that none reaches over from the face before.
            for begin in range(max(row - 1, 0), row + 1):
                for position in range(starts[begin], starts[begin + 1]):
                    lookup = order[position]
                    along, down = fractions[lookup, 0], fractions[lookup, 1]
                    weight = one - down if begin == row else down
                    left, right = weight * (one - along), weight * along
                    at = first_cells[lookup] % side * depth
                    for d in range(depth):
                        gradient = gradients[lookup, d]
                        target[at + d] += left * gradient
                        target[at + depth + d] += right * gradient

    return add


@cache
def fold_faces(real: type) -> Kernel:
    """Fills the gradient of the texels from that of the padded faces, the transpose of `pad_faces`."""
    over_column, over_row = edge_maths()
    third = real(1.0 / 3.0)

    @kernel("cube_fold_faces", real, parallel=False)
    def fold(padded, texels):
        size, depth = texels.shape[1], texels.shape[3]
        texels[:] = padded[:, 1 : size + 1, 1 : size + 1]
        for face in range(6):
            for side in range(2):
                outer, inner = (size + 1, size - 1) if side == 0 else (0, 0)
                for i in range(size):
                    f, r, c = over_column(face, side, i, size)
                    g, s, e = over_row(face, side, i, size)
                    for d in range(depth):
                        texels[f, r, c, d] += padded[face, i + 1, outer, d]
                        texels[g, s, e, d] += padded[face, outer, i + 1, d]
                for other in range(2):
                    outer_row, inner_row = (size + 1, size - 1) if other == 0 else (0, 0)
                    f, r, c = over_column(face, side, inner_row, size)
                    g, s, e = over_row(face, other, inner, size)
                    for d in range(depth):
                        share = padded[face, outer_row, outer, d] * third
                        texels[face, inner_row, inner, d] += share
                        texels[f, r, c, d] += share
                        texels[g, s, e, d] += share

    return fold
