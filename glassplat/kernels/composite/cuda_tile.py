"""What the blending kernels share: a tile's pixels, its splats in shared memory, and how much they cover."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.devices import SIMULATED
from glassplat.kernels.composite.cpu_tile import tile_functions
from glassplat.kernels.maths.blending import Scalar, blend_maths
from glassplat.kernels.maths.fast_maths import exp2_maths, fused_maths
from glassplat.kernels.records import TILE

PIXELS = TILE * TILE

BUCKET = 32
"""Consecutive pairs of a tile that a warp takes in the backward pass, one for each lane.

Bucket `k` of the n-th active tile, whose pairs begin at `start`, has the number `start // BUCKET + n + k`, which no
other bucket has.
"""

MEAN_X, MEAN_Y, FORM_XX, FORM_XY, FORM_YY, OPACITY, COLUMNS = 0, 1, 2, 3, 4, 5, 8
"""Columns of a splat's geometry; the mean is relative to the centre of the tile's first pixel. Eight, so that one load
fetches four."""

# Indices are unsigned, because Numba lets signed ones count from the end, which costs three instructions each.
at = np.uint64

ALIGNMENT = None if SIMULATED else 16
"""Bytes that one load fetches of shared memory; the simulator takes none."""


class TileFunctions(NamedTuple):
    """Compiled steps that every blending kernel takes.

    Attributes:
        place: camera, first column, first row, columns and rows of a tile.
        load: copies one splat's geometry into row `i` of an array, and returns the rows of pixels that it reaches, a
            bit for each.
        coverage: opacity times falloff of the splat in row `i` at the pixel in column x and row y of the tile.
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

    half = real(0.5)

    @inlined
    def load(geometry, i, s, means, conics, opacities, x0, y0, num_rows):
        xx, xy, yy, opacity = conics[s, 0], conics[s, 1], conics[s, 2], opacities[s]
        mean_y = means[s, 1] - real(y0)
        geometry[i, MEAN_X], geometry[i, MEAN_Y] = means[s, 0] - real(x0) - half, mean_y - half
        geometry[i, FORM_XX], geometry[i, FORM_XY], geometry[i, FORM_YY] = screen_form(xx, xy, yy)
        geometry[i, OPACITY] = opacity
        first, last = row_range(mean_y, vertical_reach(xx, xy, yy, opacity), num_rows)
        return np.int32((1 << last) - (1 << first))

    return load


def _coverage(real: type) -> Scalar:
    exp2, fused = exp2_maths(real), fused_maths()

    @inlined
    def coverage(geometry, i, x, y):
        dx, dy = x - geometry[i, MEAN_X], y - geometry[i, MEAN_Y]
        # Written out, because the compiler would choose anew in every kernel which products and sums to fuse: a splat
        # at exactly 1/255 could be in the image and not in its gradient.
        along = fused(geometry[i, FORM_XX], dx, geometry[i, FORM_XY] * dy)
        exponent = fused(along, dx, geometry[i, FORM_YY] * dy * dy)
        return geometry[i, OPACITY] * exp2(exponent)

    return coverage
