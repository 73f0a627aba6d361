"""A tile's pixels on the GPU, its splats in shared memory, their coverage, and the rows of their gradients.

A row of a (tile, splat) pair holds sums over a tile's pixels: of g dx, g dy, g dx^2, g dx dy, g dy^2 and g, then one
value per channel, and the two of `absgrad` if requested. Here g is the gradient of the exponent of the splat's falloff,
and (dx, dy) the offset from its centre. All of these are summed over tiles; the gradients of mean, conic and opacity
are computed from the sums once per splat.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, kernel
from glassplat.kernels.backend.devices import SIMULATED
from glassplat.kernels.maths.blending import Scalar, build_reached_rows, build_screen_form
from glassplat.kernels.maths.fast_maths import exp2_maths, fused_maths
from glassplat.kernels.records import REAL_OF, TILE, Splats, TileBins

PIXELS = TILE * TILE

BUCKET = 32
"""Consecutive pairs of a tile that a warp processes in the backward pass, one per lane.

Bucket `k` of the n-th active tile, whose pairs begin at `start`, has the unique number `start // BUCKET + n + k`.
"""

MEAN_X, MEAN_Y, FORM_XX, FORM_XY, FORM_YY, OPACITY, COLUMNS = 0, 1, 2, 3, 4, 5, 8
"""Columns of a splat's geometry; the mean is relative to the centre of the tile's first pixel. Eight columns, so that
one load fetches four."""

# Indices are unsigned, because Numba supports negative ones by wrapping, which costs three instructions each.
at = np.uint64

ALIGNMENT = None if SIMULATED else 16
"""Bytes per load from shared memory; the simulator does not support alignment."""


def tile_steps(real: type) -> tuple[Scalar, Scalar]:
    """Builds the steps shared by all blending kernels: `load` and `coverage`."""
    screen_form, reached_rows = build_screen_form(real), build_reached_rows(real)
    exp2, fused, half = exp2_maths(real), fused_maths(), real(0.5)

    @inlined
    def load(geometry, i, s, means, conics, opacities, x0, y0, num_rows):
        """Copies a splat's geometry to row `i` of an array; returns the rows of pixels that it reaches, as bits."""
        xx, xy, yy, opacity = conics[s, 0], conics[s, 1], conics[s, 2], opacities[s]
        mean_y = means[s, 1] - real(y0)
        geometry[i, MEAN_X], geometry[i, MEAN_Y] = means[s, 0] - real(x0) - half, mean_y - half
        geometry[i, FORM_XX], geometry[i, FORM_XY], geometry[i, FORM_YY] = screen_form(xx, xy, yy)
        geometry[i, OPACITY] = opacity
        return reached_rows(mean_y, xx, xy, yy, opacity, num_rows)

    @inlined
    def coverage(geometry, i, x, y):
        """Opacity times falloff of the splat in row `i` at the pixel in column x and row y of the tile."""
        dx, dy = x - geometry[i, MEAN_X], y - geometry[i, MEAN_Y]
        # Explicit fused operations, because the compiler would fuse differently in each kernel: a splat at exactly
        # 1/255 could be in the image and not in its gradient.
        along = fused(geometry[i, FORM_XX], dx, geometry[i, FORM_XY] * dy)
        exponent = fused(along, dx, geometry[i, FORM_YY] * dy * dy)
        return geometry[i, OPACITY] * exp2(exponent)

    return load, coverage


SUM_THREADS = 256
MOMENTS = 6


def new_pair_rows(bins: TileBins, channels: Tensor, with_absgrad: bool) -> Tensor:
    """One gradient row per pair [P, 6 + D, + 2 of absgrad], all zero; tiles fill the rows of blended pairs."""
    return channels.new_zeros(len(bins.pair_splats), MOMENTS + channels.shape[2] + (2 if with_absgrad else 0))


def sum_pair_rows(
    rows: Tensor, bins: TileBins, splats: Splats, num_values: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Sums over tiles: gradients of means2d, conics, opacities, values [C, G, num_values], absgrad [C, G, 2 or 0]."""
    shape, width = tuple(splats.opacities.shape), rows.shape[1]
    count = shape[0] * shape[1]
    found = [rows.new_empty(count, *rest) for rest in ((2,), (3,), (), (num_values,), (width - MOMENTS - num_values,))]
    given = (rows, bins.pair_slots, bins.splat_offsets, splats.conics.view(-1, 3), splats.opacities.view(-1))
    sum_rows(REAL_OF[rows.dtype]).over(count * width, *given, *found, threads=SUM_THREADS)
    v_means, v_conics, v_opacities, v_values, v_absgrad = (tensor.view(*shape, *tensor.shape[1:]) for tensor in found)
    return v_means, v_conics, v_opacities, v_values, v_absgrad


@cache
def sum_rows(real: type) -> Kernel:
    """Sums rows with one thread per column and splat, so that neighbouring threads read neighbouring numbers."""
    zero, half = real(0.0), real(0.5)

    @kernel("sum_pair_rows", real, "real2 int1 long1 real2 real1 real2 real2 real1 real2 real2")
    def sum_up(rows, slots, offsets, conics, opacities, v_means, v_conics, v_opacities, v_values, v_absgrad):
        i, width = cuda.grid(1), rows.shape[1]
        s, column = i // width, i % width
        if s >= opacities.size:
            return
        total, other = zero, zero
        for k in range(offsets[s], offsets[s + 1]):
            total += rows[slots[k], column]
            if column < 2:
                other += rows[slots[k], 1 - column]
        if column < 2:
            # q = xx dx^2 + 2 xy dx dy + yy dy^2, and the exponent is -q / 2.
            v_means[s, column] = conics[s, 2 * column] * total + conics[s, 1] * other
        elif column < 5:
            v_conics[s, column - 2] = -total if column == 3 else -half * total
        elif column == 5:
            v_opacities[s] = total / opacities[s] if total != zero else zero
        elif column < MOMENTS + v_values.shape[1]:
            v_values[s, column - MOMENTS] = total
        else:
            v_absgrad[s, column - MOMENTS - v_values.shape[1]] = total

    return sum_up
