"""What the kernels that blend discs on a GPU share: a tile's discs in shared memory, and how much they cover."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.composite.cuda_tile import PIXELS
from glassplat.kernels.maths.blending import ALPHA_MIN, Scalar, blend_maths
from glassplat.kernels.maths.fast_maths import exp2_maths, fused_maths, reciprocal_maths
from glassplat.kernels.maths.ray_hit import MOST_DEVIATIONS

CENTER_X, CENTER_Y, U_X, U_Y, V_X, V_Y, W_X, W_Y, OPACITY, DEPTH, INVERSE_DEPTH, COLUMNS = range(12)
"""Columns of a disc's geometry; the centre is relative to that of the tile's first pixel."""

# Planes of what a tile's pixels end with, and with `LAST` and `MEDIAN` of the pairs that decided it.
T, FIRST, TOTAL, SQUARES, FINALS = range(5)
LAST, MEDIAN, ORDERS = range(3)

# Planes of what a pixel had gathered before a bucket, the channels after them.
KEPT_T, KEPT_DEPTH, KEPT_TOTAL, KEPT_SQUARES, KEPT_VALUES = range(5)

__all__ = ["PIXELS", "DiscTileFunctions", "disc_tile_steps"]


class DiscTileFunctions(NamedTuple):
    """Compiled steps.

    Attributes:
        load: copies one disc's geometry into row `i` of an array, and returns the rows of pixels that its outline
            reaches, a bit for each.
        cover: ((dx, dy), (u, v, 1 / e), e, coverage, on the disc itself) of the disc in row `i` and the pixel in column
            x and row y of the tile, as `cpu_tile.DiscFunctions.cover`.
    """

    load: Scalar
    cover: Scalar


def disc_tile_steps(real: type) -> DiscTileFunctions:
    """Builds the functions for `real`, np.float32 or np.float64."""
    return DiscTileFunctions(_load(real), _cover(real))


def _load(real: type) -> Scalar:
    maths = blend_maths(real)
    vertical_reach, row_range = maths.vertical_reach, maths.row_range
    zero, half, one, endless, alpha_min = real(0.0), real(0.5), real(1.0), real(np.inf), real(ALPHA_MIN)

    @inlined
    def load(geometry, i, s, means, maps, opacities, depths, centers, conics, x0, y0, num_rows):
        opacity, depth, total = opacities[s], depths[s], means[s, 0] + means[s, 1] + depths[s]
        geometry[i, CENTER_X], geometry[i, CENTER_Y] = means[s, 0] - real(x0) - half, means[s, 1] - real(y0) - half
        for j in range(6):
            geometry[i, U_X + j] = maps[s, j]
            total += maps[s, j]
        geometry[i, OPACITY], geometry[i, DEPTH], geometry[i, INVERSE_DEPTH] = opacity, depth, one / depth
        # Written so that NaN anywhere ends in "reaches nothing".
        if not (abs(total) < endless and alpha_min <= opacity < endless and zero < depth):
            return np.int32(0)
        if conics[s, 0] == zero and conics[s, 1] == zero and conics[s, 2] == zero:
            # It crosses the near plane and may reach any row.
            return np.int32((1 << num_rows) - 1)
        reach = vertical_reach(conics[s, 0], conics[s, 1], conics[s, 2], opacity)
        first, last = row_range(centers[s, 1] - real(y0), reach, num_rows)
        return np.int32((1 << last) - (1 << first))

    return load


def _cover(real: type) -> Scalar:
    exp2, fused, reciprocal = exp2_maths(real), fused_maths(), reciprocal_maths(real)
    zero, one, farthest, far = real(0.0), real(1.0), real(MOST_DEVIATIONS**2), real(4 * MOST_DEVIATIONS**2)
    half_bits, alpha_min = real(-0.5 / math.log(2.0)), real(ALPHA_MIN)

    @inlined
    def cover(geometry, i, x, y, near, sharpness):
        dx, dy = x - geometry[i, CENTER_X], y - geometry[i, CENTER_Y]
        # Written out, because the compiler would choose anew in every kernel which products and sums to fuse: a disc
        # at exactly 1/255 could be in the image and not in its gradient.
        e = fused(dx, geometry[i, W_X], fused(dy, geometry[i, W_Y], one))
        inverse, solid = one, far
        u, v = zero, zero
        if e > zero and geometry[i, DEPTH] > near * e:
            inverse = reciprocal(e)
            u = fused(dx, geometry[i, U_X], dy * geometry[i, U_Y]) * inverse
            v = fused(dx, geometry[i, V_X], dy * geometry[i, V_Y]) * inverse
            solid = fused(u, u, v * v)
            solid = solid if solid <= farthest else far
        around = fused(dx, dx, dy * dy) * sharpness
        on_disc = solid <= farthest and not around < solid
        q = solid if on_disc else around
        covered = geometry[i, OPACITY] * exp2(q * half_bits) if q <= farthest else zero
        covered = covered if covered >= alpha_min else zero
        if not on_disc:
            u, v, inverse, e = zero, zero, one, one
        return (dx, dy), (u, v, inverse), e, covered, on_disc

    return cover
