"""Places along Hilbert's curve, on which any run of points fills a compact part of space.

Boxes around runs of eight are smaller than along a Morton curve, which leaps: rays enter two fifths fewer of them.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.tensor_checks import REAL_OF

BITS = 20
"""Bits for each axis."""
CHUNK = 1024
"""Points per task."""


def hilbert_codes(points: Tensor) -> Tensor:
    """[N] int64: place of each point [N, 3] along the curve through their bounding cube.

    What is not finite comes last.
    """
    cells, finite = curve_cells(points)
    places = torch.empty(len(points), dtype=torch.int64)
    hilbert_places(REAL_OF[points.dtype])(cells.numpy(), places.numpy())
    return torch.where(finite, places, torch.iinfo(torch.int64).max)


def curve_cells(points: Tensor) -> tuple[Tensor, Tensor]:
    """[N, 3] int64 cells of a grid over the finite points' bounding cube, and [N] which ones are finite.

    On any device, and without asking it for a number.
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
def unfolded(x, y, z):  # type: ignore[no-untyped-def]
    """Coordinates turned, from the largest cube to the smallest, into the axes of the curve within it.

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
def curve_place(x, y, z):  # type: ignore[no-untyped-def]
    """The place of a cell along the curve."""
    x, y, z = unfolded(x, y, z)
    place = np.int64(0)
    for j in range(BITS):
        shift = BITS - 1 - j
        place = (place << 3) | ((x >> shift & 1) << 2) | ((y >> shift & 1) << 1) | (z >> shift & 1)
    return place


@cache
def hilbert_places(real: type) -> Kernel:
    """Fills the places of cells along the curve."""

    @kernel("hilbert_places", real)
    def fill(cells: NDArray[Any], places: NDArray[Any]) -> None:
        count = places.size
        for chunk in prange((count + CHUNK - 1) // CHUNK):
            for i in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                places[i] = curve_place(cells[i, 0], cells[i, 1], cells[i, 2])

    return fill
