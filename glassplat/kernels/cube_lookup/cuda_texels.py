"""Texels of cube maps on the GPU: padding the faces, and summing gradients without atomics.

Lookups are sorted by the cell that they begin in. One warp adds up those of a cell, each thread every 32nd of them, and
joins its sums in a tree; then one thread for each texel gathers from the cells that show it. The order of every sum
follows from the lookups alone, so that the bits are the same in every run. The sort costs less than it would cost to
let many lookups wait for one texel, as happens where surfaces magnify the environment.
"""

from __future__ import annotations

from functools import cache

import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.maths.cube import edge_maths
from glassplat.kernels.tensor_checks import REAL_OF

THREADS = 128
WARP = 32


def padded_faces(texels: Tensor) -> Tensor:
    """Faces [6, S + 2, S + 2, D] with a ring of their neighbours' texels, as the twin's."""
    size, depth = texels.shape[1], texels.shape[3]
    padded = texels.new_empty(6, size + 2, size + 2, depth)
    pad_faces(REAL_OF[texels.dtype])(blocks_for(padded.numel(), THREADS), THREADS, texels, padded)
    return padded


def texel_gradients(first_cells: Tensor, fractions: Tensor, gradients: Tensor, size: int) -> Tensor:
    """Gradient [6, S, S, D] of the texels.

    Args:
        first_cells: [P] int32 flat index, among padded texels, of the first of the four cells that each lookup blends;
            6 (S + 2)^2 where there was none.
        fractions: [P, 2] of the way to the next column and to the next row.
        gradients: [P, D] gradient of each lookup's result.
        size: texels along the side of a face, S.
    """
    real, depth, count = REAL_OF[gradients.dtype], gradients.shape[1], 6 * (size + 2) ** 2
    by_cell, order = torch.sort(first_cells, stable=True)
    edges = torch.arange(count + 1, dtype=by_cell.dtype, device=by_cell.device)
    starts = torch.searchsorted(by_cell, edges)
    sums = gradients.new_zeros(count, 4, depth)
    sum_lookups(real)(count, WARP, fractions, gradients, starts, order, sums)
    texels = gradients.new_empty(6, size, size, depth)
    fold_faces(real)(blocks_for(texels.numel(), THREADS), THREADS, sums.view(6, size + 2, size + 2, 4 * depth), texels)
    return texels


@cache
def pad_faces(real: type) -> Kernel:
    """Fills padded faces from texels, one thread for each number."""
    over_column, over_row = edge_maths()
    third = real(1.0 / 3.0)

    @kernel("cube_pad_faces", real, "real4 real4")
    def pad(texels, padded):
        i, side, depth = cuda.grid(1), padded.shape[1], padded.shape[3]
        if i >= padded.size:
            return
        d, column, row, face = i % depth, i // depth % side, i // depth // side % side, i // depth // side // side
        size = side - 2
        inner_row, inner_column = min(max(row - 1, 0), size - 1), min(max(column - 1, 0), size - 1)
        beyond_row, beyond_column = row == 0 or row > size, column == 0 or column > size
        found = texels[face, inner_row, inner_column, d]
        if beyond_row or beyond_column:
            f, r, c = over_column(face, 1 if column == 0 else 0, inner_row, size)
            g, s, e = over_row(face, 1 if row == 0 else 0, inner_column, size)
            if beyond_row and beyond_column:
                found = (found + texels[f, r, c, d] + texels[g, s, e, d]) * third
            else:
                found = texels[g, s, e, d] if beyond_row else texels[f, r, c, d]
        padded[face, row, column, d] = found

    return pad


@cache
def sum_lookups(real: type) -> Kernel:
    """Fills what the lookups that begin in a cell give to it, the next column, the next row and both [cells, 4, D]."""
    zero, one = real(0.0), real(1.0)

    @kernel("cube_sum_lookups", real, "real2 real2 long1 long1 real3")
    def add(fractions, gradients, starts, order, sums):
        shared = cuda.shared.array((4, WARP), real)
        cell, t = cuda.blockIdx.x, cuda.threadIdx.x
        begin, end = starts[cell], starts[cell + 1]
        if begin == end:
            return
        for d in range(gradients.shape[1]):
            for corner in range(4):
                shared[corner, t] = zero
            for position in range(begin + t, end, WARP):
                lookup = order[position]
                along, down, v = fractions[lookup, 0], fractions[lookup, 1], gradients[lookup, d]
                upper, lower = (one - down) * v, down * v
                shared[0, t] += (one - along) * upper
                shared[1, t] += along * upper
                shared[2, t] += (one - along) * lower
                shared[3, t] += along * lower
            step = WARP // 2
            while step > 0:
                cuda.syncthreads()
                if t < step:
                    for corner in range(4):
                        shared[corner, t] += shared[corner, t + step]
                step //= 2
            if t == 0:
                for corner in range(4):
                    sums[cell, corner, d] = shared[corner, 0]
            # The others go on to the next channel, and into what has just been read, only now.
            cuda.syncthreads()

    return add


@cache
def fold_faces(real: type) -> Kernel:
    """Fills the gradient of the texels from sums [6, S + 2, S + 2, 4 D]: the transpose of `pad_faces`, gathered."""
    third = real(1.0 / 3.0)

    @inlined
    def cell(sums, face, row, column, d):
        """The gradient of a padded texel, from the lookups that begin in it, beside it, above it and above beside."""
        depth = sums.shape[3] // 4
        found = sums[face, row, column, d]
        if column > 0:
            found += sums[face, row, column - 1, depth + d]
        if row > 0:
            found += sums[face, row - 1, column, 2 * depth + d]
            if column > 0:
                found += sums[face, row - 1, column - 1, 3 * depth + d]
        return found

    @inlined
    def is_end(at, side, size):
        """Whether a texel is the last of its row or column, for side = 0, or the first."""
        return at == (1 - side) * (size - 1)

    @kernel("cube_fold_faces", real, "real4 real4")
    def fold(sums, texels):
        i, size, depth = cuda.grid(1), texels.shape[1], texels.shape[3]
        if i >= texels.size:
            return
        d, column, row, face = i % depth, i // depth % size, i // depth // size % size, i // depth // size // size
        axis, outer = face // 2, (1 - face % 2) * (size + 1)
        found = cell(sums, face, row + 1, column + 1, d)
        # Where this face goes on beyond an edge: the inverse of `over_column` for the first loop, of `over_row` for
        # the second one. A corner's mean is shown by all three faces that meet there.
        for side in range(2):
            if is_end(row, side, size):
                beside = 2 * ((axis + 2) % 3) + side
                found += cell(sums, beside, column + 1, outer, d)
                for other in range(2):
                    if is_end(column, other, size):
                        far = (1 - other) * (size + 1)
                        found += third * cell(sums, beside, far, outer, d)
                        found += third * cell(sums, face, (1 - side) * (size + 1), far, d)
        for side in range(2):
            if is_end(column, side, size):
                beside = 2 * ((axis + 1) % 3) + side
                found += cell(sums, beside, outer, row + 1, d)
                for other in range(2):
                    if is_end(row, other, size):
                        found += third * cell(sums, beside, outer, (1 - other) * (size + 1), d)
        texels[face, row, column, d] = found

    return fold
