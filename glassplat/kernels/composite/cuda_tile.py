"""What the blending kernels share: a tile's pixels, its splats in shared memory, and how much they cover."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from glassplat.kernels.composite.cpu_tile import tile_functions
from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.maths.blending import Scalar, blend_maths
from glassplat.kernels.splats import TILE

PIXELS = TILE * TILE

BUCKET = 32
"""Consecutive pairs of a tile that a warp takes in the backward pass, one for each lane.

Bucket `k` of the n-th active tile, whose pairs begin at `start`, has the number `start // BUCKET + n + k`, which no
other bucket has.
"""

# Rows of a splat's geometry in shared memory; the mean is relative to the tile's corner.
MEAN_X, MEAN_Y, FORM_XX, FORM_XY, FORM_YY, OPACITY, GEOMETRY = 0, 1, 2, 3, 4, 5, 6
FIRST, LAST, MEMBER, MEMBERSHIP = 0, 1, 2, 3
"""Rows of what is an integer: first and one-past-last row of pixels that a splat reaches, and its index."""


class TileFunctions(NamedTuple):
    """Compiled steps that every blending kernel takes.

    Attributes:
        place: camera, first column, first row, columns and rows of a tile.
        load: copies one splat into column `i` of the shared arrays.
        coverage: opacity times falloff of splat `i` at a pixel of the tile; 0 in rows that it does not reach.
    """

    place: Scalar
    load: Scalar
    coverage: Scalar


def tile_steps(real: type) -> TileFunctions:
    """Builds the functions for `real`, np.float32 or np.float64."""
    return TileFunctions(tile_functions(real).place, _load(real), _coverage(real))


def _load(real: type) -> Scalar:
    maths = blend_maths(real)
    screen_form, vertical_reach, row_range = maths.screen_form, maths.vertical_reach, maths.row_range

    @inlined
    def load(geometry, membership, i, s, means, conics, opacities, x0, y0, num_rows):
        xx, xy, yy, opacity = conics[s, 0], conics[s, 1], conics[s, 2], opacities[s]
        mean_y = means[s, 1] - real(y0)
        geometry[MEAN_X, i], geometry[MEAN_Y, i] = means[s, 0] - real(x0), mean_y
        geometry[FORM_XX, i], geometry[FORM_XY, i], geometry[FORM_YY, i] = screen_form(xx, xy, yy)
        geometry[OPACITY, i] = opacity
        first, last = row_range(mean_y, vertical_reach(xx, xy, yy, opacity), num_rows)
        membership[FIRST, i], membership[LAST, i], membership[MEMBER, i] = first, last, s

    return load


def _coverage(real: type) -> Scalar:
    exp2 = blend_maths(real).exp2
    zero, half = real(0.0), real(0.5)

    @inlined
    def coverage(geometry, membership, i, column, row):
        if row < membership[FIRST, i] or row >= membership[LAST, i]:
            return zero
        dx = real(np.int32(column)) + half - geometry[MEAN_X, i]
        dy = real(np.int32(row)) + half - geometry[MEAN_Y, i]
        linear, constant = geometry[FORM_XY, i] * dy, geometry[FORM_YY, i] * dy * dy
        return geometry[OPACITY, i] * exp2((geometry[FORM_XX, i] * dx + linear) * dx + constant)

    return coverage
