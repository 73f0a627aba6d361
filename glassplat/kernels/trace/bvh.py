"""Order of Gaussians along a space-filling curve, and the boxes around them.

On a Hilbert curve, any run of points fills a compact part of space. Boxes around runs of eight are smaller than on a
Morton curve, which jumps: rays enter two fifths fewer of them.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, inlined, kernel
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.records import REAL_OF
from glassplat.kernels.trace.steps import WIDTH


def level_offsets(count: int) -> list[int]:
    """Start of each level's nodes over `count` Gaussians, leaves first, and the end of the last level."""
    offsets = [0]
    while count > 1 or (count == 1 and len(offsets) == 1):
        count = -(-count // WIDTH)
        offsets.append(offsets[-1] + count)
    return offsets


def _half_widths(real: type, flat: bool) -> Scalar:
    """Builds the half widths (x, y, z) of a Gaussian's box, from its frame and its extent in standard deviations.

    They include the rounding error of the box's faces.
    """
    zero, one, slack = real(0.0), real(1.0), real(2.0 * np.finfo(real).eps)

    @inlined
    def squares(frames, g, axis):
        x, y, z = frames[g, axis, 0], frames[g, axis, 1], frames[g, axis, 2]
        # A row is an axis divided by its deviation; divided by its squared length, it is the axis times the deviation.
        inverse = one / (x * x + y * y + z * z)
        x, y, z = x * inverse, y * inverse, z * inverse
        return x * x, y * y, z * z

    @inlined
    def half_widths(means, frames, g, extent):
        u, v = squares(frames, g, 0), squares(frames, g, 1)
        w = (zero, zero, zero) if flat else squares(frames, g, 2)
        x, y, z = u[0] + v[0] + w[0], u[1] + v[1] + w[1], u[2] + v[2] + w[2]
        return (
            extent * real(math.sqrt(x)) + slack * abs(means[g, 0]),
            extent * real(math.sqrt(y)) + slack * abs(means[g, 1]),
            extent * real(math.sqrt(z)) + slack * abs(means[g, 2]),
        )

    return half_widths


def build_fit_leaf(real: type, flat: bool) -> Scalar:
    """Builds the step that fits the empty box at position k of a leaf to a Gaussian that rays can hit."""
    zero, nowhere, half_widths = real(0.0), real("inf"), _half_widths(real, flat)

    @inlined
    def fit_leaf(means, frames, extents, g, boxes, node, k):
        if not extents[g] > zero:
            return
        x, y, z = half_widths(means, frames, g, extents[g])
        # NaN and infinity fail the comparison, which leaves the box empty.
        if abs(means[g, 0]) + x < nowhere:
            boxes[node, 0, k], boxes[node, 3, k] = means[g, 0] - x, means[g, 0] + x
        if abs(means[g, 1]) + y < nowhere:
            boxes[node, 1, k], boxes[node, 4, k] = means[g, 1] - y, means[g, 1] + y
        if abs(means[g, 2]) + z < nowhere:
            boxes[node, 2, k], boxes[node, 5, k] = means[g, 2] - z, means[g, 2] + z

    return fit_leaf


BITS = 20
"""Bits per axis."""
CHUNK = 1024
"""Points per task."""


def hilbert_codes(points: Tensor) -> Tensor:
    """Positions [N] int64 of points [N, 3] along the Hilbert curve through their bounding cube.

    What is not finite comes last.
    """
    cells, finite = curve_cells(points)
    positions = torch.empty(len(points), dtype=torch.int64)
    hilbert_positions(REAL_OF[points.dtype])(cells, positions)
    return torch.where(finite, positions, torch.iinfo(torch.int64).max)


def curve_cells(points: Tensor) -> tuple[Tensor, Tensor]:
    """Cells [N, 3] int64 of points in a grid over the bounding cube of the finite ones, and a mask [N] of these.

    Runs on any device, without synchronisation.
    """
    finite = points.isfinite().all(dim=1)
    if not len(points):
        return points.long(), finite
    lowest = torch.where(finite[:, None], points, torch.inf).amin(dim=0)
    size = (torch.where(finite[:, None], points, -torch.inf).amax(dim=0) - lowest).amax().double()
    scale = torch.where(size > 0, (2**BITS - 1) / size, 0.0)
    cells = ((points - lowest).double() * scale).nan_to_num(0.0, 0.0, 0.0).long()
    return cells, finite


@inlined
def hilbert_axes(x, y, z):
    """Coordinates transformed, from the largest cube to the smallest, to the axes of the curve within it.

    In each cube the curve enters and leaves at corners that lie along one edge; reflecting and exchanging axes brings
    every cube into that position (Skilling 2004).
    """
    bit = np.int64(1 << (BITS - 1))
    while bit > 1:
        below = bit - 1
        if x & bit:
            x ^= below
        if y & bit:
            x ^= below
        else:
            differ = (x ^ y) & below
            x, y = x ^ differ, y ^ differ
        if z & bit:
            x ^= below
        else:
            differ = (x ^ z) & below
            x, z = x ^ differ, z ^ differ
        bit >>= 1
    y ^= x
    z ^= y
    turned, bit = np.int64(0), np.int64(1 << (BITS - 1))
    while bit > 1:
        if z & bit:
            turned ^= bit - 1
        bit >>= 1
    return x ^ turned, y ^ turned, z ^ turned


@inlined
def curve_position(x, y, z):
    """Position of a cell along the curve."""
    x, y, z = hilbert_axes(x, y, z)
    place = np.int64(0)
    for j in range(BITS):
        shift = BITS - 1 - j
        place = (place << 3) | ((x >> shift & 1) << 2) | ((y >> shift & 1) << 1) | (z >> shift & 1)
    return place


@cache
def hilbert_positions(real: type) -> Kernel:
    """Fills the positions of cells along the curve."""

    @kernel("hilbert_positions", real)
    def fill(cells: NDArray[Any], positions: NDArray[Any]) -> None:
        count = positions.size
        for chunk in prange((count + CHUNK - 1) // CHUNK):
            for i in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                positions[i] = curve_position(cells[i, 0], cells[i, 1], cells[i, 2])

    return fill


MORTON_BITS = 21
"""Bits per axis; three axes fit into a signed 64-bit integer."""
_SPREADS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


@torch.no_grad()
def morton_codes(means: Tensor) -> Tensor:
    """Positions [N] int64 of points [N, 3] along a Morton curve (Z-order) through their bounding cube.

    What is not finite comes last.
    """
    finite = means.isfinite().all(dim=1)
    if not bool(finite.any()):
        return torch.zeros(means.shape[0], dtype=torch.int64, device=means.device)
    lowest, highest = means[finite].amin(dim=0), means[finite].amax(dim=0)
    size = (highest - lowest).amax().clamp(min=torch.finfo(means.dtype).tiny)
    cells = (
        ((means - lowest).double() / size.double() * (2**MORTON_BITS - 1))
        .nan_to_num()
        .long()
        .clamp(0, 2**MORTON_BITS - 1)
    )
    for shift, mask in _SPREADS:
        cells = (cells | (cells << shift)) & mask
    codes = cells[:, 0] | (cells[:, 1] << 1) | (cells[:, 2] << 2)
    return torch.where(finite, codes, torch.iinfo(torch.int64).max)
