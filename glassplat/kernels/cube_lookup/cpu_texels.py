"""Texels of cube maps on the CPU: padding the faces, and summing gradients in an order that no thread count changes.

Lookups are sorted by the row of cells that they begin in. Each row is then one task, which adds up what those lookups
give to the row and to the next one, in the order of their numbers and in memory of its own.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths.cube import edge_maths
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
        first_cells: [P, 2] int32 row, counted through all faces, and column of the first of the four cells that each
            lookup blends; the row is `NO_LOOKUP` where there was none.
        fractions: [P, 2] of the way to the next column and to the next row.
        gradients: [P, D] gradient of each lookup's result.
        size: texels along the side of a face, S.
    """
    real, side, depth = REAL_OF[gradients.dtype], size + 2, gradients.shape[1]
    starts = torch.zeros(6 * side + 1, dtype=torch.int64)
    order = torch.empty(first_cells.shape[0], dtype=torch.int32)
    sort_lookups(real)(first_cells.numpy(), starts.numpy(), order.numpy())
    rows = gradients.new_empty(6 * side, 2, side * depth)
    lookups = (first_cells, fractions, gradients, starts, order)
    sum_lookups(real)(*(tensor.numpy() for tensor in lookups), rows.numpy())
    texels = gradients.new_empty(6, size, size, depth)
    fold_faces(real)(rows.view(6, side, 2, side, depth).numpy(), texels.numpy())
    return texels


@cache
def pad_faces(real: type) -> Kernel:
    """Fills padded faces from texels."""
    over_column, over_row = edge_maths()
    third = real(1.0 / 3.0)

    @kernel("cube_pad_faces", real)
    def pad(texels, padded):
        size, depth = texels.shape[1], texels.shape[3]
        rows = texels.reshape(6, size, size * depth)
        padded_rows = padded.reshape(6, size + 2, (size + 2) * depth)
        for task in prange(6 * (size + 2)):
            face, row = task // (size + 2), task % (size + 2) - 1
            low, outside = 1 if row < 0 else 0, row < 0 or row == size
            inner = min(max(row, 0), size - 1)
            target = padded[face, row + 1]
            if outside:
                for column in range(size):
                    f, r, c = over_row(face, low, column, size)
                    for d in range(depth):
                        target[column + 1, d] = texels[f, r, c, d]
            else:
                # All but the ring is copied, in long runs.
                copied, to = rows[face, row], padded_rows[face, row + 1, depth : (size + 1) * depth]
                for i in range(to.size):
                    to[i] = copied[i]
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
    def sort(first_cells, starts, order):
        for lookup in range(order.size):
            row = first_cells[lookup, 0]
            if row >= 0:
                starts[row + 1] += 1
        for row in range(starts.size - 1):
            starts[row + 1] += starts[row]
        # Filling moves each row's start to its end, which is the start of the next row.
        for lookup in range(order.size):
            row = first_cells[lookup, 0]
            if row >= 0:
                order[starts[row]] = lookup
                starts[row] += 1
        for row in range(starts.size - 1, 0, -1):
            starts[row] = starts[row - 1]
        starts[0] = 0

    return sort


@cache
def sum_lookups(real: type) -> Kernel:
    """Fills rows of cells [R, 2, floats] with what the lookups that begin in a row add to it and to the next one."""
    zero, one = real(0.0), real(1.0)

    @kernel("cube_sum_lookups", real)
    def add(first_cells, fractions, gradients, starts, order, rows):
        depth = gradients.shape[1]
        stride = even_stride(rows.shape[0])
        for task in prange(rows.shape[0]):
            row = task * stride % rows.shape[0]
            here, below = rows[row, 0], rows[row, 1]
            here[:], below[:] = zero, zero
            for position in range(starts[row], starts[row + 1]):
                lookup = order[position]
                along, down = fractions[lookup, 0], fractions[lookup, 1]
                at = first_cells[lookup, 1] * depth
                for d in range(depth):
                    upper, lower = (one - down) * gradients[lookup, d], down * gradients[lookup, d]
                    here[at + d] += (one - along) * upper
                    here[at + depth + d] += along * upper
                    below[at + d] += (one - along) * lower
                    below[at + depth + d] += along * lower

    return add


@cache
def fold_faces(real: type) -> Kernel:
    """Fills the gradient of the texels from sums [6, S + 2, 2, S + 2, D], the transpose of `pad_faces`."""
    over_column, over_row = edge_maths()
    third = real(1.0 / 3.0)

    @inlined
    def cell(sums, face, row, column, d):
        """The gradient of a cell, which lookups that begin in the row before add to as well."""
        found = sums[face, row, 0, column, d]
        return found + sums[face, row - 1, 1, column, d] if row > 0 else found

    @kernel("cube_fold_faces", real)
    def fold(sums, texels):
        size, depth = texels.shape[1], texels.shape[3]
        for task in prange(6 * size):
            face, row = task // size, task % size
            for column in range(size):
                for d in range(depth):
                    texels[face, row, column, d] = cell(sums, face, row + 1, column + 1, d)
        for face in range(6):
            for side in range(2):
                outer, inner = (size + 1, size - 1) if side == 0 else (0, 0)
                for i in range(size):
                    f, r, c = over_column(face, side, i, size)
                    g, s, e = over_row(face, side, i, size)
                    for d in range(depth):
                        texels[f, r, c, d] += cell(sums, face, i + 1, outer, d)
                        texels[g, s, e, d] += cell(sums, face, outer, i + 1, d)
                for other in range(2):
                    outer_row, inner_row = (size + 1, size - 1) if other == 0 else (0, 0)
                    f, r, c = over_column(face, side, inner_row, size)
                    g, s, e = over_row(face, other, inner, size)
                    for d in range(depth):
                        share = cell(sums, face, outer_row, outer, d) * third
                        texels[face, inner_row, inner, d] += share
                        texels[f, r, c, d] += share
                        texels[g, s, e, d] += share

    return fold
