"""Gradients of blending on the GPU, tile by tile and back to front.

A batch of splats is taken off the pixels first, one thread for each pixel, which leaves two numbers for each pixel and
splat in shared memory: what the splat's falloff there gets as gradient, and its weight. Then the threads change sides:
each sums one column of one splat's gradient over all pixels. There is no atomic, and no sum across threads; one
gradient row is written per (tile, splat) pair, and the rows of each splat are summed afterwards in a fixed order.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import cuda

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.cuda.launch import Kernel, kernel
from glassplat.kernels.cuda.pair_gradients import MOMENTS
from glassplat.kernels.cuda.tile import GEOMETRY, MEAN_X, MEAN_Y, MEMBER, MEMBERSHIP, PIXELS, tile_steps
from glassplat.kernels.maths_blend import ALPHA_MAX, Scalar, blend_maths
from glassplat.kernels.splats import TILE

# Splats of a batch; two arrays of 256 pixels x (batch + 1) have to fit in 48 KiB. The extra column keeps threads that
# write the same splat for different pixels in different banks.
BATCH: dict[type, int] = {np.float32: 16, np.float64: 8}


def _moment(real: type) -> Scalar:
    zero, one, half = real(0.0), real(1.0), real(0.5)

    @inlined
    def moment(gains, geometry, b, which, columns, rows):
        """Sum over the pixels of gain dx^i dy^j, (i, j) = (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (0, 0)."""
        # Each factor is one or the offset, chosen once, so that all threads take the same path through the loops.
        x_1 = one if which == 0 or which == 2 or which == 3 else zero
        x_2 = one if which == 2 else zero
        y_1 = one if which == 1 or which == 3 or which == 4 else zero
        y_2 = one if which == 4 else zero
        total = zero
        for row in range(rows):
            dy = real(np.int32(row)) + half - geometry[MEAN_Y, b]
            in_row = zero
            for column in range(columns):
                dx = real(np.int32(column)) + half - geometry[MEAN_X, b]
                in_row += gains[row * TILE + column, b] * (one - x_1 + x_1 * dx) * (one - x_2 + x_2 * dx)
            total += in_row * (one - y_1 + y_1 * dy) * (one - y_2 + y_2 * dy)
        return total

    return moment


def _value(real: type) -> Scalar:
    zero = real(0.0)

    @inlined
    def value(weights, b, d, value, deviates, center, v_image, v_deviation, camera, x0, y0, columns, rows):
        """Sum over the pixels of a splat's weight times the gradient of channel d."""
        total = zero
        for row in range(rows):
            for column in range(columns):
                pull = v_image[camera, y0 + row, x0 + column, d]
                if deviates:
                    difference = value - center[camera, y0 + row, x0 + column]
                    slope = v_deviation[camera, y0 + row, x0 + column]
                    if difference != zero:
                        pull += slope if difference > zero else -slope
                total += weights[row * TILE + column, b] * pull
        return total

    return value


@cache
def composite_backward(real: type, num_channels: int = 4) -> Kernel:
    """Fills one gradient row per pair that any pixel blended; all rows start at zero."""
    place, load, coverage = tile_steps(real)
    clipped_alpha = blend_maths(real).clipped_alpha
    sum_moment, sum_value = _moment(real), _value(real)
    zero, one, alpha_max, batch = real(0.0), real(1.0), real(ALPHA_MAX), BATCH[real]
    lanes, width, padded = PIXELS // batch, MOMENTS + num_channels, batch + 1

    @kernel(
        f"composite_backward_{num_channels}",
        real,
        "real2 real2 real1 real2 real2 int int int int1 long1 int1 real3 int3 int1 real3 real4 real3 real3 real3 real2",
        bounds=(PIXELS, 2),
    )
    def backward(
        means, conics, opacities, channels, marks, splats_per_camera, num_primary, channel,
        pair_splats, tile_offsets, active, final, last, looked_at, center,
        v_image, v_alpha, v_mask, v_deviation, out,
    ):  # fmt: skip
        gains = cuda.shared.array((PIXELS, padded), real)
        weights = cuda.shared.array((PIXELS, padded), real)
        geometry = cuda.shared.array((GEOMETRY, batch), real)
        membership = cuda.shared.array((MEMBERSHIP, batch), np.int32)
        v = cuda.local.array(num_channels, real)
        n, pixel = cuda.blockIdx.x, cuda.threadIdx.x
        camera, x0, y0, columns, rows = place(active[n], v_image.shape[2], v_image.shape[1])
        column, row = pixel % TILE, pixel // TILE
        t, t_glass = final[n, 0, pixel], final[n, 1, pixel]
        last_order, last_glass = last[n, 0, pixel], last[n, 1, pixel]
        behind, behind_glass, v_shown, v_spread, middle = zero, zero, zero, zero, zero
        for d in range(num_channels):
            v[d] = zero
        if column < columns and row < rows:
            y, x = y0 + row, x0 + column
            # alpha = 1 - T: its gradient acts like something behind every splat.
            behind, v_shown = -v_alpha[camera, y, x] * t, v_mask[camera, y, x]
            if channel >= 0:
                v_spread, middle = v_deviation[camera, y, x], center[camera, y, x]
            for d in range(num_channels):
                v[d] = v_image[camera, y, x, d]
        first_glass, start = camera * splats_per_camera + num_primary, tile_offsets[active[n]]
        for done in range(0, looked_at[n], batch):
            # Splat b of the batch is the b-th from the back.
            nearest, count = looked_at[n] - 1 - done, min(batch, looked_at[n] - done)
            cuda.syncthreads()
            if pixel < count:
                s = pair_splats[start + nearest - pixel]
                load(geometry, membership, pixel, s, means, conics, opacities, x0, y0, rows)
            cuda.syncthreads()
            for b in range(count):
                gain, weight, order, s = zero, zero, nearest - b, membership[MEMBER, b]
                if order <= (last_order if s < first_glass else last_glass):
                    covered = coverage(geometry, membership, b, column, row)
                    a = clipped_alpha(covered)
                    inverse = one / (one - a)
                    if s < first_glass and a > zero:
                        t *= inverse
                        weight = a * t
                        dot = v_spread * abs(channels[s, max(channel, 0)] - middle)
                        for d in range(num_channels):
                            dot += v[d] * channels[s, d]
                        gain = (t * dot - behind * inverse) * a
                        behind += weight * dot
                    elif a > zero:
                        t_glass *= inverse
                        mark, v_mark = marks[camera, s - first_glass], v_shown * t * t_glass
                        weight = a * v_mark
                        gain = (v_mark * mark - behind_glass * inverse) * a
                        behind_glass += weight * mark
                        behind += weight * mark
                    if not covered < alpha_max:
                        gain = zero
                gains[pixel, b], weights[pixel, b] = gain, weight
            cuda.syncthreads()
            b = pixel % batch
            if b < count:
                s = membership[MEMBER, b]
                for which in range(pixel // batch, width, lanes):
                    d = which - MOMENTS
                    if d < 0:
                        out[start + nearest - b, which] = sum_moment(gains, geometry, b, which, columns, rows)
                    elif s < first_glass:
                        out[start + nearest - b, which] = sum_value(
                            weights, b, d, channels[s, d], d == channel, center, v_image, v_deviation,
                            camera, x0, y0, columns, rows,
                        )  # fmt: skip
                    elif d == 0:
                        # The weights of a glass splat hold the gradient of its mark.
                        total = zero
                        for i in range(PIXELS):
                            total += weights[i, b]
                        out[start + nearest - b, which] = total

    return backward
